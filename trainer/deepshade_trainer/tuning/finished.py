"""Where a job's bundle lies when it is done."""

from __future__ import annotations

from pathlib import Path

from deepshade_trainer.tuning.plan import Plan


def candidate(folder: Path, plan: Plan) -> Path:
    """The bundle of the job in a folder, published or not; its decision is written last."""
    return folder / "candidate" / plan.effect / plan.name
