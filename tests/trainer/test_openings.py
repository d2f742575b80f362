"""Light from all around: what holds for any trunk, and the shipped bundle."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime as ort
import pytest
import torch

from deepshade.bundles import Bundle, bundle_root
from deepshade.effects import EFFECTS
from deepshade.environments import Environment, Prepared, directions, solid_angles
from deepshade.gbuffer import load_gbuffer
from deepshade.tensors import tensor, up
from deepshade_trainer.networks import build, from_bundle, network_config, slices
from deepshade_trainer.networks.openings import Openings

from .synthetic import TRUNK, arrays

NAMES = Openings.environment
GEOMETRY = {"normal": 0, "position": 3}
SHIPPED = sorted(path.parent for path in bundle_root().glob("do/*/config.json"))


def network(seed: int = 0) -> Openings:
    """With a small trunk of random weights."""
    torch.manual_seed(seed)
    made = build(network_config({"kind": "openings", "trunk": TRUNK | GEOMETRY}))
    assert isinstance(made, Openings)
    return made.eval()


def gbuffer(seed: int = 5, height: int = 32, width: int = 40) -> torch.Tensor:
    effect = EFFECTS["do"]
    given = effect, arrays("do", seed, height, width), effect.inputs, 0.5
    return torch.from_numpy(tensor(*given, per_channel=False))


def prepared(radiance: np.ndarray) -> Prepared:
    return Prepared.of(Environment("", radiance.astype(np.float32)))


def answer(made: Openings, light: Prepared, given: torch.Tensor | None = None) -> np.ndarray:
    inputs = light.inputs(NAMES, 0.0, "y", lambda: np.eye(3))
    seen = gbuffer() if given is None else given
    with torch.inference_mode():
        return made(seen, *map(torch.from_numpy, inputs.values())).numpy()


def test_frames_are_rotations_that_take_the_axis_to_the_eye() -> None:
    eye = slices.toward_eye(gbuffer()[:, 6:, 20:])
    axis = torch.tensor([0.0, 0.0, 1.0])[None, :, None, None].expand_as(eye)
    vectors = torch.randn(1, 3, 5, *eye.shape[2:], generator=torch.Generator().manual_seed(1))
    turned = slices.out_of_frame(eye[:, :, None], vectors)
    assert torch.allclose(turned.norm(dim=1), vectors.norm(dim=1), atol=1e-5)
    assert torch.allclose(slices.out_of_frame(eye[:, :, None], axis[:, :, None])[:, :, 0], eye)
    back = slices.into_frame(eye, turned[:, :, 2])
    assert torch.allclose(back, vectors[:, :, 2], atol=1e-5)


def test_light_is_a_polynomial_of_the_place() -> None:
    """Of a lamp about as wide as a sector, seen anywhere in a picture of 60 degrees."""
    lamp = np.array([0.3, 0.5, 0.6]) / np.linalg.norm([0.3, 0.5, 0.6])
    nodes, fit = slices.nodes()
    terms = torch.from_numpy(fit @ np.maximum(nodes @ lamp, 0) ** 9)
    for x, y in ((0.0, 0.0), (0.4, -0.2), (-0.3, 0.4)):
        eye = torch.tensor([x, y, (1 - x * x - y * y) ** 0.5])[None, :, None, None]
        found = (slices.place(eye)[0, :, 0] * terms).sum(0).numpy()
        toward = torch.from_numpy(slices.sectors()[0].T).float()[None, :, :, None, None]
        axes = slices.out_of_frame(eye[:, :, None], toward)[0, :, :, 0, 0].numpy()
        expected = np.maximum(lamp @ axes, 0) ** 9
        assert found == pytest.approx(expected, abs=0.08)
        assert np.abs(found - expected).mean() < 0.02


def test_a_floor_with_nothing_near_is_lit_as_if_alone() -> None:
    seen = room(64, height=0.0)
    given = tensor(EFFECTS["do"], seen, EFFECTS["do"].inputs, 1.0, per_channel=False)
    radiance = np.random.default_rng(0).random((3, 16, 32)).astype(np.float32)
    found = answer(network(), prepared(radiance), torch.from_numpy(given))
    cosines = np.maximum(directions(16, 32)[2], 0) * solid_angles(16, 32)[:, None]
    expected = (radiance * cosines).sum((1, 2)) / np.pi
    assert found == pytest.approx(np.broadcast_to(expected[:, None, None], found.shape), abs=0.01)


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
    """That of `ao/balanced`: to .01 over held-out views, to .018 on the sample's surfaces."""
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
