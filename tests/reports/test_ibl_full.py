"""The split sum against closed forms, and full shading against the methods that it is made of."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from deepshade.camera import Camera
from deepshade.effects import EFFECTS
from deepshade.environments import Environment, Surroundings, directions, world_to_map
from deepshade.errors import DeepshadeError
from deepshade_report.view import Float, View

from .walls import degenerate, rubble

try:
    from deepshade_report.baselines.ao.gtao import gtao
    from deepshade_report.baselines.dof.rings import rings
    from deepshade_report.baselines.full.chain import chain
    from deepshade_report.baselines.ibl.splitsum import Parameters, split_sum
except (ModuleNotFoundError, DeepshadeError) as error:  # no Dr.Jit or no libLLVM
    pytest.skip(f"no compiled kernels here: {error}", allow_module_level=True)

AXIS = np.array([0.6, 0.48, -0.64])
WHITE = Environment("white", np.full((3, 32, 64), 2, np.float32))
# 1 + 2 c + 3 c² of the cosine to an axis: harmonics up to degree 2
COSINE = np.tensordot(AXIS, directions(64, 128), 1)
SMOOTH = Environment("smooth", np.repeat((1 + 2 * COSINE + 3 * COSINE**2)[None], 3, 0) + 1)


def under(environment: Environment, view: View | None = None, **given: float) -> View:
    """Random surfaces, or those of a view, with reflectances and gloss, under an environment."""
    rng = np.random.default_rng(9)
    view = view or rubble()
    shape = view.background.shape
    normal = np.where(view.background, 0, rng.normal(size=(3, *shape)))
    normal /= np.maximum(np.linalg.norm(normal, axis=0), 1e-9)
    toward = normal + 0.7 * rng.normal(size=(3, *shape))
    toward /= np.linalg.norm(toward, axis=0)
    planes = {"normal_world": normal, "view": toward}
    for name, channels in (("diffuse", 3), ("specular", 3), ("gloss", 1), ("focal", 1)):
        planes[name] = np.full((channels, *shape), given.get(name, 0.0))
    attributes = {name: plane.astype(np.float32) for name, plane in planes.items()}
    camera = Camera(view.camera.fov, shape[1], shape[0], np.eye(4))
    return replace(
        view,
        effect=EFFECTS["full"],
        attributes={**view.attributes, **attributes},
        camera=camera,
        reference=np.zeros((3, *shape), np.float32),
        surroundings=Surroundings(environment, given.get("rotate", 0.0)),
    )


def shaded(method: Any, view: View) -> Float:
    method.prepare(view)
    return np.asarray(method.shade(view))


def test_a_white_furnace_gives_back_the_albedo() -> None:
    view = under(WHITE, diffuse=0.4)
    image = shaded(split_sum(5, Parameters()), view)
    assert image[:, ~view.background] == pytest.approx(0.8, rel=1e-3)
    assert image[:, view.background] == pytest.approx(2, rel=1e-3)
    face_on = under(WHITE, specular=0.3, gloss=40)
    face_on = replace(
        face_on, attributes={**face_on.attributes, "view": face_on.attributes["normal_world"]}
    )
    image = shaded(split_sum(5, Parameters()), face_on)
    assert image[:, ~view.background] == pytest.approx(0.6, rel=1e-2)


@pytest.mark.parametrize("rotate", [0.0, 70.0])
def test_a_map_of_degree_two_has_its_irradiance_and_its_mirror_image(rotate: float) -> None:
    view = under(SMOOTH, diffuse=1.0, rotate=rotate)
    there = ~view.background
    axis = world_to_map(rotate).T @ AXIS
    # over π, ∫ cosθ of 1, c and c² is 1, 2/3 c and (1 + c²) / 4
    c = np.tensordot(axis, view.attributes["normal_world"], 1)
    image = shaded(split_sum(5, Parameters()), view)[:, there]
    assert image == pytest.approx(
        np.broadcast_to(2 + 4 / 3 * c + 3 / 4 * (1 + c * c), (3, *c.shape))[:, there], abs=0.03
    )
    # a mirror: the map along the mirrored view, by the cosine
    view = under(SMOOTH, specular=1.0, gloss=60_000, rotate=rotate)
    normal, toward = view.attributes["normal_world"], view.attributes["view"]
    cosine = (normal * toward).sum(0)
    c = np.tensordot(axis, 2 * cosine * normal - toward, 1)
    expected = cosine * (2 + 2 * c + 3 * c * c)
    clear = there & (cosine > 0.1)
    image = shaded(split_sum(16, Parameters()), view)
    assert image[0, clear] == pytest.approx(expected[clear], rel=0.03, abs=0.06)


def test_light_from_the_map_is_linear_and_never_negative() -> None:
    spot = np.zeros((3, 32, 64), np.float32)
    spot[0, 10, 20] = 5000
    view = under(Environment("spot", spot), diffuse=0.5, specular=0.3, gloss=20)
    image = shaded(split_sum(9), view)
    twice = shaded(
        split_sum(9), replace(view, surroundings=Surroundings(Environment("twice", 2 * spot)))
    )
    assert (image >= 0).all()
    assert not image[1:].any()
    assert image[0].std() > 1
    assert twice == pytest.approx(2 * image, rel=1e-4, abs=1e-3)


def test_full_shading_in_focus_is_the_product_and_blurs_as_the_ring_gather() -> None:
    view = under(SMOOTH, diffuse=0.5, specular=0.2, gloss=30)
    product = shaded(split_sum(9), view) * shaded(gtao(3, 6), view)
    assert shaded(chain(9, 3, 6, 4, False), view) == pytest.approx(product, rel=1e-4, abs=1e-4)
    lens = {**view.attributes, "focal": np.full((1, 64, 64), 9, np.float32)}
    view = replace(view, attributes={**lens, "light": product})
    expected = shaded(rings(4, False), view)
    assert shaded(chain(9, 3, 6, 4, False), view) == pytest.approx(expected, rel=1e-3, abs=1e-3)


@pytest.mark.parametrize("name", degenerate())
def test_no_input_yields_nonsense(name: str) -> None:
    view = under(SMOOTH, degenerate()[name], diffuse=0.5, specular=0.5, gloss=10, focal=3)
    image = shaded(chain(5, 1, 2, 3, True), view)
    assert image.shape == (3, *view.background.shape)
    assert (np.isfinite(image) & (image >= 0)).all()
