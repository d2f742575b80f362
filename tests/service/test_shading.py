"""What the steps of a request compute, and what a plan says of it."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from deepshade import exr
from deepshade.attributes import ATTRIBUTES
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade.gbuffer import GBuffer
from deepshade.tensors import tensor
from deepshade_service import decoding, shading
from deepshade_service.parameters import ShadeParameters

EXR = {"Content-Type": "image/x-exr"}
NEVER = threading.Event()


def bundle(effect, **config):
    row = EFFECTS[effect]
    settings = {"size_multiple": 1, "halo": 2, "radius": 1.0, "fov": 50.0, "bytes_per_pixel": 1}
    return Bundle(Path(), effect, "made-up", row.inputs, row.outputs, **(settings | config))


def engine(made):
    """A network that sees two pixels far: shifted channels, mixed with different weights."""
    outputs = 1 if made.per_channel else len(EFFECTS[made.effect].outputs)
    predictions = []

    def predict(x):
        predictions.append(x.shape)
        weights = np.random.default_rng(1).uniform(0.1, 1, (outputs, x.shape[1], 3))
        padded = np.pad(x, ((0, 0), (0, 0), (2, 2), (2, 2)))
        h, w = x.shape[2:]
        shifted = [padded[:, :, 2 + d : 2 + d + h, 2 - d : 2 - d + w] for d in (-2, 0, 2)]
        mixed = sum(
            np.einsum("oc,nchw->nohw", weights[..., k], each) for k, each in enumerate(shifted)
        )
        return (mixed + 3).astype(np.float32)

    return SimpleNamespace(bundle=made, predict=predict, predictions=predictions)


def view(effect, height=90, width=150, background="half"):
    """A G-buffer with light up to 1e5, half of it background."""
    rng = np.random.default_rng(2)
    empty = np.zeros((height, width), bool)
    empty[:, : {"half": width // 2, "all": width, "none": 0}[background]] = True
    attributes = {}
    for name in EFFECTS[effect].inputs:
        attribute = ATTRIBUTES[name]
        size = 1e5 if attribute.unit.name == "radiance" else 1.0
        pixels = size * rng.random((len(attribute.channels), height, width))
        pixels = np.where(empty & (not attribute.in_background), 0, pixels)
        attributes[name] = np.ascontiguousarray(pixels, np.float32)
    return GBuffer(attributes, empty)


def shaded(effect, gbuffer, max_pixels=10**9, **config):
    net = engine(bundle(effect, **config))
    plan = shading.plan_shading(gbuffer, net.bundle, ShadeParameters(), max_pixels)
    return shading.infer(gbuffer, plan, net, NEVER), plan, net


@pytest.mark.parametrize("effect", EFFECTS)
def test_every_effect_gets_its_row_s_background(effect):
    row, gbuffer = EFFECTS[effect], view(effect)
    config = {"per_channel": row.per_channel}
    answer, plan, _ = shaded(effect, gbuffer, **config)
    there, empty = ~gbuffer.background, gbuffer.background
    assert answer.shape == (len(row.outputs), 90, 150)
    runs = row.per_channel
    inputs = tensor(row, gbuffer.attributes, row.inputs, 1.0, per_channel=runs, multiple=128)
    network = engine(bundle(effect, **config)).predict(inputs)[..., :90, :150]
    network = network.reshape(-1, 90, 150)
    np.testing.assert_array_equal(answer[:, there], network[:, there])
    if row.background == "shaded":
        np.testing.assert_array_equal(answer, network)
    elif row.background == "light":
        np.testing.assert_array_equal(answer[:, empty], gbuffer.attributes["light"][:, empty])
    else:
        assert (answer[:, empty] == row.background).all()
    assert plan.computed == 128 * 256


@pytest.mark.parametrize("effect", [name for name, row in EFFECTS.items() if row.per_channel])
def test_a_per_channel_network_equals_three_single_runs(effect):
    gbuffer = view(effect)
    answer, _, net = shaded(effect, gbuffer, per_channel=True)
    assert len(net.predictions) == 3
    for channel in range(3):
        one = {
            name: np.repeat(array[channel : channel + 1], 3, 0)
            if ATTRIBUTES[name].coloured
            else array
            for name, array in gbuffer.attributes.items()
        }
        single, _, _ = shaded(effect, GBuffer(one, gbuffer.background), per_channel=True)
        np.testing.assert_array_equal(answer[channel], single[channel])
    _, _, net = shaded(effect, gbuffer, per_channel=False)
    assert len(net.predictions) == 1  # a network that takes all colours at once


@pytest.mark.parametrize("effect", ["ao", "sss", "dof"])
def test_tiles_of_nothing_are_left_out_and_no_pixel_changes(effect):
    gbuffer = view(effect, 300, 500)
    per_channel = EFFECTS[effect].per_channel
    whole, _, _ = shaded(effect, gbuffer, per_channel=per_channel)
    tiled, plan, net = shaded(effect, gbuffer, 64 * 64, per_channel=per_channel)
    np.testing.assert_allclose(tiled, whole, rtol=1e-6)
    assert {shape[2:] for shape in net.predictions} == {(64, 64)}  # compiled once
    # 5 rows of 9 tiles of 64, which answer 60; of dof the sky is blurred, too
    assert len(plan.tiles) == (5 * 9 if effect == "dof" else 5 * 5)


@pytest.mark.parametrize(("effect", "computes"), [("ao", False), ("sss", False), ("mb", True)])
def test_nothing_but_background(effect, computes):
    answer, plan, net = shaded(effect, view(effect, background="all"), per_channel=False)
    assert bool(net.predictions) == computes == (plan.computed > 0)
    assert np.isfinite(answer).all()


def test_a_cancelled_job_stops_before_its_next_tile():
    cancelled = threading.Event()
    net = engine(bundle("ao"))
    predict = net.predict
    net.predict = lambda x: cancelled.set() or predict(x)
    gbuffer = view("ao", background="none")
    plan = shading.plan_shading(gbuffer, net.bundle, ShadeParameters(), 64 * 64)
    with pytest.raises(shading.Cancelled):
        shading.infer(gbuffer, plan, net, cancelled)
    assert len(net.predictions) == 1 < len(plan.tiles)


@pytest.fixture(scope="module")
def half(make_picture, make_exr):
    """A picture whose left 60 % are background, with channels that no shader reads."""
    channels = make_picture(256, 480)
    for plane in channels.values():
        plane[:, :288] = 0
    for name in "RGB":
        channels[name] = np.ones((256, 480), np.float32)
    return make_exr(channels, half=True, attributes={"deepshade:fov": 50.0})


def shade(client, body, query=""):
    return client.post(f"/shade/ao{query}", content=body, headers=EXR)


def test_explain_is_the_plan_that_the_answers_header_holds(client, half):
    explained = shade(client, half, "?explain=1&bundle=tiny&radius=0.25")
    assert explained.headers["content-type"] == "application/json"
    assert "infer" not in explained.headers["server-timing"]
    plan = explained.json()
    answer = shade(client, half, "?bundle=tiny&radius=0.25")
    assert json.loads(exr.read_header(answer.content).parts[0].attributes["deepshade:plan"]) == plan

    assert (plan["effect"], plan["asked"]) == ("ao", {"bundle": "tiny"})
    assert "tiny" in plan["reason"]
    assert (plan["engine"], plan["precision"]) == ("onnxruntime", "fp32")
    assert (plan["radius"], plan["radius_source"]) == (0.25, "request")
    pixels = plan["pixels"]
    assert (pixels["width"], pixels["height"]) == (480, 256)
    assert pixels["background"] == 256 * 288
    assert (pixels["computed"], pixels["tiles"], pixels["tile"]) == (256 * 512, 1, [256, 512])
    for fact in ("computed_pixels", "background_pixels"):
        header = answer.headers["deepshade-" + fact.replace("_", "-")]
        assert int(header) == pixels[fact.removesuffix("_pixels")]


def test_channels_that_are_not_read_are_not_decoded(client, half):
    channels = shade(client, half, "?explain=1").json()["channels"]
    assert channels["in_file"] == 9
    wanted = {f"{layer}.{axis}" for layer in ("normal", "position") for axis in "XYZ"}
    assert set(channels["decoded"]) == wanted


def test_the_same_request_gets_the_same_bytes(start, half, models):
    first, second = (start(models=models).client for _ in range(2))
    answers = [shade(client, half).content for client in (first, first, second)]
    assert answers[0] == answers[1] == answers[2]


def test_the_lens_that_is_asked_for_overrides_the_header(make_exr):
    """Depth alone: the blur circle is derived from it, by similar triangles."""
    body = make_exr(
        {"Z": np.full((4, 8), 4, np.float32)} | {f"light.{c}": np.ones((4, 8)) for c in "RGB"},
        attributes={"deepshade:fov": 90.0, "deepshade:focus": 1.0, "deepshade:aperture": 9.0},
    )
    files = [SimpleNamespace(name="", data=body)]
    found = []
    for query in ({}, {"focus": 2.0, "aperture": 0.5}):
        asked, limits = ShadeParameters(**query), exr.Limits()
        headers = decoding.read_headers(files, asked, limits)
        (gbuffer,) = decoding.decode(files, headers, [bundle("dof")], asked, limits)
        found.append(float(gbuffer.attributes["focal"][0, 0, 0]))
    pixels_per_unit = 4.0  # 8 pixels across 2 units, at distance 1
    np.testing.assert_allclose(found[0], 9 * pixels_per_unit * (1 / 1 - 1 / 4), rtol=1e-5)
    np.testing.assert_allclose(found[1], 0.5 * pixels_per_unit * (1 / 2 - 1 / 4), rtol=1e-5)


@pytest.mark.parametrize(
    "query",
    [
        "max_error=0",
        "max_error=nan",
        "budget_ms=-1",
        "precision=fp8",
        "precision=fp64",
        "focus=1",
        "aperture=0.5",
    ],
)
def test_impossible_wishes(client, half, query):
    response = shade(client, half, f"?{query}")
    assert response.status_code == 422
    assert response.json()["type"].endswith("bad-parameter")
    assert query.partition("=")[0] in response.json()["detail"]


def test_an_engine_that_is_not_here(client, half):
    response = shade(client, half, "?engine=abacus")
    assert response.status_code == 422
    assert "abacus" in response.json()["detail"]
    assert "onnxruntime/fp32" in response.json()["available"]
