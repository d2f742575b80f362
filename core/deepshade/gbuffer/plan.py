"""Where the attributes of a G-buffer come from, by the headers of its files alone."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade import exr
from deepshade.camera import Camera, matrix_from_header
from deepshade.errors import AmbiguousChannelError, CameraError, ImageError, MissingAttributeError
from deepshade.exr import Header
from deepshade.gbuffer import channels, derivation
from deepshade.gbuffer.profiles import PROFILES, QUANTITIES, Profile, detect, number
from deepshade.gbuffer.profiles import profile as profile_named
from deepshade.gbuffer.suggestions import near_misses

MARKERS = ("depth", "distance", "alpha")  # read, where there, to know the background

ABSENT = "not there"  # why an attribute can't be had, when nothing would make it derivable


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
    passed_over: dict[str, str] = field(default_factory=dict)  # quantity -> why

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

    def half(self, choice: channels.Choice) -> bool:
        """Whether any of its channels has 16 bits."""
        places = self._places(choice)
        parts = self.headers[choice.file].parts
        kinds = [parts[places[name][0]].channels[places[name][1]] for name in choice.channels]
        return "half" in kinds

    def explain(self, attribute: str) -> str:
        """Why `attribute` can't be had, for errors and reports."""
        if attribute in self.ambiguous:
            return str(self.ambiguous[attribute])
        needs = derivation.unmet(attribute, self.choices, self.met)
        return f"needs {derivation.requirement_text(needs)}" if needs else ABSENT

    def how(self, step: derivation.Derivation) -> str:
        """How a derivation gets its attribute, and what it had to pass over."""
        if step.target == "normal" and "position" in step.needs and "normal_world" in self.choices:
            return f"{step.how} (the world-space normals there need worldToCamera)"
        if step.target == "position" and self.passed_over:
            return f"{step.how} ({'; '.join(self.passed_over.values())})"
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
            found = [name for layer in self.layers for name in layer.channels]
            near = near_misses(self.layers, missing)
            raise MissingAttributeError(missing, found, near, enough=derivation.enough(missing))
        wanted = list(dict.fromkeys(need for name in lacking for need in unmet[name]))
        raise CameraError(
            f"{', '.join(map(repr, lacking))} could be derived from what is there, but that needs "
            f"{derivation.requirement_text(wanted)}",
            fix="; ".join(derivation.REQUIREMENT_FIXES[name] for name in wanted),
        )


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
    wanted = list(dict.fromkeys((*needs, *_related(needs), *MARKERS)))
    choices, ambiguous = channels.choose(layers, wanted, known, mapping or {})
    for choice in choices.values():
        if known is None and choice.profile not in ("", "deepshade"):
            known = PROFILES[choice.profile]  # for its handedness: the names gave it away
    matrix = _matrix(attributes, known)
    plan = Plan(list(headers), layers, choices, ambiguous, known, None, matrix, attributes)
    part = plan.parts(next(iter(choices.values())))[0] if choices else headers[0].parts[0]
    plan.camera = _camera(part, attributes, known, fov, matrix)
    return plan


def _related(needs: Sequence[str]) -> list[str]:
    """Every quantity that some derivation of `needs` could start from."""
    related: list[str] = []
    queue = list(needs)
    while queue:
        for step in derivation.steps_to(queue.pop()):
            fresh = [need for need in step.needs if need not in {*related, *needs}]
            related += fresh
            queue += fresh
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
        found = number(attributes, *profile.fov)
        fov = None if math.isnan(found) else found
    facts = {**attributes, "worldToCamera": None if matrix is None else matrix.T}
    return Camera.from_header(facts, part.data_window, part.display_window, fov=fov)


def chosen(
    plan: Plan, used: Collection[str], mapping: Collection[str]
) -> dict[str, channels.Choice]:
    """What is read: the choices that are `used`, and the markers that fit them.

    A depth or alpha that only marks the background, and covers other pixels (an auto-cropped
    beauty pass) or is subsampled, is passed over, unless the mapping asks for it. Raises
    ImageError when the choices that are used cover different pixels.
    """
    picked = {
        name: choice
        for name, choice in plan.choices.items()
        if name in used or (name in MARKERS and name in mapping)
    }
    # the markers come last: the first choice, whose window counts, is one that is needed
    picked = dict(sorted(picked.items(), key=lambda item: item[0] not in used))
    windows: dict[exr.Window, str] = {}
    for name, choice in picked.items():
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
    for name in MARKERS:
        if name in plan.choices and plan.complete(plan.choices[name], window):
            picked.setdefault(name, plan.choices[name])
    return picked


def framed(camera: Camera, part: exr.Part) -> Camera:
    """The camera for the windows of `part`."""
    (x0, y0, *_), (left, top, right, bottom) = part.data_window, part.display_window
    return replace(
        camera, width=right - left + 1, height=bottom - top + 1, x0=x0 - left, y0=y0 - top
    )


assert set(MARKERS) <= set(QUANTITIES)
