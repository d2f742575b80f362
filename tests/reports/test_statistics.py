"""Medians, ratios, the frontier, and rounds."""

from __future__ import annotations

import random
import statistics as stdlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepshade_report.statistics import frontier, percentile, ratio, spread
from deepshade_report.timing import Pace, alternate, visits

values = st.floats(1e-3, 1e6)


@given(st.lists(values, min_size=2, max_size=40))
def test_the_spread_is_that_of_the_standard_library(numbers: list[float]) -> None:
    low, middle, high = stdlib.quantiles(numbers, n=4, method="inclusive")
    found = spread(numbers)
    assert [*found["quartiles"], found["median"]] == pytest.approx([low, high, middle], rel=6e-6)
    assert found["least"] == pytest.approx(min(numbers), rel=6e-6)
    assert found["most"] == pytest.approx(max(numbers), rel=6e-6)
    assert found["count"] == len(numbers)


def test_nothing_has_no_spread() -> None:
    with pytest.raises(ValueError, match="no values"):
        spread([])


def test_a_ratio_ignores_drift_that_both_share() -> None:
    drift = [1.0, 1.5, 4.0, 0.7, 2.2]
    found = ratio([3 * d for d in drift], [2 * d for d in drift])
    assert found["least"] == found["most"] == 1.5


@given(st.lists(values, min_size=1, max_size=30), st.floats(0.01, 1))
def test_percentile_is_the_least_value_that_covers_the_share(
    numbers: list[float], share: float
) -> None:
    enough = [v for v in numbers if sum(w <= v for w in numbers) >= share * len(numbers) - 1e-9]
    assert percentile(numbers, share) == min(enough)


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), max_size=25))
def test_the_frontier_is_what_no_other_point_beats(points: list[tuple[int, int]]) -> None:
    def beaten(k: int) -> bool:
        x, y = points[k]
        return any(
            (a <= x and b <= y and (a, b) != (x, y)) or ((a, b) == (x, y) and n < k)
            for n, (a, b) in enumerate(points)
        )

    found = frontier([(float(x), float(y)) for x, y in points])
    assert sorted(found) == [k for k in range(len(points)) if not beaten(k)]
    assert [points[k][0] for k in found] == sorted(points[k][0] for k in found)


class Clock:
    """A clock that tasks advance, and whose speed drifts."""

    def __init__(self) -> None:
        self.now = 0.0
        self.calls: list[str] = []

    def __call__(self) -> float:
        return self.now

    def task(self, name: str, seconds: float):  # type: ignore[no-untyped-def]
        def run() -> None:
            self.calls.append(name)
            self.now += seconds * (1 + self.now / 10)

        return run


def test_rounds_alternate_so_that_drift_hits_all_alike() -> None:
    clock = Clock()
    tasks = {"a": clock.task("a", 0.02), "b": clock.task("b", 0.04)}
    times = alternate(tasks, Pace(3, most=50), clock=clock, pause=lambda _: None)
    assert len(times["a"]) == len(times["b"]) >= 8
    assert times["a"][-1] > 1.2 * times["a"][0]  # it drifted
    assert ratio(times["b"], times["a"])["median"] == pytest.approx(2, rel=0.03)


def test_time_and_rounds_are_bounded() -> None:
    clock = Clock()
    seen = []
    for share, name in visits(["a", "b"], Pace(1.0, fewest=2, most=100), clock=clock):
        assert 0 <= share <= 1
        seen.append(name)
        clock.now += 0.1
    assert 0.8 <= clock.now <= 1.3
    assert len(seen) % 2 == 0 and seen.count("a") == seen.count("b")
    assert len(list(visits(["a"], Pace(0.0, fewest=3), clock=Clock()))) == 20
    slow = Clock()
    for _ in visits(["a"], Pace(1.0, fewest=3, most=9), clock=slow):
        slow.now += 60
    assert slow.now == 180


def test_each_round_has_an_order_of_its_own() -> None:
    names = list("abcdefgh")
    order = [name for _, name in visits(names, Pace(1, fewest=4, most=4), clock=lambda: 0.0)]
    rounds = [order[k : k + 8] for k in range(0, 32, 8)]
    assert all(sorted(one) == names for one in rounds)
    assert len({tuple(one) for one in rounds}) == 4
    random.seed(1)  # somebody else's seed changes nothing
    again = [name for _, name in visits(names, Pace(1, fewest=4, most=4), clock=lambda: 0.0)]
    assert again == order


def test_long_runs_are_not_repeated_needlessly() -> None:
    clock = Clock()
    alternate({"a": clock.task("a", 2.0)}, Pace(0, fewest=2, most=2), clock=clock, pause=print)
    assert len(clock.calls) == 2 + 2
    assert np.isfinite(clock.now)
