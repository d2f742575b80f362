"""The one way that times are taken: tasks in turns, medians and quartiles over rounds."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Figures = dict[str, list[float]]  # by name, one value a round

_PAUSE = 0.004  # seconds in which the previous library's threads stop spinning
_BURST = 0.05  # seconds of one task before it is another's turn, at least one run
_MAX_RUNS = 8  # of a burst
_SLOW = 0.25  # seconds from which on a run needs no untimed one before it


@dataclass(frozen=True, slots=True)
class Pace:
    """How long to measure: no round begins after `seconds`, unless `min_rounds` weren't made."""

    seconds: float
    min_rounds: int = 3
    max_rounds: int = 20


def alternate(
    tasks: Mapping[str, Callable[[], object]],
    pace: Pace,
    *,
    advance: Callable[[float, str], None] = lambda share, name: None,
    clock: Callable[[], float] = time.perf_counter,
    pause: Callable[[float], None] = time.sleep,
) -> dict[str, Figures]:
    """Figures of each task, one value a round; "ms" are the milliseconds of a run.

    A round visits all tasks in an order of its own (seeded), so that drift of the machine hits all
    alike. A visit is a short burst of runs, of which the one of median time counts; it begins with
    an untimed run, which loads caches and wakes threads, unless a run is long. What a task returns
    as a dict are figures of its run, beside "ms" or instead of it. `advance` hears the share that
    is done, 0 to 1, and which task comes next. `clock` and `pause` are for tests.
    """

    def run(name: str) -> dict[str, float]:
        begin = clock()
        told = tasks[name]()
        ms = 1e3 * (clock() - begin)
        return {"ms": ms, **(told if isinstance(told, dict) else {})}

    typical: dict[str, float] = {}  # seconds of a run
    for name in tasks:
        advance(0.0, name)
        typical[name] = run(name)["ms"] / 1e3  # sets up what later runs reuse
        if typical[name] < _SLOW:
            typical[name] = run(name)["ms"] / 1e3
    found: dict[str, Figures] = {name: {} for name in tasks}
    order, shuffle, begin = list(tasks), random.Random(0), clock()
    for turn in range(pace.max_rounds):
        if turn >= pace.min_rounds and clock() - begin >= pace.seconds:
            break
        shuffle.shuffle(order)
        for name in order:
            advance(min(1.0, (clock() - begin) / max(pace.seconds, 1e-9)), name)
            pause(_PAUSE)
            if typical[name] < _SLOW:
                tasks[name]()
            count = max(1, min(_MAX_RUNS, round(_BURST / max(typical[name], 1e-7))))
            runs = sorted((run(name) for _ in range(count)), key=lambda figures: figures["ms"])
            for figure, value in runs[count // 2].items():
                found[name].setdefault(figure, []).append(value)
    return found


def spread(values: Sequence[float]) -> dict[str, Any]:
    """Median, quartiles (linear interpolation) and number of `values`.

    Raises ValueError without values.
    """
    if not len(values):
        raise ValueError("no values to summarise")
    low, middle, high = (significant(q) for q in np.quantile(values, [0.25, 0.5, 0.75]))
    return {"median": middle, "quartiles": [low, high], "count": len(values)}


def ratio(above: Sequence[float], below: Sequence[float]) -> dict[str, Any]:
    """The spread of above/below, round by round: what both suffer in one round cancels.

    Raises ValueError without a round.
    """
    return spread([a / b for a, b in zip(above, below, strict=True)])


def significant(value: float) -> float:
    """The value with six significant digits, for files that people read."""
    return float(f"{float(value):.6g}")
