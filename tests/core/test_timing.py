"""Turns, medians, ratios."""

from __future__ import annotations

import statistics

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepshade.timing import Pace, alternate, ratio, spread

values = st.floats(1e-3, 1e6)


@given(st.lists(values, min_size=2, max_size=40))
def test_the_spread_is_that_of_the_standard_library(numbers: list[float]) -> None:
    low, middle, high = statistics.quantiles(numbers, n=4, method="inclusive")
    found = spread(numbers)
    assert [*found["quartiles"], found["median"]] == pytest.approx([low, high, middle], rel=6e-6)


@given(st.lists(values, min_size=1, max_size=20), st.floats(0.5, 50))
def test_what_both_suffer_cancels_in_a_ratio(numbers: list[float], factor: float) -> None:
    found = ratio([factor * value for value in numbers], numbers)
    assert found["median"] == pytest.approx(factor, rel=1e-5)
    with pytest.raises(ValueError, match="no values"):
        ratio([], [])


class Clock:
    """Time that only passes when a task takes it."""

    def __init__(self) -> None:
        self.now = 0.0
        self.runs: list[str] = []

    def __call__(self) -> float:
        return self.now

    def task(self, name: str, seconds: float, **figures: float) -> object:
        def run() -> object:
            self.runs.append(name)
            self.now += seconds
            return figures or None

        return run


def test_all_take_turns_and_each_gets_one_figure_a_round() -> None:
    clock = Clock()
    tasks = {"a": clock.task("a", 0.001), "b": clock.task("b", 0.3, parts=7.0)}
    found = alternate(tasks, Pace(1e9, 3, 5), clock=clock, pause=lambda _: None)  # type: ignore
    assert found["a"]["ms"] == pytest.approx([1.0] * 5)
    assert found["b"] == {"ms": pytest.approx([300.0] * 5), "parts": [7.0] * 5}
    turns = [name for n, name in enumerate(clock.runs) if n == 0 or clock.runs[n - 1] != name]
    assert turns.count("a") >= 4
    assert clock.runs.count("b") == 6  # once to set up, and never untimed: it is slow


def test_time_ends_the_rounds_but_not_before_the_least_number() -> None:
    for seconds, rounds in ((0.0, 3), (10.0, 10)):
        clock = Clock()
        tasks = {"b": clock.task("b", 1.0)}
        found = alternate(tasks, Pace(seconds, 3, 50), clock=clock, pause=lambda _: None)  # type: ignore
        assert len(found["b"]["ms"]) == rounds
