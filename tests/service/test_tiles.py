"""Tiles cover every pixel once, fit the budget, and give the same answer as no tiles."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deepshade import exr
from deepshade.gbuffer import load_gbuffer
from deepshade_service import shading
from deepshade_service.planner import Plan
from deepshade_service.tiles import Tile, plan_tiles, smallest_tile

EXR = {"Content-Type": "image/x-exr"}


def largest(tiling):
    """Pixels of the largest tile."""
    return max(tile.shape[0] * tile.shape[1] for tile in tiling)


def computed(tiling):
    """Pixels that the network computes, overlaps and padding included."""
    return sum(tile.shape[0] * tile.shape[1] for tile in tiling)


@settings(max_examples=100, deadline=None)
@given(
    height=st.integers(1, 3000),
    width=st.integers(1, 3000),
    multiple=st.sampled_from([1, 4, 32, 64]),
    halo=st.integers(0, 300),
    max_pixels=st.integers(1, 4_000_000),
)
def test_tiles_cover_every_pixel_once_with_their_halo(height, width, multiple, halo, max_pixels):
    tiling = plan_tiles(height, width, multiple=multiple, halo=halo, max_pixels=max_pixels)
    smallest = smallest_tile(height, width, multiple=multiple, halo=halo)
    assert largest(tiling) <= max(max_pixels, smallest)
    for spans, length in ((tiling.rows, height), (tiling.columns, width)):
        end = -(-length // multiple) * multiple
        assert [span.first for span in spans] == [0, *(span.last for span in spans[:-1])]
        assert spans[-1].last == length
        for span in spans:
            assert span.start % multiple == span.stop % multiple == 0
            assert span.start == 0 or span.first - span.start >= halo
            assert span.stop == end or span.stop - span.last >= halo
            assert 0 <= span.start <= span.first < span.last <= span.stop <= end


def test_what_fits_is_one_tile():
    tiling = plan_tiles(512, 768, multiple=64, halo=200, max_pixels=512 * 768)
    assert list(tiling) == [Tile(tiling.rows[0], tiling.columns[0])]
    assert computed(tiling) == 512 * 768


def test_wide_pictures_are_cut_across():
    tiling = plan_tiles(64, 8192, multiple=32, halo=64, max_pixels=64 * 1024)
    assert len(tiling.rows) == 1
    assert len(tiling.columns) == 10
    assert computed(tiling) < 1.2 * 64 * 8192


@pytest.mark.parametrize(
    ("size", "most"), [((129, 257), 25_000), ((63, 265), 1), ((410, 40), 5_000), ((1, 300), 1)]
)
def test_tiled_equals_untiled(service, make_exr, size, most):
    engine = service.service.models.engine(service.service.models.candidate("ao"))
    gbuffer = load_gbuffer(make_exr(*size), engine.bundle.inputs)
    gbuffer.background[::7, ::5] = True
    for array in gbuffer.attributes.values():
        array[:, gbuffer.background] = 0
    shades = []
    for max_pixels in (10**9, most):
        tiling = plan_tiles(
            *size,
            multiple=engine.bundle.size_multiple,
            halo=engine.bundle.halo,
            max_pixels=max_pixels,
        )
        never = threading.Event()
        shades.append(shading.infer(gbuffer, Plan(0.5, "request", tiling), engine, never))
    assert len(tiling) > 1
    np.testing.assert_allclose(shades[0], shades[1], atol=1e-5)
    assert shades[0].std() > 0.01


def test_the_halo_matters(service, make_exr):
    """Without one the same comparison fails, so it can fail."""
    engine = service.service.models.engine(service.service.models.candidate("ao"))
    gbuffer = load_gbuffer(make_exr(64, 64), engine.bundle.inputs)
    never = threading.Event()
    shades = [
        shading.infer(
            gbuffer,
            Plan(0.5, "request", plan_tiles(64, 64, multiple=4, halo=0, max_pixels=pixels)),
            engine,
            never,
        )
        for pixels in (4096, 256)
    ]
    assert np.abs(shades[0] - shades[1]).max() > 1e-3


def test_a_small_memory_setting_cuts_tiles_and_changes_nothing(start, client, make_exr):
    body = make_exr(300, 500)
    models = start().service.models
    engine_bytes = models.engine(models.candidate("ao")).bytes_per_pixel
    held = len(body) + 300 * 500 * (24 + 4 + 12)
    local = start(memory=int((held + 60_000 * engine_bytes) / 0.75))
    local.service.models.engine(local.service.models.candidate("ao")).bytes_per_pixel = engine_bytes
    answers = [
        c.post("/shade/ao?half=false", content=body, headers=EXR) for c in (client, local.client)
    ]
    tiles = [int(answer.headers["deepshade-tiles"]) for answer in answers]
    assert tiles[0] == 1
    assert tiles[1] > 1
    a, b = (exr.read(answer.content).pixels["Y"] for answer in answers)
    np.testing.assert_allclose(a, b, atol=1e-5)
