"""Which views are learnt from, which are rehearsed, and which only judge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from deepshade.errors import DataError
from deepshade_trainer.dataset import Dataset

# Of the views: what share judges, and at least how many must, for an interval to mean something.
JUDGES = 1 / 4
MIN_JUDGES = 4


@dataclass(frozen=True)
class Parts:
    """Sample numbers in a data set whose first folders are a job's own and whose others rehearsal.

    `learnt` of its own, `judges` of its own that nothing learns from; `rehearsed` and `reminders`
    of the others alike.
    """

    learnt: list[int]
    judges: list[int]
    rehearsed: list[int]
    reminders: list[int]

    @classmethod
    def of(cls, data: Dataset, own: Sequence[str], seed: int) -> Parts:
        """By a hash of each view's seed and the job's, so that more views don't move the others.

        The turns of a view stay together. Raises DataError where there are too few views.
        """
        folders = {Path(folder).resolve() for folder in own}
        mine = [k for k, e in enumerate(data.entries) if e.path.parent.resolve() in folders]
        others = sorted(set(range(len(data.entries))) - set(mine))
        learnt, judges = _split(data, mine, seed)
        if len(learnt) < MIN_JUDGES or len(judges) < MIN_JUDGES:
            raise DataError(
                f"{len(mine)} views are too few: {MIN_JUDGES} must judge, and as many be learnt",
                fix=f"give at least {2 * MIN_JUDGES} views, better 64",
            )
        return cls(learnt, judges, *_split(data, others, seed))

    def mixed(self, share: float) -> list[int]:
        """What to draw batches from: each part repeated so that about `share` is rehearsed."""
        own, other = len(self.learnt), len(self.rehearsed)
        if not other or share == 0:
            return self.learnt
        more = other * (1 - share) / (own * share)  # times that the own must come for each other
        return self.learnt * max(1, round(more)) + self.rehearsed * max(1, round(1 / more))


def _split(data: Dataset, numbers: Sequence[int], seed: int) -> tuple[list[int], list[int]]:
    """Numbers to learn from, and the quarter (at least `MIN_JUDGES` views) that isn't."""
    views: dict[str, list[int]] = {}
    for number in numbers:
        record = data.entries[number].record
        view = f"{seed}:{record['scene']}:{record.get('seed', data.entries[number].name)}"
        views.setdefault(sha256(view.encode()).hexdigest(), []).append(number)
    order = sorted(views)
    count = min(len(order), max(MIN_JUDGES, round(len(order) * JUDGES)))
    held = sorted(number for view in order[:count] for number in views[view])
    return [number for number in numbers if number not in set(held)], held
