"""Looks: a texture lies where it should, and every ray finds the same at a place."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest

from deepshade.camera import Camera
from deepshade_workers import look as looks
from deepshade_workers.look import Look, scattering
from deepshade_workers.scenes.mesh import merge
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.textures import SIDE, draw_textures
from deepshade_workers.trace import material, trace
from deepshade_workers.view import LookRecord, View

from .conftest import quad

RECORD = LookRecord(seed=7, length=2.0, scatter={"b": (0.3, 0.2, 0.1)})


@pytest.fixture(scope="module")
def floors() -> Scene:
    """Two floors side by side, named a (x < 0) and b."""
    a = quad((-5, 0, 0), (5, 0, 0), (0, 0, -10))
    b = quad((5, 0, 0), (5, 0, 0), (0, 0, -10))
    return Scene.from_mesh("floors", merge([a, b], ["a", "b"]))


def values(scene: Scene, view: View, hits: Any, name: str) -> np.ndarray:
    channels = 1 if name == "gloss" else 3
    return np.asarray(hits.planar(material(scene, view, hits.surface, hits.valid, name, channels)))


def above(height: float, size: int = 16) -> Camera:
    return Camera.look_at((0.1, height, 0), (0.1, 0, 0), (0, 0, -1), 50, size, size)


def dressed(scene: Scene, camera: Camera, monkeypatch: Any, **options: Any) -> View:
    """With textures on every object."""
    monkeypatch.setattr(looks, "PLAIN_SHARE", 0.0)
    record = LookRecord(**{**vars(RECORD), **options})
    return View(camera, 1.0, look=Look.draw(scene, camera, record))


def test_near_by_it_is_the_texture_between_its_texels(floors: Scene, monkeypatch: Any) -> None:
    camera = above(0.01)
    view = dressed(floors, camera, monkeypatch)
    look = view.look
    assert look is not None
    hits = trace(floors, camera, 16, 16)
    found = values(floors, view, hits, "diffuse").reshape(3, -1)
    object_number = 1  # x > 0
    layer = int(look.layer.numpy()[object_number])
    texture = draw_textures(np.random.default_rng(RECORD.seed), 2)[layer]
    p = hits.p.numpy().astype(np.float64)
    across, offset = (a.numpy()[:, object_number] for a in (look.across, look.offset))
    u = across[0] * p[0] + across[1] * p[2] + offset[0]
    v = across[0] * p[2] - across[1] * p[0] + offset[1]
    x, y = u * SIDE - 0.5, v * SIDE - 0.5
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    expected = sum(
        (np.abs(1 - a - (x - i)) * np.abs(1 - b - (y - j)))[:, None]
        * texture[(j + b) % SIDE, (i + a) % SIDE]
        for a in (0, 1)
        for b in (0, 1)
    )
    tint = look.tint.numpy()[:, object_number]
    assert found == pytest.approx(np.asarray(expected).T * tint[:, None], abs=2e-3)


def test_far_away_it_is_the_textures_mean(floors: Scene, monkeypatch: Any) -> None:
    camera = above(9.0, 2)  # pixels wider than some repeats
    view = dressed(floors, camera, monkeypatch, length=0.02)
    look = view.look
    assert look is not None
    hits = trace(floors, camera, 2, 2)
    found = values(floors, view, hits, "diffuse").reshape(3, -1)
    textures = draw_textures(np.random.default_rng(RECORD.seed), 2)
    for k, x in enumerate(hits.p.numpy()[0]):
        number = int(x > 0)
        mean = textures[int(look.layer.numpy()[number])].mean((0, 1))
        assert found[:, k] == pytest.approx(mean * look.tint.numpy()[:, number], rel=1e-2)


def test_any_ray_finds_what_the_camera_sees(floors: Scene, monkeypatch: Any) -> None:
    """A ray from elsewhere to the same places: a lens ray, a bounce."""
    from deepshade_workers.backend import mitsuba

    mi = mitsuba()
    camera = above(3.0)
    view = dressed(floors, camera, monkeypatch)
    hits = trace(floors, camera, 16, 16)
    origin = mi.Point3f(4, 0.5, -2)
    ray = mi.Ray3f(origin, dr.normalize(hits.p - origin))
    other = floors.traced.ray_intersect(ray)
    seen = hits.planar(material(floors, view, other, other.is_valid(), "diffuse", 3))
    assert seen == pytest.approx(values(floors, view, hits, "diffuse"), abs=2e-3)


def test_what_scatters_is_recorded_and_diffuse_light_leaves_room_for_highlights(
    floors: Scene,
) -> None:
    camera = above(3.0)
    hits = trace(floors, camera, 16, 16)
    right = hits.p.numpy()[0] > 0
    for seed in range(2):
        record = LookRecord(seed, 2.0, None, RECORD.scatter)
        view = View(camera, 1.0, look=Look.draw(floors, camera, record))
        scatter = values(floors, view, hits, "scatter").reshape(3, -1)
        assert scatter[:, right] == pytest.approx(np.repeat([[0.3], [0.2], [0.1]], right.sum(), 1))
        assert (scatter[:, ~right] == 0).all()
        both = values(floors, view, hits, "diffuse") + values(floors, view, hits, "specular")
        assert both.max() <= 1
        assert values(floors, view, hits, "gloss").min() >= 2


def test_the_scenes_own_materials_may_stay(floors: Scene) -> None:
    camera = above(3.0)
    hits = trace(floors, camera, 16, 16)
    view = View(camera, 1.0, look=Look.draw(floors, camera, LookRecord(1, 2.0, own=True)))
    bare = View(camera, 1.0)
    for name in ("diffuse", "specular", "gloss", "scatter"):
        assert (values(floors, view, hits, name) == values(floors, bare, hits, name)).all()


def test_mean_free_paths_span_what_users_set() -> None:
    depths = {str(k): 2.0 for k in range(4000)}
    drawn = np.array(list(scattering(np.random.default_rng(1), depths, 100.0, 64.0).values()))
    assert 0.45 < len(drawn) / len(depths) < 0.55
    pixels = drawn[:, 0] * 100 / 2
    assert pixels.min() == pytest.approx(0.5, rel=0.05)
    assert pixels.max() == pytest.approx(64, rel=0.05)
    assert np.median(np.log(pixels)) == pytest.approx(np.log(32) / 2, abs=0.15)
    assert (drawn[:, 0] >= drawn[:, 1]).all()
    assert (drawn[:, 1] >= drawn[:, 2]).all()
