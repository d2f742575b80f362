"""What one answer takes: the plan, as `?explain=1` answers it, and as facts for headers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade import exr
from deepshade.effects import EFFECTS, SETTINGS
from deepshade.environments import Environment, Up
from deepshade.gbuffer import GBuffer
from deepshade_service.parameters import CAMERA, ShadeParameters
from deepshade_service.problems import as_query
from deepshade_service.radius import Radius
from deepshade_service.selection import Selection
from deepshade_service.tiles import Tile

Json = dict[str, Any]
Facts = dict[str, str | float | int]

# Which parameters a plan repeats: those that chose.
_ASKED = ("quality", "bundle", "max_error", "budget_ms", "engine", "precision")


@dataclass(frozen=True, slots=True)
class Lighting:
    """The environment that lights the scene, turned by `rotate` degrees in a world `up` up."""

    environment: Environment
    rotate: float
    up: Up

    def facts(self) -> Json:
        """For plans and headers."""
        return {
            "environment": self.environment.name,
            "environment_sha256": self.environment.sha256,
            "rotate": self.rotate,
            "up": self.up,
        }


@dataclass(frozen=True, slots=True)
class ShadePlan:
    """What will be computed: at which radius, in which tiles, all of one `shape`.

    `given` are the network's inputs beside the picture, of the lighting.
    """

    radius: Radius
    shape: tuple[int, int]
    tiles: tuple[Tile, ...]
    lighting: Lighting | None = None
    given: Mapping[str, NDArray[np.float32]] = field(default_factory=dict, repr=False)

    @property
    def computed(self) -> int:
        """Pixels that the network computes, overlaps and padding included."""
        return len(self.tiles) * prod(self.shape)


def explain(
    gbuffer: GBuffer,
    headers: Sequence[exr.Header],
    selection: Selection,
    asked: ShadeParameters,
    plan: ShadePlan,
    memory_bytes: int,
) -> Json:
    """One effect's plan as JSON values: what `?explain=1` answers and an answer's header holds.

    `memory_bytes` are what the whole request holds.
    """
    bundle, (height, width) = selection.bundle, gbuffer.shape
    return {
        "effect": bundle.effect,
        "asked": {name: v for name in _ASKED if (v := getattr(asked, name)) is not None},
        "reason": selection.reason,
        "bundle": bundle.name,
        "bundle_sha256": bundle.sha256,
        "engine": selection.backend.engine,
        "precision": selection.backend.precision,
        "dssim": bundle.dssim,
        **_settings(gbuffer, bundle.effect, plan),
        "derived": _derived(gbuffer, plan),
        "warnings": [as_query(warning, type(asked).model_fields) for warning in gbuffer.warnings]
        + list(filter(None, [plan.radius.warning])),
        "pixels": {
            "width": width,
            "height": height,
            "background": int(np.count_nonzero(gbuffer.background)),
            "computed": plan.computed,
            "tiles": len(plan.tiles),
            "tile": list(plan.shape),
        },
        "channels": {
            "in_file": sum(len(header.channels()) for header in headers),
            "decoded": list(dict.fromkeys(name for _, name in gbuffer.decoded)),
        },
        "memory_bytes": memory_bytes,
    }


def facts_of(gbuffer: GBuffer, plan: ShadePlan, made: Json) -> Facts:
    """How an answer was made, for its EXR header and the response's headers.

    `made` is the plan as JSON. What isn't known is left out.
    """
    names = ("effect", "bundle", "bundle_sha256", "engine", "precision", "dssim", "radius")
    more = "radius_source", *CAMERA, "environment", "environment_sha256", "rotate", "up"
    facts = {name: made.get(name) for name in (*names, *more)}
    return {name: fact for name, fact in facts.items() if fact is not None} | {
        "mapped": _listed(gbuffer.mapped),
        "derived": _listed(made["derived"]),
        "background_pixels": made["pixels"]["background"],
        "nonfinite_pixels": int(gbuffer.nonfinite),
        "computed_pixels": plan.computed,
        "tiles": len(plan.tiles),
        **({"warnings": "; ".join(made["warnings"])} if made["warnings"] else {}),
    }


def _settings(gbuffer: GBuffer, effect: str, plan: ShadePlan) -> Json:
    """Those that the effect has."""
    known = EFFECTS[effect].settings
    found: Json = {}
    if "radius" in known:
        found |= {"radius": plan.radius.value, "radius_source": plan.radius.source}
    if plan.lighting is not None:
        found |= plan.lighting.facts()
    for name in CAMERA:
        if name in known and (value := gbuffer.header.get(SETTINGS[name].header)) is not None:
            found[name] = value if isinstance(value, float) else str(value)
    return found


def _derived(gbuffer: GBuffer, plan: ShadePlan) -> dict[str, str]:
    """How what wasn't there was found: the radius, and attributes."""
    radius = {"radius": plan.radius.derived} if plan.radius.derived else {}
    return radius | gbuffer.derived


def _listed(entries: dict[str, str]) -> str:
    return "; ".join(f"{name}: {how}" for name, how in sorted(entries.items()))
