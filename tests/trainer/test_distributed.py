"""The same job on Ray Train: two processes learn what one does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from deepshade_trainer.run import Run
from deepshade_trainer.tuning.distributed import train_together
from deepshade_trainer.tuning.finetune import base_recipe
from deepshade_trainer.tuning.plan import Plan
from deepshade_trainer.tuning.steps import own_parts, training

pytest.importorskip("pandas", reason="Ray Train isn't installed: the extra 'cluster'")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of Ray's
def test_two_processes_learn_what_one_does(plan: Plan, tmp_path: Path) -> None:
    """Gradients are means over half batches of equal size; only the order of sums differs."""
    recipe = base_recipe(plan).changed(steps=3, warmup=1, precision="fp32")
    one, two = Run(tmp_path / "one"), Run(tmp_path / "two")
    alone = list(training(plan, recipe, one, own_parts(plan)))
    events = list(train_together(replace(plan, processes=2), recipe, two))
    assert [each["step"] for each in events] == [each["step"] for each in alone]
    assert events[-1]["validation"]["dssim"] == pytest.approx(
        alone[-1]["validation"]["dssim"], rel=1e-3
    )
    base, first, second = (run.load()[0]["average"] for run in (_begun(plan, tmp_path), one, two))
    moved = sum(float((first[name] - base[name]).square().sum()) for name in base)
    apart = sum(float((first[name] - second[name]).square().sum()) for name in base)
    assert apart < 1e-4 * moved
    assert two.load()[1] == 3


def _begun(plan: Plan, folder: Path) -> Run:
    """A run of the base's weights."""
    from deepshade.bundles import Bundle
    from deepshade_trainer.networks import bundle_weights

    run = Run(folder / "begun")
    run.folder.mkdir()
    weights: dict[str, torch.Tensor] = bundle_weights(Bundle.load(Path(plan.base)))
    run.save({"average": weights}, 0, {"state": {}, "param_groups": []})
    return run
