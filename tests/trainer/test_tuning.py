"""Fine-tuning: what is learnt from, what judges, what comes of it, and that a kill changes nothing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from deepshade.bundles import Bundle
from deepshade.errors import ConfigError, DataError
from deepshade_trainer.export import export
from deepshade_trainer.recipe import Recipe
from deepshade_trainer.run import Run
from deepshade_trainer.training import train
from deepshade_trainer.tuning.finetune import finetune, own_parts
from deepshade_trainer.tuning.finished import candidate
from deepshade_trainer.tuning.plan import Plan
from deepshade_trainer.tuning.verdict import FILE, Paired, Verdict

from .conftest import write_data


@pytest.fixture(scope="session")
def base(data: Path, tmp_path_factory: Any) -> Path:
    """A bundle that has learnt little."""
    from deepshade_trainer.networks import FoldConfig

    folder = tmp_path_factory.mktemp("base")
    network = FoldConfig(
        widths=(8, 12), steps=(2,), down=(1, 1), up=(1,), normal=0, position=3, bias=0.85
    )
    recipe = Recipe(network=network, batch=4, steps=2, warmup=1, precision="fp32")
    list(train(recipe, [data], Run(folder / "run")))
    return export(Run(folder / "run"), folder / "models/ao/balanced", [data])[0].path


@pytest.fixture
def plan(base: Path, data: Path) -> Plan:
    return Plan(
        effect="ao",
        base=str(base),
        name="balanced",
        data=(str(data),),
        test=(str(data),),
        steps=12,
        batch=4,
        lr=4e-3,
        slower=10.0,
    )


def test_a(plan: Plan, tmp_path: Path) -> None:
    events = list(finetune(plan, tmp_path))
    for e in events: print(e)
