"""Every row of the table of effects can be learnt and exported; nothing knows their names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from deepshade import tensors
from deepshade.effects import EFFECTS
from deepshade_trainer.dataset import Dataset
from deepshade_trainer.evaluation import evaluate
from deepshade_trainer.export import load_shader, some_light
from deepshade_trainer.graph import session
from deepshade_trainer.networks import Shader, build, from_bundle
from deepshade_trainer.resident import Resident
from deepshade_trainer.run import Run

from .synthetic import LEARNT, RADIUS, arrays, make_bundle, small, write_data

PRESETS = [("paper", each) for each in EFFECTS] + [("balanced", each) for each in LEARNT]


@pytest.mark.parametrize(("name", "effect"), PRESETS)
def test_a_batch_has_the_channels_of_its_network(effect: str, name: str, tmp_path: Path) -> None:
    """Of an effect run per channel one colour channel, its own, drawn anew for each sample."""
    row = EFFECTS[effect]
    shader = Shader(row, build(small(effect, name).network))
    runs = shader.per_channel
    data = Dataset([write_data(tmp_path, effect)], effect, per_channel=runs)
    channels = tensors.channel_count(row.inputs, runs)
    assert channels == shader.channels
    gbuffer, reference = data.batch([0] * 24, np.random.default_rng(0))
    assert gbuffer.shape == (24, channels, 64, 64)
    assert reference.shape == (24, 1 if runs else len(row.outputs), 64, 64)
    truth = data.load(0)[data.reference]
    if runs:  # turned or not, a channel's values stay its own
        sorts = [np.sort(plane.ravel()) for plane in truth]
        seen = {
            next(k for k, sort in enumerate(sorts) if (np.sort(one.numpy().ravel()) == sort).all())
            for one in reference
        }
        assert seen == {0, 1, 2}
    whole = data.gbuffer(data.load(0), RADIUS)
    assert whole.shape == (3 if runs else 1, channels, 64, 64)
    assert np.isfinite(whole).all()


@pytest.mark.parametrize("runs", [False, True])
@pytest.mark.parametrize("effect", [name for name, row in EFFECTS.items() if row.per_channel])
def test_a_batch_made_on_the_device_is_the_same(
    effect: str, runs: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Turned alike, the same channels; the depth's median may see other pixels when turned."""
    for share in ("HALF_LENGTHS", "SHORT_DIRECTIONS"):
        for module in ("dataset", "resident"):
            monkeypatch.setattr(f"deepshade_trainer.{module}.{share}", 0.0)
    folders = [write_data(tmp_path, effect)]
    plain = Dataset(folders, effect, per_channel=runs)
    kept = Resident(folders, effect, per_channel=runs, device=torch.device("cpu"))
    for seed in range(4):
        ours, theirs = (
            data.batch([0, 1, 2], np.random.default_rng(seed)) for data in (kept, plain)
        )
        assert torch.equal(ours[1], theirs[1])
        assert torch.allclose(ours[0], theirs[0], rtol=0.05)


def test_batches_made_on_the_device_repeat(tmp_path: Path) -> None:
    """With its shortened directions: whatever torch drew in between."""
    effect = next(name for name, row in EFFECTS.items() if "normal" in row.inputs)
    folders = [write_data(tmp_path, effect)]
    kept = Resident(folders, effect, per_channel=False, device=torch.device("cpu"))
    first = [kept.batch([0, 1], np.random.default_rng(seed))[0] for seed in range(8)]
    torch.rand(3)
    again = [kept.batch([0, 1], np.random.default_rng(seed))[0] for seed in range(8)]
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "effect"), PRESETS)
def test_every_effect_trains_and_exports(effect: str, name: str, made_once: Path) -> None:
    root = made_once / name
    bundle = make_bundle(effect, root, name)
    row = EFFECTS[effect]
    assert bundle.inputs == row.inputs
    assert bundle.outputs == row.outputs
    before, after = build(small(effect, name).network), from_bundle(bundle.path)
    assert bundle.per_channel == after.per_channel == (row.per_channel and not before.linear)
    names = before.state_dict().keys()
    assert names == after.network.state_dict().keys()
    _, trained = load_shader(Run(root / "runs" / effect / name))
    for key, weight in trained.network.state_dict().items():
        assert torch.equal(weight, after.network.state_dict()[key]), key
    # an odd size, half of it empty, light up to 1e5
    gbuffer = tensors.tensor(
        row,
        arrays(effect, 99, 53, 71),
        bundle.inputs,
        RADIUS,
        per_channel=bundle.per_channel,
        multiple=bundle.size_multiple,
    )
    light = some_light(after)
    assert tuple(light) == bundle.environment
    running = session(bundle.model)
    (shade,) = running.run([bundle.output_name], {bundle.input_name: gbuffer, **light})
    with torch.inference_mode():
        expected = after(*map(torch.from_numpy, (gbuffer, *light.values()))).numpy()
    # what is summed up from bright light may cancel: rounding is relative to the brightest
    size = np.abs(expected).max() if before.linear else np.abs(expected)
    assert (np.abs(shade - expected) <= 1e-5 * np.maximum(1, size)).all()
    lowest, highest = row.range
    assert lowest is None or shade.min() >= lowest
    assert highest is None or shade.max() <= highest
    if isinstance(row.background, float):
        assert shade[:, :, :26] == pytest.approx(row.background, abs=1e-6)
    if bundle.per_channel:  # three runs at once are three single runs
        single = [running.run(None, {bundle.input_name: one[None]})[0][0] for one in gbuffer]
        assert np.abs(np.stack(single) - shade).max() <= 1e-5 * max(1, np.abs(shade).max())
    rows = list(evaluate(bundle, [root / "data" / effect], limit=2))
    figures: dict[str, Any] = rows[0].figures
    assert all(np.isfinite(value) for value in figures.values())
    assert ("smape" in figures) == row.is_light


@pytest.mark.parametrize("effect", LEARNT)
def test_a_picture_is_padded_as_everywhere(effect: str) -> None:
    row = EFFECTS[effect]
    shader = Shader(row, build(small(effect, "balanced").network))
    plain, padded = (
        tensors.tensor(
            row,
            arrays(effect, 3, 33, 21),
            row.inputs,
            RADIUS,
            per_channel=shader.per_channel,
            multiple=multiple,
        )
        for multiple in (1, shader.size_multiple)
    )
    assert torch.equal(shader.padded(torch.from_numpy(plain)), torch.from_numpy(padded))


@pytest.mark.parametrize("effect", LEARNT)
def test_what_is_learnt_is_the_answer_on_its_curve(effect: str) -> None:
    """In training nothing is clamped; the answer is its curve's inverse, and finite."""
    row = EFFECTS[effect]
    torch.manual_seed(0)
    shader = Shader(row, build(small(effect, "balanced").network)).train()
    gbuffer = tensors.tensor(
        row,
        arrays(effect, 3),
        row.inputs,
        RADIUS,
        per_channel=shader.per_channel,
        multiple=shader.size_multiple,
    )
    given = [*map(torch.from_numpy, (gbuffer, *some_light(shader).values()))]
    image, answer = shader.on_curve(*given), shader(*given)
    assert torch.isfinite(answer).all()
    expected = torch.expm1(image) if shader.transfer == "log" else image
    # beyond expm1's slope at 80 float32 ends
    assert torch.allclose(answer[image.abs() < 10], expected[image.abs() < 10])
    answer.clamp(-1, 1).mean().backward()
    assert all(p.grad is None or torch.isfinite(p.grad).all() for p in shader.network.parameters())
