"""Ray tracing with a denoiser: scenes made again from records, the estimator, and its noise."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from deepshade.camera import Camera
from deepshade.errors import DataError, DeepshadeError, SceneError
from deepshade.manifest import Manifest
from deepshade_report.view import View, load_views

try:
    from deepshade_report.baselines.ao import raytracing
except (ModuleNotFoundError, DeepshadeError) as error:  # no Mitsuba, Open Image Denoise or libLLVM
    pytest.skip(f"no ray tracing here: {error}", allow_module_level=True)

from deepshade_workers.datagen import make_shard
from deepshade_workers.dataspec import DataSpec
from deepshade_workers.scenes.mesh import Mesh, merge
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.shards import schema
from deepshade_workers.trace import trace

SIZE = 96


@pytest.fixture(scope="module")
def view(tmp_path_factory: pytest.TempPathFactory) -> View:
    """A window of a view of a procedural scene, as it comes back from a data set's files."""
    folder: Path = tmp_path_factory.mktemp("rays")
    job = DataSpec(
        ("procedural:stairs",), 1, size=SIZE, frame=128, spp=256, seed=3, min_contrast=0.12
    )
    shard = make_shard(job, 0, folder, lambda: None)
    Manifest(job.settings(), schema(job.effects, SIZE)).with_shard(shard).write(folder)
    (found,) = load_views(folder, "ao")
    return found


def error_of(method: raytracing.RayTracing, view: View) -> float:
    method.prepare(view)
    return view.dssim(method.shade(view)[None])


def plane(center: tuple[float, ...], u: tuple[float, ...], v: tuple[float, ...]) -> Mesh:
    c, a, b = (np.array(x, float) for x in (center, u, v))
    corners = np.stack([c - a - b, c + a - b, c + a + b, c - a + b])
    return Mesh.build(corners, np.array([[0, 1, 2], [0, 2, 3]]), crease=0)


def test_the_record_alone_gives_the_stored_pixels_again(view: View) -> None:
    assert view.record["camera"]["origin"] != [0, 0]  # a window off the corner, or it proves less
    _, hits = raytracing.rebuild(view)
    valid = hits.valid.numpy().reshape(SIZE, SIZE)
    assert (valid == ~view.background).all()
    points = hits.p.numpy().reshape(3, -1).astype(np.float64)
    seen = (view.camera.matrix @ np.vstack([points, np.ones_like(points[:1])]))[:3]
    apart = np.linalg.norm(seen.reshape(3, SIZE, SIZE) - view.attributes["position"], axis=0)
    assert apart[valid].max() < 1e-4 * view.radius
    # world-space normals turned by the record's matrix, stored with 16 bits
    turned = view.camera.matrix[:3, :3] @ hits.ns.numpy().reshape(3, -1)
    assert np.abs(turned.reshape(3, SIZE, SIZE) - view.attributes["normal"])[:, valid].max() < 2e-3


def test_many_rays_give_the_reference(view: View) -> None:
    method = raytracing.RayTracing(1024)
    method.prepare(view)
    image = method.shade(view)
    assert view.dssim(image[None]) < 0.015
    assert abs(float((image - view.reference[0]).mean())) < 1e-3


@pytest.mark.parametrize("rays", [1, 8, 256])
def test_the_estimate_is_that_of_the_closed_form(rays: int) -> None:
    floor = plane((0, 0, 0), (500, 0, 0), (0, 0, -500))
    wall = plane((0, 0, -1), (500, 0, 0), (0, 500, 0))
    scene = Scene.from_mesh("corner", merge([floor, wall]))
    camera = Camera.look_at((0, 2, 0), (0, 0, -0.5), (0, 1, 0), 30, 64, 64)
    hits = trace(scene, camera, 64, 64)
    image = raytracing.visibility(scene, hits, radius=1.0, rays=rays, seed=5)
    point, facing = (np.reshape(v.numpy(), (3, 64, 64)) for v in (hits.p, hits.ns))
    on_floor = facing[1] > 0.99
    away = np.clip(point[2] + 1, 0, 1)
    exact = 1 - (np.arccos(away) - away * np.sqrt(1 - away**2)) / np.pi
    # no stratum varies more than a coin: a mean of n rays over all pixels stays this near
    spread = 0.5 / np.sqrt(rays * on_floor.sum())
    assert on_floor.sum() > 1000
    assert abs(float((image - exact)[on_floor].mean())) < 5 * spread


def test_the_noise_is_that_of_coins_and_strata_lessen_it(view: View) -> None:
    squared = {}
    for rays in raytracing.RAYS:
        method = raytracing.RayTracing(rays)
        method.prepare(view)
        squared[rays] = float(((method.shade(view) - view.reference[0]) ** 2).mean())
    coin = float((view.reference * (1 - view.reference)).mean())
    assert squared[1] == pytest.approx(coin, rel=0.1)
    for rays in raytracing.RAYS[1:]:
        assert squared[rays] < 1.03 * squared[1] / rays


def test_numbers_of_rays_are_kept() -> None:
    assert [np.prod(raytracing.strata(2 * rays)) for rays in raytracing.RAYS] == [1, 2, 4, 8]


@pytest.mark.parametrize("quality", ["fast", pytest.param("high", marks=pytest.mark.slow)])
def test_the_denoiser_takes_most_of_the_error_of_one_ray(view: View, quality: str) -> None:
    raw, clean = raytracing.RayTracing(1), raytracing.RayTracing(1, quality)
    assert error_of(clean, view) < 0.5 * error_of(raw, view)
    # and doesn't shift the whole picture
    assert abs(float((clean.shade(view) - view.reference[0]).mean())) < 0.02


def test_random_numbers_are_not_those_of_the_reference(view: View) -> None:
    scene, hits = raytracing.rebuild(view)
    own = raytracing.visibility(
        scene, hits, radius=view.radius, rays=4, seed=int(view.record["seed"])
    )
    method = raytracing.RayTracing(4)
    method.prepare(view)
    assert (method.shade(view) != own).mean() > 0.05
    assert (method.shade(view) == method.shade(view)).all()


def test_a_view_of_another_scene_is_refused(view: View) -> None:
    other = dataclasses.replace(view, scene=f"{view.scene}1")
    with pytest.raises(DataError, match="see another surface"):
        raytracing.RayTracing(1).prepare(other)
    with pytest.raises(SceneError, match="no scene file"):
        raytracing.RayTracing(1).prepare(dataclasses.replace(view, scene="../shared/none.obj"))


def test_all_settings_are_told_apart() -> None:
    for quick, number in ((False, 12), (True, 3)):
        found = raytracing.methods(quick)
        assert len({(m.name, *m.settings.values()) for m in found}) == len(found) == number
        assert all(raytracing.RayTracing.needs_scene for _ in found)
