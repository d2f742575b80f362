"""Collects placed solids into one scene mesh."""

from __future__ import annotations

from deepshade_workers.scenes.mesh import Floats, Material, Mesh, merge
from deepshade_workers.scenes.procedural.primitives import Rng, along, box, cylinder, place, sphere


class Assembly:
    """A growing list of placed meshes with random materials, drawn from `rng`."""

    def __init__(self, rng: Rng) -> None:
        self.rng = rng
        self._parts: list[Mesh] = []
        self.material = self._draw_material()

    def _draw_material(self) -> Material:
        rng = self.rng
        diffuse = rng.uniform(0.15, 0.9) * (1 - rng.uniform(0, 0.5) * rng.random(3))
        shine = rng.uniform(0, 0.3)
        gloss = float(2 ** rng.uniform(1, 8))
        r, g, b = (float(v) for v in diffuse)
        return Material((r, g, b), (shine, shine, shine), gloss)

    def paint(self) -> None:
        """Give what follows a new material."""
        self.material = self._draw_material()

    def add(self, mesh: Mesh, matrix: Floats | None = None) -> None:
        """Place `mesh` by a (4, 4) `matrix`."""
        placed = mesh if matrix is None else mesh.transformed(matrix)
        self._parts.append(placed.with_material(self.material))

    def box(
        self,
        center: tuple[float, float, float] | Floats,
        size: tuple[float, float, float] | Floats,
        rotation: Floats | None = None,
    ) -> None:
        """Place a box by its centre and full size."""
        self.add(box(), place(center, size, rotation))

    def span(self, low: tuple[float, ...], high: tuple[float, ...]) -> None:
        """Place a box from its lowest to its highest corner."""
        center = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
        size = [abs(b - a) for a, b in zip(low, high, strict=True)]
        self.add(box(), place((center[0], center[1], center[2]), (size[0], size[1], size[2])))

    def bar(self, start: Floats, end: Floats, thickness: float, sides: int = 12) -> None:
        """Place a round bar between two points."""
        self.add(cylinder(sides), along(start, end, thickness))

    def ball(self, center: Floats, diameter: float, detail: int = 2) -> None:
        """Place a ball."""
        self.add(sphere(detail), place(center, diameter))

    def floor(self, size: float = 24.0, height: float = 0.0) -> None:
        """A thick square floor whose top is at `height`."""
        self.box((0, height - 0.25, 0), (size, 0.5, size))

    def finish(self) -> Mesh:
        """All parts as one mesh."""
        return merge(self._parts)
