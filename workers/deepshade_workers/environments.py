"""Environment maps in the renderer: their radiance, and directions drawn in proportion to it.

Radiance is bilinear between the centres of a map's pixels, as `deepshade.environments` has it.
Directions come from a density that is bilinear too (a pixel's tent about its centre), in columns
and rows, so that radiance over density is nearly constant and a sun doesn't sparkle.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import numpy as np

from deepshade.environments import Environment, solid_angles
from deepshade.errors import ConfigError
from deepshade_workers.backend import mitsuba
from deepshade_workers.view import View

mi = mitsuba()


@dataclass(frozen=True, eq=False)
class EnvironmentLight:
    """An environment map turned about the world's up axis, as Dr.Jit arrays."""

    environment: Environment
    rotation: float  # degrees, as `deepshade.environments.world_to_map` turns it
    _texels: Any = field(repr=False)  # (H, W, 3), flat
    _weights: Any = field(repr=False)  # (H, W), flat: what a pixel's tent is chosen by; sum to 1
    _rows: Any = field(repr=False)  # (H,) cumulative weights of rows
    _columns: Any = field(repr=False)  # (H, W) cumulative weights within each row, up to 1
    _turn: Any = field(repr=False)  # columns from a direction's own to where it lies in the map

    @classmethod
    def of(cls, environment: Environment, rotation: float = 0.0) -> EnvironmentLight:
        """`environment` turned by `rotation` degrees about +y."""
        radiance = environment.radiance
        height, width = environment.shape
        solid = solid_angles(height, width)[:, None]
        weights = radiance.mean(0, dtype=np.float64) * solid
        if not weights.any():
            weights = weights + solid  # black: any direction is as good
        weights /= weights.sum()
        rows = weights.sum(1)
        within = weights.cumsum(1) / np.where(rows, rows, 1)[:, None]
        return cls(
            environment,
            rotation,
            mi.Float(radiance.transpose(1, 2, 0).ravel()),
            mi.Float(weights.astype(np.float32).ravel()),
            mi.Float(rows.cumsum().astype(np.float32)),
            mi.Float(within.astype(np.float32).ravel()),
            dr.opaque(mi.Float, rotation % 360 / 360 * width),
        )

    @property
    def mean(self) -> Any:
        """Mean radiance (Color3f) over all directions."""
        return mi.Color3f(*(dr.opaque(mi.Float, float(value)) for value in self.environment.mean))

    def radiance(self, direction: Any) -> Any:
        """Radiance (Color3f) from the unit world `direction`."""
        return self._bilinear(mi.Color3f, self._texels, *self._place(direction))

    def density(self, direction: Any) -> Any:
        """The density of `sample` at the unit world `direction`, per steradian."""
        column, row = self._place(direction)
        height, width = self.environment.shape
        sine = dr.maximum(dr.sqrt(dr.square(direction.x) + dr.square(direction.z)), 1e-7)
        found = self._bilinear(mi.Float, self._weights, column, row)
        return found * width * height / (2 * dr.square(dr.pi) * sine)

    def sample(self, pair: Any) -> Any:
        """A unit world direction, about in proportion to radiance, for uniform `pair` in [0, 1)².

        Where a pixel's neighbours are bright its tent reaches into them: see `density`.
        """
        height, width = self.environment.shape
        row, down = _chosen(self._rows, 0, height, pair.y)
        column, across = _chosen(self._columns, row * width, width, pair.x)
        # Beyond the poles rows repeat: what falls there is mirrored back.
        y = dr.abs(mi.Float(row) + 0.5 + _tent(down))
        theta = dr.select(y > height, 2 * height - y, y) * (dr.pi / height)
        x = mi.Float(column) + 0.5 + _tent(across) - self._turn
        phi = x * (dr.two_pi / width)
        sine, cosine = dr.sincos(theta)
        # From the left edge of the map, +z, by way of -x to the centre, -z.
        side, back = dr.sincos(phi)
        return mi.Vector3f(-sine * side, cosine, sine * back)

    def _place(self, direction: Any) -> tuple[Any, Any]:
        """Column and row (float, pixels' centres at ½) that `direction` lies at."""
        height, width = self.environment.shape
        across = (dr.atan2(direction.x, -direction.z) * dr.inv_two_pi + 0.5) * width
        sine = dr.sqrt(dr.square(direction.x) + dr.square(direction.z))
        return across + self._turn, dr.atan2(sine, direction.y) * dr.inv_pi * height

    def _bilinear(self, kind: Any, table: Any, column: Any, row: Any) -> Any:
        height, width = self.environment.shape
        x, y = column - 0.5, row - 0.5
        left, top = dr.floor(x), dr.floor(y)
        fx, fy = x - left, y - top

        def at(down: int, right: int) -> Any:
            line = mi.UInt32(dr.clip(mi.Int32(top) + down, 0, height - 1))
            # A turned map's columns go up to twice its width, and down to -1.
            place = mi.UInt32(mi.Int32(left) + (width + right)) % width
            return dr.gather(kind, table, line * width + place)

        return dr.lerp(dr.lerp(at(0, 0), at(0, 1), fx), dr.lerp(at(1, 0), at(1, 1), fx), fy)


def light_of(view: View, effect: str) -> EnvironmentLight:
    """The view's environment; ConfigError if it has none, which `effect` can't do without."""
    if view.surroundings is None:
        raise ConfigError(
            "environment", detail=f"{effect} needs an environment map: --environment FILE"
        )
    return view.surroundings


def _chosen(cumulative: Any, start: Any, count: int, number: Any) -> tuple[Any, Any]:
    """The entry that uniform `number` falls into, and where in it as a number in [0, 1).

    `cumulative` holds `count` cumulative weights from `start` on.
    """
    index = dr.binary_search(  # type: ignore[no-untyped-call]
        0, count - 1, lambda k: dr.gather(mi.Float, cumulative, start + k) <= number
    )
    above = dr.gather(mi.Float, cumulative, start + index)
    below = dr.select(index > 0, dr.gather(mi.Float, cumulative, start + index - 1, index > 0), 0)
    return index, dr.clip((number - below) / dr.maximum(above - below, 1e-30), 0, 1)


def _tent(number: Any) -> Any:
    """Uniform in [0, 1) to the density 1 - |x| on [-1, 1]."""
    low = dr.sqrt(2 * number) - 1
    return dr.select(number < 0.5, low, 1 - dr.safe_sqrt(2 - 2 * number))
