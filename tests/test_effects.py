"""Every row of the table of effects, from arrays to a served answer: nothing knows their names.

`tests/trainer/test_nine.py` has a batch, a training step and the exported graph of each.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from deepshade import exr, tensors
from deepshade.attributes import ATTRIBUTES, RADIANCE
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade_service.config import Settings
from deepshade_trainer.networks import from_bundle

from .service.conftest import ORDINARY, Local, encode
from .trainer.synthetic import RADIUS, arrays, make_bundle

HEIGHT, WIDTH = 53, 71  # odd; the service pads them to 64 x 128
EMPTY = HEIGHT // 2  # rows with nothing but sky


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle of every effect, trained for one step."""
    root = tmp_path_factory.mktemp("nine")
    for effect in EFFECTS:
        make_bundle(effect, root)
    return root


@pytest.fixture(scope="module")
def local(models: Path) -> Iterator[Local]:
    local = Local(Settings(**ORDINARY, models=models))
    local.wait()
    yield local
    local.stop()


def scene(effect: str) -> dict[str, np.ndarray]:
    """The effect's inputs (C, H, W), light up to 1e5, in the types that shards have."""
    return {n: a.astype(np.float32) for n, a in arrays(effect, 7, HEIGHT, WIDTH).items()}


def shaded(local: Local, effect: str, inputs: dict[str, np.ndarray]) -> np.ndarray:
    """(C, H, W): the service's answer to these inputs, sent as an EXR with depth as a marker."""
    depth = np.ones((HEIGHT, WIDTH), np.float32)
    depth[:EMPTY] = 0
    channels = {"Z": depth}
    for name, planes in inputs.items():
        channels |= dict(zip(ATTRIBUTES[name].channels, planes, strict=True))
    response = local.client.post(
        f"/shade/{effect}",
        params={
            "half": "false",
            **({"radius": RADIUS} if "radius" in EFFECTS[effect].settings else {}),
        },
        content=encode(channels),
        headers={"Content-Type": "image/x-exr"},
    )
    assert response.status_code == 200, response.text
    return exr.read(response.content).stack(EFFECTS[effect].outputs)


@pytest.mark.slow
@pytest.mark.parametrize("effect", EFFECTS)
def test_a_served_answer_is_the_networks(models: Path, local: Local, effect: str) -> None:
    """Equal to PyTorch on the padded tensor, and background as the row says."""
    inputs = scene(effect)
    answer = shaded(local, effect, inputs)
    assert answer.shape == (len(EFFECTS[effect].outputs), HEIGHT, WIDTH)
    bundle = Bundle.load(models / effect / "balanced")
    given = tensors.tensor(
        EFFECTS[effect], inputs, bundle.inputs, RADIUS, per_channel=bundle.per_channel
    )
    rows, columns = (tensors.up(side, bundle.size_multiple) for side in (64, 128))
    given = np.pad(given, ((0, 0), (0, 0), (0, rows - HEIGHT), (0, columns - WIDTH)))
    with torch.inference_mode():
        expected = from_bundle(bundle.path)(torch.from_numpy(given)).flatten(0, 1).numpy()
    expected = expected[:, :HEIGHT, :WIDTH].clip(*EFFECTS[effect].range)
    background = EFFECTS[effect].background
    if background == "light":
        expected[:, :EMPTY] = inputs["light"][:, :EMPTY]
    elif background != "shaded":
        expected[:, :EMPTY] = background
    assert np.isfinite(answer).all()
    assert (np.abs(answer - expected) <= 1e-4 * np.maximum(1, np.abs(expected))).all()


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1e-3, 1e3])
@pytest.mark.parametrize("effect", [name for name, row in EFFECTS.items() if row.per_channel])
def test_the_answer_scales_with_the_light(local: Local, effect: str, factor: float) -> None:
    """Light of up to 1e5 and down to 1e-3, and a thousand times more and less of it."""
    inputs = scene(effect)
    scaled = {
        name: planes * np.float32(factor) if ATTRIBUTES[name].unit is RADIANCE else planes
        for name, planes in inputs.items()
    }
    answer = shaded(local, effect, inputs)
    assert shaded(local, effect, scaled) / factor == pytest.approx(answer, rel=1e-3, abs=1e-2)
