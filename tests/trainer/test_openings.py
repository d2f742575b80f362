"""Light from all around: what holds for any weights, what is learnt from, the shipped bundle."""

from __future__ import annotations

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
from deepshade.errors import ConfigError
from deepshade.gbuffer import load_gbuffer
from deepshade.tensors import tensor, up
from deepshade_trainer.lit import Lit
from deepshade_trainer.networks import Shader, build, from_bundle, network_config, slices
from deepshade_trainer.networks.openings import Openings, OpeningsConfig

from .synthetic import OPENINGS, arrays, write_data

NAMES = Openings.environment
SHIPPED = sorted(path.parent for path in bundle_root().glob("do/*/config.json"))


def network(seed: int = 0, learnt: float = 0.3) -> Openings:
    """With random weights; without `learnt` it only calculates."""
    torch.manual_seed(seed)
    made = build(network_config(OPENINGS))
    assert isinstance(made, Openings)
    torch.nn.init.normal_(made.block.weight, std=learnt)
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


def test_frames_are_rotations_that_take_the_axis_to_the_eye() -> None:
    eye = slices.toward_eye(gbuffer()[:, 6:, 20:])
    axis = torch.tensor([0.0, 0.0, 1.0])[None, :, None, None].expand_as(eye)
    vectors = torch.randn(1, 3, 5, *eye.shape[2:], generator=torch.Generator().manual_seed(1))
    turned = slices.out_of_frame(eye[:, :, None], vectors)
    assert torch.allclose(turned.norm(dim=1), vectors.norm(dim=1), atol=1e-5)
    assert torch.allclose(slices.out_of_frame(eye[:, :, None], axis[:, :, None])[:, :, 0], eye)
    back = slices.into_frame(eye, turned[:, :, 2])
    assert torch.allclose(back, vectors[:, :, 2], atol=1e-5)


def test_light_through_lobes_is_a_polynomial_of_the_place() -> None:
    """Of a lamp as wide as a sector, seen anywhere in a picture of 60 degrees."""
    lamp = np.array([0.3, 0.5, 0.6])
    light = np.maximum(DIRECTIONS @ (lamp / np.linalg.norm(lamp)), 0) ** 12
    terms = torch.from_numpy(slices.lobes(DIRECTIONS, 32.0) @ light)
    for x, y in ((0.0, 0.0), (0.4, -0.2), (-0.3, 0.4)):
        eye = torch.tensor([x, y, (1 - x * x - y * y) ** 0.5])[None, :, None, None]
        found = (slices.place(eye)[0, :, 0] * terms).sum(0).numpy()
        toward = torch.from_numpy(slices.sectors()[0].T).float()[None, :, :, None, None]
        axes = slices.out_of_frame(eye[:, :, None], toward)[0, :, :, 0, 0].numpy()
        shares = np.maximum(axes.T @ DIRECTIONS.T, 0) ** 32
        expected = shares @ light / shares.sum(1)
        assert found == pytest.approx(expected, abs=0.08)
        assert np.abs(found - expected).mean() < 0.02


def test_a_floor_with_nothing_near_is_lit_as_if_alone() -> None:
    seen = room(64, height=0.0)
    given = tensor(EFFECTS["do"], seen, EFFECTS["do"].inputs, 1.0, per_channel=False)
    torch.manual_seed(0)
    irradiance, through = torch.rand(1, 3, 64, 64), torch.rand(1, 3, slices.TERMS, slices.SECTORS)
    with torch.inference_mode():
        found = network(learnt=0).lit(torch.from_numpy(given), irradiance, through)
    assert torch.allclose(found, irradiance, atol=0.01)


def test_what_a_wall_blocks_is_what_rays_say() -> None:
    """The sectors of a floor's cells beside a wall so thick that none sees past it."""
    side, high = 96, 0.5
    seen = room(side, height=high, thick=0.6)
    given = tensor(EFFECTS["do"], seen, EFFECTS["do"].inputs, 1.0, per_channel=False)
    folded = torch.nn.functional.pixel_unshuffle(torch.from_numpy(given)[:, 3:9], slices.CELL)
    folded = folded.reshape(1, 6, 16, *folded.shape[2:])
    at = folded[:, :, slices.TAKEN * (slices.CELL + 1)]
    at = torch.cat([at, torch.ones_like(at[:, :1])], 1)
    blocked = torch.stack([part[0, : slices.HEIGHTS] for part in slices.slices(folded, at)])
    row, column = side // 8, side * 3 // 4 // 4  # of a cell to the wall's right
    x = float(at[0, 3, row, column])
    for azimuth in range(slices.AZIMUTHS):
        for sector in range(slices.HEIGHTS):
            cosines = 1 - (sector + (np.arange(9) + 0.5) / 9) * 2 / slices.HEIGHTS
            angles = (azimuth + (np.arange(9) - 4) / 9) * 2 * np.pi / slices.AZIMUTHS
            u, a = np.meshgrid(cosines, angles)
            # the eye is so far above that its ray is the axis
            toward = np.stack([np.sqrt(1 - u * u) * np.cos(a), np.sqrt(1 - u * u) * np.sin(a), u])
            with np.errstate(divide="ignore", invalid="ignore"):
                reach = np.where(toward[0] < 0, (0.3 - x) / toward[0], np.inf)
            hit = (reach * toward[2] < high) & (reach < 1) & (toward[2] > 0)
            found = float(blocked[azimuth, sector, row, column])
            if (u > 0.1).all():
                assert found == pytest.approx(hit.mean(), abs=0.45)
    total = blocked[:, : slices.HEIGHTS // 2, row, column].sum(1)
    assert total[slices.AZIMUTHS // 2] > 0.8
    assert total[0] < 0.05


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
    toward_nodes, fit = slices.nodes()
    through = blurred(toward_nodes.reshape(-1, 3).T, 32).reshape(1, 3, -1, slices.SECTORS)
    through = torch.from_numpy(fit).float() @ through
    with torch.inference_mode():
        expected = made.lit(given, irradiance, through).numpy()
    assert answer(made, Prepared.of(environment)) == pytest.approx(expected, abs=0.01)


def test_several_maps_at_once_are_each_alone() -> None:
    made, given = network(), gbuffer()
    irradiance = torch.rand(1, 6, *given.shape[2:])
    through = torch.rand(1, 6, slices.TERMS, slices.SECTORS)
    with torch.inference_mode():
        both = made.lit(given, irradiance, through)
        alone = [made.lit(given, irradiance[:, k], through[:, k]) for k in (slice(3), slice(3, 6))]
    assert torch.allclose(both, torch.cat(alone, 1), atol=1e-6)


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Lit:
    """Noise, as data."""
    folder = write_data(tmp_path_factory.mktemp("lit"), "do", 2)
    return Lit([folder], "do")


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


@pytest.mark.parametrize("turn", range(8))
def test_the_light_turns_with_the_picture(samples: Lit, turn: int) -> None:
    """A lamp is then seen where `symmetry.apply` puts a vector that points to it."""
    toward = DIRECTIONS[100]
    moved = symmetry.apply(toward.reshape(3, 1, 1), "normal", turn)[:, 0, 0]
    lamp, there = (
        np.maximum(DIRECTIONS @ v, 0)[:, None] ** 8 * np.ones(3) for v in (toward, moved)
    )
    found, expected = samples._through(lamp, turn)[0, 0], samples._through(there, 0)[0, 0]
    assert found == pytest.approx(expected, abs=0.05)
    assert expected.max() > 0.5


def room(side: int, height: float = 0.6, thick: float = 0.1) -> dict[str, np.ndarray]:
    """A floor seen from above, on which a wall stands along y."""
    x, y = (np.mgrid[0:side, 0:side][::-1] + 0.5) / side * 2 - 1
    wall = np.abs(x) < thick / 2
    position = np.stack([x, -y, np.where(wall, height, 0.0) - 4]).astype(np.float32)
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


@pytest.mark.skipif(not SHIPPED, reason="models/do holds no bundle")
def test_under_a_white_map_it_is_ambient_occlusion() -> None:
    """That of `ao/balanced`: to .01 over held-out views, to .015 on the sample's surfaces."""
    seen = load_gbuffer(Path(__file__).parents[2] / "samples" / "room.exr", EFFECTS["do"].inputs)
    radius, white = 0.4, prepared(np.ones((3, 16, 32)))
    given = tensor(EFFECTS["do"], seen.attributes, EFFECTS["do"].inputs, radius, per_channel=False)
    inputs = white.inputs(NAMES, 0.0, "y", lambda: np.eye(3))
    gbuffer = torch.from_numpy(given)
    with torch.inference_mode():
        found = from_bundle(SHIPPED[0])(gbuffer, *map(torch.from_numpy, inputs.values()))
        occlusion = from_bundle(bundle_root() / "ao" / "balanced")(gbuffer[:, 3:])
    assert torch.allclose(found[:, 0], found[:, 2], atol=1e-3)
    difference = (found[:, :1] - occlusion).abs()[gbuffer[:, 8:] < 0]
    assert float(difference.mean()) < 0.018
    assert float(occlusion.std()) > 0.1


def test_settings_that_make_no_network_are_refused() -> None:
    for change in (
        {"hidden": 0},
        {"position": 3},
        {"trunk": {"fold": 2}},
        {"trunk": {"bias": "a"}},
    ):
        with pytest.raises(ConfigError):
            network_config(change, OpeningsConfig())


def test_a_shader_lights_what_it_pads() -> None:
    shader = Shader(EFFECTS["do"], network()).eval()
    given = gbuffer(height=29, width=37)
    irradiance, through = torch.rand(1, 3, 29, 37), torch.rand(1, 3, slices.TERMS, slices.SECTORS)
    with torch.inference_mode():
        image = shader.lit(shader.padded(given), irradiance, through)
    assert image.shape == (1, 3, 32, 40)
