"""Tiles cover every pixel once, all of one size, and give the same answer as no tiles."""

from __future__ import annotations

import threading
from dataclasses import replace
from math import prod

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deepshade import exr
from deepshade.gbuffer import load_gbuffer
from deepshade_service import shading
from deepshade_service.parameters import ShadeParameters
from deepshade_service.tiles import min_tile, plan_tiles

EXR = {"Content-Type": "image/x-exr"}


def allowed(side: int, multiple: int) -> bool:
    """64, 128, 256 and multiples of 64 beyond; whole cells in any case."""
    usual = side in (64, 128, 256) or (side > 256 and side % 64 == 0)
    return side % multiple == 0 and (usual or 64 % multiple > 0)


@settings(max_examples=200, deadline=None)
@given(
    height=st.integers(1, 3000),
    width=st.integers(1, 3000),
    multiple=st.sampled_from([1, 4, 32, 64, 3, 96]),
    halo=st.integers(0, 300),
    max_pixels=st.integers(1, 4_000_000),
)
def test_tiles_cover_every_pixel_once_with_their_halo(height, width, multiple, halo, max_pixels):
    grid = plan_tiles(height, width, multiple, halo, max_pixels)
    whole = plan_tiles(height, width, multiple, halo, 10**12)
    assert prod(grid.shape) <= max(max_pixels, min_tile(height, width, multiple, halo))
    assert len(whole) == 1
    for spans, side, end, length in zip(
        (grid.rows, grid.columns), grid.shape, whole.shape, (height, width), strict=True
    ):
        assert allowed(side, multiple)
        assert allowed(end, multiple)
        assert [span.first for span in spans] == [0, *(span.last for span in spans[:-1])]
        assert spans[-1].last == length
        for span in spans:
            assert span.stop - span.start == side
            assert span.start % multiple == 0
            assert span.start == 0 or span.first - span.start >= halo
            assert span.stop == end or span.stop - span.last >= halo
            assert 0 <= span.start <= span.first < span.last <= span.stop <= end


@settings(max_examples=30, deadline=None)
@given(height=st.integers(1, 1500), width=st.integers(1, 1500), most=st.integers(20_000, 10**6))
def test_no_grid_of_allowed_sides_computes_less(height, width, most):
    """By trying all of them, each cut as closely as its halos let it be."""
    halo = 32

    def counts(length):
        end = next(s for s in (64, 128, *range(256, 2000, 64)) if s >= length)
        sides = [s for s in (128, *range(256, end, 64)) if s < end]
        return {end: 1} | {s: 1 + -(-(end - s) // (s - 2 * halo)) for s in sides}

    tall, wide = counts(height), counts(width)
    possible = [h * tall[h] * w * wide[w] for h in tall for w in wide if h * w <= most]
    if possible:
        assert plan_tiles(height, width, 32, halo, most).computed <= min(possible)


@pytest.mark.parametrize(
    ("size", "most"),
    [((129, 257), 40_000), ((63, 565), 30_000), ((410, 40), 20_000), ((700, 700), 1)],
)
def test_tiled_equals_untiled(service, make_exr, size, most):
    engine = service.engine()
    gbuffer = load_gbuffer(make_exr(*size), engine.bundle.inputs)
    gbuffer.background[::7, ::5] = True
    for array in gbuffer.attributes.values():
        array[:, gbuffer.background] = 0
    plans = [
        shading.plan_shading(gbuffer, engine.bundle, ShadeParameters(radius=0.5), max_pixels)
        for max_pixels in (10**9, most)
    ]
    shades = [shading.infer(gbuffer, plan, engine, threading.Event()) for plan in plans]
    assert len(plans[0].tiles) == 1 < len(plans[1].tiles)
    np.testing.assert_allclose(shades[0], shades[1], atol=1e-5)
    assert shades[0].std() > 0.01


def test_the_halo_matters(service, make_exr):
    """Without one the same comparison fails, so it can fail."""
    engine = service.engine()
    bundle = replace(engine.bundle, halo=0)
    gbuffer = load_gbuffer(make_exr(300, 300), bundle.inputs)
    shades = [
        shading.infer(
            gbuffer,
            shading.plan_shading(gbuffer, bundle, ShadeParameters(radius=0.5), pixels),
            engine,
            threading.Event(),
        )
        for pixels in (10**9, 4096)
    ]
    assert np.abs(shades[0] - shades[1]).max() > 1e-3


def test_a_small_memory_setting_cuts_tiles_and_changes_nothing(start, client, make_exr):
    body = make_exr(400, 700)
    held = len(body) + 400 * 700 * (24 + 4 + 12)
    local = start(memory=int((held + 70_000 * (128 + 4 * 7)) / 0.75))
    answers = [
        c.post("/shade/ao?half=false", content=body, headers=EXR) for c in (client, local.client)
    ]
    tiles = [int(answer.headers["deepshade-tiles"]) for answer in answers]
    assert tiles[0] == 1 < tiles[1]
    a, b = (exr.read(answer.content).pixels["Y"] for answer in answers)
    np.testing.assert_allclose(a, b, atol=1e-5)
