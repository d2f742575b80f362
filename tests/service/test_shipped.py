"""The same promises with the bundles that ship in models/, not only with the tests' small one."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

from deepshade import exr
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade.engines import REFERENCE, load_engine
from deepshade.gbuffer import load_gbuffer
from deepshade_service import shading
from deepshade_service.parameters import ShadeParameters
from deepshade_service.planner import Plan, Scene
from deepshade_service.tiles import plan_tiles

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
    height, width = gbuffer.shape
    bundle = engine.bundle
    tiling = plan_tiles(
        height, width, multiple=bundle.size_multiple, halo=bundle.halo, max_pixels=max_pixels
    )
    return shading.infer(gbuffer, Plan(radius, "request", tiling), engine, threading.Event())


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (63, 65), (129, 257)])
def test_any_size(engine, make_exr, size):
    shade = infer(engine, make_exr(*size), 0.5)
    assert shade.shape == (1, *size)
    assert 0 <= shade.min() <= shade.max() <= 1


def test_tiled_equals_untiled(engine, make_exr):
    side = 4 * engine.bundle.halo + 2 * engine.bundle.size_multiple
    size = (min(side, 900), min(2 * side, 1900))
    body = make_exr(*size)
    whole, tiled = infer(engine, body, 0.5), infer(engine, body, 0.5, max_pixels=1)
    np.testing.assert_allclose(tiled, whole, atol=1e-5)
    assert whole.std() > 1e-3


@pytest.mark.parametrize("shape", ["corner", "two", "ragged", "stripe"])
def test_cropped_equals_whole(engine, make_exr, make_picture, shape):
    """What the planner leaves out counts for nothing: the bundle's background halo is enough."""
    bundle = engine.bundle
    size = (600, 900) if bundle.background_halo < 200 else (700, 1300)
    y, x = np.mgrid[0 : size[0], 0 : size[1]]
    covered = {
        "corner": (y < 90) & (x < 140),
        "two": ((y < 80) & (x < 90)) | ((y > size[0] - 70) & (x > size[1] - 100)),
        "ragged": (y < 90 + 60 * np.sin(x / 17)) & (x < size[1] // 3),
        "stripe": (x > 37) & (x < 41),
    }[shape]
    steps = 1 + 0.1 * ((x // 20 + y // 20) % 2)  # in depth, so that there is something to shade
    channels = {
        name: np.where(covered, p * (steps if name.startswith("position") else 1), 0)
        for name, p in make_picture(*size).items()
    }
    gbuffer = load_gbuffer(make_exr(channels), bundle.inputs)
    scene = Scene(gbuffer, EFFECTS[bundle.effect])
    plan = scene.plan(bundle, ShadeParameters(radius=0.5), 10**9)
    assert plan.computed < 0.9 * covered.size
    whole = plan_tiles(*size, multiple=bundle.size_multiple, halo=bundle.halo, max_pixels=10**9)
    answers = [
        shading.infer(gbuffer, Plan(0.5, "request", tiling), engine, threading.Event())
        for tiling in (plan.tiling, whole)
    ]
    np.testing.assert_allclose(*answers, atol=1e-3)
    assert answers[0][0, covered].std() > 1e-3


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
