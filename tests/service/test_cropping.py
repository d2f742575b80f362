"""What is computed equals the whole picture's answer, whatever the shape of what is covered.

The networks are convolutions in NumPy whose reach is counted by hand, one with biases (which fill
the background with features, so all of its halo counts) and others without.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade.gbuffer import GBuffer
from deepshade.relevance import Known
from deepshade_service import cropping, shading
from deepshade_service.coverage import Bits, Grid
from deepshade_service.cropping import Reach, computed_pixels, cover
from deepshade_service.parameters import ShadeParameters
from deepshade_service.planner import Plan, Scene
from deepshade_service.tiles import plan_tiles

NEVER = threading.Event()


@dataclass(frozen=True)
class Net:
    """`layers` 3 x 3 convolutions, or with `pooled` a U of two resolutions; reaches in pixels."""

    layers: int
    bias: bool
    pooled: bool = False

    @property
    def reach(self) -> Reach:
        if self.pooled:
            # out: 1; one coarse cell and what its rounding adds: 2 + 1; in: 1. Without biases,
            # features spread 1, in cells 2, then 4 pixels, with 5, 4 and 2 still to come.
            return Reach(2, 5, 5 if self.bias else 2)
        # after n layers features reach n pixels into the background, and n are left to return
        return Reach(1, self.layers, self.layers if self.bias else self.layers // 2)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        rng = np.random.default_rng(7)

        def conv(x: np.ndarray, out: int) -> np.ndarray:
            kernel = rng.normal(0, (2 / x.shape[0] / 9) ** 0.5, (out, x.shape[0], 3, 3))
            padded = np.pad(x, ((0, 0), (1, 1), (1, 1)))
            windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(1, 2))
            bias = rng.normal(0, 0.3, out) if self.bias else np.zeros(out)
            y = np.einsum("chwij,ocij->ohw", windows, kernel, optimize=True)
            y += bias[:, None, None]
            return np.maximum(y, 0.01 * y)

        if self.pooled:
            fine = conv(x, 4)
            c, h, w = fine.shape
            coarse = conv(fine.reshape(c, h // 2, 2, w // 2, 2).mean((2, 4)), 4)
            return conv(fine + coarse.repeat(2, 1).repeat(2, 2), 1)
        for _ in range(self.layers - 1):
            x = conv(x, 4)
        return conv(x, 1)

    def engine(self, **wrong: int) -> SimpleNamespace:
        """An engine around it; `wrong` overrides what its bundle says about its reach."""
        reach = self.reach
        says = {
            "size_multiple": reach.multiple,
            "halo": reach.halo,
            "background_halo": reach.background_halo,
        } | wrong
        bundle = Bundle(
            Path(), "ao", "net", ("normal", "position"), ("Y",), radius=1.0, fov=50.0, **says
        )
        return SimpleNamespace(
            bundle=bundle, predict=lambda g: self(g[0].astype(np.float64))[None].astype(np.float32)
        )


NETS = [Net(4, bias=False), Net(5, bias=True), Net(0, bias=False, pooled=True)]


def shapes(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Geometry: a few rectangles, discs and specks, or nearly everything."""
    y, x = np.mgrid[0:height, 0:width]
    covered = np.zeros((height, width), bool)
    for _ in range(rng.integers(1, 5)):
        cy, cx = rng.uniform(0, height), rng.uniform(0, width)
        size = rng.uniform(0.5, 1 + 0.3 * max(height, width))
        if rng.random() < 0.5:
            covered |= (y - cy) ** 2 + (x - cx) ** 2 < size**2
        else:
            covered |= (abs(y - cy) < size) & (abs(x - cx) < size * rng.uniform(0.1, 2))
    return ~covered if rng.random() < 0.3 else covered


def view(rng: np.random.Generator, covered: np.ndarray) -> GBuffer:
    attributes = {
        name: np.where(covered, rng.normal(size=(3, *covered.shape)), 0).astype(np.float32)
        for name in ("normal", "position")
    }
    return GBuffer(attributes, ~covered)


@pytest.fixture
def eager(monkeypatch):
    """Cut wherever a pixel can be spared, also in small pictures."""
    monkeypatch.setattr(cropping, "_CALL", 0)
    monkeypatch.setattr(cropping, "_WORTH", 0.0)
    monkeypatch.setattr(cropping, "_PIXELS_A_SPLIT", 300)


def both(net, gbuffer, known, max_pixels, **wrong):
    """The whole picture's answer and the cropped one, and how much that computed; None if all."""
    engine = net.engine(**wrong)
    bundle = engine.bundle
    height, width = gbuffer.shape
    multiple, halo = bundle.size_multiple, bundle.halo
    whole = plan_tiles(height, width, multiple=multiple, halo=halo, max_pixels=10**9)
    mask = None if known is None else known.pixels
    grid = Grid.of(gbuffer.background, mask, multiple)
    tiles = cover(grid, Reach(multiple, halo, bundle.background_halo), max_pixels)
    if tiles is None:
        return None
    answers = [
        shading.infer(gbuffer, Plan(1.0, "request", tiling, known), engine, NEVER)
        for tiling in (whole, tiles)
    ]
    return (*answers, tiles)


@pytest.mark.usefixtures("eager")
@pytest.mark.parametrize("net", NETS, ids=["plain", "biased", "pooled"])
def test_cropped_equals_whole(net):
    tried = 0

    @settings(max_examples=60, deadline=None)
    @given(
        height=st.integers(1, 70),
        width=st.integers(1, 90),
        seed=st.integers(0, 2**31),
        most=st.sampled_from([10**9, 1500]),
        partly=st.booleans(),
    )
    def check(height, width, seed, most, partly):
        nonlocal tried
        rng = np.random.default_rng(seed)
        covered = shapes(rng, height, width)
        known = None
        if partly:
            known = Known(covered & shapes(rng, height, width), 1.0, "")
        gbuffer = view(rng, covered)
        found = both(net, gbuffer, known, most)
        if found is None:
            return
        tried += 1
        whole, cropped, tiles = found
        np.testing.assert_allclose(cropped, whole, atol=1e-4)
        assert (cropped[0][~covered] == 1).all()
        for tile in tiles:
            assert tile.rows.start <= tile.rows.first < tile.rows.last <= tile.rows.stop
            assert tile.columns.start <= tile.columns.first
            assert tile.columns.last <= tile.columns.stop

    check()
    assert tried > 15


@pytest.mark.usefixtures("eager")
@pytest.mark.parametrize("net", NETS, ids=["plain", "biased", "pooled"])
@pytest.mark.parametrize("name", ["halo", "background_halo"])
def test_each_reach_matters(net, name):
    """With a reach that is too short the same comparison fails, so it can fail."""
    worst = 0.0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        covered = shapes(rng, 64, 80)
        # all but a stripe is known: then the halo counts within the geometry
        known = covered.copy()
        known[:, 16:24] = False
        short = {"halo": 1, "background_halo": 0}[name]
        found = both(net, view(rng, covered), Known(known, 1.0, ""), 10**9, **{name: short})
        if found is not None:
            worst = max(worst, float(np.abs(found[0] - found[1]).max()))
    assert worst > 1e-3


@pytest.mark.usefixtures("eager")
@pytest.mark.parametrize("size", [(48, 64), (47, 63)])
@pytest.mark.parametrize("part", [1, 3])  # of the width that is covered: all, or a third
def test_scaling_in_place_changes_nothing(size, part):
    covered = np.zeros(size, bool)
    covered[:, : size[1] // part] = True
    answers = []
    for consume in (False, True):
        gbuffer = view(np.random.default_rng(5), covered)
        engine = NETS[2].engine()
        plan = Scene(gbuffer, EFFECTS["ao"]).plan(engine.bundle, ShadeParameters(radius=0.3), 10**9)
        answers.append(shading.infer(gbuffer, plan, engine, NEVER, consume=consume))
    np.testing.assert_array_equal(*answers)
    net = NETS[2]
    planes = [gbuffer.attributes["normal"], gbuffer.attributes["position"]]
    if part == 1 and not any(length % 2 for length in size):  # `consume` has scaled them
        whole = net(np.concatenate(planes).astype(np.float64))
        np.testing.assert_allclose(answers[0], whole, rtol=1e-5, atol=1e-6)


@pytest.mark.usefixtures("eager")
def test_one_pixel():
    for covered in (np.ones((1, 1), bool), np.zeros((1, 1), bool)):
        gbuffer = view(np.random.default_rng(0), covered)
        scene = Scene(gbuffer, EFFECTS["ao"])
        engine = NETS[2].engine()
        plan = scene.plan(engine.bundle, ShadeParameters(), 10**9)
        assert plan.computed == (4 if covered.all() else 0)
        shade = shading.infer(gbuffer, plan, engine, NEVER)
        assert shade.shape == (1, 1, 1)
        assert covered.all() or shade[0, 0, 0] == 1


@pytest.mark.parametrize("side", ["left", "right", "top", "bottom"])
def test_half_a_frame_costs_at_most_0_6(side):
    background = np.zeros((512, 768), bool)
    background[
        {
            "left": np.s_[:, :384],
            "right": np.s_[:, 384:],
            "top": np.s_[:256],
            "bottom": np.s_[256:],
        }[side]
    ] = True
    tiles = cover(Grid.of(background, None, 16), Reach(16, 100, 32), 10**9)
    assert tiles is not None
    assert computed_pixels(tiles) <= 0.6 * background.size


def test_what_lies_apart_is_computed_apart():
    background = np.ones((512, 768), bool)
    background[20:120, 20:120] = background[380:480, 600:740] = False
    tiles = cover(Grid.of(background, None, 4), Reach(4, 60, 30), 10**9)
    assert tiles is not None
    assert len(tiles) == 2
    assert computed_pixels(tiles) < 0.2 * background.size


def test_nothing_covered_computes_nothing_and_a_full_frame_everything():
    reach = Reach(4, 60, 30)
    assert cover(Grid.of(np.ones((50, 70), bool), None, 4), reach, 10**9) == []
    assert cover(Grid.of(np.zeros((50, 70), bool), None, 4), reach, 10**9) is None
    everything_known = np.ones((50, 70), bool)
    assert cover(Grid.of(~everything_known, everything_known, 4), reach, 10**9) == []


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**31), st.data())
def test_bits(height, width, seed, data):
    mask = np.random.default_rng(seed).random((height, width)) < 0.1
    bits = Bits(mask)
    top, left = data.draw(st.integers(0, height - 1)), data.draw(st.integers(0, width - 1))
    bottom, right = (
        data.draw(st.integers(top + 1, height)),
        data.draw(st.integers(left + 1, width)),
    )
    inside = np.argwhere(mask[top:bottom, left:right]) + np.array([top, left])
    box = top, bottom, left, right
    assert bits.count(box) == len(inside)
    if len(inside):
        (a, c), (b, d) = inside.min(0), inside.max(0) + 1
        assert bits.bounds(box) == (a, b, c, d)
    else:
        assert bits.bounds(box) is None


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 300), st.integers(1, 300), st.sampled_from([1, 3, 64]), st.integers(0, 2**31))
def test_the_grid_says_what_its_cells_hold(height, width, multiple, seed):
    rng = np.random.default_rng(seed)
    background, known = rng.random((2, height, width)) < 0.98
    grid = Grid.of(background, known, multiple)
    cell = grid.cell
    assert cell % multiple == 0
    for bits, wanted in ((grid.geometry, ~background), (grid.needed, ~(background | known))):
        rows, columns = bits.shape
        for r in range(rows):
            for c in range(columns):
                held = wanted[r * cell : (r + 1) * cell, c * cell : (c + 1) * cell].any()
                assert bits.count((r, r + 1, c, c + 1)) == held
                assert bits.columns[c] >> r & 1 == held
