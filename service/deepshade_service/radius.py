"""The effect's radius: the one asked for, else the header's, else a share of the depth."""

from __future__ import annotations

from dataclasses import dataclass

from deepshade import tensors
from deepshade.attributes import ATTRIBUTES
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS, SETTINGS
from deepshade.effects.settings import MAX_LENGTH, MIN_LENGTH
from deepshade.gbuffer import GBuffer
from deepshade_service.decoding import stored
from deepshade_service.parameters import ShadeParameters, Share

_SETTING = SETTINGS["radius"]
_DIGITS = 4  # of a radius that follows from depth, so that naming it gives the same bytes
_SLACK = 1.01  # at the ends of what was learnt: who names a radius rounds it


@dataclass(frozen=True, slots=True)
class Radius:
    """In scene units; `source` is "request", "header", "depth", or "bundle" where nothing is seen.

    `derived` says how it follows from depth, `warning` why it may serve badly; else both are "".
    """

    value: float
    source: str
    derived: str = ""
    warning: str = ""


def radius_of(gbuffer: GBuffer, bundle: Bundle, asked: ShadeParameters) -> Radius:
    """The radius at which a picture is shaded. Raises Problem 422 for an impossible header."""
    if not EFFECTS[bundle.effect].takes(_SETTING):
        return Radius(bundle.radius, "bundle")
    value, source = asked.radius, "request"
    if value is None:
        value, source = stored(gbuffer, _SETTING, "; ?radius= overrides it"), "header"
    if value is None:
        value, source = Share(_SETTING.share), "depth"
    if not any(ATTRIBUTES[name].unit.scaled for name in bundle.inputs):
        return Radius(bundle.radius, "bundle", warning=_fixed(bundle, value, source))
    depth = tensors.median_depth(gbuffer.attributes)
    if not isinstance(value, Share):
        return Radius(value, source, warning=_warning(value, depth) if depth else "")
    if depth is None:
        return Radius(bundle.radius, "bundle")
    radius = _part(value, depth)
    derived = f"{radius:g}, {_percent(value)} of the median depth {depth:.4g}"
    return Radius(radius, source, derived, _warning(radius, depth))


def _fixed(bundle: Bundle, value: float | Share, source: str) -> str:
    """What to say of a radius that a bundle which sees no lengths can't follow."""
    known = not isinstance(value, Share) and abs(value - bundle.radius) <= 0.01 * bundle.radius
    if known or source == "depth":
        return ""
    return (
        f"{bundle.name} knows one mesh at the radius {bundle.radius:.4g} that it learnt, and can't "
        "follow another: leave ?radius= out, or choose another ?bundle="
    )


def _part(share: float, depth: float) -> float:
    return min(max(float(f"{share * depth:.{_DIGITS}g}"), MIN_LENGTH), MAX_LENGTH)


def _warning(radius: float, depth: float) -> str:
    low, high = _SETTING.learnt
    if low / _SLACK <= radius / depth <= high * _SLACK:
        return ""
    usual = _percent(_SETTING.share)
    return (
        f"the radius {radius:.4g} is {_percent(radius / depth)} of the median depth {depth:.4g};"
        f" shaders learnt {_percent(low)} to {_percent(high)} and err beyond: ?radius={usual} is"
        f" {_part(_SETTING.share, depth):g}"
    )


def _percent(share: float) -> str:
    return f"{100 * share:.3g}%"
