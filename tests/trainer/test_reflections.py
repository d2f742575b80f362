"""Image-based lighting by look-ups, against sums over the map in float64, and on every engine."""

import hashlib

import numpy as np
import pytest
import torch
from safetensors.numpy import save

from deepshade import judging, metrics
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade.engines import load_engine, usable
from deepshade.environments import (
    Environment,
    Prepared,
    directions,
    sky,
    solid_angles,
    world_to_map,
)
from deepshade.environments.stored import store
from deepshade.manifest import Manifest, Shard
from deepshade_trainer.calculated import export_calculated, picture
from deepshade_trainer.evaluation import evaluate
from deepshade_trainer.networks import phong
from deepshade_trainer.networks.reflections import ATTRIBUTES, Reflections, ReflectionsConfig

COUNT = 64


@pytest.fixture(scope="module")
def shaders():
    return {lobes: Reflections(ReflectionsConfig(lobes=lobes)).eval() for lobes in (1, 2)}


@pytest.fixture(scope="module")
def soft():
    """A map without a sun: a few broad lights."""
    grid = directions(64, 128)
    light = np.full((3, 64, 128), 0.1)
    for seed in range(6):
        draw = np.random.default_rng(seed)
        towards = draw.normal(size=3)
        cosine = np.tensordot(towards / np.linalg.norm(towards), grid, axes=1)
        light += draw.uniform(0.5, 3, 3)[:, None, None] * np.exp(20 * (cosine - 1))
    return Prepared.of(Environment("soft", light))


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=0)


def seen(seed=0, count=COUNT):
    """Normals and directions to the eye (3, count), from face on to grazing."""
    draw = np.random.default_rng(seed)
    normal, other = (
        unit(draw.normal(size=(2, 3, count)).swapaxes(0, 1))[:, 0],
        draw.normal(size=(3, count)),
    )
    aside = unit(np.cross(normal, other, axis=0))
    mu = np.sqrt(draw.uniform(0.01, 1, count))
    return normal, mu * normal + np.sqrt(1 - mu * mu) * aside


def gbuffer(normal, view, diffuse, specular, gloss):
    planes = np.zeros((1, 13, 1, normal.shape[1]), np.float32)
    planes[0, :3, 0], planes[0, 3:6, 0] = normal, view
    planes[0, 6:9], planes[0, 9:12], planes[0, 12] = diffuse, specular, gloss
    return planes


def answer(shader, prepared, planes, degrees=0.0, up="y"):
    given = [
        torch.from_numpy(each)
        for each in prepared.inputs(Reflections.environment, degrees, up).values()
    ]
    with torch.inference_mode():
        return shader(torch.from_numpy(planes), *given).numpy()[0, :, 0]


def summed(environment, normal, view, gloss):
    """The specular integral, pixel by pixel."""
    grid = directions(*environment.shape).reshape(3, -1)
    weights = np.repeat(solid_angles(*environment.shape), environment.shape[1])
    mirrored = 2 * (normal * view).sum(0) * normal - view
    lobe = np.maximum(mirrored.T @ grid, 0) ** gloss * np.maximum(normal.T @ grid, 0) * weights
    return (gloss + 2) / (2 * np.pi) * (environment.radiance.reshape(3, -1) @ lobe.T)


def test_the_table_knows_what_is_known():
    """Face on nothing is cut off, and far above the horizon next to nothing is."""
    for exponent in (1, 30, 1000):
        assert phong._entry(1.0, exponent, 2)[0] == pytest.approx(0, abs=1e-4)
        assert phong._entry(1.0, exponent, 2)[3] == pytest.approx(0, abs=0.01)
    assert phong._entry(0.6, 1000, 1)[0] == pytest.approx(0, abs=1e-3)
    # ∫ max(0, R·ω) max(0, N·ω) dω for N at a right angle to R is 2/3: times 3/(2π)
    assert phong._entry(0.0, 1, 1)[0] == pytest.approx(1 / np.pi, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("lobes", "most"), [(1, 0.08), (2, 0.035)])
def test_as_summed_over_the_map(shaders, soft, lobes, most):
    normal, view = seen()
    for gloss in (1, 3, 10, 40, 200):
        expected = summed(soft.environment, normal, view, gloss)
        found = answer(shaders[lobes], soft, gbuffer(normal, view, 0, 1, gloss))
        assert np.abs(found - expected).mean() < most * expected.mean(), gloss


@pytest.mark.slow
def test_diffuse_as_summed_over_the_map(shaders, soft):
    normal, view = seen()
    grid = directions(*soft.environment.shape).reshape(3, -1)
    weights = np.repeat(solid_angles(*soft.environment.shape), soft.environment.shape[1])
    cosine = np.maximum(normal.T @ grid, 0) * weights / np.pi
    expected = 0.3 * soft.environment.radiance.reshape(3, -1) @ cosine.T
    found = answer(shaders[1], soft, gbuffer(normal, view, 0.3, 0, 50))
    np.testing.assert_allclose(found, expected, rtol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("lobes", [1, 2])
def test_the_white_furnace(shaders, lobes):
    white = Prepared.of(Environment("", np.ones((3, 8, 16), np.float32)))
    normal, view = seen(1)
    for gloss in (1, 77, 10_000):
        diffuse = answer(shaders[lobes], white, gbuffer(normal, view, 0.6, 0, gloss))
        np.testing.assert_allclose(diffuse, 0.6, rtol=1e-5)
        facing = answer(shaders[lobes], white, gbuffer(normal, normal, 0.2, 0.6, gloss))
        np.testing.assert_allclose(facing, 0.8, rtol=2e-3)
        both = answer(shaders[lobes], white, gbuffer(normal, view, 0.4, 0.6, gloss))
        assert both.max() <= 1.001


@pytest.mark.slow
@pytest.mark.parametrize("lobes", [1, 2])
def test_glossy_tends_to_a_mirror(shaders, soft, lobes):
    normal, view = seen(2)
    mu = (normal * view).sum(0)
    mirrored = 2 * mu * normal - view
    expected = soft.environment.sample(mirrored) * mu
    found = answer(shaders[lobes], soft, gbuffer(normal, view, 0, 1, 10_000))
    clear = mu > 0.2
    np.testing.assert_allclose(found[:, clear], expected[:, clear], rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("lobes", [1, 2])
def test_no_brighter_than_the_map(shaders, lobes):
    prepared = Prepared.of(sky(height=64))
    normal, view = seen(3, 512)
    gloss = 10 ** np.random.default_rng(0).uniform(0, 4, 512)
    found = answer(shaders[lobes], prepared, gbuffer(normal, view, 0.5, 0.5, gloss))
    most = prepared.environment.radiance.max((1, 2))
    assert (found.max(1) <= 1.001 * most).all()
    assert found.min() >= 0
    assert np.isfinite(found).all()


@pytest.mark.slow
def test_background_is_the_map_behind_it(shaders, soft):
    _, view = seen(4)
    nothing = np.zeros_like(view)
    behind = answer(shaders[2], soft, gbuffer(nothing, view, 0, 0, 0))
    np.testing.assert_allclose(behind, soft.environment.sample(-view), rtol=0.01)
    unknown = answer(shaders[2], soft, gbuffer(nothing, nothing, 0, 0, 0))
    np.testing.assert_allclose(
        unknown.T, np.broadcast_to(soft.environment.mean, (COUNT, 3)), rtol=1e-5
    )


@pytest.mark.slow
@pytest.mark.parametrize(("degrees", "up"), [(50.0, "y"), (-140.0, "z")])
def test_turned_is_as_from_elsewhere(shaders, soft, degrees, up):
    """A turned map over a surface is the map over a surface turned back."""
    normal, view = seen(5)
    turn = world_to_map(degrees, up)
    turned = answer(shaders[1], soft, gbuffer(normal, view, 0.4, 0.4, 30), degrees, up)
    plain = answer(shaders[1], soft, gbuffer(turn @ normal, turn @ view, 0.4, 0.4, 30))
    np.testing.assert_allclose(turned, plain, rtol=1e-3)


@pytest.mark.slow
def test_every_engine_gives_the_same(tmp_path, shaders, soft):
    bundle, _ = export_calculated(tmp_path / "ibl" / "small", "reflections")
    assert Bundle.load(bundle.path).environment == Reflections.environment
    planes = picture(48, ATTRIBUTES)
    given = soft.inputs(bundle.environment, 20.0, "z")
    with torch.inference_mode():
        inputs = [torch.from_numpy(each) for each in (planes, *given.values())]
        expected = shaders[1](*inputs).numpy()
    backends = usable(bundle)
    assert {backend.precision for backend in backends} == {"fp32"}  # no other is offered
    for backend in backends:
        engine = load_engine(bundle, backend, threads=1)
        engine.warm()
        found = engine.predict(planes, given)
        np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-4)
        engine.shrink()
        np.testing.assert_array_equal(engine.predict(planes, given), found)


@pytest.mark.slow
def test_samples_are_judged_under_their_own_environment(tmp_path, shaders, soft):
    """A data set whose references are the answers themselves, under a turned map."""
    planes = picture(48, ATTRIBUTES)
    given = soft.inputs(Reflections.environment, 65.0, "y")
    with torch.inference_mode():
        inputs = [torch.from_numpy(each) for each in (planes, *given.values())]
        sample = {"reference_ibl": shaders[1](*inputs).numpy()[0]}
    for name, place in shaders[1].places.items():
        sample[name] = planes[0, place]
    folder = tmp_path / "data"
    store(folder, soft.environment)
    content = save({name: array[None] for name, array in sample.items()})
    (folder / "shard-00000.safetensors").write_bytes(content)
    environment = {
        "environment": "soft",
        "environment_sha256": soft.environment.sha256,
        "rotate": 65.0,
    }
    record = {"scene": "ball", "seed": 0, "camera": {}, **environment}
    digest = hashlib.sha256(content).hexdigest()
    schema = {n: {"dtype": "float32", "shape": list(a.shape)} for n, a in sample.items()}
    Manifest({}, schema, [Shard("shard-00000.safetensors", digest, [record])]).write(folder)
    bundle, _ = export_calculated(tmp_path / "ibl" / "small", "reflections")
    (row,) = evaluate(bundle, [folder], min_contrast=0)
    assert row.figures["dssim"] < 1e-5
    trivial = planes[:, 6:9] * soft.environment.mean[:, None, None]
    image, nothing = judging.exposed(
        EFFECTS["ibl"], sample["reference_ibl"], sample["reference_ibl"], trivial[0]
    )
    assert row.figures["trivial_dssim"] == pytest.approx(metrics.dssim(nothing, image))
