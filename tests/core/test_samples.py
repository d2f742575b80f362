"""The shipped G-buffer: what every effect needs, and references that agree with each other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepshade import exr, metrics
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
    # unblocked irradiance of the service's sky, from world-space normals that are derived here
    gbuffer = load_gbuffer(ROOM, ["normal_world", "light"])
    image = exr.read(ROOM).pixels
    layers = {
        name: np.stack([image[f"reference_{name}.{band}"] for band in "RGB"])
        for name in ("do", "dof", "mb", "aa", "sss")
    }
    free = Surroundings(sky(height=512)).irradiance(gbuffer.attributes["normal_world"])
    opened = image["reference_ao.V"] > 0.97
    assert layers["do"][:, opened] == pytest.approx(free[:, opened], rel=0.15, abs=0.05)
    for name in ("dof", "mb", "aa", "sss"):
        assert (
            metrics.dssim(*(np.clip(p, 0, 1) for p in (layers[name], gbuffer.attributes["light"])))
            < 0.2
        )
        assert layers[name].mean() == pytest.approx(gbuffer.attributes["light"].mean(), rel=0.03)
