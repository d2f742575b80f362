"""Better or not published: candidate and base on the same views, with an interval."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

CONFIDENCE = 0.95
FILE = "decision.json"


@dataclass(frozen=True)
class Paired:
    """DSSIM over the same views: means, and the mean of candidate - base with its interval.

    `low` and `high` bound that mean with `CONFIDENCE` by Student's t over the views' differences
    (Student, The probable error of a mean, 1908), which are near normal where views are alike.
    Of a single view they are None. `noise` is the part of the error that the references' own noise
    explains (`judging.floor`), where that is known: no candidate gets below it.
    """

    views: int
    base: float
    candidate: float
    difference: float
    low: float | None
    high: float | None
    noise: float | None = None

    @classmethod
    def of(
        cls, base: Sequence[float], candidate: Sequence[float], noise: Sequence[float] = ()
    ) -> Paired:
        """Of two equally long lists, at least one view each."""
        from scipy import stats

        before, after = np.asarray(base, np.float64), np.asarray(candidate, np.float64)
        difference = after - before
        mean = float(difference.mean())
        means = len(difference), float(before.mean()), float(after.mean()), mean
        floor = float(np.mean(noise)) if len(noise) else None
        if len(difference) < 2:
            return cls(*means, None, None, floor)
        error = float(difference.std(ddof=1)) / len(difference) ** 0.5
        reach = float(stats.t.ppf((1 + CONFIDENCE) / 2, len(difference) - 1)) * error
        return cls(*means, mean - reach, mean + reach, floor)

    @property
    def change(self) -> float:
        """The difference as a share of the base's error."""
        return self.difference / self.base

    def told(self) -> str:
        """For people: the candidate's error, its change, and the interval."""
        sure = ""
        if self.low is not None and self.high is not None:
            low, high = (100 * bound / self.base for bound in (self.low, self.high))
            sure = f", {CONFIDENCE:.0%} sure of {low:+.1f} to {high:+.1f} %"
        change = f"{100 * self.change:+.1f} %{sure}"
        floor = "" if self.noise is None else f", of which noise {self.noise:.4f}"
        return f"DSSIM {self.candidate:.4f} after {self.base:.4f} ({change}{floor})"


@dataclass(frozen=True)
class Verdict:
    """What was measured, and whether that is enough. `speed` is the ratio of run times."""

    own: Paired
    test: Mapping[str, Paired]
    speed: float
    worse: float
    slower: float

    @property
    def objections(self) -> list[str]:
        """Why it isn't published, each as the end of a sentence; none if it is."""
        found = []
        if self.own.high is None or self.own.high >= 0:
            found.append("on views that neither saw it isn't surely better")
        for name, test in self.test.items():
            if test.change > self.worse:
                found.append(
                    f"on {name} it is {100 * test.change:.1f} % worse, {100 * self.worse:g} % are "
                    "allowed"
                )
        if self.speed > self.slower:
            found.append(f"it takes {self.speed:.2f} x as long, {self.slower:g} x are allowed")
        return found

    @property
    def better(self) -> bool:
        """Whether it may be published."""
        return not self.objections

    def sentence(self) -> str:
        """The decision with its numbers, for people."""
        tests = "".join(
            f"; on {test.views} views of {name} {100 * test.change:+.1f} %"
            for name, test in self.test.items()
        )
        reason = "" if self.better else f": {'; '.join(self.objections)}"
        return (
            f"{'better' if self.better else 'not published'}{reason}. On {self.own.views} views "
            f"that neither saw {self.own.told()}{tests}; {self.speed:.2f} x the time."
        )

    def document(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "better": self.better,
            "objections": self.objections,
            "sentence": self.sentence(),
            "own": asdict(self.own) | {"change": self.own.change},
            "test": {n: asdict(t) | {"change": t.change} for n, t in self.test.items()},
            "speed": self.speed,
            "allowed": {"worse": self.worse, "slower": self.slower},
            "confidence": CONFIDENCE,
        }
