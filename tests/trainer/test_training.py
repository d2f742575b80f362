"""The training loop: learns, resumes exactly, and ignores poison."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch

from deepshade.bundles import bundle_root
from deepshade.effects import EFFECTS
from deepshade.errors import ConfigError, DataError
from deepshade_trainer.dataset import Dataset
from deepshade_trainer.networks import Shader, build, from_bundle
from deepshade_trainer.recipe import Recipe, preset
from deepshade_trainer.run import Run
from deepshade_trainer.training import train
from deepshade_trainer.validation import answered

from .conftest import write_data


def weights(run: Run) -> dict[str, torch.Tensor]:
    groups, _, _ = run.load()
    return groups["average"]


@pytest.mark.slow
def test_it_learns(data: Path, tmp_path: Path, recipe: Recipe) -> None:
    recipe = recipe.changed(steps=120, lr=4e-3)
    steps = list(train(recipe, [data], Run(tmp_path / "run")))
    assert [p.step for p in steps] == list(range(1, 121))
    assert steps[-1].loss < 0.6 * steps[0].loss
    figures = steps[-1].figures
    assert figures is not None
    assert figures["dssim"] < 0.7 * figures["trivial_dssim"]
    history = json.loads((tmp_path / "run/metrics.json").read_text())
    assert history[-1]["step"] == 120
    assert list((tmp_path / "run/log").glob("events*"))


@pytest.mark.slow
def test_steady_answers_change_less_where_the_picture_moves(
    data: Path, tmp_path: Path, recipe: Recipe
) -> None:
    """The same weights, the same batches: with the term a moved picture's answer is nearer."""
    begun = Run(tmp_path / "begun")
    list(train(recipe.changed(steps=80, lr=4e-3), [data], begun))
    held = Dataset([data], "ao")
    changes = []
    for steady in (0.0, 5.0):
        run = Run(tmp_path / f"run{steady}")
        further = recipe.changed(steps=60, init_from=str(begun.folder), steady=steady)
        list(train(further, [data], run))
        network = build(recipe.network)
        network.load_state_dict(weights(run))
        shader = Shader(EFFECTS["ao"], network).eval()
        with torch.inference_mode():
            whole = held.judged(0)[0]
            moved = answered(shader, whole[:, :, 2:, 1:])
            change = moved - answered(shader, whole)[:, :, 2:, 1:]
        changes.append(float(change[:, :, 16:, 16:].abs().mean()))
    assert changes[1] < 0.8 * changes[0]


def test_a_stopped_run_ends_where_an_uninterrupted_one_does(
    data: Path, tmp_path: Path, recipe: Recipe
) -> None:
    whole, parts = Run(tmp_path / "whole"), Run(tmp_path / "parts")
    list(train(recipe, [data], whole))
    for progress in train(recipe, [data], parts):
        if progress.step == 3:
            os.kill(os.getpid(), signal.SIGTERM)  # as a scheduler would
    assert parts.load()[1] == 4
    list(train(recipe, [data], parts))
    expected, found = weights(whole), weights(parts)
    for name, tensor in expected.items():
        assert torch.equal(tensor, found[name]), name


def test_a_run_starts_from_another_ones_average(data: Path, tmp_path: Path, recipe: Recipe) -> None:
    """Weights that both have are taken over; what only the new network has begins at random."""
    first, second = Run(tmp_path / "first"), Run(tmp_path / "second")
    list(train(recipe, [data], first))
    changed = {"steps": 1, "lr": 1e-9, "weight_decay": 0.0, "init_from": str(first.folder)}
    *down, last = recipe.network.down
    start, _ = train(recipe.changed(network={"down": [*down, last + 1]}, **changed), [data], second)
    assert "encode" in start.warning
    assert start.step == 0
    assert start.figures  # what it has to beat
    taken, given = weights(second), weights(first)
    assert set(given) < set(taken)
    for name, tensor in given.items():
        assert torch.allclose(taken[name], tensor, atol=1e-6), name


def test_a_run_starts_from_a_bundle(data: Path, tmp_path: Path) -> None:
    """Its weights go by their names; the padding of its stem is left out."""
    recipe = preset("fast", "ao").changed(
        steps=1, batch=2, lr=1e-9, weight_decay=0.0, precision="fp32"
    )
    folder = bundle_root() / "ao" / "fast"
    found = list(train(recipe.changed(init_from=str(folder)), [data], Run(tmp_path)))
    assert "at random" not in found[0].warning
    given, taken = from_bundle(folder).network.state_dict(), weights(Run(tmp_path))
    assert given.keys() == taken.keys()
    for name, tensor in given.items():
        assert torch.allclose(taken[name], tensor, atol=1e-6), name


def test_a_single_scene_is_validated_by_views(tmp_path: Path, recipe: Recipe) -> None:
    folder = write_data(tmp_path / "one")
    manifest = folder / "manifest.json"
    manifest.write_text(re.sub(r"wave:\d+", "wave:0", manifest.read_text()))
    found = Dataset([folder], "ao")
    training, held = found.split(0.04, seed=0)
    assert sorted(training + held) == list(range(24))
    assert 1 <= len(held) <= 8
    assert found.split(0.0, seed=0)[1] == []
    steps = list(train(recipe.changed(val_fraction=0.04), [folder], Run(tmp_path / "run")))
    assert f"{len(held)} of its 24 views" in steps[0].warning
    assert steps[-1].figures


def test_a_warm_up_longer_than_the_run_is_said(data: Path, tmp_path: Path, recipe: Recipe) -> None:
    first = next(train(recipe.changed(warmup=7), [data], Run(tmp_path / "a")))
    assert "warm-up of 7 steps is longer than the run of 6" in first.warning
    assert "warm-up" not in next(train(recipe, [data], Run(tmp_path / "b"))).warning


@pytest.mark.parametrize("device", ["cuda:99", "gpu", "cuda:x", "meta"])
def test_a_device_that_is_not_there_is_refused(
    device: str, data: Path, tmp_path: Path, recipe: Recipe
) -> None:
    with pytest.raises(ConfigError, match="device"):
        next(train(recipe, [data], Run(tmp_path), device=device))


def test_training_in_a_thread_leaves_signals_alone(
    data: Path, tmp_path: Path, recipe: Recipe
) -> None:
    """As a service does it: Python lets only the main thread set handlers."""
    before = signal.getsignal(signal.SIGTERM)
    with ThreadPoolExecutor(1) as pool:
        steps = pool.submit(lambda: list(train(recipe, [data], Run(tmp_path)))).result()
    assert len(steps) == recipe.steps
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_start_that_is_no_run_or_another_network_is_refused(
    data: Path, tmp_path: Path, recipe: Recipe
) -> None:
    with pytest.raises(ConfigError, match="no run to start from"):
        next(train(recipe.changed(init_from=str(tmp_path)), [data], Run(tmp_path / "run")))
    paper = preset("paper", "ao").changed(batch=recipe.batch, steps=1, val_fraction=0.0)
    paper = paper.changed(network={"u0": 4, "levels": 2})
    list(train(paper, [data], Run(tmp_path / "paper")))
    with pytest.raises(ConfigError, match="no weights in common"):
        next(
            train(recipe.changed(init_from=str(tmp_path / "paper")), [data], Run(tmp_path / "run"))
        )


@pytest.mark.slow
def test_a_killed_run_goes_on(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    settings = ["steps=100000", "batch=4", "precision=fp32"]
    settings += ["network.widths=[8,12]", "network.steps=[2]", "network.down=[1,1]"]
    settings += ["network.up=[1]", "network.rings=[1]", "network.fine_rings=[1]"]
    settings += ["network.detail=[]"]
    often = "from deepshade_trainer import training; "
    often += "every = training.Every; training.Every = lambda: every(save=5); "
    code = f"import sys; {often}from deepshade.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "train", "ao", "--data", str(data)]
    command += ["--threads", "1", "--out", str(out), *(x for s in settings for x in ("--set", s))]
    for _ in range(2):
        before = Run(out).load()[1] if Run(out).checkpoint.exists() else 0
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        limit = time.monotonic() + 120
        while time.monotonic() < limit:
            if Run(out).checkpoint.exists() and Run(out).load()[1] > before:
                break
            assert process.poll() is None
            time.sleep(0.2)
        process.kill()
        process.wait()
        assert Run(out).load()[1] > before


def test_poisoned_batches_teach_nothing_and_are_named(tmp_path: Path, recipe: Recipe) -> None:
    data = write_data(tmp_path / "data", broken=(2, 9))
    recipe = recipe.changed(steps=12, val_fraction=0.0)
    warnings = [p.warning for p in train(recipe, [data], Run(tmp_path / "run")) if p.warning]
    assert warnings
    assert all("non-finite samples" in w and "shard-0000" in w for w in warnings)
    assert any("wave:1" in w or "wave:4" in w for w in warnings)
    for tensor in weights(Run(tmp_path / "run")).values():
        assert torch.isfinite(tensor).all()


def test_another_recipe_does_not_resume(data: Path, tmp_path: Path, recipe: Recipe) -> None:
    list(train(recipe, [data], Run(tmp_path)))
    with pytest.raises(ConfigError, match="another recipe"):
        list(train(recipe.changed(lr=0.1), [data], Run(tmp_path)))
    # More steps are the same run, longer.
    longer = list(train(recipe.changed(steps=8), [data], Run(tmp_path)))
    assert [p.step for p in longer] == [7, 8]
    assert Recipe.read(Run(tmp_path).recipe).steps == 8


def test_a_damaged_checkpoint_is_said(data: Path, tmp_path: Path, recipe: Recipe) -> None:
    list(train(recipe, [data], Run(tmp_path)))
    content = Run(tmp_path).checkpoint.read_bytes()
    Run(tmp_path).checkpoint.write_bytes(content[: len(content) // 2])
    with pytest.raises(DataError, match="can't be read"):
        list(train(recipe.changed(steps=9), [data], Run(tmp_path)))


def test_too_little_data(data: Path, tmp_path: Path, recipe: Recipe) -> None:
    with pytest.raises(DataError, match="don't fill a batch"):
        list(train(recipe.changed(batch=200), [data], Run(tmp_path)))


def test_presets_and_settings() -> None:
    for name in ("fast", "balanced", "best", "paper", "paper-network"):
        assert preset(name, "ao").effect == "ao"
    paper = preset("paper", "ao")
    assert (paper.optimizer, paper.batch, paper.network.kind) == ("adadelta", 16, "paper")
    with pytest.raises(ConfigError) as caught:
        paper.changed(stpes=3)
    assert caught.value.nearest == "steps"
    with pytest.raises(ConfigError):
        paper.changed(network={"width": 3})
    with pytest.raises(ConfigError):
        preset("papr", "ao")


@pytest.mark.parametrize(
    "change",
    [
        {"precision": "fp16"},
        {"schedule": "lineer"},
        {"steps": "abc"},
        {"steps": 0},
        {"loss": "l9"},
        {"val_fraction": 1.5},
        {"network": {"kind": "foo"}},
        {"network": {"widths": 8}},
        {"network": {"widths": [8, -1]}},
    ],
)
def test_settings_that_no_run_could_mean(change: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        preset("balanced", "ao").changed(**change)


@pytest.mark.parametrize(
    ("effect", "inputs", "outputs"),
    [("ao", 6, 1), ("dof", 2, 1), ("gi", 7, 1), ("do", 9, 3), ("mb", 4, 1)],
)
def test_every_effect_has_its_networks_inputs(effect: str, inputs: int, outputs: int) -> None:
    network = preset("paper", effect).network
    assert (network.inputs, network.outputs) == (inputs, outputs)


def test_a_broken_held_out_sample_is_named_not_averaged(tmp_path: Path, recipe: Recipe) -> None:
    data = write_data(tmp_path / "data", broken=tuple(range(24)))
    warning = next(iter(train(recipe, [data], Run(tmp_path / "run")))).warning
    assert "not validated on: shard-0000" in warning
    assert "nothing to validate on" in warning


def test_a_recipe_survives_saving(tmp_path: Path, recipe: Recipe) -> None:
    recipe.write(tmp_path / "recipe.json")
    assert Recipe.read(tmp_path / "recipe.json") == recipe
