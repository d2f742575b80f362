"""The G-buffer: per-pixel attributes of one view, loaded from EXR files of any renderer."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from deepshade import channels, derivation, exr
from deepshade.attributes import ATTRIBUTES
from deepshade.camera import Camera, matrix_from_header
from deepshade.errors import AmbiguousChannelError, CameraError, ConfigError, ImageError
from deepshade.exr import Header, Limits
from deepshade.profiles import PROFILES, QUANTITIES, Profile, detect
from deepshade.profiles import profile as profile_named

Source = Path | str | bytes | tuple[str, bytes]

FAR = 1e10  # depths from here on mean that nothing was hit
_DEPTHS = ("depth", "distance")
_MARKERS = ("depth", "distance", "alpha")  # read, where there, to know the background


@dataclass(slots=True)
class GBuffer:
    """Attributes of one view, ready for a network.

    `attributes` maps names to (C, H, W) float32, C-contiguous; every attribute is 0 where
    `background` (H, W) is true. `nonfinite` counts the pixels that held NaN or infinities (an
    infinite depth is a renderer's way to say background and doesn't count). `mapped` tells which
    channels each quantity came from, `derived` how the others were computed. The windows,
    (x0, y0, x1, y1) inclusive, are those of the part that the attributes came from.
    """

    attributes: dict[str, NDArray[np.float32]]
    background: NDArray[np.bool_]
    camera: Camera | None = None
    nonfinite: int = 0
    mapped: dict[str, str] = field(default_factory=dict)
    derived: dict[str, str] = field(default_factory=dict)
    header: dict[str, Any] = field(default_factory=dict)
    data_window: exr.Window = (0, 0, 0, 0)
    display_window: exr.Window = (0, 0, 0, 0)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return cast(tuple[int, int], self.background.shape)


@dataclass(slots=True)
class Plan:
    """What the files hold and how the needed attributes follow from it; no pixel is read yet."""

    headers: list[Header]
    layers: list[channels.Layer]
    choices: dict[str, channels.Choice]
    ambiguous: dict[str, AmbiguousChannelError]
    profile: Profile | None
    camera: Camera | None
    matrix: NDArray[np.float64] | None
    attributes: dict[str, Any]

    def steps(self, attribute: str) -> list[derivation.Derivation] | None:
        """Derivations that lead to `attribute`; [] if it is in the files, None if impossible."""
        return derivation.plan(attribute, self.choices, self.met)

    @property
    def met(self) -> set[derivation.Requirement]:
        """The camera facts that are known."""
        return derivation.requirements(self.camera, self.matrix, self.attributes)

    def complete(self, choice: channels.Choice, window: exr.Window) -> bool:
        """Whether all its channels have a value for each pixel of that data window."""
        bare = [self._places(choice)[name][1] for name in choice.channels]
        return all(
            part.data_window == window and name not in part.subsampled
            for part, name in zip(self.parts(choice), bare, strict=True)
        )

    def _places(self, choice: channels.Choice) -> dict[str, tuple[int, str]]:
        return self.headers[choice.file].channels()

    def parts(self, choice: channels.Choice) -> list[exr.Part]:
        """The part of each of its channels."""
        places = self._places(choice)
        return [self.headers[choice.file].parts[places[name][0]] for name in choice.channels]

    def explain(self, attribute: str) -> str:
        """Why `attribute` can't be had, for errors and reports."""
        if attribute in self.ambiguous:
            return str(self.ambiguous[attribute])
        needs = derivation.unmet(attribute, self.choices, self.met)
        if needs:
            return f"needs {derivation.requirement_text(needs)}"
        return "not there"

    def how(self, step: derivation.Derivation) -> str:
        """How a derivation gets its attribute, and what it had to pass over."""
        if step.target == "normal" and "position" in step.needs and "normal_world" in self.choices:
            return f"{step.how} (the world-space normals there need worldToCamera)"
        return step.how

    def require(self, needs: Sequence[str]) -> None:
        """Raises what stands in the way of `needs`; returns if nothing does.

        AmbiguousChannelError, CameraError, or MissingAttributeError, in this order.
        """
        for name in needs:
            for cause in (name, f"{name}_world"):
                # derivable or not: falling back would be choosing among the candidates
                if name not in self.choices and cause in self.ambiguous:
                    raise self.ambiguous[cause]
        lacking = [name for name in needs if self.steps(name) is None]
        if not lacking:
            return
        for cause in ("depth", "distance", "position", "position_world", "normal_world"):
            if cause in self.ambiguous:
                raise self.ambiguous[cause]
        unmet = {name: derivation.unmet(name, self.choices, self.met) for name in lacking}
        missing = [name for name in lacking if not unmet[name]]
        if missing:
            raise channels.missing(self.layers, missing, {})
        wanted = list(dict.fromkeys(need for name in lacking for need in unmet[name]))
        raise CameraError(
            f"{', '.join(map(repr, lacking))} could be derived from what is there, but that needs "
            f"{derivation.requirement_text(wanted)}",
            fix="; ".join(derivation.REQUIREMENT_FIXES[name] for name in wanted),
        )


def load_gbuffer(
    sources: Source | Sequence[Source],
    needs: Sequence[str],
    *,
    profile: str | None = None,
    mapping: Mapping[str, str] | None = None,
    fov: float | None = None,
    limits: Limits | None = None,
    headers: Sequence[Header] | None = None,
) -> GBuffer:
    """Loads the attributes `needs` from one EXR file, or from several of one view.

    A source is a path, the bytes of a file, or (file name, bytes). `profile` names the renderer
    (`profiles.PROFILES`), found from the header by default. `mapping` says which layer or
    comma-separated channels hold an attribute; `fov` is the full horizontal angle in degrees.
    What isn't there is derived (`derivation`), and `GBuffer.derived` says how. `headers` are what
    `exr.read_header` gave for the same sources, to spare reading them again.

    Raises ImageError, DamagedImageError, LimitError, MissingAttributeError,
    AmbiguousChannelError, CameraError, ConfigError.
    """
    limits = limits or Limits()
    for name in needs:
        if name not in ATTRIBUTES:
            raise ConfigError(name, ATTRIBUTES, detail=f"no attribute is called '{name}'")
    stems, bodies = _fetch(sources, limits)
    headers = headers or [exr.read_header(body, limits) for body in bodies]
    _check_together(headers, limits)
    planned = plan_gbuffer(headers, stems, needs, profile=profile, mapping=mapping, fov=fov)
    planned.require(needs)
    steps: dict[str, derivation.Derivation] = {}
    for name in needs:
        for step in derivation.plan(name, {*planned.choices, *steps}, planned.met) or ():
            steps.setdefault(step.target, step)

    used = {*needs, *(need for step in steps.values() for need in step.needs)}
    choices = _chosen(planned, used, mapping or {})
    part = planned.parts(next(iter(choices.values())))[0]
    if planned.camera:
        planned.camera = _framed(planned.camera, part)
    arrays = _read(bodies, headers, choices, limits)
    background, nonfinite = _background(arrays)
    _clear(arrays.values(), background)
    source = derivation.Source(
        arrays, ~background, planned.camera, planned.matrix, planned.attributes
    )
    with np.errstate(over="ignore", invalid="ignore"):
        for step in steps.values():
            arrays[step.target] = np.ascontiguousarray(step.function(source), np.float32)
            # finite input can still overflow float32: that pixel is background too
            bad = _nonfinite(arrays[step.target]) & ~background
            if bad.any():
                nonfinite += int(bad.sum())
                background = background | bad
                source.valid = ~background
            _clear([arrays[step.target]], background)
    _clear(arrays.values(), background)
    _check_side(arrays, background)
    return GBuffer(
        attributes={name: arrays[name] for name in needs},
        background=background,
        camera=planned.camera,
        nonfinite=nonfinite,
        mapped={name: str(choice) for name, choice in choices.items()},
        derived={name: planned.how(step) for name, step in steps.items()},
        header=planned.attributes,
        data_window=part.data_window,
        display_window=part.display_window,
    )


def source_name(field: str, filename: str) -> str:
    """What a form's file is called: its field if that names a quantity, else its file name."""
    return f"{field}.exr" if field in QUANTITIES else filename


def plan_gbuffer(
    headers: Sequence[Header],
    stems: Sequence[str],
    needs: Sequence[str],
    *,
    profile: str | None = None,
    mapping: Mapping[str, str] | None = None,
    fov: float | None = None,
) -> Plan:
    """Maps the channels of files, by their headers alone, to what `needs` could come from.

    `stems` are the files' names without suffix ("" where unknown). Raises CameraError,
    ConfigError, and MissingAttributeError for a mapping to a channel that isn't there.
    """
    attributes: dict[str, Any] = {}
    for header in headers:
        for part in header.parts:
            for key, value in part.attributes.items():
                attributes.setdefault(key, value)
    known = profile_named(profile) if profile else detect(attributes)
    layers = channels.layers(headers, stems)
    wanted = list(dict.fromkeys((*needs, *_related(needs), *_MARKERS)))
    choices, ambiguous = channels.choose(layers, wanted, known, mapping or {})
    part = headers[0].parts[0]
    for choice in choices.values():
        if known is None and choice.profile not in ("", "deepshade"):
            known = PROFILES[choice.profile]  # for its handedness: the names gave it away
    if choices:
        first = next(iter(choices.values()))
        part = headers[first.file].parts[headers[first.file].channels()[first.channels[0]][0]]
    matrix = _matrix(attributes, known)
    camera = _camera(part, attributes, known, fov, matrix)
    return Plan(list(headers), layers, choices, ambiguous, known, camera, matrix, attributes)


def _related(needs: Sequence[str]) -> list[str]:
    """Every quantity that some derivation of `needs` could start from."""
    related: list[str] = []
    queue = list(needs)
    while queue:
        target = queue.pop()
        for step in derivation.steps_to(target):
            for need in step.needs:
                if need not in related and need not in needs:
                    related.append(need)
                    queue.append(need)
    return related


def _matrix(attributes: Mapping[str, Any], profile: Profile | None) -> NDArray[np.float64] | None:
    matrix = matrix_from_header(attributes)
    if matrix is None:
        return profile.matrix(attributes) if profile is not None and profile.matrix else None
    # A right-handed world and a matrix that mirrors mean a left-handed camera looking down +z,
    # as Arnold and Karma write it; ours looks down -z.
    world_is_left = profile is not None and profile.world == "left"
    if (np.linalg.det(matrix[:3, :3]) < 0) != world_is_left:
        matrix = np.diag([1.0, 1.0, -1.0, 1.0]) @ matrix
    return matrix


def _camera(
    part: exr.Part,
    attributes: Mapping[str, Any],
    profile: Profile | None,
    fov: float | None,
    matrix: NDArray[np.float64] | None,
) -> Camera | None:
    if fov is None and profile is not None and "deepshade:fov" not in attributes:
        for key in profile.fov:
            try:
                fov = float(attributes[key])
                break
            except (KeyError, TypeError, ValueError):
                continue
    facts = dict(attributes)
    facts.pop("worldToCamera", None)
    if matrix is not None:
        facts["worldToCamera"] = matrix.T
    return Camera.from_header(facts, part.data_window, part.display_window, fov=fov)


def _fetch(sources: Source | Sequence[Source], limits: Limits) -> tuple[list[str], list[bytes]]:
    if isinstance(sources, (str, bytes, Path)) or (
        isinstance(sources, tuple)
        and len(sources) == 2
        and isinstance(sources[0], str)
        and isinstance(sources[1], bytes)
    ):
        sources = [cast(Source, sources)]
    stems, bodies, total = [], [], 0
    for source in sources:
        if isinstance(source, bytes):
            stems.append("")
            bodies.append(source)
        elif isinstance(source, tuple):
            stems.append(Path(source[0]).stem)
            bodies.append(source[1])
        else:
            stems.append(Path(source).stem)
            bodies.append(exr.fetch(source, limits))
        total += len(bodies[-1])
        limits.check("body_bytes", total)
    if not bodies:
        raise ImageError("no image was given", fix="name at least one EXR file")
    return stems, bodies


def _check_together(headers: Sequence[Header], limits: Limits) -> None:
    limits.check("parts", sum(len(header.parts) for header in headers))
    limits.check("channels", sum(len(p.channels) for header in headers for p in header.parts))
    limits.check("decoded_bytes", sum(header.decoded_bytes for header in headers))


def _chosen(
    plan: Plan, used: Collection[str], mapping: Collection[str]
) -> dict[str, channels.Choice]:
    """What is read: the choices that are `used`, and the markers that fit them.

    A depth or alpha that only marks the background, and covers other pixels (an auto-cropped
    beauty pass) or is subsampled, is passed over, unless the mapping asks for it. Raises
    ImageError when the choices that are used cover different pixels.
    """
    chosen = {
        name: choice
        for name, choice in plan.choices.items()
        if name in used or (name in _MARKERS and name in mapping)
    }
    # the markers come last: the first choice, whose window counts, is one that is needed
    chosen = dict(sorted(chosen.items(), key=lambda item: item[0] not in used))
    windows: dict[exr.Window, str] = {}
    for name, choice in chosen.items():
        for part in plan.parts(choice):
            windows.setdefault(part.data_window, name)
    if len(windows) > 1:
        sizes = ", ".join(
            f"'{name}' {x1 - x0 + 1} x {y1 - y0 + 1} at ({x0}, {y0})"
            for (x0, y0, x1, y1), name in windows.items()
        )
        raise ImageError(
            f"the attributes cover different pixels: {sizes}", fix="render them as one view"
        )
    window = next(iter(windows))
    markers = {
        name: plan.choices[name]
        for name in _MARKERS
        if name in plan.choices and plan.complete(plan.choices[name], window)
    }
    return {**chosen, **{name: markers[name] for name in markers if name not in chosen}}


def _framed(camera: Camera, part: exr.Part) -> Camera:
    """The camera for the windows of `part`."""
    (x0, y0, *_), (left, top, right, bottom) = part.data_window, part.display_window
    return replace(
        camera, width=right - left + 1, height=bottom - top + 1, x0=x0 - left, y0=y0 - top
    )


def _check_side(arrays: Mapping[str, NDArray[np.float32]], background: NDArray[np.bool_]) -> None:
    """Raises CameraError when positions lie behind the camera: another renderer's convention."""
    if "position" not in arrays or (arrays["position"][2] <= 0).all():
        return
    behind = int(np.count_nonzero(arrays["position"][2] > 0))
    visible = int(np.count_nonzero(~background))
    if 2 * behind > visible:
        raise CameraError(
            f"{behind} of {visible} positions lie behind the camera, which looks down -z",
            fix="if they are in world space: --map position_world=<layer>; "
            "if the renderer's camera looks down +z, name it: --profile renderman",
        )


def _read(
    bodies: Sequence[bytes],
    headers: Sequence[Header],
    choices: Mapping[str, channels.Choice],
    limits: Limits,
) -> dict[str, NDArray[np.float32]]:
    arrays: dict[str, NDArray[np.float32]] = {}
    for index, (body, header) in enumerate(zip(bodies, headers, strict=True)):
        mine = {name: choice for name, choice in choices.items() if choice.file == index}
        if not mine:
            continue
        wanted = [channel for choice in mine.values() for channel in choice.channels]
        image = exr.read(body, wanted, limits, header=header)
        users = Counter(channel for choice in mine.values() for channel in set(choice.channels))
        for name, choice in mine.items():
            array = image.stack(choice.channels)
            # attributes that share a channel don't share its memory: each has signs of its own
            if any(users[channel] > 1 for channel in choice.channels):
                array = array.copy()
            for plane, sign in zip(array, choice.signs, strict=False):
                if sign < 0:
                    np.negative(plane, out=plane)
            arrays[name] = array
    return arrays


def _background(arrays: Mapping[str, NDArray[np.float32]]) -> tuple[NDArray[np.bool_], int]:
    """(pixels without geometry, number of pixels that hold NaN or infinities)."""
    shape = next(iter(arrays.values())).shape[1:]
    background = np.zeros(shape, np.bool_)
    infinite = np.zeros(shape, np.bool_)  # where a depth says so: expected, not an error
    broken = np.zeros(shape, np.bool_)
    with np.errstate(invalid="ignore", over="ignore"):
        for name, array in arrays.items():
            if name in _DEPTHS:
                inside = (array[0] > 0) & (array[0] < FAR)  # false for NaN
                background |= ~inside
                infinite |= np.isposinf(array[0])
                if not inside.all():
                    broken |= np.isnan(array[0]) | np.isneginf(array[0])
                continue
            broken |= _nonfinite(array)
            if name == "alpha":
                background |= array[0] <= 0
            elif name == "position":
                background |= ~((array[2] != 0) & (np.abs(array[2]) < FAR))
            elif name in ("normal", "normal_world", "position_world"):
                background |= ~array.any(axis=0)
    broken &= ~infinite
    return background | broken | infinite, int(np.count_nonzero(broken))


def _nonfinite(array: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(H, W): where any channel is NaN or infinite; a single sum when, as mostly, none is."""
    with np.errstate(invalid="ignore", over="ignore"):
        if np.isfinite(array.sum()):
            return np.zeros(array.shape[1:], np.bool_)
    return np.asarray(~np.isfinite(array).all(axis=0))


def _clear(arrays: Any, background: NDArray[np.bool_]) -> None:
    if background.any():
        for array in arrays:
            np.copyto(array, 0, where=background)


assert set(_MARKERS) <= set(QUANTITIES)
