"""Light from all around: what holds for any weights, what is learnt from, the shipped bundle."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime as ort
import pytest
import torch

from deepshade import symmetry
from deepshade.bundles import Bundle, bundle_root
from deepshade.effects import EFFECTS
from deepshade.environments import Environment, Prepared, directions, solid_angles
from deepshade.environments.lamps import DIRECTIONS
from deepshade.tensors import tensor, up
from deepshade_trainer.lit import Lit
from deepshade_trainer.networks import Shader, build
from deepshade_trainer.networks.openings import Openings, OpeningsConfig

from .synthetic import OPENINGS, arrays, write_data

NAMES = Openings.environment
SHIPPED = sorted(path.parent for path in bundle_root().glob("do/*/config.json"))


def network(seed: int = 0) -> Openings:
    torch.manual_seed(seed)
    made = build(OpeningsConfig(**OPENINGS))
    assert isinstance(made, Openings)
    return made.eval()


def gbuffer(seed: int = 5, height: int = 32, width: int = 40) -> torch.Tensor:
    effect = EFFECTS["do"]
    given = effect, arrays("do", seed, height, width), effect.inputs, 0.5
    return torch.from_numpy(tensor(*given, per_channel=False))


def prepared(radiance: np.ndarray) -> Prepared:
    return Prepared.of(Environment("", radiance.astype(np.float32)))


def answer(made: Openings, light: Prepared, degrees: float = 0.0) -> np.ndarray:
    given = light.inputs(NAMES, degrees, "y", lambda: np.eye(3))
    with torch.inference_mode():
        return made(gbuffer(), *map(torch.from_numpy, given.values())).numpy()


def test_a_white_map_gives_ambient_occlusion_whatever_the_weights() -> None:
    made = network()
    light = prepared(np.full((3, 16, 32), 2))
    with torch.inference_mode():
        occlusion = made.trunk(gbuffer(), 3)[0]
    seen = answer(made, light)
    occlusion = torch.where(gbuffer()[:, 8:] < 0, occlusion, 1)  # elsewhere is nothing
    assert seen == pytest.approx(2 * occlusion.expand(-1, 3, -1, -1).numpy(), abs=1e-5)


def test_the_answer_is_linear_in_the_map() -> None:
    rng = np.random.default_rng(2)
    one, two = rng.random((2, 3, 16, 32)) * [[[[1.0]]], [[[50.0]]]]
    made = network()
    both = answer(made, prepared(3 * one + two))
    apart = 3 * answer(made, prepared(one)) + answer(made, prepared(two))
    assert both == pytest.approx(apart, rel=1e-4, abs=1e-3)
    assert both.std() > 0.1


def test_it_is_learnt_as_it_answers() -> None:
    """`lit` with what the graph looks up, here integrated over the map's pixels."""
    made = network()
    radiance = np.random.default_rng(3).random((3, 16, 32)).astype(np.float32)
    environment = Environment("", radiance)
    weights = (radiance * solid_angles(16, 32)[:, None]).reshape(3, -1)
    toward = directions(16, 32).reshape(3, -1)

    def blurred(axes: np.ndarray, exponent: int) -> torch.Tensor:  # axes (3, N)
        lobes = np.maximum(axes.T @ toward, 0) ** exponent
        found = (exponent + 1) / (2 * np.pi) * weights @ lobes.T
        return torch.from_numpy(found.astype(np.float32))[None]

    given = gbuffer()
    normal = given[0, :3].numpy().reshape(3, -1)
    irradiance = blurred(normal, 1).reshape(1, 3, *given.shape[2:])
    mean = torch.from_numpy(environment.mean.astype(np.float32))[:, None, None]
    irradiance[0] = torch.where(given[0, 8] < 0, irradiance[0], mean)
    through = blurred(made.towards[0, :, 0].numpy(), 32)
    with torch.inference_mode():
        expected = made.lit(given, irradiance, through).numpy()
    assert answer(made, Prepared.of(environment)) == pytest.approx(expected, abs=0.01)


def test_several_maps_at_once_are_each_alone() -> None:
    made, given = network(), gbuffer()
    irradiance = torch.rand(1, 6, *given.shape[2:])
    through = torch.rand(1, 6, 12)
    with torch.inference_mode():
        both = made.lit(given, irradiance, through)
        alone = [made.lit(given, irradiance[:, k], through[:, k]) for k in (slice(3), slice(3, 6))]
    assert torch.allclose(both, torch.cat(alone, 1), atol=1e-6)


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Lit:
    """Noise, as data."""
    folder = write_data(tmp_path_factory.mktemp("lit"), "do", 2)
    return Lit([folder], "do", network().towards.numpy(), 4)


def test_samples_are_relit_as_a_sum_over_their_open_directions(samples: Lit) -> None:
    """Unpacked, each multiplied by its cosine and its light."""
    sample = samples.load(0)
    light = np.random.default_rng(4).random((512, 3)).astype(np.float32)
    part = slice(40, 48), slice(10, 30)
    normal = sample["normal"][:, *part]
    reference, irradiance = samples._relit(0, normal, light, part)
    packed = samples._file(0).get_slice(samples.layer)[0][:, *part]
    open_ = np.unpackbits(packed, axis=0)
    cosines = np.einsum("sd,dhw->shw", DIRECTIONS, normal)
    expected = np.einsum("sc,shw->chw", light, open_ * cosines) * 4 / 512
    assert reference == pytest.approx(np.maximum(expected, 0), abs=1e-5)
    all_open = np.einsum("sc,shw->chw", light, np.maximum(cosines, 0)) * 4 / 512
    assert irradiance == pytest.approx(all_open, abs=2e-3)
    sky = slice(0, 4), slice(0, 4)
    for image in samples._relit(0, sample["normal"][:, *sky], light, sky):
        mean = np.broadcast_to(light.mean(0)[:, None, None], image.shape)
        assert image == pytest.approx(mean, rel=1e-5)


def test_the_error_of_what_is_open_is_that_under_each_lamp_alone(samples: Lit) -> None:
    """The answer to each of some lamps of radiance 1, against open or not."""
    made = network().train()
    gbuffer, _, irradiance, through, *probe = samples.batch([1], np.random.default_rng(6))
    at, open_, towards, shares = (part[0] for part in probe)
    image, error = made.learnt(gbuffer, irradiance, through, [(at, open_, towards, shares)])
    assert torch.allclose(image, made.lit(gbuffer, irradiance, through))
    cells = gbuffer[:, :, at[0] :: 4, at[1] :: 4]
    normal = cells[0, 3:6] / cells[0, 3:6].norm(dim=0).clamp_min(1e-6)
    whole = gbuffer[0, 3:6] / gbuffer[0, 3:6].norm(dim=0).clamp_min(1e-6)
    squares = []
    for k in range(0, 512, 37):
        lamp = torch.einsum("d,dhw->hw", towards[k], whole).clamp_min(0)
        alone = made.lit(gbuffer, lamp[None, None] / 128, shares[None, None, :, k])
        cosine = torch.einsum("d,dhw->hw", towards[k], normal).clamp_min(0)
        seen = alone[0, 0, at[0] :: 4, at[1] :: 4] * 128 - open_[k] * cosine
        squares.append(float((seen * (cells[0, 8] < 0)).square().mean().detach()))
    assert np.mean(squares) == pytest.approx(float(error.detach()), rel=0.15)


@pytest.mark.parametrize("turn", range(8))
def test_the_light_turns_with_the_picture(samples: Lit, turn: int) -> None:
    """A lamp is then seen where `symmetry.apply` puts a vector that points to it."""
    lamp = np.zeros((512, 3), np.float32)
    lamp[100] = 1
    moved = symmetry.apply(DIRECTIONS[100].reshape(3, 1, 1), "normal", turn)[:, 0, 0]
    towards = network().towards[0, :, 0].numpy()
    lobes = np.maximum(moved @ towards, 0) ** 32
    found = samples._through(lamp, turn)[0]
    assert found / found.max() == pytest.approx(lobes / lobes.max(), abs=0.05)
    assert found.argmax() == lobes.argmax()


def room(side: int) -> dict[str, np.ndarray]:
    """A floor seen from above, on which a wall 0.6 high and 0.1 thick stands along y."""
    x, y = (np.mgrid[0:side, 0:side][::-1] + 0.5) / side * 2 - 1
    y = -y
    wall = np.abs(x) < 0.05
    height = np.where(wall, 0.6, 0.0)
    position = np.stack([x, y, height - 4]).astype(np.float32)
    normal = np.zeros((3, side, side), np.float32)
    normal[2] = 1
    return {"position": position, "normal": normal, "normal_world": normal}


@pytest.mark.skipif(not SHIPPED, reason="models/do holds no bundle")
@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_a_sun_casts_its_shadow_on_the_side_away_from_it(path: Path) -> None:
    """Low in +x, then in -x; the space is the camera's, whose view is straight down."""
    bundle = Bundle.load(path)
    side = up(128, bundle.size_multiple)
    seen = room(side)
    given = tensor(EFFECTS["do"], seen, bundle.inputs, 0.6, per_channel=False)
    session = ort.InferenceSession(str(bundle.model), providers=["CPUExecutionProvider"])
    grid = directions(32, 64)
    found = []
    for sign in (1.0, -1.0):
        toward = np.array([sign, 0, 1]) / np.sqrt(2)
        sun = np.exp(200 * (np.tensordot(toward, grid, 1) - 1))
        light = prepared(np.broadcast_to(100 * sun + 0.1, (3, 32, 64)))
        inputs = light.inputs(bundle.environment, 0.0, "y", lambda: np.eye(3))
        (image,) = session.run(None, {bundle.input_name: given, **inputs})
        middle, near, wide = side // 2, round(side * 0.03), round(side * 0.12)
        left = image[0, 1, side // 4 : -side // 4, middle - wide : middle - near].mean()
        right = image[0, 1, side // 4 : -side // 4, middle + near : middle + wide].mean()
        found.append((left, right) if sign > 0 else (right, left))
        assert image.min() >= 0
    for away, toward_it in found:
        assert away < 0.8 * toward_it


def test_settings_that_make_no_network_are_refused() -> None:
    from deepshade.errors import ConfigError

    for change in ({"features": 0}, {"normal": None}, {"position": 3}, {"fold": 3, "detail": ()}):
        with pytest.raises(ConfigError):
            replace(OpeningsConfig(), **change)


def test_a_shader_lights_what_it_pads() -> None:
    shader = Shader(EFFECTS["do"], network()).eval()
    given = gbuffer(height=29, width=37)
    irradiance, through = torch.rand(1, 3, 29, 37), torch.rand(1, 3, 12)
    with torch.inference_mode():
        image, error = shader.lit(shader.padded(given), irradiance, through)
    assert error == 0
    assert image.shape == (1, 3, 32, 40)
