"""The shipped G-buffer: what every effect needs, and references that agree with each other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepshade import exr
from deepshade.effects import EFFECTS
from deepshade.environments import Surroundings, sky
from deepshade.gbuffer import load_gbuffer

ROOM = Path(__file__).resolve().parents[2] / "samples" / "room.exr"


def test_every_effect_finds_its_inputs_and_its_reference() -> None:
    names = tuple(dict.fromkeys(name for effect in EFFECTS.values() for name in effect.inputs))
    gbuffer = load_gbuffer(ROOM, names)
    for name in names:
        assert np.isfinite(gbuffer.attributes[name]).all(), name
        assert gbuffer.attributes[name].std() > 0.01, name
    channels = exr.read_header(ROOM.read_bytes()).channels()
    for effect in EFFECTS.values():
        assert any(channel.startswith(f"reference_{effect.name}.") for channel in channels)


def test_references_are_about_what_the_effects_start_from() -> None:
    gbuffer = load_gbuffer(ROOM, ["normal_world", "light"])
    names = ("do", "dof", "mb", "aa", "sss")
    wanted = [f"reference_{name}.{band}" for name in names for band in "RGB"]
    image = exr.read(ROOM, [*wanted, "reference_ao.V"]).pixels
    opened, *layers = (
        np.stack([image[f"reference_{name}.{band}"] for band in "RGB"]) for name in names
    )
    # where nothing is near, the irradiance of the service's sky over derived normals
    free = Surroundings(sky(height=128)).irradiance(gbuffer.attributes["normal_world"])
    clear = image["reference_ao.V"] > 0.98
    assert clear.mean() > 0.1
    off = np.abs(opened / free - 1)[:, clear]
    assert np.quantile(off, 0.95) < 0.1  # the sun may be behind what little is near
    light = gbuffer.attributes["light"]
    for layer in layers:
        assert layer.mean() == pytest.approx(light.mean(), rel=0.03)
