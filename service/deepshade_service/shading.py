"""A request's path, from uploaded bytes to an encoded answer: decode, plan, infer, encode."""

from __future__ import annotations

import io
import json
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from deepshade import exr, pictures, tensors
from deepshade.bundles import Bundle
from deepshade.camera import camera_to_world
from deepshade.effects import EFFECTS, SETTINGS, Setting
from deepshade.engines import Engine
from deepshade.environments import Prepared
from deepshade.gbuffer import GBuffer, load_gbuffer
from deepshade.machine import trim
from deepshade_service.environments import DEFAULT, Environments
from deepshade_service.memory import MemoryBudget, Need, need_of, size_of
from deepshade_service.models import Models
from deepshade_service.parameters import LENS, LIGHT, ShadeParameters
from deepshade_service.plan import Facts, Json, Lighting, ShadePlan, explain, facts_of
from deepshade_service.problems import Problem
from deepshade_service.selection import Candidate, Selection, select
from deepshade_service.telemetry import Stopwatch
from deepshade_service.tiles import plan_tiles
from deepshade_service.uploads import Upload
from deepshade_service.workers import Cancelled, Workers

Float = NDArray[np.float32]

# Work that used more hands memory back at once, other work when the service is idle.
_BIG = 512 * 2**20


@dataclass(frozen=True, slots=True)
class Shaded:
    """An encoded picture, or a plan as JSON, and how it was made."""

    content: bytes
    media_type: str
    facts: Facts
    pixels: int
    computed: int
    watch: Stopwatch


@dataclass(frozen=True, slots=True)
class Shader:
    """Shades pictures with these models, on these workers, within this memory."""

    models: Models
    workers: Workers
    memory: MemoryBudget
    limits: exr.Limits
    environments: Environments

    async def shade(
        self, files: list[Upload], asked: ShadeParameters, candidates: list[Candidate]
    ) -> Shaded:
        """The answer, by one of the candidates. Waits, in turn, for a worker and for memory.

        Raises what the steps raise, and Cancelled.
        """
        watch = Stopwatch()

        def read(_: threading.Event) -> list[exr.Header]:
            with watch.time("decode"):
                return read_headers(files, asked, self.limits)

        def work(cancelled: threading.Event) -> Shaded:
            if cancelled.is_set():
                raise Cancelled
            with watch.time("decode"):
                gbuffer = decode(files, headers, bundle, asked, self.limits)
            with watch.time("plan"):
                plan = plan_shading(gbuffer, bundle, asked, need.max_pixels)
                if prepared is not None:
                    plan = lit(plan, prepared, gbuffer, bundle, asked)
                made = explain(gbuffer, headers, selection, asked, plan, need)
                facts = facts_of(gbuffer, plan, made)
            if engine is None:
                content = json.dumps(made, indent=2).encode()
                return Shaded(content, "application/json", facts, 0, 0, watch)
            with watch.time("infer"):
                shade = infer(gbuffer, plan, engine, cancelled)
            with watch.time("encode"):
                content, media_type = encode(shade, gbuffer, asked, facts, made)
            return Shaded(content, media_type, facts, shade[0].size, plan.computed, watch)

        headers = await self.workers.run(read)
        selection = await self._select(headers, asked, candidates)
        bundle = selection.bundle
        need = need_of(headers, bundle, self.memory.total)
        prepared = await self._environment(bundle, asked)
        engine = None if asked.explain else await self.models.engine(bundle, selection.backend)
        async with self.memory.hold(need.total):
            return await self.workers.run(_giving_back(engine, need)(work))

    async def _environment(self, bundle: Bundle, asked: ShadeParameters) -> Prepared | None:
        """The environment that the bundle is to be given, if it takes one.

        Raises Problem 422 where one is asked for that it can't be given.
        """
        if bundle.environment:
            return await self.environments.get(asked.environment or DEFAULT)
        for name in LIGHT:
            if getattr(asked, name) is not None:
                raise Problem(
                    422,
                    "bad-parameter",
                    f"the bundle '{bundle.name}' knows no environment but the one it learnt",
                    fix=f"leave out ?{name}=, or choose another ?bundle=",
                )
        return None

    async def _select(
        self, headers: list[exr.Header], asked: ShadeParameters, candidates: list[Candidate]
    ) -> Selection:
        """Which bundle; a time is predicted as if there were no background."""
        megapixels: dict[str, float] = {}
        for bundle, _ in candidates if asked.budget_ms is not None else ():
            most = need_of(headers, bundle, self.memory.total).max_pixels
            grid = plan_tiles(*size_of(headers), bundle.size_multiple, bundle.halo, most)
            megapixels[bundle.name] = grid.computed / 1e6
        return await select(self.models, candidates, asked, megapixels)


def read_headers(
    files: Sequence[Upload], asked: ShadeParameters, limits: exr.Limits
) -> list[exr.Header]:
    """The files' checked headers, in which the lens is the one asked for.

    Raises what `exr.read_header` raises.
    """
    headers = [exr.read_header(file.data, limits) for file in files]
    lens = {SETTINGS[name].header: getattr(asked, name) for name in LENS}
    for part in (part for header in headers for part in header.parts):
        part.attributes.update({key: value for key, value in lens.items() if value is not None})
    return headers


def decode(
    files: Sequence[Upload],
    headers: Sequence[exr.Header],
    bundle: Bundle,
    asked: ShadeParameters,
    limits: exr.Limits,
) -> GBuffer:
    """The G-buffer that the bundle's network needs, found or derived in the files.

    Nothing else is decoded. A blur circle that the files hold is of their lens: where another is
    asked for, it is derived. Raises what `load_gbuffer` raises, and Problem 422 for a shutter
    asked for where the header doesn't say which one the motion holds for.
    """
    needs = list(bundle.inputs)
    new_lens = any(getattr(asked, name) is not None for name in LENS)
    if EFFECTS[bundle.effect].background == "light" and "light" not in needs:
        needs.append("light")
    gbuffer = load_gbuffer(
        [(file.name, file.data) for file in files],
        needs,
        profile=asked.profile,
        mapping=asked.mapping,
        fov=asked.fov,
        limits=limits,
        headers=headers,
        anew=("focal",) if new_lens and "focal" in needs else (),
    )
    if asked.shutter is not None:
        setting = SETTINGS["shutter"]
        shutter = _stored(gbuffer, setting)
        if not shutter:
            raise Problem(
                422,
                "bad-parameter",
                "shutter: motion can't be scaled, for the header doesn't say how long the shutter"
                " is open that it holds for",
                fix=f"write {setting.header}, in {setting.unit} above 0, or leave out ?shutter=",
            )
        gbuffer.attributes["motion"] *= np.float32(asked.shutter / shutter)
        gbuffer.header[setting.header] = asked.shutter
    return gbuffer


def plan_shading(
    gbuffer: GBuffer, bundle: Bundle, asked: ShadeParameters, max_pixels: int
) -> ShadePlan:
    """What to compute, in tiles of at most `max_pixels`.

    The radius is the one asked for, else the header's, else the bundle's. A tile that would only
    answer background is left out, where the effect says what stands there. Raises Problem 422
    for an impossible radius in the header.
    """
    radius, source = _radius(gbuffer, bundle, asked)
    grid = plan_tiles(*gbuffer.shape, bundle.size_multiple, bundle.halo, max_pixels)
    tiles = tuple(grid)
    if EFFECTS[bundle.effect].background != "shaded":
        tiles = tuple(tile for tile in tiles if not gbuffer.background[tile.answered].all())
    return ShadePlan(radius, source, grid.shape, tiles)


def lit(
    plan: ShadePlan, prepared: Prepared, gbuffer: GBuffer, bundle: Bundle, asked: ShadeParameters
) -> ShadePlan:
    """The plan with its lighting: the world's up axis is the one asked for, else the renderer's."""
    lighting = Lighting(prepared.environment, asked.rotate or 0.0, asked.up or gbuffer.up)
    camera = camera_to_world(gbuffer.attributes, gbuffer.camera)
    given = prepared.inputs(bundle.environment, lighting.rotate, lighting.up, camera)
    return replace(plan, lighting=lighting, given=given)


def infer(gbuffer: GBuffer, plan: ShadePlan, engine: Engine, cancelled: threading.Event) -> Float:
    """(C', H, W): the network's answer, and the effect's background where there is none.

    A per-channel network runs once for each colour channel. Raises Cancelled between tiles when
    the event is set, and Problem 500 for an answer that isn't finite.
    """
    bundle = engine.bundle
    effect = EFFECTS[bundle.effect]
    scale = tensors.length_scale(effect, gbuffer.attributes, plan.radius)
    shade = np.empty((len(effect.outputs), *gbuffer.shape), np.float32)
    for channel in range(3) if bundle.per_channel else (None,):
        planes = tensors.planes(gbuffer.attributes, bundle.inputs, scale, channel=channel)
        out = shade if channel is None else shade[channel : channel + 1]
        for tile in plan.tiles:
            if cancelled.is_set():
                raise Cancelled
            given = (plan.given,) if plan.given else ()
            answer = engine.predict(tensors.cut(planes, tile.box), *given)[0][:, *tile.inner]
            if answer.shape == shade.shape:
                shade = answer  # all of it at once: no copy
            else:
                out[:, *tile.answered] = answer
    if effect.background == "light":
        np.copyto(shade, gbuffer.attributes["light"], where=gbuffer.background)
    elif effect.background != "shaded" and gbuffer.background.any():
        np.copyto(shade, np.float32(effect.background), where=gbuffer.background)
    # One sum, unless something is wrong: a single number that isn't finite makes it so too.
    if not np.isfinite(shade.sum()) and not np.isfinite(shade).all():
        raise Problem(
            500,
            "bad-answer",
            f"the network '{bundle.name}' gave numbers that aren't finite",
            fix="report it with the picture; another ?radius= or ?bundle= may work",
        )
    return shade


def encode(
    shade: Float, gbuffer: GBuffer, asked: ShadeParameters, facts: Facts, made: Json
) -> tuple[bytes, str]:
    """The answer's bytes and media type; it lies where the G-buffer lay.

    Its header holds `facts` and, as JSON, the plan (`made`).
    """
    effect = EFFECTS[str(facts["effect"])]
    if asked.format == "png":
        return pictures.png(pictures.of_effect(shade, effect)), "image/png"
    attributes = gbuffer.placement()
    attributes |= {f"deepshade:{name}": value for name, value in facts.items()}
    attributes["deepshade:plan"] = json.dumps(made, separators=(",", ":"))
    stream = io.BytesIO()
    exr.write(
        stream,
        dict(zip(effect.outputs, shade, strict=True)),
        attributes=attributes,
        compression=asked.compression,
        half=asked.half,
        data_window=gbuffer.data_window,
        display_window=gbuffer.display_window,
    )
    return stream.getvalue(), "image/x-exr"


@contextmanager
def _giving_back(engine: Engine | None, need: Need) -> Iterator[None]:
    """Memory that the block leaves behind is given back if it was much."""
    try:
        yield
    finally:
        if engine is not None and need.total > _BIG:
            engine.shrink()
            trim()


def _radius(gbuffer: GBuffer, bundle: Bundle, asked: ShadeParameters) -> tuple[float, str]:
    if asked.radius is not None:
        return asked.radius, "request"
    if "radius" not in EFFECTS[bundle.effect].settings:
        return bundle.radius, "bundle"
    radius = _stored(gbuffer, SETTINGS["radius"], "; ?radius= overrides it")
    return (bundle.radius, "bundle") if radius is None else (radius, "header")


def _stored(gbuffer: GBuffer, setting: Setting, instead: str = "") -> float | None:
    """What the header says of a setting. Raises Problem 422 where it can't mean that."""
    stored = gbuffer.header.get(setting.header)
    if stored is None:
        return None
    try:
        value = float(stored)
    except (TypeError, ValueError):
        value = float("nan")
    if not setting.lowest <= value <= setting.highest:
        raise Problem(
            422,
            "bad-header",
            f"the image's header says {setting.header} = {str(stored)[:60]}",
            fix=f"it must be a number from {setting.lowest:g} to {setting.highest:g}{instead}",
        )
    return value
