"""The same promises with the bundles that ship in models/, not only with the tests' small one."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

from deepshade import exr
from deepshade.bundles import Bundle
from deepshade.engines import REFERENCE, load_engine
from deepshade.gbuffer import load_gbuffer
from deepshade_service import shading
from deepshade_service.parameters import ShadeParameters

MODELS = Path(__file__).parents[2] / "models"
SHIPPED = sorted(path.parent for path in MODELS.glob("ao/*/config.json"))

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not SHIPPED, reason="models/ao holds no bundle yet"),
]


@pytest.fixture(scope="module", params=SHIPPED, ids=lambda path: path.name)
def engine(request):
    return load_engine(Bundle.load(request.param), REFERENCE, threads=2)


def infer(engine, body, radius, max_pixels=10**9):
    gbuffer = load_gbuffer(body, engine.bundle.inputs)
    plan = shading.plan_shading(gbuffer, engine.bundle, ShadeParameters(radius=radius), max_pixels)
    return shading.infer(gbuffer, plan, engine, threading.Event())


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (63, 65), (129, 257)])
def test_any_size(engine, make_exr, size):
    shade = infer(engine, make_exr(*size), 0.5)
    assert shade.shape == (1, *size)
    assert 0 <= shade.min() <= shade.max() <= 1


def test_tiled_equals_untiled(engine, make_exr):
    side = 4 * engine.bundle.halo + 2 * engine.bundle.size_multiple
    body = make_exr(128, min(2 * side, 1900))  # several tiles wide
    whole, tiled = infer(engine, body, 0.5), infer(engine, body, 0.5, max_pixels=1)
    np.testing.assert_allclose(tiled, whole, atol=1e-5)
    assert whole.std() > 1e-3


@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_scale(engine, make_exr, make_picture, scale):
    channels = make_picture(128, 192)
    scaled = {
        name: plane * np.float32(scale) if name.startswith("position") else plane
        for name, plane in channels.items()
    }
    a, b = infer(engine, make_exr(channels), 0.5), infer(engine, make_exr(scaled), 0.5 * scale)
    np.testing.assert_allclose(a, b, atol=1e-3)


def test_background_is_white_and_a_nan_does_not_spread(engine, make_exr, make_picture):
    channels = make_picture(64, 64)
    empty = {name: plane.copy() for name, plane in channels.items()}
    broken = {name: plane.copy() for name, plane in channels.items()}
    for name in channels:
        empty[name][20:30, 20:40] = 0
        broken[name][20:30, 20:40] = np.nan
    a, b = infer(engine, make_exr(empty), 0.5), infer(engine, make_exr(broken), 0.5)
    assert (a[0, 20:30, 20:40] == 1).all()
    np.testing.assert_array_equal(a, b)


def test_the_service_ships_it(start, make_exr):
    local = start(models=MODELS)
    response = local.client.post(
        "/shade/ao", content=make_exr(64, 96), headers={"Content-Type": "image/x-exr"}
    )
    assert response.status_code == 200
    assert exr.read(response.content).pixels["Y"].shape == (64, 96)
