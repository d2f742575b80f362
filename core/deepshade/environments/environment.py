"""Environment maps: the light that comes from each direction, as a latitude-longitude picture.

Row 0 is up, the centre column is -z of the world, columns to the right of it turn towards +x:

    direction(u, v) = (sin φ sin θ, cos θ, -cos φ sin θ),  φ = 2π (u - 1/2),  θ = π v,

u and v in [0, 1] from the left and from the top. Between the centres of pixels radiance is
bilinear; it goes on around the edges, and above and below the outermost centres it stays.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from deepshade import exr
from deepshade.environments import hdr
from deepshade.errors import EnvironmentMapError, ImageError

Float = NDArray[np.float32]
Up = Literal["y", "z"]

LIMITS = exr.Limits(body_bytes=512 * 2**20, decoded_bytes=2**30, pixels=8192 * 4096)
MAX_RADIANCE = 1e12  # thousands of times the sun's; sums of it stay finite in float32
SUFFIXES = (".exr", ".hdr", ".pic")


@dataclass(frozen=True, slots=True, eq=False)
class Environment:
    """A map: its name, radiance (3, H, W) float32, linear, W = 2 H, and sha256 of its values.

    Raises EnvironmentMapError for values that no light has, or another shape.
    """

    name: str
    radiance: Float
    sha256: str = ""

    def __post_init__(self) -> None:
        radiance = np.ascontiguousarray(self.radiance, np.float32)
        _check(self.name, radiance)
        digest = hashlib.sha256(f"{radiance.shape}".encode())
        digest.update(radiance.astype("<f4", copy=False).tobytes())
        object.__setattr__(self, "radiance", radiance)
        object.__setattr__(self, "sha256", digest.hexdigest())

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        _, height, width = self.radiance.shape
        return height, width

    @property
    def mean(self) -> NDArray[np.float64]:
        """(3,): the mean over all directions."""
        weights = solid_angles(*self.shape) / (4 * math.pi)
        return np.asarray(self.radiance.sum(axis=2, dtype=np.float64) @ weights)

    def sample(
        self, directions: NDArray[np.floating], to_map: NDArray[np.floating] | None = None
    ) -> Float:
        """(3, …): the radiance from unit `directions` (3, …).

        `to_map` (3, 3) turns them into the map's space first: see `world_to_map`.
        """
        d = np.asarray(directions, np.float64)
        if to_map is not None:
            d = np.tensordot(to_map, d, axes=1)
        height, width = self.shape
        x = (np.arctan2(d[0], -d[2]) / (2 * math.pi) + 0.5) * width - 0.5
        y = np.arctan2(np.hypot(d[0], d[2]), d[1]) / math.pi * height - 0.5
        left, top = np.floor(x), np.clip(np.floor(y), 0, max(height - 2, 0))
        across = (x - left).astype(np.float32)
        down = np.clip(y - top, 0, 1).astype(np.float32)
        columns = left.astype(np.intp) % width, (left.astype(np.intp) + 1) % width
        upper = top.astype(np.intp)
        rows = upper, np.minimum(upper + 1, height - 1)
        above, below = (
            self.radiance[:, row, columns[0]] * (1 - across)
            + self.radiance[:, row, columns[1]] * across
            for row in rows
        )
        return np.asarray(above * (1 - down) + below * down, np.float32)

    def rotated(self, degrees: float, up: Up = "y") -> Environment:
        """The map that a y-up world sees instead: this one, turned, and laid over a world that is
        `up` up (see `world_to_map`). Exact where each pixel falls on another, else bilinear."""
        grid = directions(*self.shape)
        return Environment(self.name, self.sample(grid, world_to_map(degrees, up)))


def directions(height: int, width: int) -> NDArray[np.float64]:
    """(3, H, W): unit directions of the pixels' centres."""
    phi = 2 * math.pi * ((np.arange(width) + 0.5) / width - 0.5)
    theta = (math.pi * (np.arange(height) + 0.5) / height)[:, None]
    sine = np.sin(theta)
    up = np.broadcast_to(np.cos(theta), (height, width))
    return np.stack([np.sin(phi) * sine, up, -np.cos(phi) * sine])


def solid_angles(height: int, width: int) -> NDArray[np.float64]:
    """(H,): the solid angle of a pixel of each row, in steradians; all pixels add to 4π."""
    edges = math.pi * np.arange(height + 1) / height
    # cos a - cos b, without the cancellation near the poles
    middle, half = (edges[1:] + edges[:-1]) / 2, (edges[1:] - edges[:-1]) / 2
    return np.asarray(2 * np.sin(middle) * np.sin(half) * (2 * math.pi / width))


def world_to_map(degrees: float = 0.0, up: Up = "y") -> NDArray[np.float64]:
    """(3, 3): turns directions of the world into those of the map.

    `degrees` turn the map about the world's up axis, counter-clockwise as seen from above. In a
    z-up world the map's centre is +y at 0 degrees, and to the right of it lies +x.
    """
    angle = math.radians(math.fmod(degrees, 360.0))
    sine, cosine = math.sin(angle), math.cos(angle)
    back = np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])
    if up == "y":
        return back
    return np.asarray(back @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]))


def read_environment(
    source: Path | str | bytes, name: str = "", limits: exr.Limits = LIMITS
) -> Environment:
    """The map in an EXR or Radiance HDR file, or in its bytes; named as the file if not said.

    An EXR holds R G B, or Y alone, or one layer of R G B. Raises ImageError, DamagedImageError,
    LimitError, and EnvironmentMapError for a picture that is no environment.
    """
    data = exr.fetch(source, limits)
    if not name and not isinstance(source, bytes):
        name = Path(source).stem
    if data.startswith(hdr.MAGIC):
        return Environment(name, hdr.decode(data, limits))
    if not data.startswith(_EXR):
        raise ImageError(
            "an environment map is neither OpenEXR nor Radiance HDR", fix="send an .exr or .hdr"
        )
    header = exr.read_header(data, limits)
    channels = _colours(list(header.channels()))
    image = exr.read(data, channels, limits, header=header)
    return Environment(name, np.stack([image.pixels[channel] for channel in channels]))


_EXR = b"\x76\x2f\x31\x01"


def _colours(channels: list[str]) -> list[str]:
    """The channels that hold red, green and blue."""
    for trio in (["R", "G", "B"], ["Y"] * 3):
        if set(trio) <= set(channels):
            return trio
    layers = [name[:-2] for name in channels if name.endswith(".R")]
    complete = [at for at in layers if {f"{at}.G", f"{at}.B"} <= set(channels)]
    if len(complete) == 1:
        return [f"{complete[0]}.{band}" for band in "RGB"]
    raise EnvironmentMapError(
        f"the map's colours aren't clear among its channels: {', '.join(channels[:24])}",
        fix="save it with the channels R, G and B",
    )


def _check(name: str, radiance: Float) -> None:
    """Raises EnvironmentMapError unless it is the light of all directions."""
    label = f"the environment map '{name[:100]}'" if name else "the environment map"
    if radiance.ndim != 3 or radiance.shape[0] != 3 or radiance.size == 0:
        raise EnvironmentMapError(f"{label} has the shape {radiance.shape}, not (3, H, 2 H)")
    height, width = radiance.shape[1:]
    if width != 2 * height:
        raise EnvironmentMapError(
            f"{label} has {width} x {height} pixels",
            fix="it must be latitude-longitude, twice as wide as it is high",
        )
    good = (radiance >= 0) & (radiance <= MAX_RADIANCE)  # false for NaN
    if not good.all():
        band, row, column = (int(i) for i in np.argwhere(~good)[0])
        raise EnvironmentMapError(
            f"{label} holds {radiance[band, row, column]:g} at row {row}, column {column}"
            f" ({int(np.count_nonzero(~good))} such values in all)",
            fix=f"radiance must be finite, from 0 to {MAX_RADIANCE:g}",
        )
