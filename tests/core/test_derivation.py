"""Derived attributes against analytic surfaces, and the resolution of the table."""

import math

import numpy as np
import pytest

from deepshade.camera import Camera
from deepshade.gbuffer import derivation, geometry


def plane_seen(camera, normal, distance):
    """Positions (3, H, W) on the plane normal · p = -distance, by intersecting the rays."""
    rays = camera.rays().astype(np.float64)
    t = -distance / np.tensordot(normal, rays, 1)
    return (rays * t).astype(np.float32), t > 0


def sphere_seen(camera, centre, radius):
    rays = camera.rays().astype(np.float64)
    centre = np.asarray(centre, np.float64)
    a = (rays * rays).sum(0)
    b = np.tensordot(centre, rays, 1)
    c = centre @ centre - radius**2
    root = b * b - a * c
    hit = root > 0
    t = np.where(hit, (b - np.sqrt(np.maximum(root, 0))) / a, 0)
    position = rays * t
    return position.astype(np.float32), hit, (position - centre[:, None, None]) / radius


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e5])
@pytest.mark.parametrize("normal", [(0, 0, 1), (0.6, 0, 0.8), (0.1, -0.7, 0.7)])
def test_normals_of_a_plane_are_exact(normal, scale):
    normal = np.asarray(normal, np.float64) / np.linalg.norm(normal)
    position, hit = plane_seen(Camera(50, 32, 24), normal, 5 * scale)
    found = geometry.normals_from_positions(position, hit)
    np.testing.assert_allclose(found[:, hit].T, np.tile(normal, (hit.sum(), 1)), atol=2e-3)


def test_normals_of_a_sphere_point_outwards():
    position, hit, expected = sphere_seen(Camera(40, 128, 128), (0.2, -0.1, -5), 1.2)
    found = geometry.normals_from_positions(position, hit)
    cosine = (found * expected).sum(0)[hit]
    assert np.median(cosine) > 0.999
    assert cosine.min() > 0  # also at the silhouette nothing is turned around
    assert (found[:, ~hit] == 0).all()


def test_a_depth_edge_keeps_both_sides_straight():
    """Two walls that face the camera, one before the other: no pixel may see the step between."""
    camera = Camera(60, 40, 20)
    depth = np.where(np.arange(40) < 17, 2.0, 7.0) * np.ones((20, 1))
    position = camera.position_from_depth(depth)
    found = geometry.normals_from_positions(position, np.ones((20, 40), bool))
    np.testing.assert_allclose(found[2], 1, atol=1e-5)


def test_a_depth_edge_beside_a_steep_wall():
    """The smaller step isn't always the right one: a grazing floor before a wall behind it."""
    camera = Camera(60, 64, 64)
    floor, ahead = plane_seen(camera, (0, 1, 0), 1.0)
    wall = camera.position_from_depth(np.full((64, 64), 8.0))
    is_floor = ahead & (-floor[2] < 8)
    position = np.where(is_floor, floor, wall)
    found = geometry.normals_from_positions(position, np.ones((64, 64), bool))
    np.testing.assert_allclose(found[1][is_floor], 1, atol=5e-3)
    np.testing.assert_allclose(found[2][~is_floor], 1, atol=5e-3)


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1), (2, 2)])
def test_small_images_get_unit_normals_that_face_the_camera(shape):
    camera = Camera(50, shape[1], shape[0])
    position = camera.position_from_depth(np.full(shape, 3.0))
    found = geometry.normals_from_positions(position, np.ones(shape, bool))
    np.testing.assert_allclose((found**2).sum(0), 1, atol=1e-5)
    assert ((found * position).sum(0) < 0).all()


def test_strips_change_nothing(monkeypatch):
    position, hit, _ = sphere_seen(Camera(40, 60, 90), (0.2, -0.1, -5), 1.2)
    whole = geometry.normals_from_positions(position, hit)
    for rows in (1, 7, 1000):
        monkeypatch.setattr(geometry, "_STRIP", rows)
        np.testing.assert_array_equal(geometry.normals_from_positions(position, hit), whole)


def test_distance_and_depth_give_the_same_position():
    camera = Camera(70, 9, 7)
    expected, _ = plane_seen(camera, (0.3, 0.2, 0.9), 4)
    distance = np.sqrt((expected.astype(np.float64) ** 2).sum(0, keepdims=True))
    source = derivation.Source(
        {"distance": distance.astype(np.float32), "depth": -expected[2:]},
        np.ones((7, 9), bool),
        camera,
    )
    for needs in ("distance", "depth"):
        row = next(r for r in derivation.steps_to("position") if r.needs == (needs,))
        np.testing.assert_allclose(row.function(source), expected, rtol=1e-5, atol=1e-6)


def test_circle_of_confusion_by_ray_tracing_a_lens():
    """The blur's width on the sensor, from the two rays through the lens' rim."""
    focus, aperture, ppu = 4.0, 0.3, 500.0
    for depth in (2.0, 4.0, 9.0, 1e6):
        # the rim's rays from a point on the axis cross the plane of focus here
        rim = aperture / 2 * (1 - focus / depth)
        expected = 2 * rim / focus * ppu
        found = derivation.circle_of_confusion(np.array([[[depth]]], "f"), focus, aperture, ppu)
        assert found[0, 0, 0] == pytest.approx(expected, rel=1e-5, abs=1e-6)
    zero = derivation.circle_of_confusion(np.zeros((1, 1, 1), "f"), focus, aperture, ppu)
    assert zero[0, 0, 0] == pytest.approx(aperture / focus * ppu)  # infinitely far


@pytest.mark.parametrize("angle", [0, 1e-4, 0.7, math.pi / 2, math.pi])
def test_view_angle_is_exact_near_its_ends(angle):
    position = np.array([0, 0, -2.0], "f").reshape(3, 1, 1)
    normal = 3 * np.array([math.sin(angle), 0, math.cos(angle)], "f").reshape(3, 1, 1)
    row = derivation.steps_to("view_angle")[0]
    source = derivation.Source({"position": position, "normal": normal}, np.ones((1, 1), bool))
    assert row.function(source)[0, 0, 0] == pytest.approx(angle, abs=1e-6)


def test_unit_survives_zero_tiny_and_huge_vectors():
    vectors = np.array([[0, 1e-30, 3e38], [0, 1e-30, 0], [0, 0, 0]], "f").reshape(3, 1, 3)
    lengths = np.sqrt((geometry.unit(vectors) ** 2).sum(0))
    np.testing.assert_allclose(lengths, [[0, 1, 1]], atol=1e-6)


def targets(steps):
    return None if steps is None else [step.target for step in steps]


@pytest.mark.parametrize(
    ("target", "have", "met", "expected"),
    [
        ("normal", {"normal"}, set(), []),
        ("normal", {"depth"}, {"fov"}, ["position", "normal"]),
        ("normal", {"depth"}, {"matrix"}, None),
        ("normal", {"normal_world", "position"}, {"matrix"}, ["normal"]),
        ("normal_world", {"depth"}, {"fov", "matrix"}, ["position", "normal", "normal_world"]),
        ("depth", {"distance"}, {"fov"}, ["position", "depth"]),
        ("view_angle", {"position"}, set(), ["normal", "view_angle"]),
        ("focal", {"position"}, {"fov", "lens"}, ["depth", "focal"]),
        ("focal", {"position"}, {"fov"}, None),
        ("light", {"depth"}, {"fov", "matrix", "lens"}, None),
        ("position", set(), {"fov", "matrix", "lens"}, None),
    ],
)
def test_plans(target, have, met, expected):
    assert targets(derivation.plan(target, have, met)) == expected


def test_unmet_names_the_fewest_requirements():
    assert derivation.unmet("position", {"depth"}, set()) == ["fov"]
    assert derivation.unmet("view", {"depth"}, set()) == ["fov", "matrix"]
    assert derivation.unmet("light", {"depth"}, set()) == []
