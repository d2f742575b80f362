"""Light of one bounce, gathered from the picture: against a form factor, and what must hold."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from deepshade_trainer.networks.bases.bounces import (
    CELL,
    DIRECTIONS,
    RAYS,
    RINGS,
    TURNS,
    Bounces,
    _moved,
    _offset,
)

SIZE = 64


@pytest.fixture
def bounces() -> Bounces:
    torch.manual_seed(1)
    return Bounces().eval()


def answer(bounces: Bounces, gbuffer: Tensor, weights: Tensor | None = None) -> Tensor:
    """What the trunk's weights, by default none, make of a G-buffer."""
    with torch.no_grad():
        _, state = bounces.features(gbuffer)
        none = torch.zeros(len(gbuffer), bounces.weights, *gbuffer.shape[2:])
        return bounces.carry(state, none if weights is None else weights)


def rays(height: int, width: int, spread: float = 1.0) -> Tensor:
    """(3, H, W): where pixels look, at depth 1."""
    down, right = torch.meshgrid(
        (torch.arange(height) + 0.5 - height / 2) / width * spread,
        (torch.arange(width) + 0.5 - width / 2) / width * spread,
        indexing="ij",
    )
    return torch.stack([right, -down, -torch.ones(height, width)])


def corner(height: int = SIZE, width: int = SIZE) -> Tensor:
    """(1, 9, H, W): two walls that meet at 90° in front of the eye; the left one is lit."""
    ray = rays(height, width)
    # walls x - z = 0.8 and -x - z = 0.8 at the distance that each pixel's ray meets the first
    depth = 0.8 / (1 + ray[:1].abs())
    left = (ray[:1] < 0).float()
    half = torch.full_like(left, 0.5).sqrt()
    normal = torch.cat([half * (2 * left - 1), torch.zeros_like(half), half])
    light = (left * torch.tensor([1.0, 2.0, 3.0]).reshape(3, 1, 1)).float()
    return torch.cat([normal, ray * depth, light])[None]


def noisy(seed: int, height: int = SIZE, width: int = SIZE) -> Tensor:
    """A rough surface with holes, and light all over it."""
    rng = torch.Generator().manual_seed(seed)
    depth = 1 + torch.rand(1, height, width, generator=rng)
    hole = torch.rand(1, height // 4, width // 4, generator=rng) < 0.2
    hole = hole.repeat_interleave(4, 1).repeat_interleave(4, 2)
    normal = torch.randn(3, height, width, generator=rng)
    normal[2] = normal[2].abs() + 0.1
    light = torch.rand(3, height, width, generator=rng)
    gbuffer = torch.cat([normal / normal.norm(dim=0), rays(height, width) * depth, light])
    gbuffer[:6, hole[0]] = 0
    return gbuffer[None]


def test_a_wall_lights_the_one_beside_it_as_its_form_factor_says(bounces: Bounces) -> None:
    """Against a sum over the lit wall's pixels: Σ L cosθ cosθ' dA / (π r²), within the radius."""
    gbuffer = corner(128, 128)
    image = answer(bounces, gbuffer)[0]
    normal, position = gbuffer[0, :3].double(), gbuffer[0, 3:6].double()
    lit = gbuffer[0, 6] > 0
    points, normals = position[:, lit], normal[:, lit]
    # a pixel's area: its solid angle times the squared distance over the cosine towards the eye
    distance = points.norm(dim=0)
    slope = -(points * normals).sum(0) / distance
    area = (1 / 128) ** 2 * (-points[2] / distance) ** 3 * distance**2 / slope
    for row, column in ((64, 76), (64, 90), (40, 84)):
        delta = points - position[:, row, column, None]
        r = delta.norm(dim=0)
        cosine = (delta * normal[:, row, column, None]).sum(0) / r
        facing = -(delta * normals).sum(0) / r
        factor = float((cosine * facing * area / (torch.pi * r**2))[r < 1].clamp_min(0).sum())
        got = image[:, row, column].numpy()
        np.testing.assert_allclose(got, np.array([1, 2, 3]) * factor, rtol=0.2)


def test_light_passes_linearly(bounces: Bounces) -> None:
    gbuffer = noisy(1)
    weights = 0.3 * torch.randn(1, bounces.weights, SIZE, SIZE)
    image = answer(bounces, gbuffer, weights)
    for scale in (1e-3, 1e5):
        scaled = torch.cat([gbuffer[:, :6], gbuffer[:, 6:] * scale], 1)
        torch.testing.assert_close(
            answer(bounces, scaled, weights) / scale, image, rtol=1e-4, atol=1e-6
        )


def test_light_changes_nothing_that_the_network_is_told(bounces: Bounces) -> None:
    dark, bright = noisy(1), noisy(1)
    bright[:, 6:] *= 1e5
    assert torch.equal(bounces.features(dark)[0], bounces.features(bright)[0])


def test_a_plane_and_a_convex_edge_receive_nothing(bounces: Bounces) -> None:
    edge = corner()
    ray = rays(SIZE, SIZE)
    edge[0, 3:6] = ray * 0.8 / (1 - 0.6 * ray[:1].abs())
    edge[0, 0] = -(edge[0, 0].sign()) * 0.6 / (1 + 0.36) ** 0.5
    edge[0, 2] = 1 / (1 + 0.36) ** 0.5
    flat = edge.clone()
    flat[0, 3:6] = ray
    flat[0, :3] = torch.tensor([0.0, 0, 1]).reshape(3, 1, 1)
    for gbuffer in (edge, flat):
        gbuffer[0, 6:] = 1
        assert answer(bounces, gbuffer).abs().max() < 2e-3


def test_nothing_beyond_the_radius_counts(bounces: Bounces) -> None:
    gbuffer = corner()
    near, far = gbuffer.clone(), gbuffer.clone()
    far[:, 3:6] *= 100
    assert answer(bounces, near).max() > 0.1
    assert answer(bounces, far)[..., SIZE // 2 + 2 * CELL :].abs().max() == 0


def test_a_firefly_lights_only_what_it_can_reach(bounces: Bounces) -> None:
    gbuffer = corner(128, 128)
    gbuffer[:, 3:6] *= 8  # the radius is an eighth of the corner's distance
    bright = gbuffer.clone()
    bright[0, 6:, 64, 60] = 1e5
    change = (answer(bounces, bright) - answer(bounces, gbuffer)).abs().amax(1)[0]
    away = (gbuffer[0, 3:6] - gbuffer[0, 3:6, 64, 60].reshape(3, 1, 1)).norm(dim=0)
    assert torch.isfinite(change).all()
    # the wall across is lit; its own, which is flat, isn't, though cells lie on both
    own, across = change[:, :64], change[:, 64:]
    assert across.max() > 95 and own.sum() < 0.01 * across.sum()
    # far away light comes in squares of cells, a part of which may lie beyond the radius
    assert change[away > 2].max() < 0.01 * change.max()


def test_tiles_equal_the_whole(bounces: Bounces) -> None:
    width = 1408
    gbuffer = noisy(2, 32, width)
    weights = 0.3 * torch.randn(1, bounces.weights, 32, width)
    whole = answer(bounces, gbuffer, weights)
    first, last = 672, 703
    left, right = bounces.receptive_field(first)[0], bounces.receptive_field(last)[1]
    assert left > 0
    assert right < width - 1
    left = left // 32 * 32
    tile = answer(bounces, gbuffer[..., left : right + 1], weights[..., left : right + 1])
    torch.testing.assert_close(
        tile[..., first - left : last + 1 - left], whole[..., first : last + 1], rtol=0, atol=1e-5
    )


@pytest.mark.parametrize("kind", ["zero", "sky", "pixel"])
def test_odd_pictures_are_finite(bounces: Bounces, kind: str) -> None:
    gbuffer = torch.zeros(1, 9, 32, 32)
    if kind != "zero":
        gbuffer[:, 6:] = 1e5
    if kind == "pixel":
        gbuffer[0, :6, 4, 4] = torch.tensor([0, 0, 1, 0, 0, -1.0])
    image = answer(bounces, gbuffer)
    assert torch.isfinite(image).all()
    assert image.abs().max() == 0


def test_background_light_is_nobodys(bounces: Bounces) -> None:
    """The sky's light is no bounce, and what stands before the sky is lit as before nothing."""
    gbuffer = noisy(3)
    sky = gbuffer.clone()
    sky[:, 6:] += 1e4 * (gbuffer[:, 5:6] == 0)
    torch.testing.assert_close(answer(bounces, sky), answer(bounces, gbuffer))


def test_cells_that_take_turns_look_at_the_cells_their_rays_pass() -> None:
    height, width = 12, 20
    x = torch.rand(1, 1, height, width, generator=torch.Generator().manual_seed(4))
    for ring in RINGS[:5]:
        found = _moved(x, ring).reshape(RAYS, TURNS, TURNS, height // TURNS, width // TURNS)
        for ray, a, b, i, j in np.ndindex(*found.shape):
            right, down = _offset(ring, ray, a * TURNS + b)
            row, column = TURNS * i + a + down, TURNS * j + b + right
            inside = 0 <= row < height and 0 <= column < width
            expected = x[0, 0, row, column] if inside else 1e4
            assert found[ray, a, b, i, j] == expected


def test_neighbours_together_look_all_around() -> None:
    angles = np.sort([np.arctan2(up, right) for turns in DIRECTIONS for right, up in turns])
    steps = np.diff(np.append(angles, angles[0] + 2 * np.pi))
    np.testing.assert_allclose(steps, 2 * np.pi / len(angles), atol=1e-6)
