"""Shaders of which nothing is learnt: whose weights they hold, and that nobody trains them."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import pytest
import torch

from deepshade.bundles import Bundle, bundle_folders, bundle_root
from deepshade.effects import EFFECTS
from deepshade.errors import ConfigError, DataError
from deepshade_trainer.calculated import calculated
from deepshade_trainer.networks import from_bundle
from deepshade_trainer.recipe import preset
from deepshade_trainer.tuning.finetune import base_recipe
from deepshade_trainer.tuning.plan import Plan

from .synthetic import LEARNT

ROOT = bundle_root()
CALCULATED = [folder for folder in bundle_folders(ROOT) if folder.parent.name not in LEARNT]


@pytest.mark.parametrize(("name", "part"), [("do", "trunk"), ("full", "occlusion")])
def test_a_part_is_that_of_the_bundle_that_is_named(name: str, part: str) -> None:
    bundle = Bundle.load(ROOT / name / "balanced")
    hashes = {Bundle.load(each).short_hash: each for each in (ROOT / "ao").iterdir()}
    given = Bundle.load(hashes[bundle.network["of"]])
    assert bundle.int8 == {f"{part}.{key}": span for key, span in given.int8.items()}
    ours, theirs = (from_bundle(each.path).network for each in (bundle, given))
    weights = {key.removeprefix(f"{part}."): w for key, w in ours.state_dict().items()}
    assert weights.keys() == theirs.state_dict().keys()
    for key, weight in theirs.state_dict().items():
        assert torch.equal(weights[key], weight), key


def test_what_is_no_occlusion_is_refused() -> None:
    with pytest.raises(DataError, match="no part"):
        calculated("full", "lens", Bundle.load(ROOT / "gi/balanced"))


@pytest.mark.parametrize("effect", [effect for effect in EFFECTS if effect not in LEARNT])
def test_a_calculated_shader_is_not_trained(effect: str) -> None:
    with pytest.raises(ConfigError, match="nothing to learn") as caught:
        preset("balanced", effect)
    assert f"deepshade train {effect} --preset paper" in caught.value.fix
    paper = preset("paper", effect)  # as is said
    assert preset("balanced", effect, asdict(paper.network)).network == paper.network
    with pytest.raises(ConfigError, match="nothing to learn"):
        paper.changed(network={"kind": "discs"})


@pytest.mark.parametrize("folder", CALCULATED, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_nor_is_it_tuned(folder: Path) -> None:
    plan = Plan(effect=folder.parent.name, base=str(folder), name="mine", data=())
    with pytest.raises(ConfigError, match="nothing to learn"):
        base_recipe(plan)
