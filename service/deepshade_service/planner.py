"""What will be computed, and why: the plan of one answer.

    scene = Scene(gbuffer, effect)
    plan = scene.plan(bundle, asked, max_pixels)

Background and pixels whose answer is known are filled, not computed (`cropping`, and the effect's
`open_rule`). Choosing the bundle is `choice`; how large tiles may be is `room`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from deepshade import exr
from deepshade.bundles import Bundle
from deepshade.effects import Effect
from deepshade.gbuffer import GBuffer
from deepshade.relevance import Known
from deepshade_service.choice import Choice, Choices, considered, rounded
from deepshade_service.coverage import Grid
from deepshade_service.cropping import Reach, computed_pixels, cover
from deepshade_service.parameters import MAX_RADIUS, MIN_RADIUS, ShadeParameters
from deepshade_service.problems import Problem
from deepshade_service.room import Room, bytes_per_pixel
from deepshade_service.tiles import Tile, Tiling, plan_tiles

if TYPE_CHECKING:
    from deepshade.engines import Engine

Json = dict[str, Any]

_BYTES = {"half": 2, "float": 4, "uint": 4}
# Which parameters a plan repeats: those that chose.
_ASKED = ("quality", "bundle", "max_error", "budget_ms", "engine", "precision")


@dataclass(frozen=True, slots=True)
class Plan:
    """What will be computed: with which radius (scene units), in which tiles.

    `known` pixels hold their known answer, whether or not a tile has computed them.
    """

    radius: float
    radius_source: str
    tiling: Tiling | list[Tile]
    known: Known | None = None

    @property
    def computed(self) -> int:
        """Pixels that the network computes, overlaps and padding included."""
        return computed_pixels(self.tiling)


class Scene:
    """One picture, and what is found out about it once for all bundles."""

    def __init__(self, gbuffer: GBuffer, effect: Effect) -> None:
        self.gbuffer = gbuffer
        self.effect = effect
        self.background = int(np.count_nonzero(gbuffer.background))
        self._known: dict[float, Known | None] = {}
        self._grids: dict[tuple[float, int], Grid] = {}

    def plan(self, bundle: Bundle, asked: ShadeParameters, max_pixels: int) -> Plan:
        """The plan for one bundle, whose tiles compute at most `max_pixels` each.

        The radius is the one asked for, else the header's, else the bundle's. Raises Problem 422
        for an impossible radius in the header.
        """
        radius, source = _radius(self.gbuffer, bundle, asked)
        known = self._known_at(radius)
        height, width = self.gbuffer.shape
        tiles: Tiling | list[Tile] | None = None
        if self.background or known is not None:
            grid = self._grid(radius, bundle.size_multiple)
            reach = Reach(bundle.size_multiple, bundle.halo, bundle.background_halo)
            tiles = cover(grid, reach, max_pixels)
        if tiles is None:
            tiles = plan_tiles(
                height,
                width,
                multiple=bundle.size_multiple,
                halo=bundle.halo,
                max_pixels=max_pixels,
            )
        return Plan(radius, source, tiles, known)

    def _known_at(self, radius: float) -> Known | None:
        rule = self.effect.open_rule
        if radius not in self._known:
            self._known[radius] = rule(self.gbuffer, radius) if rule else None
        return self._known[radius]

    def _grid(self, radius: float, multiple: int) -> Grid:
        key = radius, multiple
        if key not in self._grids:
            known = self._known_at(radius)
            pixels = None if known is None else known.pixels
            self._grids[key] = Grid.of(self.gbuffer.background, pixels, multiple)
        return self._grids[key]


def explain(
    scene: Scene,
    plan: Plan,
    choice: Choice,
    choices: Choices,
    engine: Engine,
    room: Room,
    headers: Sequence[exr.Header],
) -> Json:
    """The plan as JSON values: what `?explain=1` answers and an answer's header holds."""
    candidate, bundle = choice.candidate, choice.candidate.bundle
    height, width = scene.gbuffer.shape
    asked = {name: getattr(choices.asked, name) for name in _ASKED}
    return {
        "effect": scene.effect.name,
        "asked": {name: value for name, value in asked.items() if value is not None},
        "reason": choice.reason,
        "bundle": bundle.name,
        "bundle_sha256": bundle.sha256,
        "engine": engine.backend.engine,
        "precision": engine.backend.precision,
        "dssim": rounded(candidate.dssim),
        "added": rounded(candidate.added),
        "predicted_ms": rounded(candidate.ms(plan.computed)),
        "calibrated": candidate.calibrated,
        "radius": plan.radius,
        "radius_source": plan.radius_source,
        "pixels": {
            "width": width,
            "height": height,
            "all": width * height,
            "background": scene.background,
            "known": known_pixels(plan),
            "known_why": plan.known.why if plan.known else None,
            "computed": plan.computed,
            "share": rounded(plan.computed / (width * height)),
            "tiles": len(plan.tiling),
            "largest_tile": max((tile.shape for tile in plan.tiling), key=_area, default=None),
        },
        "channels": _channels(scene.gbuffer, headers),
        "memory": {
            "reserved_bytes": room.needed,
            "tile_bytes": room.tile_bytes,
            "bytes_per_pixel": bytes_per_pixel(engine),
        },
        "considered": considered(choices.pool, lambda _: plan.computed),
    }


def known_pixels(plan: Plan) -> int:
    """Pixels with geometry whose answer is known without the network."""
    return int(np.count_nonzero(plan.known.pixels)) if plan.known else 0


def _channels(gbuffer: GBuffer, headers: Sequence[exr.Header]) -> Json:
    """What the files hold, and what of it was decoded; bytes are those of decoded pixels."""
    stored = 0
    sizes: dict[tuple[int, str], int] = {}
    for file, header in enumerate(headers):
        stored += header.decoded_bytes
        for name, (index, bare) in header.channels().items():
            part = header.parts[index]
            sizes[file, name] = _BYTES[part.channels[bare]] * part.shape[0] * part.shape[1]
    decoded = list(dict.fromkeys(gbuffer.decoded))
    used = sum(sizes[channel] for channel in decoded)
    return {
        "in_file": len(sizes),
        "decoded": [name for _, name in decoded],
        "bytes_in_file": stored,
        "bytes_decoded": used,
        "bytes_saved": stored - used,
    }


def _radius(gbuffer: GBuffer, bundle: Bundle, asked: ShadeParameters) -> tuple[float, str]:
    if asked.radius is not None:
        return asked.radius, "request"
    stored = gbuffer.header.get("deepshade:radius")
    if stored is None:
        return bundle.radius, "bundle"
    try:
        radius = float(stored)
    except (TypeError, ValueError):
        radius = float("nan")
    if not MIN_RADIUS <= radius <= MAX_RADIUS:
        raise Problem(
            422,
            "bad-header",
            f"the image's header says deepshade:radius = {str(stored)[:60]}",
            fix="it must be a positive number; ?radius= overrides it",
        )
    return radius, "header"


def _area(shape: tuple[int, int]) -> int:
    return shape[0] * shape[1]
