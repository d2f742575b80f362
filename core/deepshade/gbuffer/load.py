"""Loads G-buffers from EXR files of any renderer: plans, reads, checks, derives."""

from __future__ import annotations

from collections.abc import Collection, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade import exr
from deepshade.attributes import ATTRIBUTES
from deepshade.camera import Projection
from deepshade.errors import CameraError, ConfigError, ImageError, MissingAttributeError
from deepshade.exr import Header, Limits
from deepshade.exr.entries import Entry
from deepshade.gbuffer import background, channels, derivation, directions
from deepshade.gbuffer.cameras import framed
from deepshade.gbuffer.checks import examine
from deepshade.gbuffer.conventions import Conventions, apply
from deepshade.gbuffer.examination import Verdict
from deepshade.gbuffer.gbuffer import GBuffer
from deepshade.gbuffer.guesses import suggestion
from deepshade.gbuffer.lenses import number
from deepshade.gbuffer.mixtures import unmix
from deepshade.gbuffer.plan import Plan, chosen, plan_gbuffer
from deepshade.gbuffer.poses import find_pose
from deepshade.gbuffer.reading import Body, Read, Source, fetch, read_choices
from deepshade.gbuffer.repair import repair
from deepshade.gbuffer.sources import passed_over

SHUTTER = "deepshade:shutter"


@dataclass(frozen=True, slots=True)
class _Job:
    """What one G-buffer needs, where in the files that is, and the steps that derive the rest."""

    needs: Sequence[str]
    plan: Plan
    choices: dict[str, channels.Choice]
    steps: dict[str, derivation.Derivation]
    part: exr.Part
    used: frozenset[str]
    conventions: Conventions
    radius: float | None


def load_gbuffer(sources: Source | Sequence[Source], needs: Sequence[str], **how: Any) -> GBuffer:
    """Loads the attributes `needs` of one view; `how` and what it raises are `load_gbuffers`'."""
    return next(load_gbuffers(sources, [needs], **how))


def load_gbuffers(
    sources: Source | Sequence[Source],
    needs: Sequence[Sequence[str]],
    *,
    profile: str | None = None,
    mapping: Mapping[str, str] | None = None,
    fov: float | None = None,
    projection: Projection | None = None,
    ortho_width: float | None = None,
    view: str | None = None,
    limits: Limits | None = None,
    headers: Sequence[Header] | None = None,
    anew: Collection[str] = (),
    conventions: Conventions | None = None,
    radius: float | None = None,
) -> Generator[GBuffer]:
    """Loads one EXR file, or several of one view, for each of `needs`: names of attributes.

    A source is a path, the bytes of a file, or (file name, bytes or planes). `profile` names the
    renderer (`profiles.PROFILES`), found from the header by default. `mapping` says which layer or
    comma-separated channels hold an attribute; `fov` is the full horizontal angle in degrees, of
    another `projection` an orthographic one is `ortho_width` scene units wide. `view` names one of
    the views of stereo files, or a part; without it the default one is read.
    What isn't there, or is to be `anew`, is derived (`derivation`): `GBuffer.derived` says how.
    `conventions` say how values are stored, and which checks they have to pass (`checks`).
    Positions whose steps are coarse beside the `radius` (by default the header's) are smoothed.
    `headers` are what `exr.read_header` gave for the same sources, to spare reading them again.

    Each G-buffer is what it would be alone. They share arrays, and so what is decoded and derived
    for them, as long as their backgrounds are the same; where one reads a NaN that another
    doesn't, each is decoded when it is asked for.

    Raises ImageError, DamagedImageError, LimitError, MissingAttributeError,
    AmbiguousChannelError, CameraError, ContradictionError, ConfigError.
    """
    conventions = conventions or Conventions()
    limits = limits or Limits()
    every = list(dict.fromkeys(name for each in needs for name in each))
    for name in every:
        if name not in ATTRIBUTES:
            raise ConfigError(name, ATTRIBUTES, detail=f"no attribute is called '{name}'")
    stems, bodies = fetch(sources, limits)
    headers = headers or [exr.read_header(body, limits) for body in bodies]
    limits.check("parts", sum(len(header.parts) for header in headers))
    limits.check("channels", sum(len(p.channels) for header in headers for p in header.parts))
    limits.check("decoded_bytes", sum(header.decoded_bytes for header in headers))

    read: Read = {}

    def reader(choices: Mapping[str, channels.Choice]) -> Mapping[str, NDArray[np.float32]]:
        missing = {name: c for name, c in choices.items() if c not in read}
        arrays, suspects = read_choices(bodies, headers, missing, limits, {})
        read.update({missing[name]: (arrays[name], name in suspects) for name in missing})
        return {name: read[choice][0] for name, choice in choices.items()}

    def plan(wanted: Sequence[str]) -> Plan:
        found = plan_gbuffer(
            headers,
            stems,
            wanted,
            profile=profile,
            mapping=mapping,
            fov=fov,
            projection=projection,
            across=ortho_width,
            view=view,
        )
        find_pose(found, conventions, reader)
        found.passed_over = passed_over(found, mapping or {}, conventions, reader)
        for name in (*anew, *found.passed_over):
            found.choices.pop(name, None)
        try:
            found.require(wanted)
        except CameraError as error:
            if lens := suggestion(found, reader):
                detail = f"{error}; depth and normals go together with {lens}"
                raise CameraError(detail, fix=f"{lens}; else {error.fix}") from None
            raise
        return found

    try:
        jobs = [_job(each, plan(each), mapping or {}, conventions, radius) for each in needs]
    except MissingAttributeError:
        if len(needs) > 1:
            plan(every)  # which says all that is missing
        raise
    if len({job.part.data_window for job in jobs}) > 1:
        raise ImageError("the attributes cover different pixels", fix="render them as one view")
    yield from _load(jobs, bodies, headers, limits, read)


def _job(
    needs: Sequence[str],
    plan: Plan,
    mapping: Collection[str],
    conventions: Conventions,
    radius: float | None,
) -> _Job:
    steps: dict[str, derivation.Derivation] = {}
    for name in needs:
        for step in derivation.plan(name, {*plan.choices, *steps}, plan.met) or ():
            steps.setdefault(step.target, step)
    used = {*needs, *(need for step in steps.values() for need in step.needs)}
    choices = chosen(plan, used, mapping)
    for name in conventions.axes:  # of the file: a profile's signs no longer count
        if name in choices:
            choices[name] = replace(choices[name], signs=())
    part = plan.parts(next(iter(choices.values())))[0]
    if plan.camera:
        plan.camera = framed(plan.camera, part)
    return _Job(needs, plan, choices, steps, part, frozenset(used), conventions, radius)


def _load(
    jobs: Sequence[_Job],
    bodies: Sequence[Body],
    headers: Sequence[Header],
    limits: Limits,
    read: Read,
) -> Generator[GBuffer]:
    """The jobs' G-buffers: together if they are then what they are alone, else one by one."""
    loaded = _together(jobs, bodies, headers, limits, read) if _agree(jobs) else None
    if loaded is None:
        for job in jobs:
            yield from _load([job], bodies, headers, limits, read)
        return
    arrays, empty, nonfinite, verdict = loaded
    for job in jobs:
        motion = job.choices.get("motion")
        # without a shutter's time of its own it is open throughout
        per_frame = motion is not None and motion.per_frame and SHUTTER not in job.plan.attributes
        yield GBuffer(
            attributes={name: arrays[name] for name in job.needs},
            background=empty,
            camera=job.plan.camera,
            nonfinite=nonfinite,
            mapped={name: str(choice) for name, choice in job.choices.items()},
            decoded=tuple((c.file, name) for c in job.choices.values() for name in c.channels),
            derived=_said(job, verdict),
            warnings=tuple(verdict.warnings),
            header={SHUTTER: 1.0} | job.plan.attributes if per_frame else job.plan.attributes,
            part_header=job.part.attributes,
            entries=_entries(job),
            data_window=job.part.data_window,
            display_window=job.part.display_window,
            up=job.plan.profile.up if job.plan.profile else "y",
            per_frame=per_frame,
        )


def _agree(jobs: Sequence[_Job]) -> bool:
    """Whether all mean the same by every quantity, and see it through the same camera."""
    choices: dict[str, channels.Choice] = {}
    for job in jobs:
        choices = {**job.choices, **choices}
    first = jobs[0].plan
    for job in jobs:
        if (
            any(choices[name] != choice for name, choice in job.choices.items())
            or not choices.keys().isdisjoint(job.steps)
            or first.camera != job.plan.camera
            or not np.array_equal(_matrix(first), _matrix(job.plan))
        ):
            return False
    return True


def _matrix(plan: Plan) -> NDArray[np.float64]:
    return np.empty(0) if plan.matrix is None else plan.matrix


def _together(
    jobs: Sequence[_Job],
    bodies: Sequence[Body],
    headers: Sequence[Header],
    limits: Limits,
    read: Read,
) -> tuple[dict[str, NDArray[np.float32]], NDArray[np.bool_], int, Verdict] | None:
    """(the attributes of all jobs, the background, how many pixels held NaN or infinities, what
    the checks found).

    None where a job's background or count would be another's.
    """
    choices = {name: choice for job in jobs for name, choice in job.choices.items()}
    arrays, suspects = read_choices(bodies, headers, choices, limits, read)
    verdict = _checked(jobs, choices, arrays)
    if jobs[0].conventions.checks != "trust":
        notes, warning = unmix(arrays)
        for name, note in notes.items():
            verdict.note(name, note)
        if warning:
            verdict.warn(warning, jobs[0].conventions)
    directions.mend(arrays)
    if len(jobs) > 1 and not background.same(arrays, suspects, [job.choices for job in jobs]):
        return None
    empty, nonfinite = background.remove(arrays, suspects)
    plan = jobs[0].plan
    if jobs[0].conventions.checks != "trust" and plan.projection in (None, "perspective"):
        reach = jobs[0].radius or number(plan.attributes, "deepshade:radius")
        mended = repair(arrays, ~empty, plan.camera, plan.matrix, reach if reach > 0 else None)
        for name, note in mended.items():
            verdict.note(name, note)
    steps = {name: step for job in jobs for name, step in job.steps.items()}
    if steps:
        empty, more = _derive(steps.values(), jobs[0].plan, arrays, empty)
        if more and len(jobs) > 1:
            return None
        nonfinite += more
    return {name: arrays[name] for job in jobs for name in job.needs}, empty, nonfinite, verdict


def _checked(
    jobs: Sequence[_Job],
    choices: Mapping[str, channels.Choice],
    arrays: dict[str, NDArray[np.float32]],
) -> Verdict:
    """Examines what was read, and turns it into our conventions."""
    plan, used = jobs[0].plan, {name for job in jobs for name in job.used}
    coarse = any(plan.half(choices[name]) for name in choices if name.startswith("position"))
    given = plan.camera, plan.matrix, jobs[0].conventions
    verdict = examine(arrays, used, *given, coarse=coarse)
    apply(verdict.readings, arrays, plan.camera)
    return verdict


def _said(job: _Job, verdict: Verdict) -> dict[str, str]:
    """How what the job needs was derived, and how what that came from had to be read."""
    view = {"view": note} if (note := job.plan.views.note) else {}
    derived = view | {name: job.plan.how(step) for name, step in job.steps.items()}
    for name, note in verdict.notes.items():
        if name in job.choices:
            derived[name] = f"{derived[name]}; {note}" if name in derived else note
    return derived


def _entries(job: _Job) -> dict[str, Entry]:
    """What an answer keeps of the part's header, and which view it is of."""
    views = job.plan.views
    if "view" in job.part.entries or not (views.read in views.names and views.note):
        return job.part.entries
    return job.part.entries | {"view": Entry("string", views.read.encode())}


def _derive(
    steps: Iterable[derivation.Derivation],
    plan: Plan,
    arrays: dict[str, NDArray[np.float32]],
    empty: NDArray[np.bool_],
) -> tuple[NDArray[np.bool_], int]:
    """Adds to `arrays` what the steps give; (the background, by how many pixels it grew)."""
    source = derivation.Source(arrays, ~empty, plan.camera, plan.matrix, plan.attributes)
    grown = 0
    for step in steps:
        with np.errstate(over="ignore", invalid="ignore"):
            array = np.ascontiguousarray(step.function(source), np.float32)
        arrays[step.target] = array
        # finite input can still overflow float32: that pixel is background too
        broken = background.nonfinite(array)
        bad = broken & source.valid
        if bad.any():
            grown += int(np.count_nonzero(bad))
            source.valid &= ~bad
        stays = background.in_background(step.target)
        background.clear([array], broken if stays else ~source.valid)
    if grown:
        surfaces = [a for name, a in arrays.items() if not background.in_background(name)]
        background.clear(surfaces, ~source.valid)
    return ~source.valid, grown
