"""Views from EXR files: those of `samples/`, beside what the trainer's way of reading gives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepshade import exr
from deepshade.effects import EFFECTS
from deepshade.errors import ConfigError, DataError
from deepshade_report.context import Context
from deepshade_report.samples import sample_views

SAMPLES = Path(__file__).parents[2] / "samples"


def test_the_samples_are_views() -> None:
    foliage, room = sample_views(SAMPLES, "ao")
    assert (foliage.scene, room.scene) == ("procedural:foliage:12", "procedural:room:7")
    assert (foliage.radius, foliage.camera.fov) == (0.5, 50.0)
    stored = exr.read(SAMPLES / "foliage.exr", ["Z", "reference_ao.V"]).pixels
    assert np.array_equal(foliage.reference[0], stored["reference_ao.V"].astype(np.float32))
    seen = ~foliage.background
    assert np.allclose(-foliage.attributes["position"][2][seen], stored["Z"][seen])
    assert foliage.error is not None


@pytest.mark.parametrize(
    "effect", [name for name, e in EFFECTS.items() if "environment" in e.settings]
)
def test_what_an_environment_lit_is_lit_by_it(effect: str) -> None:
    (room,) = sample_views(SAMPLES, effect)
    assert room.surroundings is not None
    assert room.dssim(room.trivial()) < room.dssim(np.zeros_like(room.reference))
    assert np.isfinite(room.trivial()).all()


def test_a_folder_without_references_is_an_error(tmp_path: Path) -> None:
    exr.write(tmp_path / "shot.exr", {"Z": np.ones((8, 8), np.float32)})
    models = [Path(__file__).parents[2] / "models"]
    with pytest.raises(DataError, match=r"no EXR file of .* has a reference of 'ao'"):
        Context(models, tmp_path, tmp_path / "out").views  # noqa: B018
    with pytest.raises((ConfigError, DataError)):
        Context(models, tmp_path / "nowhere", tmp_path / "out").views  # noqa: B018
