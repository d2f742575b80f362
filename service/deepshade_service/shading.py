"""Shading one picture: decode, infer, encode (`planner` has the step between the first two)."""

from __future__ import annotations

import io
import json
import threading
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from deepshade import exr, pictures
from deepshade.attributes import ATTRIBUTES
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade.engines import Engine
from deepshade.gbuffer import GBuffer, load_gbuffer
from deepshade_service.parameters import ShadeParameters
from deepshade_service.planner import Json, Plan, known_pixels
from deepshade_service.pool import Cancelled
from deepshade_service.problems import Problem
from deepshade_service.tiles import Tile
from deepshade_service.uploads import Upload

Float = NDArray[np.float32]
Facts = dict[str, str | float | int]

# So far away nothing depends on where exactly; what matters is to stay finite, in 16 bits too.
_MOST_RADII = 6e4


def decode(
    files: Sequence[Upload],
    headers: Sequence[exr.Header],
    bundle: Bundle,
    asked: ShadeParameters,
    limits: exr.Limits,
) -> GBuffer:
    """The G-buffer that the bundle's network needs, found or derived in the files.

    Nothing else is decoded. `headers` are the files' own, read before. Raises what
    `load_gbuffer` raises.
    """
    return load_gbuffer(
        [(file.name, file.data) for file in files],
        bundle.inputs,
        profile=asked.profile,
        mapping=asked.mapping,
        fov=asked.fov,
        limits=limits,
        headers=headers,
    )


def infer(
    gbuffer: GBuffer,
    plan: Plan,
    engine: Engine,
    cancelled: threading.Event,
    *,
    consume: bool = False,
) -> Float:
    """Run the network tile by tile: (C', H, W), the effect's background where there is none.

    What no tile answers is background, or known. `consume` allows to scale the G-buffer's own
    positions in place, where that spares a copy of them; it is of no use afterwards. Raises
    Cancelled between tiles when the event is set.
    """
    effect = EFFECTS[engine.bundle.effect]
    divisors = _divisors(engine.bundle, plan.radius)
    if consume and any(tile.shape == gbuffer.shape for tile in plan.tiling):
        for name, divisor in divisors.items():
            for plane in gbuffer.attributes[name]:
                _scale(plane, divisor, plane)
        divisors = {}
    answered = sum(_valid_area(tile) for tile in plan.tiling)
    shade = np.empty((len(effect.outputs), *gbuffer.shape), np.float32)
    if answered < gbuffer.background.size:
        shade.fill(effect.background)
    for planes, out in passes(gbuffer, engine.bundle, divisors, shade):
        for tile in plan.tiling:
            if cancelled.is_set():
                raise Cancelled
            rows, columns = tile.rows, tile.columns
            answer = engine.predict(cut(planes, tile))[
                0,
                :,
                rows.first - rows.start : rows.last - rows.start,
                columns.first - columns.start : columns.last - columns.start,
            ]
            if answer.shape == shade.shape:
                shade = answer  # all of it at once: no copy
            else:
                out[:, rows.first : rows.last, columns.first : columns.last] = answer
    if gbuffer.background.any():
        np.copyto(shade, np.float32(effect.background), where=gbuffer.background)
    if plan.known is not None:
        np.copyto(shade, plan.known.value, where=plan.known.pixels)
    # One sum, unless something is wrong: a single number that isn't finite makes it so too.
    if not np.isfinite(shade.sum()) and not np.isfinite(shade).all():
        raise Problem(
            500,
            "bad-answer",
            f"the network '{engine.bundle.name}' gave numbers that aren't finite",
            fix="report it with the picture; another ?radius= or ?bundle= may work",
        )
    return shade


def encode(
    shade: Float, gbuffer: GBuffer, asked: ShadeParameters, facts: Facts, plan: Json
) -> tuple[bytes, str]:
    """The answer's bytes and media type; it lies where the G-buffer lay.

    Its header holds `facts` and, as JSON, the `plan`.
    """
    if asked.format == "png":
        picture = pictures.of_effect(shade, EFFECTS[str(facts["effect"])])
        return pictures.png(picture), "image/png"
    outputs = "Y" if len(shade) == 1 else "RGB"
    attributes = gbuffer.placement()
    attributes |= {f"deepshade:{name}": value for name, value in facts.items()}
    attributes["deepshade:plan"] = json.dumps(plan, separators=(",", ":"))
    stream = io.BytesIO()
    exr.write(
        stream,
        dict(zip(outputs, shade, strict=True)),
        attributes=attributes,
        compression=asked.compression,
        half=asked.half,
        data_window=gbuffer.data_window,
        display_window=gbuffer.display_window,
    )
    return stream.getvalue(), "image/x-exr"


def describe(gbuffer: GBuffer, plan: Plan, engine: Engine, made: Json) -> Facts:
    """How an answer was made, for its EXR header and the response's headers.

    `made` is the plan as JSON; facts that aren't known are left out.
    """
    bundle = engine.bundle
    facts: Facts = {
        "effect": bundle.effect,
        "bundle": bundle.name,
        "bundle_sha256": bundle.sha256,
        "engine": engine.backend.engine,
        "precision": engine.backend.precision,
        "radius": plan.radius,
        "radius_source": plan.radius_source,
        "mapped": _listed(gbuffer.mapped),
        "derived": _listed(gbuffer.derived),
        "background_pixels": made["pixels"]["background"],
        "nonfinite_pixels": int(gbuffer.nonfinite),
        "known_pixels": known_pixels(plan),
        "computed_pixels": plan.computed,
        "tiles": len(plan.tiling),
    }
    return facts | {
        name: made[name] for name in ("dssim", "added", "predicted_ms") if made[name] is not None
    }


def first_input(gbuffer: GBuffer, plan: Plan, bundle: Bundle) -> Float:
    """What the network is given first for this plan, (1, C, h, w): for timing it alone."""
    shade = np.empty((len(EFFECTS[bundle.effect].outputs), 1, 1), np.float32)
    planes, _ = next(passes(gbuffer, bundle, _divisors(bundle, plan.radius), shade))
    return cut(planes, next(iter(plan.tiling)))


def _divisors(bundle: Bundle, radius: float) -> dict[str, float]:
    """What attributes have to be divided by for the network: positions, by the radius."""
    if bundle.position_scale != "1/radius":
        return {}
    return {name: radius for name in bundle.inputs if ATTRIBUTES[name].kind == "point"}


Plane = tuple[Float, float | None]  # (H, W) and what to divide it by, None if by nothing


def passes(
    gbuffer: GBuffer, bundle: Bundle, divisors: Mapping[str, float], shade: Float
) -> Iterator[tuple[list[Plane], Float]]:
    """Each network run's input planes, in network order, and the part of `shade` it fills.

    A per-channel effect is one run for each colour channel, with that channel of its colours.
    """
    effect = EFFECTS[bundle.effect]
    runs: list[int | None] = list(range(len(effect.outputs))) if effect.per_channel else [None]
    for run in runs:
        planes: list[Plane] = []
        for name in bundle.inputs:
            pixels = gbuffer.attributes[name]
            one = run is not None and ATTRIBUTES[name].kind == "colour"
            chosen = pixels[run : run + 1] if run is not None and one else pixels
            planes += [(plane, divisors.get(name)) for plane in chosen]
        yield planes, shade if run is None else shade[run : run + 1]


def cut(planes: list[Plane], tile: Tile) -> Float:
    """(1, C, h, w): the tile of every plane, scaled; zero, which is background, past the edge.

    No copy where the planes are what is wanted already.
    """
    height, width = planes[0][0].shape
    rows, columns = tile.rows, tile.columns
    if tile.shape == (height, width) and (block := _block(planes)) is not None:
        return block[None]
    bottom, right = min(rows.stop, height), min(columns.stop, width)
    inside = (slice(0, bottom - rows.start), slice(0, right - columns.start))
    gbuffer = np.empty((1, len(planes), *tile.shape), np.float32)
    gbuffer[:, :, inside[0].stop :, :] = 0
    gbuffer[:, :, :, inside[1].stop :] = 0
    for (plane, divisor), target in zip(planes, gbuffer[0], strict=True):
        source = plane[rows.start : bottom, columns.start : right]
        if divisor is None:
            target[inside] = source
        else:
            _scale(source, divisor, target[inside])
    return gbuffer


def _scale(source: Float, divisor: float, out: Float) -> None:
    """Positions in radii, so bounded that they stay finite."""
    with np.errstate(over="ignore"):
        np.divide(source, np.float32(divisor), out=out)
    if out.size and (out.max() > _MOST_RADII or out.min() < -_MOST_RADII):
        np.clip(out, -_MOST_RADII, _MOST_RADII, out=out)


def _block(planes: list[Plane]) -> Float | None:
    """(C, H, W) if the planes lie one after the other in one array, unscaled; else None."""
    arrays = [plane for plane, _ in planes]
    owner = arrays[0].base
    if any(divisor is not None for _, divisor in planes) or not (
        isinstance(owner, np.ndarray)
        and owner.dtype == np.float32
        and owner.flags.c_contiguous
        and all(plane.base is owner and plane.flags.c_contiguous for plane in arrays)
    ):
        return None
    size = arrays[0].nbytes
    starts = [plane.ctypes.data - owner.ctypes.data for plane in arrays]
    first = starts[0] // size
    if starts != [(first + k) * size for k in range(len(arrays))]:
        return None
    return owner.reshape(-1, *arrays[0].shape)[first : first + len(arrays)]


def _valid_area(tile: Tile) -> int:
    rows, columns = tile.rows, tile.columns
    return (rows.last - rows.first) * (columns.last - columns.first)


def _listed(entries: dict[str, str]) -> str:
    return "; ".join(f"{name}: {how}" for name, how in sorted(entries.items()))
