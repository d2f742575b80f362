"""Directional occlusion in screen space against closed forms."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from deepshade.camera import Camera
from deepshade.effects import EFFECTS
from deepshade.environments import Environment, Surroundings, directions, sky
from deepshade.errors import DataError, DeepshadeError
from deepshade_report.view import Float, View

from .walls import degenerate, groove, rubble

try:
    import drjit as dr

    from deepshade_report.baselines.ao.gtao import PUBLISHED, gtao, march_bent
    from deepshade_report.baselines.do import bent as bent_module
    from deepshade_report.baselines.do import bitmask as bitmask_module
    from deepshade_report.baselines.do import plain as plain_module
    from deepshade_report.baselines.do.bent import bent
    from deepshade_report.baselines.do.bitmask import Parameters, bitmask
    from deepshade_report.baselines.picture import mi
    from deepshade_report.baselines.screen import open_screen
except (ModuleNotFoundError, DeepshadeError) as error:  # no Dr.Jit or no libLLVM
    pytest.skip(f"no compiled kernels here: {error}", allow_module_level=True)

PLAIN = Parameters(thickness=0.5, blur=0)


def under(view: View, light: Any, rotate: float = 0.0) -> View:
    """The view as one of this effect, under a map of 32 rows; its camera looks down the world's -z.

    `light` is (3, 32, 64), or what it is everywhere.
    """
    radiance = np.broadcast_to(np.asarray(light, np.float32), (3, 32, 64))
    environment = kept(radiance.tobytes())
    height, width = view.background.shape
    camera = Camera(view.camera.fov, width, height, np.eye(4))
    made = {"effect": EFFECTS["do"], "camera": camera}
    answer = np.ones((3, height, width), np.float32)
    return replace(view, **made, reference=answer, surroundings=Surroundings(environment, rotate))


@cache
def kept(radiance: bytes) -> Environment:
    """Equal maps are one, and prepared once."""
    return Environment("test", np.frombuffer(radiance, np.float32).reshape(3, 32, 64))


def glow(*towards: float) -> Float:
    """A map that shines from within about 15 degrees of a direction."""
    cosine = np.tensordot(np.asarray(towards) / math.hypot(*towards), directions(32, 64), 1)
    return np.where(cosine > math.cos(math.radians(15)), 100, 0)[None].astype(np.float32)


def shaded(method: Any, view: View) -> Float:
    method.prepare(view)
    return np.asarray(method.shade(view))


@pytest.mark.parametrize("ratio", [0, 1])
def test_a_white_map_leaves_occlusion_by_the_bitmask(ratio: int) -> None:
    # beside the crease of a groove (1 - cos φ) / 2 of the light is left, φ the opening
    view = under(groove(45, 45), np.array([1.0, 2, 0]).reshape(3, 1, 1))
    image = shaded(bitmask(16, 64, 16, replace(PLAIN, ratio=ratio)), view)[:, 126:130, 122:134]
    assert image[0].mean() == pytest.approx((1 - math.cos(math.radians(90))) / 2, abs=0.03)
    assert image[1] == pytest.approx(2 * image[0], rel=1e-4)
    assert not image[2].any()


def test_a_white_map_leaves_gtao_along_a_bent_normal() -> None:
    view = under(rubble(), 3.0)
    occlusion = shaded(gtao(3, 6, PUBLISHED), view)
    expected = np.where(view.background, 3, 3 * occlusion)
    assert shaded(bent(3, 6, PUBLISHED), view) == pytest.approx(
        np.broadcast_to(expected, (3, 64, 64)), rel=1e-4, abs=1e-4
    )


@pytest.mark.parametrize("method", [lambda: bitmask(4, 16, 16, PLAIN), lambda: bent(4, 16)])
def test_light_from_one_side_casts_its_shadow_away(method: Any) -> None:
    # a crease whose left wall hides light from the left for the right wall, and the reverse
    for side in (-1, 1):
        view = under(groove(60, 60), glow(side, 0, 0.4))
        image = shaded(method(), view)[0, 126:130]
        left, right = image[:, 96:124].mean(), image[:, 132:160].mean()
        near, far = (left, right) if side < 0 else (right, left)
        assert near < 0.5 * far


def test_a_bent_normal_leans_to_the_middle_of_what_is_open() -> None:
    # on a groove's left wall, beside the crease, the other wall blocks what points into it
    left, right = np.array([[1.0, 0, 1], [-1, 0, 1]]) / math.sqrt(2)
    sphere = np.random.default_rng(3).normal(size=(3, 100_000))
    sphere /= np.linalg.norm(sphere, axis=0)
    weight = np.maximum(left @ sphere, 0) * (right @ sphere > 0)
    x, _, z = (sphere * weight).mean(1)
    screen = open_screen(groove(45, 45))
    counts = [dr.opaque(mi.UInt32, count) for count in (16, 64)]
    given = [dr.opaque(mi.Float, float(v)) for v in (1.0, 0.01, 0.0, 1.0, 1.0, 1.0)]
    found = np.asarray(march_bent(screen, *counts, *given)).reshape(4, 256, 256)[:, 126:130]
    _, across, _, ahead = found[..., 122:126].mean((1, 2))
    assert math.atan2(across, ahead) == pytest.approx(math.atan2(x, z), abs=0.05)


def test_nothing_near_leaves_the_irradiance_and_turns_follow_the_map() -> None:
    # a plane that faces the eye, +z: light of 1 + the cosine to some axis has 1 + 2/3 of that of
    # the normal
    axis = np.array([math.sin(0.5), 0.0, math.cos(0.5)])
    light = 1 + np.tensordot(axis, directions(32, 64), 1)
    for turn, lean in ((0.0, 0.5), (30.0, 0.5 + math.radians(30))):
        view = under(groove(0, 0, size=32), light, turn)
        for method in (bitmask(2, 6, 8), bent(2, 4), plain_module.methods(True)[0]):
            image = shaded(method, view)
            assert image == pytest.approx(1 + 2 / 3 * math.cos(lean), abs=0.02)


@pytest.mark.parametrize("name", degenerate())
def test_no_input_yields_nonsense(name: str) -> None:
    view = under(degenerate()[name], sky(height=32).radiance)
    for method in (bitmask(2, 3, 4), bent(1, 2), plain_module.methods(True)[0]):
        image = shaded(method, view)
        assert image.shape == (3, *view.background.shape)
        assert (np.isfinite(image) & (image >= 0)).all()


def test_the_settings_go_from_cheap_to_best_and_quick_is_fewer() -> None:
    for module in (bitmask_module, bent_module):
        samples = [math.prod(method.settings.values()) for method in module.methods(False)]
        assert samples == sorted(set(samples))
        assert len(module.methods(True)) < len(samples)


def test_a_view_under_no_map_is_refused() -> None:
    with pytest.raises(DataError, match="environment"):
        bitmask(1, 4, 4).prepare(replace(under(rubble(), 1.0), surroundings=None))
