"""Sampled views: reproducible, outside geometry, with something to see."""

from __future__ import annotations

import numpy as np
import pytest

from deepshade.errors import SceneError
from deepshade_workers.references import ao
from deepshade_workers.scenes.loading import open_scene
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import trace
from deepshade_workers.viewpoints import RADIUS_RANGE, sample_view

from .conftest import quad


@pytest.mark.parametrize("name", ["procedural:room:3", "procedural:scattered:3"])
def test_views_show_something_from_outside(name: str) -> None:
    scene = open_scene(name)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        view = sample_view(scene, rng, frame=256, size=96, min_contrast=0.08)
        hits = trace(scene, view.camera, 96, 96)
        valid = hits.valid.numpy()
        assert valid.mean() > 0.35
        assert hits.back.numpy()[valid].mean() < 0.1
        value, _ = ao.reference(scene, view, hits, {}, samples=32, seed=1)
        assert value.std() > 0.06
        depth = float(np.median(hits.depth.numpy()[valid]))
        low, high = RADIUS_RANGE
        assert 0.8 * low * depth < view.radius < 1.25 * high * depth


def test_the_same_stream_gives_the_same_view() -> None:
    scene = open_scene("procedural:stairs:1")
    a, b = (sample_view(scene, np.random.default_rng(5), frame=128, size=64) for _ in range(2))
    assert a == b
    assert (a.camera.matrix == b.camera.matrix).all()


def test_a_bare_plane_has_no_view() -> None:
    scene = Scene.from_mesh("plane", quad((0, 0, 0), (1, 0, 0), (0, 0, -1)))
    with pytest.raises(SceneError, match="no useful view"):
        sample_view(scene, np.random.default_rng(0), frame=64, size=64)
