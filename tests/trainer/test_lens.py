"""Image-based light times occlusion through a lens: against its parts, and as light behaves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from deepshade.bundles import Bundle
from deepshade.engines import load_engine, usable
from deepshade.environments import Environment, Prepared, sky
from deepshade_trainer.calculated import calculated, picture
from deepshade_trainer.graph import session
from deepshade_trainer.networks import Shader, from_bundle
from deepshade_trainer.networks.lens import ATTRIBUTES, Lens
from deepshade_trainer.networks.reflections import Reflections

MODELS = Path(__file__).resolve().parents[2] / "models"
SHIPPED = MODELS / "full/balanced"
FOCAL = 19  # the last channel


@pytest.fixture(scope="module")
def shader() -> Shader:
    return calculated("full", "lens", Bundle.load(MODELS / "ao/fast"))[1]


@pytest.fixture(scope="module")
def daylight() -> dict[str, np.ndarray]:
    return Prepared.of(sky(height=32)).inputs(Lens.environment, 20.0, "y")


def answer(shader: Shader, gbuffer: np.ndarray, given: dict[str, np.ndarray]) -> np.ndarray:
    inputs = [torch.from_numpy(each) for each in (gbuffer, *given.values())]
    with torch.inference_mode():
        found: np.ndarray = shader(*inputs).numpy()
    return found


@pytest.mark.slow
def test_in_focus_it_is_ibl_times_ao(shader: Shader, daylight: dict[str, np.ndarray]) -> None:
    gbuffer = picture(96, ATTRIBUTES)
    gbuffer[:, FOCAL] = 0
    gbuffer[:, 18, :, :48] *= 0.9  # one half nearer: it occludes the other
    inputs = [torch.from_numpy(each) for each in (gbuffer[:, :13], *daylight.values())]
    with torch.inference_mode():
        light = Reflections().eval()(*inputs).numpy()
        openness = from_bundle(MODELS / "ao/fast")(torch.from_numpy(gbuffer[:, 13:19])).numpy()
    assert openness.min() < 0.95
    found = answer(shader, gbuffer, daylight)
    np.testing.assert_allclose(found, light * openness, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_it_is_linear_in_the_environment(shader: Shader, daylight: dict[str, np.ndarray]) -> None:
    gbuffer = picture(64, ATTRIBUTES)
    other = daylight["lobes"][:, ::-1] ** 2
    both = {**daylight, "lobes": 300 * daylight["lobes"] + other}
    parts = [
        answer(shader, gbuffer, daylight | {"lobes": table.copy()})
        for table in (daylight["lobes"], other)
    ]
    expected = 300 * parts[0] + parts[1]
    np.testing.assert_allclose(answer(shader, gbuffer, both), expected, rtol=1e-4)


@pytest.mark.slow
def test_the_white_furnace(shader: Shader) -> None:
    """An open white wall under a white map shows its reflectance, blurred or not."""
    white = Prepared.of(Environment("", np.ones((3, 8, 16), np.float32)))
    side = 96
    across = ((np.arange(side) + 0.5) / side - 0.5) * 4
    gbuffer = np.zeros((1, 20, side, side), np.float32)
    gbuffer[:, 2] = gbuffer[:, 5] = gbuffer[:, 15] = 1  # normals and views towards +z
    gbuffer[:, 6:9] = 0.6
    gbuffer[:, 16], gbuffer[:, 17] = across, -across[:, None]
    gbuffer[:, 18] = -4
    gbuffer[:, FOCAL] = np.linspace(-30, 30, side)
    found = answer(shader, gbuffer, white.inputs(Lens.environment, 0.0, "y"))
    assert found == pytest.approx(0.6, rel=0.03)


@pytest.mark.slow
def test_nothing_farther_than_the_halo_counts(
    shader: Shader, daylight: dict[str, np.ndarray]
) -> None:
    """The left part of a wide picture, alone with its halo, is what it is in the whole."""
    ball = picture(64, ATTRIBUTES)
    whole = np.concatenate([ball, ball[..., ::-1], ball[..., ::-1, :], *[ball] * 5], axis=3)
    whole[:, FOCAL] += 8
    inner = 128
    wide = inner + -(-shader.halo // shader.size_multiple) * shader.size_multiple
    assert wide < whole.shape[3]
    left = answer(shader, np.ascontiguousarray(whole[..., :wide]), daylight)[..., :inner]
    np.testing.assert_allclose(left, answer(shader, whole, daylight)[..., :inner], rtol=1e-5)


@pytest.mark.slow
def test_every_engine_gives_the_same(shader: Shader, daylight: dict[str, np.ndarray]) -> None:
    bundle = Bundle.load(SHIPPED)
    assert (bundle.size_multiple, bundle.halo) == (shader.size_multiple, shader.halo)
    gbuffer = picture(96, ATTRIBUTES)
    expected = answer(shader, gbuffer, daylight)
    for backend in usable(bundle):
        engine = load_engine(bundle, backend, threads=1)
        found = engine.predict(gbuffer, daylight)
        most = 2e-3 if backend.precision == "fp32" else 0.05
        assert np.abs(found - expected).mean() < most * expected.mean(), backend


@pytest.mark.slow
def test_16_and_8_bits_never_see_the_light(daylight: dict[str, np.ndarray]) -> None:
    """What the trunk takes and gives stays to the last bit with 1,024 times the light."""
    import onnx
    from openvino import Core

    from deepshade.engines.splitting import split

    bundle = Bundle.load(SHIPPED)
    pieces = split(Core().read_model(str(bundle.model)), bundle.float32, bundle.float32_after)
    assert [piece.exact for piece in pieces] == [True, False, True]
    trunk = pieces[1]
    assert sorted(trunk.gives) == sorted(bundle.float32_after)
    names = list(dict.fromkeys((*trunk.taken, *trunk.gives)))
    graph = onnx.load(bundle.model)
    graph.graph.output.extend(onnx.ValueInfoProto(name=name) for name in names)
    running = session(graph.SerializeToString())
    feed = {bundle.input_name: picture(96, ATTRIBUTES), **daylight}
    bright = feed | {"lobes": daylight["lobes"] * 1024}
    for name, before, after in zip(
        names, running.run(names, feed), running.run(names, bright), strict=True
    ):
        assert (before == after).all(), name
    assert {name.split(".")[0] for name in bundle.int8} == {"occlusion"}
