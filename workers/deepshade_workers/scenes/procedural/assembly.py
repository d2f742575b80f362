"""Collects placed solids into one scene mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from deepshade_workers.scenes.mesh import Floats, Mesh, merge
from deepshade_workers.scenes.procedural.primitives import Rng, along, box, cylinder, place

Triple = tuple[float, float, float] | Floats

# How many materials scatter light below their surface, and how far it gets (scene units).
SCATTERING_SHARE = 0.4
MEAN_FREE_PATHS = (0.005, 0.3)


class Assembly:
    """A growing list of placed meshes with random materials, drawn from `rng`.

    What is placed between two coats of paint is one object.
    """

    def __init__(self, rng: Rng) -> None:
        self.rng = rng
        # A stream of its own: a seed's geometry and other materials don't depend on it.
        self._scatter_rng = rng.spawn(1)[0]
        self._parts: list[Mesh] = []
        self._names: list[str] = []
        self._coats = 0
        self.paint()

    def paint(self) -> None:
        """Begin a new object, of a new material."""
        rng, scatter_rng = self.rng, self._scatter_rng
        diffuse = rng.uniform(0.15, 0.9) * (1 - rng.uniform(0, 0.5) * rng.random(3))
        shine = rng.uniform(0, 0.3)
        gloss = 2 ** rng.uniform(1, 8)
        scatters = scatter_rng.random() < SCATTERING_SHARE
        farthest = np.exp(scatter_rng.uniform(*np.log(MEAN_FREE_PATHS)))
        scatter = scatters * farthest * scatter_rng.uniform(0.2, 1, 3)
        # in the order of Material.row
        self._material = np.array([*diffuse, shine, shine, shine, gloss, *scatter])
        self._coats += 1

    def add(self, mesh: Mesh, matrix: Floats | None = None) -> None:
        """Place `mesh` by a (4, 4) `matrix`."""
        placed = mesh if matrix is None else mesh.transformed(matrix)
        rows = np.tile(self._material, (len(placed.faces), 1))
        self._parts.append(replace(placed, materials=rows))
        self._names.append(f"object {self._coats}")

    def box(self, center: Triple, size: Triple, rotation: Floats | None = None) -> None:
        """Place a box by its centre and full size."""
        self.add(box(), place(center, size, rotation))

    def boxes_at(self, at: Floats, turn: Floats) -> Callable[[Triple, Triple], None]:
        """A function that places a box by its offset from `at` and its size, turned by `turn`."""
        return lambda offset, size: self.box(at + turn @ np.array(offset), size, turn)

    def span(self, low: tuple[float, ...], high: tuple[float, ...]) -> None:
        """Place a box from its lowest to its highest corner."""
        a, b = np.array(low, np.float64), np.array(high, np.float64)
        self.box((a + b) / 2, abs(b - a))

    def bar(self, start: Floats, end: Floats, thickness: float, sides: int = 12) -> None:
        """Place a round bar between two points."""
        self.add(cylinder(sides), along(start, end, thickness))

    def floor(self, size: float) -> None:
        """A thick square floor whose top is at 0."""
        self.box((0, -0.25, 0), (size, 0.5, size))

    def finish(self) -> Mesh:
        """All parts as one mesh."""
        return merge(self._parts, self._names)
