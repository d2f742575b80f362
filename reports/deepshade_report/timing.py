"""Timing several things side by side: alternating rounds, so that drift hits all alike."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

T = TypeVar("T")

_PAUSE = 0.004  # seconds in which the previous library's threads stop spinning
_BURST = 0.05  # seconds of one thing before it is another's turn, at least one run
_MOST = 8  # runs of a burst
_SLOW = 0.25  # seconds from which on a run needs no untimed one before it


@dataclass(frozen=True, slots=True)
class Pace:
    """How long to measure: seconds for all rounds together, and how many rounds at least, at most.

    Once `seconds` are over no new round begins, unless fewer than `fewest` were made.
    """

    seconds: float
    fewest: int = 3
    most: int = 20


def alternate(
    tasks: Mapping[str, Callable[[], object]],
    pace: Pace,
    *,
    advance: Callable[[float, str], None] = lambda share, name: None,
    clock: Callable[[], float] = time.perf_counter,
    pause: Callable[[float], None] = time.sleep,
) -> dict[str, list[float]]:
    """Milliseconds of each task, one figure a round: the median of a short burst of runs.

    A round visits all tasks in an order of its own (seeded). Each visit begins with an untimed
    run, which loads caches and wakes threads, unless a run is long. `advance` hears the share
    that is done, 0 to 1, and which task comes next. `clock` and `pause` are for tests.
    """
    typical = {}
    for name, task in tasks.items():
        advance(0.0, name)
        task()  # the first run sets up what later ones reuse
        start = clock()
        task()
        typical[name] = max(clock() - start, 1e-7)
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for share, name in visits(list(tasks), pace, clock=clock):
        advance(share, name)
        pause(_PAUSE)
        times[name].append(_visit(tasks[name], typical[name], clock))
    return times


def visits(
    names: Sequence[T], pace: Pace, *, clock: Callable[[], float] = time.perf_counter
) -> Iterator[tuple[float, T]]:
    """Whose turn it is, round by round, each round in an order of its own (seeded).

    With each comes the share of the time that is over, 0 to 1.
    """
    order = list(names)
    shuffle = random.Random(0)
    begin = clock()
    for turn in range(pace.most):
        spent = clock() - begin
        if turn >= pace.fewest and spent + 0.5 * spent / turn > pace.seconds:
            return
        shuffle.shuffle(order)
        for number, name in enumerate(order):
            made = (turn + number / len(order)) / pace.most
            over = (clock() - begin) / max(pace.seconds, 1e-9)
            yield min(1.0, max(made, over)), name


def _visit(task: Callable[[], object], typical: float, clock: Callable[[], float]) -> float:
    if typical < _SLOW:
        task()
    runs = []
    for _ in range(max(1, min(_MOST, round(_BURST / typical)))):
        start = clock()
        task()
        runs.append(clock() - start)
    return 1e3 * sorted(runs)[len(runs) // 2]
