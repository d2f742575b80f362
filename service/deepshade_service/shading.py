"""Shading one picture in four named steps: decode, plan, infer, encode."""

from __future__ import annotations

import io
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade import exr, pictures
from deepshade.attributes import ATTRIBUTES
from deepshade.effects import EFFECTS
from deepshade.gbuffer import GBuffer, load_gbuffer
from deepshade_service.engine import Engine
from deepshade_service.parameters import MAX_RADIUS, MIN_RADIUS, ShadeParameters
from deepshade_service.pool import Cancelled
from deepshade_service.problems import Problem
from deepshade_service.tiles import Tile, Tiling, plan_tiles
from deepshade_service.uploads import Upload

Float = NDArray[np.float32]
Facts = dict[str, str | float | int]

# A million radii away float32 no longer resolves one radius; what matters is to stay finite.
_MOST_RADII = 1e6


@dataclass(frozen=True, slots=True)
class Plan:
    """What will be computed: with which radius (scene units), and in which tiles."""

    radius: float
    radius_source: str
    tiling: Tiling


def decode(
    files: Sequence[Upload],
    headers: Sequence[exr.Header],
    engine: Engine,
    asked: ShadeParameters,
    limits: exr.Limits,
) -> GBuffer:
    """The G-buffer that the engine's network needs, found or derived in the files.

    `headers` are the files' own, read before.

    Raises what `load_gbuffer` raises.
    """
    return load_gbuffer(
        [(file.name, file.data) for file in files],
        engine.bundle.inputs,
        profile=asked.profile,
        mapping=asked.mapping,
        fov=asked.fov,
        limits=limits,
        headers=headers,
    )


def plan(gbuffer: GBuffer, engine: Engine, asked: ShadeParameters, tile_bytes: int) -> Plan:
    """Choose the radius (asked, else the header's, else the bundle's) and the tiles.

    `tile_bytes` is what one prediction may use. Raises Problem 422 for an impossible radius in
    the header.
    """
    bundle = engine.bundle
    if asked.radius is not None:
        radius, source = asked.radius, "request"
    elif (stored := gbuffer.header.get("deepshade:radius")) is not None:
        radius, source = _header_radius(stored), "header"
    else:
        radius, source = bundle.radius, "bundle"
    height, width = gbuffer.background.shape
    tiling = plan_tiles(
        height,
        width,
        multiple=bundle.size_multiple,
        halo=bundle.halo,
        max_pixels=tile_bytes // engine.bytes_per_pixel,
    )
    return Plan(radius, source, tiling)


def infer(gbuffer: GBuffer, plan: Plan, engine: Engine, cancelled: threading.Event) -> Float:
    """Run the network tile by tile: (C', H, W), the effect's background where there is none.

    Raises Cancelled between tiles when the event is set.
    """
    effect = EFFECTS[engine.bundle.effect]
    shade = np.empty((len(effect.outputs), *gbuffer.background.shape), np.float32)
    for planes, out in passes(gbuffer, engine, plan.radius, shade):
        for tile in plan.tiling:
            if cancelled.is_set():
                raise Cancelled
            rows, columns = tile.rows, tile.columns
            answer = engine.predict(cut(planes, tile))[0]
            out[:, rows.first : rows.last, columns.first : columns.last] = answer[
                :,
                rows.first - rows.start : rows.last - rows.start,
                columns.first - columns.start : columns.last - columns.start,
            ]
    if gbuffer.background.any():
        np.copyto(shade, np.float32(effect.background), where=gbuffer.background)
    if not np.isfinite(shade).all():
        raise Problem(
            500,
            "bad-answer",
            f"the network '{engine.bundle.name}' gave numbers that aren't finite",
            fix="report it with the picture; another ?radius= or ?bundle= may work",
        )
    return shade


def encode(
    shade: Float, gbuffer: GBuffer, engine: Engine, asked: ShadeParameters, facts: Facts
) -> tuple[bytes, str]:
    """The answer's bytes and media type; it has the G-buffer's windows, and `facts` in its header.

    The frame starts at (0, 0), whatever the display window's corner was.
    """
    if asked.format == "png":
        picture = pictures.of_effect(shade, EFFECTS[engine.bundle.effect])
        return pictures.png(picture), "image/png"
    outputs = "Y" if len(shade) == 1 else "RGB"
    attributes: dict[str, Any] = gbuffer.camera.to_header() if gbuffer.camera else {}
    attributes |= {f"deepshade:{name}": value for name, value in facts.items()}
    (x0, y0, *_), (left, top, right, bottom) = gbuffer.data_window, gbuffer.display_window
    stream = io.BytesIO()
    exr.write(
        stream,
        dict(zip(outputs, shade, strict=True)),
        attributes=attributes,
        compression=asked.compression,
        half=asked.half,
        frame=(right - left + 1, bottom - top + 1),
        origin=(x0 - left, y0 - top),
    )
    return stream.getvalue(), "image/x-exr"


def describe(gbuffer: GBuffer, plan: Plan, engine: Engine) -> Facts:
    """How an answer was made, for its EXR header and the response's headers."""
    bundle = engine.bundle
    return {
        "effect": bundle.effect,
        "bundle": bundle.name,
        "bundle_sha256": bundle.sha256,
        "engine": engine.name,
        "precision": engine.precision,
        "radius": plan.radius,
        "radius_source": plan.radius_source,
        "mapped": _listed(gbuffer.mapped),
        "derived": _listed(gbuffer.derived),
        "background_pixels": int(np.count_nonzero(gbuffer.background)),
        "nonfinite_pixels": int(gbuffer.nonfinite),
        "tiles": len(plan.tiling),
    }


def _header_radius(stored: Any) -> float:
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
    return radius


Plane = tuple[Float, float]  # (H, W) and what to divide it by


def passes(
    gbuffer: GBuffer, engine: Engine, radius: float, shade: Float
) -> Iterator[tuple[list[Plane], Float]]:
    """Each network run's input planes, in network order, and the part of `shade` it fills.

    A per-channel effect is one run for each colour channel, with that channel of its colours.
    """
    effect = EFFECTS[engine.bundle.effect]
    scaled = engine.bundle.position_scale == "1/radius"
    runs: list[int | None] = list(range(len(effect.outputs))) if effect.per_channel else [None]
    for run in runs:
        planes: list[Plane] = []
        for name in engine.bundle.inputs:
            kind = ATTRIBUTES[name].kind
            pixels = gbuffer.attributes[name]
            chosen = pixels if run is None or kind != "colour" else pixels[run : run + 1]
            divisor = radius if kind == "point" and scaled else 1.0
            planes += [(plane, divisor) for plane in chosen]
        yield planes, shade if run is None else shade[run : run + 1]


def cut(planes: list[Plane], tile: Tile) -> Float:
    """(1, C, h, w): the tile of every plane, scaled; zero, which is background, past the edge."""
    height, width = planes[0][0].shape
    rows, columns = tile.rows, tile.columns
    bottom, right = min(rows.stop, height), min(columns.stop, width)
    inside = (slice(0, bottom - rows.start), slice(0, right - columns.start))
    gbuffer = np.empty((1, len(planes), *tile.shape), np.float32)
    gbuffer[:, :, inside[0].stop :, :] = 0
    gbuffer[:, :, :, inside[1].stop :] = 0
    for (plane, divisor), target in zip(planes, gbuffer[0], strict=True):
        source = plane[rows.start : bottom, columns.start : right]
        if divisor == 1.0:
            target[inside] = source
            continue
        with np.errstate(over="ignore"):
            np.divide(source, np.float32(divisor), out=target[inside])
        np.clip(target, -_MOST_RADII, _MOST_RADII, out=target)
    return gbuffer


def _listed(entries: dict[str, str]) -> str:
    return "; ".join(f"{name}: {how}" for name, how in sorted(entries.items()))
