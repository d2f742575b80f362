"""What HBAO and GTAO share: a view's pixels as tensors, the march over them, and the filter.

All lengths are in units of the effect radius, so a scene's scale doesn't matter. Only pixels that
hold geometry are worked on, in blocks small enough for the processor's cache.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deepshade_report.method import Float, View

NEAREST = 1.3  # pixels between a pixel and its first sample, so that it never meets itself
BLOCK = 32768  # pixels at a time
_FAR = -1e9  # depth of background and of what lies outside the picture: beyond any radius
_TINY = 1e-12
GOLDEN = 0.61803398875


@dataclass(frozen=True)
class Field:
    """A view, ready to be marched over.

    `position` is (3, (H + 2) * (W + 2)): camera space, with a border of nothing around it, so
    that a sample outside needs no test. `depth` is (H, W), zero in background. `pixels` (n,) are
    the flat numbers of the pixels that hold geometry, `normal` (3, n) their unit normals,
    `reach` (n,) the pixels that one radius spans there. `rotation` and `offset` are their (n,)
    shares of jitter in [0, 1).
    """

    height: int
    width: int
    position: Tensor
    depth: Tensor
    pixels: Tensor
    normal: Tensor
    reach: Tensor
    rotation: Tensor
    offset: Tensor

    def within(self, mask: NDArray[np.bool_]) -> Field:
        """The same field where only the pixels of a (H, W) mask get computed."""
        kept = torch.from_numpy(mask.ravel())[self.pixels]
        return replace(
            self,
            pixels=self.pixels[kept],
            normal=self.normal[:, kept],
            reach=self.reach[kept],
            rotation=self.rotation[kept],
            offset=self.offset[kept],
        )


@dataclass(frozen=True)
class Block:
    """Some pixels of a field: planes of (n,), `place` their (3, n) positions, `view` to the eye.

    `column` and `row` are whole numbers as floats. `facing` is the cosine of normal and `view`,
    at least 0: normals that face away (interpolated ones do) count as edge-on.
    """

    field: Field
    column: Tensor
    row: Tensor
    place: Tensor
    view: Tensor
    normal: Tensor
    facing: Tensor
    reach: Tensor
    rotation: Tensor
    offset: Tensor


@dataclass(frozen=True)
class Slice:
    """A plane through the eye's ray, one for each pixel of a block.

    `cos`, `sin` (n,) are its direction on the screen, y up. `length` (n,) is that of the normal
    projected into the plane, and `low` (2, n) the sine of the tangent's elevation over the screen
    to either side: where the horizon of a plane lies.
    """

    cos: Tensor
    sin: Tensor
    length: Tensor
    low: Tensor


def open_field(view: View) -> Field:
    """`view` as a field. Pixels with values that aren't finite, or behind the eye, hold nothing."""
    height, width = view.background.shape
    place = np.asarray(view.position, np.float32) / np.float32(view.radius)
    normal = np.asarray(view.normal, np.float32)
    with np.errstate(invalid="ignore"):
        there = ~view.background & (place[2] < 0) & np.isfinite(place).all(0)
        there &= np.isfinite(normal).all(0) & normal.any(0)
    padded = np.zeros((3, height + 2, width + 2), np.float32)
    padded[2] = _FAR
    padded[:, 1:-1, 1:-1][:, there] = place[:, there]
    depth = np.where(there, -place[2], np.float32(0))
    scale = np.float32(view.pixel_scale())
    pixels = np.flatnonzero(there)
    reach = scale / depth.ravel()[pixels]
    seen = reach >= NEAREST  # a radius below a pixel occludes nothing that can be seen
    pixels, reach = pixels[seen], np.minimum(reach[seen], np.float32(2 * max(height, width)))
    row, column = np.divmod(pixels, max(width, 1))
    rotation, offset = jitter(column, row)
    flat = torch.from_numpy(np.ascontiguousarray(normal.reshape(3, -1)[:, pixels]))
    return Field(
        height,
        width,
        torch.from_numpy(padded.reshape(3, -1)),
        torch.from_numpy(depth),
        torch.from_numpy(pixels),
        torch.nn.functional.normalize(flat, dim=0),
        torch.from_numpy(reach),
        torch.from_numpy(rotation),
        torch.from_numpy(offset),
    )


def jitter(column: NDArray[np.int64], row: NDArray[np.int64]) -> tuple[Float, Float]:
    """Shares of a turn and of a step in [0, 1) for pixels, repeating every 4 x 4 of them.

    Jimenez et al. 2016, "Practical Real-Time Strategies for Accurate Indirect Occlusion", course
    notes, section on spatial noise: any 4 x 4 pixels together hold 16 turns and 4 offsets.
    """
    turn = ((((column + row) & 3) << 2) + (column & 3)) / 16
    step = ((row - column) & 3) / 4
    return turn.astype(np.float32), step.astype(np.float32)


def blocks(field: Field) -> Iterator[tuple[slice, Block]]:
    """The field's pixels, a block at a time, and which of them it holds."""
    for start in range(0, len(field.pixels), BLOCK):
        some = slice(start, start + BLOCK)
        pixels, normal = field.pixels[some], field.normal[:, some]
        row = torch.div(pixels, field.width, rounding_mode="floor")
        column = pixels - row * field.width
        at = (row + 1) * (field.width + 2) + column + 1
        place = field.position.index_select(1, at)
        view = torch.nn.functional.normalize(-place, dim=0)
        yield (
            some,
            Block(
                field,
                column.float(),
                row.float(),
                place,
                view,
                normal,
                (normal * view).sum(0).clamp(min=0),
                field.reach[some],
                field.rotation[some],
                field.offset[some],
            ),
        )


def slices(block: Block, count: int) -> Iterator[tuple[int, Slice]]:
    """`count` planes, spread evenly over half a turn from each pixel's own start."""
    for index in range(count):
        angle = (block.rotation + index) * (math.pi / count)
        cos, sin = angle.cos(), angle.sin()
        # the screen's direction, with what points at the eye taken out, at length 1
        towards = cos * block.view[0] + sin * block.view[1]
        ahead = cos * block.normal[0] + sin * block.normal[1]
        across = (1 - towards * towards).clamp_(min=_TINY).rsqrt_()
        ahead = (ahead - towards * (block.normal * block.view).sum(0)).mul_(across)
        length = (ahead * ahead + block.facing * block.facing).sqrt_()
        tilt = ahead / length.clamp(min=_TINY)
        yield index, Slice(cos, sin, length, torch.stack((-tilt, tilt)))


def march(
    block: Block, plane: Slice, index: int, steps: int, *, reach: float, spread: float
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Samples to both sides of a slice, from near to far: elevation, squared distance, depth.

    Each is (2, n): the sine of the elevation over the plane that the eye's ray is normal to,
    measured between the two points in space, their squared distance, and how much nearer to the
    image plane the sample lies. `reach` is the march's length in radii, `spread` the power that
    draws samples towards the pixel (1 = even).
    """
    field = block.field
    stride = field.width + 2
    along = block.reach * reach
    for step in range(steps):
        # the golden ratio keeps slices from sampling the same distances (as XeGTAO does)
        share = block.offset + ((index + step * steps) * GOLDEN) % 1.0
        share = (share - share.floor()).add_(step).mul_(1 / steps)
        if spread != 1.0:
            share = share.pow_(spread)
        distance = share.mul_(along).add_(NEAREST)
        right, down = distance * plane.cos, distance.mul_(plane.sin)
        column = torch.stack((block.column + right, block.column - right))
        row = torch.stack((block.row - down, block.row + down))
        column = column.round_().clamp_(-1, field.width).int()
        at = row.round_().clamp_(-1, field.height).int()
        at = at.add_(1).mul_(stride).add_(column).add_(1).view(-1)
        x, y, z = (
            field.position[axis].index_select(0, at).view(2, -1).sub_(block.place[axis])
            for axis in range(3)
        )
        squared = (x * x).addcmul_(y, y).addcmul_(z, z)
        elevation = x.mul_(block.view[0]).addcmul_(y, block.view[1]).addcmul_(z, block.view[2])
        elevation = elevation.mul_(squared.clamp(min=_TINY).rsqrt_())
        yield elevation, squared, z


def finish(field: Field, open_share: Tensor, *, blur: int, edge: float) -> Float:
    """(H, W): `open_share` (n,) at its pixels and 1 elsewhere, filtered over `blur` pixels."""
    image = torch.ones(field.height * field.width)
    image[field.pixels] = open_share
    image = image.view(field.height, field.width)
    if blur > 0:
        image = smooth(smooth(image, field.depth, blur, edge, 0), field.depth, blur, edge, 1)
        image[field.depth == 0] = 1.0
    result: Float = image.clamp_(0, 1).numpy()
    return result


def smooth(image: Tensor, depth: Tensor, blur: int, edge: float, axis: int) -> Tensor:
    """A Gaussian over `blur` pixels to both sides along an axis that stops at depth edges.

    The separable cross-bilateral filter of Bavoil and Sainz 2008 ("Image-Space Horizon-Based
    Ambient Occlusion", section on noise): a neighbour's weight falls with its distance on the
    screen and to zero where its depth differs by `edge` radii.
    """
    total, weights = image.clone(), torch.ones_like(image)
    sharpness, size = 1 / edge, image.shape[axis]
    for shift in range(1, min(blur, size - 1) + 1):
        near, far = (slice(0, size - shift), slice(shift, size))
        first, second = ((near, slice(None)), (far, slice(None)))
        if axis:
            first, second = first[::-1], second[::-1]
        weight = (depth[first] - depth[second]).abs_().mul_(-sharpness).add_(1).clamp_(min=0)
        weight.mul_(math.exp(-0.5 * (2 * shift / (blur + 1)) ** 2))
        total[first].addcmul_(weight, image[second])
        total[second].addcmul_(weight, image[first])
        weights[first].add_(weight)
        weights[second].add_(weight)
    return total.div_(weights)
