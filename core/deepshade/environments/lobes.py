"""An environment blurred by cosine lobes, for every exponent: what Phong shading looks up.

    A(d, m) = (m + 1) / (2π) ∫ max(0, d·ω)^m L(ω) dω

is the mean of the map L around the direction d, weighted by a lobe of exponent m. Irradiance
over π is A(N, 1); a mirror is m → ∞. It is tabulated for m = 1, 2, 4, … 16384, each in a
latitude-longitude tile about as fine as its lobe asks for; between exponents it is linear in
log m. One picture (3, HEIGHT, WIDTH) holds all tiles, the map itself and its mean, so that any
engine can sample it, and maps of all sizes look alike to a compiled graph.

A row of a tile is a sum over rows of the map, each convolved around the axis: a product of
Fourier coefficients. (Driscoll and Healy, "Computing Fourier Transforms and Convolutions on the
2-Sphere", 1994, go on to Legendre functions; narrow lobes reach few rows, which is quicker.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.environments.environment import Environment, solid_angles
from deepshade.threads import run_all, thread_count

Float = NDArray[np.float32]

LEVELS = 15  # exponents 2^0 to 2^14
_FINEST = 512  # rows of the finest tile
_COARSEST = 64
_REACH = 5.0  # standard deviations (1 / √m) at which a lobe ends
_FREQUENCIES = 6.0  # its spectrum ends at so many / its deviation
_BLOCK = 32  # rows worked on together


@dataclass(frozen=True, slots=True)
class Tile:
    """Where a picture of `rows` x 2 `rows` pixels begins: its top left pixel.

    Around it lies a border of one pixel: what comes next on the sphere.
    """

    row: int
    column: int
    rows: int


def _rows(level: int) -> int:
    return min(_FINEST, max(_COARSEST, 16 << (level // 2)))


def _layout() -> tuple[tuple[Tile, ...], int, int]:
    """The mean, the levels and the map itself, in shelves; (tiles, height, width)."""
    rows = [1, *(_rows(level) for level in range(LEVELS)), 2 * _FINEST]
    width = 4 * _FINEST + 4  # of two tiles, or of the map
    tiles: dict[int, Tile] = {}
    top = left = shelf = 0
    for index in sorted(range(len(rows)), key=lambda index: -rows[index]):
        wide = 2 * rows[index] + 2
        if left + wide > width:
            top, left, shelf = top + shelf, 0, 0
        shelf = max(shelf, rows[index] + 2)
        tiles[index] = Tile(top + 1, left + 1, rows[index])
        left += wide
    return tuple(tiles[index] for index in range(len(rows))), top + shelf, width


# The mean, then the exponents 2^0, 2^1, …, then the map itself.
TILES, HEIGHT, WIDTH = _layout()


def prefilter(environment: Environment) -> Float:
    """(3, HEIGHT, WIDTH): all tiles of `TILES`.

    No value is above the map's largest or below its least.
    """
    table = np.zeros((3, HEIGHT, WIDTH), np.float32)
    _place(table, TILES[0], environment.mean.astype(np.float32)[:, None, None])
    _place(table, TILES[-1], _resized(environment.radiance, TILES[-1].rows))
    maps = {_FINEST: _resized(environment.radiance, _FINEST)}
    while (rows := min(maps)) > _COARSEST:
        maps[rows // 2] = _halved(maps[rows])
    low, high = environment.radiance.min((1, 2)), environment.radiance.max((1, 2))

    def fill(level: int) -> None:
        tile = TILES[level + 1]
        # halving has widened what it moved, and left a quarter of a new pixel's square
        widened = 0.25 * (math.pi / tile.rows) ** 2 * (1 - (tile.rows / _FINEST) ** 2)
        blurred = _blurred(maps[tile.rows], 1 / (2.0**-level - widened))
        _place(table, tile, np.clip(blurred, low[:, None, None], high[:, None, None]))

    run_all(fill, range(LEVELS)[::-1], thread_count())  # the long ones first
    return table


def diffuse(environment: Environment) -> Environment:
    """A(d, 1) as a map of its own: what falls on an unblocked surface that faces d, over π."""
    radiance = environment.radiance
    blurred = _blurred(_resized(radiance, _COARSEST), 1.0)
    low, high = (radiance.min((1, 2)), radiance.max((1, 2)))
    return Environment(environment.name, np.clip(blurred, low[:, None, None], high[:, None, None]))


def _place(table: Float, tile: Tile, picture: Float) -> None:
    """Writes a picture (3, rows, 2 rows) and its border; a smaller one is repeated."""
    picture = np.broadcast_to(picture, (3, tile.rows, 2 * tile.rows))
    half = tile.rows
    # beyond a pole lies the other side of its row
    around = np.concatenate(
        [
            np.roll(picture[:, :1], half, axis=2),
            picture,
            np.roll(picture[:, -1:], half, axis=2),
        ],
        axis=1,
    )
    around = np.concatenate([around[:, :, -1:], around, around[:, :, :1]], axis=2)
    bottom, right = tile.row + tile.rows + 1, tile.column + 2 * tile.rows + 1
    table[:, tile.row - 1 : bottom, tile.column - 1 : right] = around


def _resized(picture: Float, rows: int) -> Float:
    """(3, rows, 2 rows): a smaller map's bilinear values, or means over each new pixel."""
    height, width = picture.shape[1:]
    if height == rows:
        return picture
    if height < rows:
        for axis, size, wraps in ((1, rows, False), (2, 2 * rows, True)):
            old = picture.shape[axis]
            at = (np.arange(size) + 0.5) * (old / size) - 0.5
            left = np.floor(at).astype(np.intp)
            share = (at - left).astype(np.float32)[:, None if axis == 1 else ...]
            ends = (
                [left % old, (left + 1) % old] if wraps else np.clip([left, left + 1], 0, old - 1)
            )
            first, second = (picture.take(end, axis) for end in ends)
            picture = first + (second - first) * share
        return picture
    energy = picture.astype(np.float64) * solid_angles(height, width)[:, None]
    for axis, size in ((1, rows), (2, 2 * rows)):
        old = energy.shape[axis]
        if old % size == 0:
            starts = np.arange(0, old, old // size)
            energy = np.add.reduceat(energy, starts, axis=axis)
            continue
        # sums up to each edge, and what lies between two of the new ones
        sums = np.insert(energy.cumsum(axis=axis), 0, 0, axis=axis)
        at = np.arange(size + 1) * (old / size)
        below = np.minimum(at.astype(np.intp), old - 1)
        share = (at - below)[:, None if axis == 1 else ...]
        edges = sums.take(below, axis) * (1 - share) + sums.take(below + 1, axis) * share
        energy = np.diff(edges, axis=axis)
    return np.asarray(energy / solid_angles(rows, 2 * rows)[:, None], np.float32)


def _halved(picture: Float) -> Float:
    """(3, H / 2, W / 2): light is shared between the two nearest pixels, so that none moves.

    A mean over four would shift a sun by up to half a pixel.
    """
    height, width = picture.shape[1:]
    energy: NDArray[Any] = picture * solid_angles(height, width)[:, None].astype(np.float32)
    for axis in (1, 2):
        before = np.roll(energy, 1, axis)
        after = np.roll(energy, -1, axis)
        if axis == 1:
            before[:, 0] = np.roll(energy[:, 0], width // 2, axis=1)
            after[:, -1] = np.roll(energy[:, -1], width // 2, axis=1)
        even, odd = (
            (np.s_[:, 0::2], np.s_[:, 1::2]) if axis == 1 else (np.s_[..., 0::2], np.s_[..., 1::2])
        )
        energy = (before[even] + 3 * (energy[even] + energy[odd]) + after[odd]) / 4
    weights = solid_angles(height // 2, width // 2)[:, None]
    return np.asarray(energy / weights, np.float32)


def _blurred(picture: Float, exponent: float) -> Float:
    """(3, H, W): A(d, exponent) at the pixels' directions, of a map of that size."""
    rows, columns = picture.shape[1:]
    deviation = 1 / math.sqrt(exponent)
    # and wide lobes have an edge, at the horizon
    count = min(rows + 1, math.ceil(_FREQUENCIES / deviation) + 48)
    reach = min(rows - 1, math.ceil(_REACH * deviation / (math.pi / rows)))
    offsets = np.arange(-reach, reach + 1)
    weights = solid_angles(rows, columns).astype(np.float32)
    energy = np.fft.rfft(picture * weights[:, None], axis=2)[..., :count]
    spectrum = np.zeros((3, rows, columns // 2 + 1), np.complex64)
    halves = (
        (energy, spectrum[:, : rows // 2]),
        (energy[:, ::-1], spectrum[:, ::-1][:, : rows // 2]),
    )
    for top in range(0, rows // 2, _BLOCK):
        block = np.arange(top, min(top + _BLOCK, rows // 2))
        kernel = _kernel(block, offsets, rows, exponent, count)
        at = np.clip(block[:, None] + offsets, 0, rows - 1)
        kernel *= (1 / (kernel[..., 0] * weights[at]).sum(1))[:, None, None]
        for source, target in halves:  # the south is the north of a mirrored map
            for index, offset in enumerate(offsets):
                first, last = max(top, -offset), min(top + block.size, rows - offset)
                if first < last:
                    moved = source[:, first + offset : last + offset]
                    part = kernel[first - top : last - top, index]
                    target[:, first:last, :count] += part * moved
    return np.asarray(np.fft.irfft(spectrum, columns, axis=2), np.float32)


def _kernel(
    block: NDArray[np.intp],
    offsets: NDArray[np.intp],
    rows: int,
    exponent: float,
    count: int,
) -> Float:
    """(block, offsets, count): cosine series around the axis of the lobe between the rows `block`
    and those `offsets` further, 0 where there are none."""
    step = math.pi / rows
    theta = (block + 0.5) * step
    other = theta[:, None] + offsets * step
    there = (other > 0) & (other < math.pi)
    # 1 - cos γ of two pixels, exact where it is small: haversines of their angles
    apart = 2 * np.sin(offsets * (step / 2)) ** 2
    product = 2 * np.sin(theta)[:, None] * np.sin(other)
    # how far around the axis the lobe reaches, half way at most
    ends = 1 - math.cos(min(math.pi / 2, (_REACH + 0.5) / math.sqrt(exponent)))
    sine = min(1.0, math.sqrt(ends / product[there].min()))
    across = min(rows, math.ceil(2 * math.asin(sine) / step)) + 1
    along = np.sin(np.arange(across) * (step / 2)) ** 2
    lobe = product.astype(np.float32)[..., None] * along.astype(np.float32)
    lobe += apart.astype(np.float32)[:, None]
    # cos γ ^ exponent, 0 below the horizon
    np.subtract(1, lobe, out=lobe)
    np.maximum(lobe, np.float32(1e-30), out=lobe)
    np.log(lobe, out=lobe)
    lobe *= np.float32(exponent)
    np.exp(lobe, out=lobe)
    lobe *= there[..., None]
    # twice what lies between the two ends
    series = np.cos(np.outer(np.arange(across), np.arange(count)) * step)
    series[1:] *= 2
    if across == rows + 1:
        series[-1] /= 2
    kernel = lobe.reshape(-1, across) @ series.astype(np.float32)
    return np.asarray(kernel.reshape(block.size, offsets.size, count), np.float32)
