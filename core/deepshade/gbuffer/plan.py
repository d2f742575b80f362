"""Where the attributes of a G-buffer come from, by the headers of its files alone."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade import exr
from deepshade.camera import Camera, Projection
from deepshade.errors import AmbiguousChannelError, CameraError, ImageError, MissingAttributeError
from deepshade.exr import Header
from deepshade.gbuffer import channels, derivation, views
from deepshade.gbuffer.cameras import see
from deepshade.gbuffer.profiles import PROFILES, QUANTITIES, Profile, detect
from deepshade.gbuffer.profiles import profile as profile_named
from deepshade.gbuffer.suggestions import near_misses
from deepshade.gbuffer.views import Views

MARKERS = ("depth", "distance", "alpha")  # read, where there, to know the background

_RAYS = {"orthographic": "the width of the frame", "latlong": "a panorama's field of view"}
ABSENT = "not there"  # why an attribute can't be had, when nothing would make it derivable


@dataclass(slots=True)
class Plan:
    """What the files hold and how the needed attributes follow from it; no pixel is read yet."""

    headers: list[Header]
    layers: list[channels.Layer]
    choices: dict[str, channels.Choice]
    ambiguous: dict[str, AmbiguousChannelError]
    profile: Profile | None
    attributes: dict[str, Any]
    views: Views = field(default_factory=Views)
    camera: Camera | None = None
    matrix: NDArray[np.float64] | None = None
    projection: Projection | None = None  # as far as it is known, even where its width isn't
    unusable: dict[derivation.Requirement, str] = field(default_factory=dict)  # why
    passed_over: dict[str, str] = field(default_factory=dict)  # quantity -> why
    wanted: tuple[str, ...] = ()  # all that what is needed could come from
    pose: str = ""  # how the matrix was found, if no header has it

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
        how = step.how
        if step.requires == "fov" and self.projection in _RAYS:
            how = how.replace("the field of view", _RAYS[self.projection])
        if step.target == "normal" and "position" in step.needs and "normal_world" in self.choices:
            return f"{how} (the world-space normals there need worldToCamera)"
        if self.pose and step.requires == "matrix":
            return f"{how} ({self.pose})"
        if step.target == "position" and self.passed_over:
            return f"{how} ({'; '.join(self.passed_over.values())})"
        return how

    def require(self, needs: Sequence[str]) -> None:
        """Raises what stands in the way of `needs`; returns if nothing does.

        AmbiguousChannelError, CameraError, or MissingAttributeError, in this order.
        """
        for name in needs:
            for cause in (name, f"{name}_world"):
                # derivable or not: falling back would be choosing among the candidates
                if name not in self.choices and cause in self.ambiguous:
                    raise self._ambiguous(cause, needs)
        lacking = [name for name in needs if self.steps(name) is None]
        if not lacking:
            return
        for cause in ("depth", "distance", "position", "position_world", "normal_world"):
            if cause in self.ambiguous:
                raise self._ambiguous(cause, needs)
        unmet = {name: derivation.unmet(name, self.choices, self.met) for name in lacking}
        missing = [name for name in lacking if not unmet[name]]
        if missing:
            found = [name for layer in self.layers for name in layer.channels]
            near = near_misses(self.layers, missing)
            enough = derivation.enough(missing)
            fix = " or ".join(self._writers(needs))
            raise MissingAttributeError(missing, found, near, enough=enough, fix=fix)
        wanted = list(dict.fromkeys(need for name in lacking for need in unmet[name]))
        wide = self.projection == "orthographic"
        needed = derivation.requirement_text(wanted)
        fixes = [derivation.REQUIREMENT_FIXES[name] for name in wanted]
        if wide and "fov" in wanted:
            needed = needed.replace(derivation.requirement_text(["fov"]), "the frame's width")
            fixes[wanted.index("fov")] = "give it in scene units (--ortho-width)"
        why = "; ".join(self.unusable[name] for name in wanted if name in self.unusable)
        raise CameraError(
            f"{', '.join(map(repr, lacking))} could be derived from what is there, but that needs "
            f"{needed}{f' ({why})' if why else ''}",
            fix="; ".join(fixes),
        )

    def _ambiguous(self, name: str, needs: Sequence[str]) -> AmbiguousChannelError:
        error = self.ambiguous[name]
        fixes = [*self._writers(needs), error.fix]
        return AmbiguousChannelError(name, error.candidates, fix=" or ".join(fixes))

    def _writers(self, needs: Sequence[str]) -> list[str]:
        """Fixes that name renderers whose names would give all that is needed."""
        found: list[str] = []
        for profile in PROFILES.values():
            if not profile.free_names or self.profile is not None:
                continue
            named = [layer for layer in self.layers if layer.name in _names(profile)]
            choices, _ = channels.choose(named, self.wanted, profile, {})
            met = self.met | {"fov", "matrix"}  # what else is missing is said then
            if all(derivation.plan(name, choices, met) is not None for name in needs):
                found.append(f"if {profile.name} wrote it: --profile {profile.name}")
        return found


def _names(profile: Profile) -> set[str]:
    return {name for source in profile.sources for name in source.layers}


def plan_gbuffer(
    headers: Sequence[Header],
    stems: Sequence[str],
    needs: Sequence[str],
    *,
    profile: str | None = None,
    mapping: Mapping[str, str] | None = None,
    fov: float | None = None,
    projection: Projection | None = None,
    across: float | None = None,
    view: str | None = None,
) -> Plan:
    """Maps the channels of files, by their headers alone, to what `needs` could come from.

    `stems` are the files' names without suffix ("" where unknown). Of the camera `fov` (degrees),
    the `projection` and the width `across` an orthographic frame override what headers say; `view`
    is one of the files' views, or a part's name. Raises CameraError, ConfigError, and
    MissingAttributeError for a mapping to a channel that isn't there.
    """
    attributes: dict[str, Any] = {}
    for header in headers:
        for part in header.parts:
            for key, value in part.attributes.items():
                attributes.setdefault(key, value)
    known = profile_named(profile) if profile else detect(attributes)
    seen = views.choose(headers, view)
    layers = channels.layers(headers, stems, seen)
    wanted = list(dict.fromkeys((*needs, *_related(needs), *MARKERS)))
    choices, ambiguous = channels.choose(layers, wanted, known, mapping or {})
    for choice in choices.values():
        if known is None and choice.profile not in ("", "deepshade"):
            known = PROFILES[choice.profile]  # for its handedness: the names gave it away
    plan = Plan(list(headers), layers, choices, ambiguous, known, attributes, seen)
    plan.wanted = tuple(wanted)
    for name, error in ambiguous.items():
        if fix := _view_fix(plan, error):
            ambiguous[name] = AmbiguousChannelError(name, error.candidates, fix=fix)
    see(plan, needs, fov, projection, across)
    return plan


def _view_fix(plan: Plan, error: AmbiguousChannelError) -> str:
    """Which views to read one of, where candidates differ by them; "" where they don't."""
    names: Sequence[str] = plan.views.names if not plan.views.read else ()
    if len(names) < 2:
        places = [
            at for h in plan.headers for n, at in h.channels().items() if n in error.candidates
        ]
        parts = {part: plan.headers[0].parts[part].name for part, _ in places}
        names = [name for name in parts.values() if name] if len(plan.headers) == 1 else ()
    if len(names) < 2 or plan.views.read:
        return ""
    return "read one view: " + " or ".join(f"--view {name}" for name in names[:8])


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
    shaded = {id(part) for choice in picked.values() for part in plan.parts(choice)}
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
            (*_, part) = plan.parts(plan.choices[name])
            alone = len(part.channels) == 1 or len(plan.headers[plan.choices[name].file].parts) == 1
            if alone or id(part) in shaded:  # never of another part
                picked.setdefault(name, plan.choices[name])
    return picked


assert set(MARKERS) <= set(QUANTITIES)
