"""A request's path, from uploaded bytes to an encoded answer: decode, plan, infer, encode."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from math import prod

import numpy as np
from numpy.typing import NDArray

from deepshade import exr, tensors
from deepshade.bundles import Bundle
from deepshade.camera import camera_to_world
from deepshade.effects import EFFECTS, SETTINGS
from deepshade.engines import Engine
from deepshade.environments import Prepared
from deepshade.gbuffer import GBuffer
from deepshade.machine import trim
from deepshade_service import panoramas
from deepshade_service.answers import Made, Place, Shaded, encode, plan_of
from deepshade_service.composition import Composition, bytes_of, compose
from deepshade_service.decoding import decode, read_headers
from deepshade_service.environments import DEFAULT, Environments
from deepshade_service.memory import MemoryBudget, Need, need_of, size_of
from deepshade_service.models import Models
from deepshade_service.parameters import LIGHT, ShadeParameters
from deepshade_service.plan import Lighting, ShadePlan, explain, facts_of
from deepshade_service.problems import Problem
from deepshade_service.radius import radius_of
from deepshade_service.selection import Candidate, Selection, select
from deepshade_service.telemetry import Stopwatch
from deepshade_service.tiles import plan_tiles
from deepshade_service.uploads import Upload
from deepshade_service.workers import Cancelled, Workers, unless

Float = NDArray[np.float32]

# Work that used more hands memory back at once, other work when the service is idle.
_BIG = 512 * 2**20


@dataclass(frozen=True, slots=True)
class Job:
    """One effect of a request: by which bundle on what, and what it is given beside the picture.

    Without an engine it is only planned.
    """

    selection: Selection
    need: Need
    prepared: Prepared | None
    engine: Engine | None

    @property
    def bundle(self) -> Bundle:
        """The bundle that was selected."""
        return self.selection.bundle


@dataclass(frozen=True, slots=True)
class Shader:
    """Shades pictures with these models, on these workers, within this memory."""

    models: Models
    workers: Workers
    memory: MemoryBudget
    limits: exr.Limits
    environments: Environments
    stopping: asyncio.Event

    async def shade(
        self, files: list[Upload], asked: ShadeParameters, effects: list[list[Candidate]]
    ) -> Shaded:
        """The answer, for each effect by one of its candidates, one effect after the other.

        Waits, in turn, for a worker and for memory. Raises what the steps raise, and Cancelled.
        """
        watch = Stopwatch()

        def read(_: threading.Event) -> list[exr.Header]:
            with watch.time("decode"):
                return read_headers(files, asked, self.limits)

        def work(cancelled: threading.Event) -> Shaded:
            shades: list[Float] = []
            made: list[Made] = []
            bundles = [job.bundle for job in jobs]
            composition: Composition | None = None
            place: Place | None = None
            for view in asked.views or [""]:
                of_view = asked.model_copy(update={"view": view}) if view else asked
                gbuffers = decode(files, headers, bundles, of_view, self.limits)
                for job in jobs:
                    if cancelled.is_set():
                        raise Cancelled
                    with watch.time("decode"):
                        gbuffer = next(gbuffers)
                    here = Place.of(gbuffer)
                    place = place or here
                    if here.windows != place.windows:
                        raise _other_pixels()
                    if composition is None:
                        effects = [EFFECTS[bundle.effect] for bundle in bundles]
                        composition = compose(files, headers, asked, effects, gbuffer)
                    shade, how = run(job, gbuffer, headers, asked, held, cancelled)
                    shades.append(shade)
                    facts = how.facts | composition.facts
                    several = len(asked.views) > 1
                    made.append(replace(how, facts=facts, view=view if several else ""))
                    del gbuffer  # the next may be decoded anew
                gbuffers.close()  # what they share is no longer needed
            if asked.explain:
                content = json.dumps(plan_of(made), indent=2).encode()
                return Shaded(content, "application/json", made, watch.milliseconds)
            assert composition is not None and place is not None, "there is at least one effect"
            with watch.time("decode"):
                own = composition.read(files, headers)
            with watch.time("encode"):
                content, media_type = encode(shades, made, place, asked, composition, own)
            return Shaded(content, media_type, made, watch.milliseconds)

        headers = await self.workers.run(read)
        jobs = await self.jobs(headers, asked, effects)
        held = max(job.need.total for job in jobs)
        async with self.memory.hold(held):
            return await self.workers.run(_giving_back(jobs, held)(work))

    async def jobs(
        self, headers: list[exr.Header], asked: ShadeParameters, effects: list[list[Candidate]]
    ) -> list[Job]:
        """What shades each effect of a picture with these headers, its network loaded.

        Raises Problem, 503 where the service stops meanwhile.
        """
        jobs = self._jobs(headers, asked, effects)
        return await unless(self.stopping.wait(), _stopping(), jobs)

    async def _jobs(
        self, headers: list[exr.Header], asked: ShadeParameters, effects: list[list[Candidate]]
    ) -> list[Job]:
        selections = [await self._select(headers, asked, candidates) for candidates in effects]
        bundles = [selection.bundle for selection in selections]
        jobs = []
        for selection in selections:
            bundle = selection.bundle
            more = bytes_of(headers, asked) + _more(headers, asked, bundles)
            need = need_of(headers, bundle, self.memory.total, bundles, more)
            prepared = await self._environment(bundle, asked)
            engine = None if asked.explain else await self.models.engine(bundle, selection.backend)
            jobs.append(Job(selection, need, prepared, engine))
        return jobs

    async def _environment(self, bundle: Bundle, asked: ShadeParameters) -> Prepared | None:
        """The environment that the bundle is to be given, if it takes one.

        Raises Problem 422 where one is asked for that it can't be given.
        """
        if bundle.environment:
            return await self.environments.get(asked.environment or DEFAULT)
        for name in LIGHT:
            taken = EFFECTS[bundle.effect].takes(SETTINGS[name])
            if taken and getattr(asked, name) is not None:
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


def run(
    job: Job,
    gbuffer: GBuffer,
    headers: Sequence[exr.Header],
    asked: ShadeParameters,
    held: int,
    cancelled: threading.Event,
) -> tuple[Float, Made]:
    """One effect's answer and how it was made; an empty one without an engine.

    `held` is the memory that the request holds. Raises what the steps raise.
    """
    watch, bundle = Stopwatch(), job.bundle
    around = panoramas.is_panorama(gbuffer)
    with watch.time("plan"):
        if around:
            panoramas.check(bundle)
        plan = plan_shading(gbuffer, bundle, asked, job.need.max_pixels)
        if job.prepared is not None:
            plan = lit(plan, job.prepared, gbuffer, bundle, asked)
        if asked.strict and plan.radius.warning:
            fix = "leave out ?strict=1 to have it shaded"
            raise Problem(422, "contradiction", plan.radius.warning, fix=fix)
        made = explain(gbuffer, headers, job.selection, asked, plan, held)
        facts = facts_of(gbuffer, plan, made)
    shade = np.empty((0, 0, 0), np.float32)
    if job.engine is not None:
        with watch.time("infer"):
            if around:
                shade = _around(job, gbuffer, plan, asked, cancelled)
            else:
                shade = infer(gbuffer, plan, job.engine, cancelled)
        if held > _BIG:
            job.engine.shrink()  # for the next one
    pixels = gbuffer.background.size
    return shade, Made(bundle.effect, facts, made, pixels, plan.computed, watch.milliseconds)


def plan_shading(
    gbuffer: GBuffer, bundle: Bundle, asked: ShadeParameters, max_pixels: int
) -> ShadePlan:
    """What to compute, in tiles of at most `max_pixels`, all at the radius of the whole picture.

    A tile that would only answer background is left out, where the effect says what stands there.
    Raises Problem 422 for an impossible radius in the header.
    """
    grid = plan_tiles(*gbuffer.shape, bundle.size_multiple, bundle.halo, max_pixels)
    tiles = tuple(grid)
    if EFFECTS[bundle.effect].background != "shaded":
        tiles = tuple(tile for tile in tiles if not gbuffer.background[tile.answered].all())
    sized = panoramas.measured(gbuffer) if panoramas.is_panorama(gbuffer) else gbuffer
    return ShadePlan(radius_of(sized, bundle, asked), grid.shape, tiles)


def lit(
    plan: ShadePlan, prepared: Prepared, gbuffer: GBuffer, bundle: Bundle, asked: ShadeParameters
) -> ShadePlan:
    """The plan with its lighting: the world's up axis is the one asked for, else the renderer's."""
    lighting = Lighting(prepared.environment, asked.rotate or 0.0, asked.up or gbuffer.up)
    camera = partial(camera_to_world, gbuffer.attributes, gbuffer.camera)
    given = prepared.inputs(bundle.environment, lighting.rotate, lighting.up, camera)
    return replace(plan, lighting=lighting, given=given)


def infer(gbuffer: GBuffer, plan: ShadePlan, engine: Engine, cancelled: threading.Event) -> Float:
    """(C', H, W): the network's answer, and the effect's background where there is none.

    A per-channel network runs once for each colour channel. Raises Cancelled between tiles when
    the event is set, and Problem 500 for an answer that isn't finite.
    """
    bundle = engine.bundle
    effect = EFFECTS[bundle.effect]
    scale = tensors.length_scale(effect, gbuffer.attributes, plan.radius.value)
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


def _around(
    job: Job,
    gbuffer: GBuffer,
    plan: ShadePlan,
    asked: ShadeParameters,
    cancelled: threading.Event,
) -> Float:
    """`infer` of a panorama, by the views that it is cut into."""
    assert job.engine is not None, "what is only planned isn't inferred"
    effect = EFFECTS[job.bundle.effect]
    shade = np.empty((len(effect.outputs), *gbuffer.shape), np.float32)
    for face in panoramas.faces(gbuffer):
        part = plan_shading(face.gbuffer, job.bundle, asked, job.need.max_pixels)
        part = replace(part, radius=plan.radius)
        if job.prepared is not None:
            part = lit(part, job.prepared, face.gbuffer, job.bundle, asked)
        shade[:, face.of] = infer(face.gbuffer, part, job.engine, cancelled)[:, *face.at]
    if effect.background == "light":
        np.copyto(shade, gbuffer.attributes["light"], where=gbuffer.background)
    elif effect.background != "shaded":
        np.copyto(shade, np.float32(effect.background), where=gbuffer.background)
    return shade


def _more(headers: Sequence[exr.Header], asked: ShadeParameters, bundles: Sequence[Bundle]) -> int:
    """Bytes that further views' answers take, and the views that a panorama is cut into."""
    outputs = sum(len(EFFECTS[bundle.effect].outputs) for bundle in bundles)
    further = 12 * outputs * max(0, len(asked.views) - 1)
    around = [part.attributes.get("envmap") == 0 for header in headers for part in header.parts]
    inputs = {name for bundle in bundles for name in bundle.inputs}
    faces = 8 * tensors.channel_count(inputs, per_channel=False)
    if asked.projection != "latlong" and not any(around):
        faces = 0
    return (further + faces) * prod(size_of(headers))


def _other_pixels() -> Problem:
    return Problem(
        422,
        "unusable-input",
        "the views cover different pixels, which one picture can't hold",
        fix="ask for one ?view= at a time",
    )


def _stopping() -> Problem:
    return Problem(
        503,
        "stopping",
        "the service stops, and what this request needs was still being loaded",
        fix="try again when it runs again",
        headers={"Retry-After": "2"},
    )


@contextmanager
def _giving_back(jobs: Sequence[Job], held: int) -> Iterator[None]:
    """Memory that the block leaves behind is given back if it was much."""
    try:
        yield
    finally:
        engines = [job.engine for job in jobs if job.engine is not None]
        if engines and held > _BIG:
            for engine in engines:
                engine.shrink()
            trim()
