"""Every row of the table of effects, from arrays to a served answer: nothing knows their names.

`tests/trainer/test_nine.py` has a batch, a training step and the exported graph of each.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from deepshade import exr, judging, metrics, tensors
from deepshade.attributes import ATTRIBUTES, RADIANCE
from deepshade.bundles import Bundle
from deepshade.camera import camera_to_world
from deepshade.effects import EFFECTS
from deepshade.engines import Backend, Engine, available, load_engine
from deepshade.environments import Prepared, sky
from deepshade.gbuffer import GBuffer
from deepshade_service import shading
from deepshade_service.config import Settings
from deepshade_service.parameters import ShadeParameters
from deepshade_trainer.graph import session
from deepshade_trainer.networks import from_bundle

from .service.conftest import ORDINARY, Local, encode
from .trainer.synthetic import LEARNT, RADIUS, arrays, make_bundle

HEIGHT, WIDTH = 53, 71  # odd; the service pads them to 64 x 128
EMPTY = HEIGHT // 2  # rows with nothing but sky
CARRIED = [name for name, row in EFFECTS.items() if row.per_channel]  # linear in their light
# Graphs in pieces, as 16 bits take them, also where the CPU has none and so calculates in 32.
PIECES = Backend("openvino", "bf16")
BACKENDS = list(dict.fromkeys([*available(), PIECES]))


@pytest.fixture(scope="module")
def models(made_once: Path) -> Path:
    """A folder with a bundle of every effect: trained for one step, or calculated."""
    root = made_once / "balanced"
    for effect in EFFECTS:
        make_bundle(effect, root)
    return root


@pytest.fixture(scope="module")
def local(models: Path) -> Iterator[Local]:
    local = Local(Settings(**ORDINARY, models=models))
    local.wait()
    yield local
    local.stop()


def scene(effect: str, height: int = HEIGHT, width: int = WIDTH) -> dict[str, np.ndarray]:
    """The effect's inputs (C, H, W), light up to 1e5, in the types that shards have."""
    return {n: a.astype(np.float32) for n, a in arrays(effect, 7, height, width).items()}


def relit(inputs: dict[str, np.ndarray], change: Any) -> dict[str, np.ndarray]:
    """The inputs with `change` made of their light."""
    lit = {name for name in inputs if ATTRIBUTES[name].unit is RADIANCE}
    return {
        name: change(planes).astype(np.float32) if name in lit else planes
        for name, planes in inputs.items()
    }


def asked(
    local: Local,
    effect: str,
    inputs: dict[str, np.ndarray],
    depth: np.ndarray | None = None,
    header: dict[str, Any] | None = None,
    **query: Any,
) -> Any:
    """The service's response to these inputs, sent as an EXR with depth as a marker."""
    height, width = inputs[EFFECTS[effect].inputs[0]].shape[1:]
    if depth is None:
        depth = np.ones((height, width), np.float32)
        depth[: height // 2] = 0
    channels = {"Z": depth}
    for name, planes in inputs.items():
        channels |= dict(zip(ATTRIBUTES[name].channels, planes, strict=True))
    radius = {"radius": RADIUS} if "radius" in EFFECTS[effect].settings else {}
    return local.client.post(
        f"/shade/{effect}",
        params={"half": "false", **radius, **query},
        content=encode(channels, attributes=header or {}),
        headers={"Content-Type": "image/x-exr"},
    )


def shaded(
    local: Local, effect: str, inputs: dict[str, np.ndarray], *more: Any, **query: Any
) -> np.ndarray:
    """(C, H, W): the service's answer."""
    response = asked(local, effect, inputs, *more, **query)
    assert response.status_code == 200, response.text
    return exr.read(response.content).stack(EFFECTS[effect].outputs)


def engine_of(bundle: Bundle, backend: Backend) -> Engine:
    """The engine of a backend, or of `PIECES`."""
    if backend in available():
        return load_engine(bundle, backend, threads=2)
    engine: Any = load_engine(bundle, Backend(backend.engine, "fp32"), threads=2)
    engine._type = "bf16"
    return engine  # type: ignore[no-any-return]


def network_input(bundle: Bundle, inputs: dict[str, np.ndarray]) -> np.ndarray:
    """(1, C, h, w) of a network that takes all colours at once."""
    assert not bundle.per_channel
    multiple = bundle.size_multiple
    row = EFFECTS[bundle.effect]
    return tensors.tensor(row, inputs, bundle.inputs, RADIUS, per_channel=False, multiple=multiple)


@pytest.mark.slow
@pytest.mark.parametrize("effect", EFFECTS)
def test_a_served_answer_is_the_networks(models: Path, local: Local, effect: str) -> None:
    """Equal to PyTorch on the padded tensor, and background as the row says."""
    inputs = scene(effect)
    answer = shaded(local, effect, inputs)
    assert answer.shape == (len(EFFECTS[effect].outputs), HEIGHT, WIDTH)
    bundle = Bundle.load(models / effect / "balanced")
    rows, columns = (tensors.up(side, bundle.size_multiple) for side in (64, 128))
    scale = tensors.length_scale(EFFECTS[effect], inputs, RADIUS)
    runs = range(3) if bundle.per_channel else (None,)
    planes = [tensors.planes(inputs, bundle.inputs, scale, channel=run) for run in runs]
    given = np.concatenate([tensors.cut(each, (0, rows, 0, columns)) for each in planes])
    light = Prepared.of(sky(height=512)) if bundle.environment else None
    more = (
        light.inputs(bundle.environment, 0.0, "y", partial(camera_to_world, inputs))
        if light
        else {}
    )
    with torch.inference_mode():
        shader = from_bundle(bundle.path)
        answered = shader(*map(torch.from_numpy, (given, *more.values())))
    expected = answered.flatten(0, 1).numpy()
    expected = expected[:, :HEIGHT, :WIDTH].clip(*EFFECTS[effect].range)
    background = EFFECTS[effect].background
    if background == "light":
        expected[:, :EMPTY] = inputs["light"][:, :EMPTY]
    elif background != "shaded":
        expected[:, :EMPTY] = background
    assert np.isfinite(answer).all()
    assert (np.abs(answer - expected) <= 1e-4 * np.maximum(1, np.abs(expected))).all()


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1e-3, 1e3])
@pytest.mark.parametrize("effect", CARRIED)
def test_the_answer_scales_with_the_light(local: Local, effect: str, factor: float) -> None:
    """Light of up to 1e5 and down to 1e-3, and a thousand times more and less of it."""
    inputs = scene(effect)
    answer = shaded(local, effect, inputs)
    scaled = shaded(local, effect, relit(inputs, lambda light: light * factor))
    assert scaled / factor == pytest.approx(answer, rel=1e-3, abs=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS, ids=str)
@pytest.mark.parametrize("effect", CARRIED)
def test_light_is_carried_in_every_precision(models: Path, effect: str, backend: Backend) -> None:
    """It scales, and a pixel of 1e5 adds what it would give alone, and nothing else."""
    bundle = Bundle.load(models / effect / "balanced")
    if bundle.exact and backend.precision != "fp32":
        pytest.skip("never offered")
    engine = engine_of(bundle, backend)
    inputs = scene(effect)
    given = network_input(bundle, inputs)
    answer = engine.predict(given)
    for factor in (1e-3, 1e3, 1e5):
        scaled = network_input(bundle, relit(inputs, lambda light, f=factor: light * f))
        close = 1e-3 * np.abs(answer) + 1e-6 * np.abs(answer).max()
        assert (np.abs(engine.predict(scaled) / np.float32(factor) - answer) <= close).all()

    firefly = np.zeros((3, HEIGHT, WIDTH))
    firefly[:, 40, 30] = 1e5
    even, alone, both = (
        engine.predict(network_input(bundle, relit(inputs, change)))
        for change in (
            lambda light: 1 + light % 1,
            lambda light: firefly,
            lambda light: 1 + light % 1 + firefly,
        )
    )
    if effect == "aa":  # whose edges are found in light, so that superposition ends at them
        row, column = np.ogrid[: even.shape[2], : even.shape[3]]
        away = np.maximum(abs(row - 40), abs(column - 30))
        assert (away > bundle.halo).any()
        assert (even == both)[..., away > bundle.halo].all()
        return
    # of gi what would be negative is 0
    counts = np.ones(even.shape, bool) if effect != "gi" else (even > 0) & (alone > 0)
    assert counts.mean() > 0.005
    assert (np.abs(both - even - alone) <= 1e-4 * (even + alone))[counts].all()


@pytest.mark.parametrize("effect", [each for each in CARRIED if each in LEARNT])
def test_what_is_calculated_in_16_or_8_bits_never_sees_the_light(models: Path, effect: str) -> None:
    """What the 16-bit part takes and gives stays to the last bit with 1,024 times the light."""
    import onnx
    from openvino import Core

    from deepshade.engines.splitting import split

    bundle = Bundle.load(models / effect / "balanced")
    graph = onnx.load(bundle.model)
    pieces = split(Core().read_model(str(bundle.model)), bundle.float32, bundle.float32_after)
    assert [piece.exact for piece in pieces] == [True, False, True]
    assert not pieces[1].channels  # nothing of the picture itself
    names = [*pieces[1].taken, *pieces[1].gives]
    assert pieces[1].taken and pieces[1].gives == bundle.float32_after
    graph.graph.output.extend(onnx.ValueInfoProto(name=name) for name in names)
    running = session(graph.SerializeToString())
    inputs = scene(effect)
    brighter = relit(inputs, lambda light: light * 1024)
    plain, bright = (
        running.run(names, {bundle.input_name: network_input(bundle, each)})
        for each in (inputs, brighter)
    )
    for name, before, after in zip(names, plain, bright, strict=True):
        assert (before == after).all(), name
        assert np.ptp(before) > 0
    assert bundle.int8
    assert all(name.startswith("trunk.") for name in bundle.int8)


@pytest.mark.slow
@pytest.mark.parametrize("effect", CARRIED)
def test_light_in_16_bits_costs_next_to_nothing(local: Local, effect: str) -> None:
    inputs = relit(scene(effect), lambda light: light.clip(0, 6e4))
    rounded = relit(inputs, lambda light: light.astype(np.float16))
    exact, coarse = (shaded(local, effect, each) for each in (inputs, rounded))
    image, truth = judging.exposed(EFFECTS[effect], exact, coarse, exact)
    assert metrics.ssim(image, truth) > 0.998


@pytest.mark.slow
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("effect", CARRIED)
def test_light_that_is_not_finite_is_background(local: Local, effect: str, value: float) -> None:
    """It counts as a pixel without a surface or light, as if the file had said so."""
    inputs, depth = scene(effect), np.ones((HEIGHT, WIDTH), np.float32)
    depth[:EMPTY] = 0
    broken, hole = (relit(inputs, lambda light: light.copy()) for _ in range(2))
    (name,) = (name for name in inputs if ATTRIBUTES[name].unit is RADIANCE)
    broken[name][1, 40, 30] = value
    hole[name][:, 40, 30] = 0
    if "depth" in hole:
        hole["depth"] = hole["depth"] * depth
        hole["depth"][0, 40, 30] = 0
    response = asked(local, effect, broken, depth)
    assert response.headers["deepshade-nonfinite-pixels"] == "1"
    depth[40, 30] = 0
    found = exr.read(response.content).stack(EFFECTS[effect].outputs)
    assert np.isfinite(found).all()
    assert (found == shaded(local, effect, hole, depth)).all()


@pytest.mark.slow
@pytest.mark.parametrize("effect", CARRIED)
@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (31, 33)])
def test_any_size(local: Local, effect: str, size: tuple[int, int]) -> None:
    """As if the picture were larger, with nothing there."""
    inputs, depth = scene(effect, *size), np.ones(size, np.float32)
    answer = shaded(local, effect, inputs, depth)
    more = (0, 0), (0, 64), (0, 64)
    wide = {
        name: np.pad(planes, more, "edge" if ATTRIBUTES[name].goes_on else "constant")
        for name, planes in inputs.items()
    }
    wider = shaded(local, effect, wide, np.pad(depth, (0, 64)))
    assert answer.shape == (3, *size)
    found = wider[:, : size[0], : size[1]]
    assert (np.abs(answer - found) <= 1e-4 * np.abs(found) + 1e-5 * np.abs(found).max()).all()


@pytest.mark.slow
@pytest.mark.parametrize("effect", CARRIED)
def test_tiles_equal_the_whole_however_wide_the_blur(models: Path, effect: str) -> None:
    bundle = Bundle.load(models / effect / "balanced")
    engine = load_engine(bundle, Backend("onnxruntime", "fp32"), threads=2)
    halo = tensors.up(bundle.halo, bundle.size_multiple)
    height, width = 61, 4 * tensors.up(max(halo, 64), 64) + 203
    inputs = scene(effect, height, width)
    for name, most in (("focal", 48), ("motion", 64), ("scatter", 2)):
        if name in inputs:
            inputs[name] = inputs[name] * np.float32(most)
    background = np.zeros((height, width), bool)
    background[: height // 2] = True
    gbuffer = GBuffer(relit(inputs, lambda light: light.clip(0, 100)), background)
    answers = []
    for pixels in (10**9, 1):
        query = {"radius": RADIUS} if "radius" in EFFECTS[effect].settings else {}
        plan = shading.plan_shading(gbuffer, bundle, ShadeParameters(**query), pixels)
        answers.append(shading.infer(gbuffer, plan, engine, threading.Event()))
    assert len(plan.tiles) > 1
    assert np.abs(answers[1] - answers[0]).max() <= 1e-5 * np.abs(answers[0]).max()


def wall(effect: str, sky: float, **attributes: float) -> dict[str, np.ndarray]:
    """A dark wall, of light 1 to 1.1, in the left 36 columns of 64 x 72, and sky of light `sky`."""
    planes = scene(effect, 64, 72)
    for name, array in planes.items():
        array[:] = 0
        if ATTRIBUTES[name].unit is RADIANCE:
            array[:] = 1 + 0.1 * np.random.default_rng(3).random(array.shape)
            array[:, :, 36:] = sky
        elif name == "position":
            y, x = (np.mgrid[0:64, 0:72] + 0.5) / 64
            array[:] = np.stack([x - 0.5, 0.5 - y, np.full_like(x, -1)]) * 4
        elif name == "normal":
            array[2] = 1
        elif name == "depth":
            array[:, :, :36] = 4
        elif name in attributes:
            array[:1, :, :36] = attributes[name]
            if name == "focal":
                array[:, :, 36:] = 24
        elif name == "scatter":
            array[:] = 0.1
    return planes


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "attributes", "reach"),
    [
        ("gi", {}, 0),
        ("sss", {}, 0),
        ("aa", {}, 1),
        ("mb", {"motion": 0}, 0),
        ("mb", {"motion": 12}, 8),
        ("dof", {"focal": 0}, 1),
        ("dof", {"focal": -16}, 26),
        ("dof", {"focal": 16}, 26),
    ],
)
def test_a_bright_sky_lights_nothing_before_it(
    local: Local, effect: str, attributes: dict[str, float], reach: int
) -> None:
    """Beyond its blur's `reach` a wall is as dark before a sky of 1e4 as before one like itself."""
    depth = np.full((64, 72), 4, np.float32)
    depth[:, 36:] = 0
    even, bright = (
        shaded(local, effect, wall(effect, sky, **attributes), depth) for sky in (1.0, 1e4)
    )
    inner = slice(0, 36 - reach)
    assert bright[:, :, inner] == pytest.approx(even[:, :, inner], rel=1e-3)
    # nor does the wall darken the sky farther than it reaches, and between them all is between
    if EFFECTS[effect].trivial == "light":
        assert bright[:, :, 36 + reach + 1 :] == pytest.approx(1e4, rel=1e-3)
        assert bright.min() >= 0.999
        assert bright.max() <= 1e4 * 1.001


@pytest.mark.slow
def test_a_lens_asked_for_makes_its_own_blur_circles(local: Local) -> None:
    """Those in the file are of another lens; without depth that can't be helped."""
    inputs = {"light": scene("dof")["light"], "focal": np.full((1, HEIGHT, WIDTH), 9, np.float32)}
    depth = np.full((HEIGHT, WIDTH), 2, np.float32)
    camera = {"deepshade:fov": 50.0}
    query = {"focus": 2.0, "aperture": 0.1}
    sharp = shaded(local, "dof", inputs, depth, camera, **query)
    assert sharp == pytest.approx(inputs["light"], rel=1e-3)
    assert np.abs(shaded(local, "dof", inputs, depth, camera) - sharp).max() > 1
    del query["aperture"]
    response = asked(local, "dof", inputs, depth, camera, **query)
    assert response.status_code == 422
    assert "deepshade:aperture" in response.text


@pytest.mark.slow
def test_a_shutter_asked_for_scales_the_motion(local: Local) -> None:
    inputs, depth = scene("mb"), np.full((HEIGHT, WIDTH), 2, np.float32)
    inputs["motion"] *= 9
    header = {"deepshade:shutter": 0.5}
    twice = {**inputs, "motion": inputs["motion"] * 2}
    response = asked(local, "mb", inputs, depth, header, shutter=1.0)
    answer = exr.read(response.content).stack("RGB")
    assert response.headers["deepshade-shutter"] == "1"
    assert (answer == shaded(local, "mb", twice, depth)).all()
    still = shaded(local, "mb", inputs, depth, header, shutter=0.0)
    assert still == pytest.approx(inputs["light"], rel=1e-4)
    for told, query, text in (
        ({}, 1.0, "deepshade:shutter"),
        (header, 1.5, "shutter"),
        ({"deepshade:shutter": "long"}, 1.0, "from 0 to 1"),
    ):
        response = asked(local, "mb", inputs, depth, told, shutter=query)
        assert response.status_code == 422
        assert text in response.text
    response = asked(local, "aa", scene("aa"), shutter=1.0)
    assert response.status_code == 422
    assert "no setting 'shutter'" in response.text
