"""Attributes from other attributes: one table, resolved transitively.

Adding a derivation is adding a row. Everything is camera space unless it says world; arrays are
(C, H, W) float32. Rows are tried in order; the first whose needs can be met wins.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from deepshade.camera import Camera, rotation_of
from deepshade.gbuffer.geometry import normals_from_positions, unit

Array = NDArray[np.float32]
Requirement = Literal["fov", "matrix", "lens", "unmoved"]

_PIECE = 2**13  # pixels transformed at a time

_REQUIREMENTS: dict[Requirement, str] = {
    "fov": "the field of view (--fov)",
    "matrix": "the camera's matrix (worldToCamera)",
    "lens": "the field of view and the lens (deepshade:focus and deepshade:aperture)",
    "unmoved": "objects that were never moved (deepshade:unmoved)",
}
REQUIREMENT_FIXES: dict[Requirement, str] = {
    "fov": "give the full horizontal angle in degrees (--fov), or write deepshade:fov; of a camera "
    "with parallel rays the frame's width in scene units (--ortho-width)",
    "matrix": "give it (--world-to-camera), or write the standard header attribute worldToCamera",
    "lens": "give the full horizontal angle, the focus distance and the aperture's diameter, or "
    "write deepshade:fov, deepshade:focus and deepshade:aperture",
    "unmoved": "where all objects are placed and turned as they were modelled, object space is "
    "world space: write deepshade:unmoved 1 (--map normal_object=<layer> says so too)",
}


@dataclass(slots=True)
class Source:
    """What derivations start from. `valid` is (H, W), false where there is no geometry."""

    arrays: dict[str, Array]
    valid: NDArray[np.bool_]
    camera: Camera | None = None
    matrix: NDArray[np.float64] | None = None
    header: Mapping[str, Any] = field(default_factory=dict)

    @property
    def view(self) -> Camera:
        """The camera, which the plan has made sure of."""
        assert self.camera is not None, "a derivation was planned without its field of view"
        return self.camera

    @property
    def world_to_camera(self) -> NDArray[np.float64]:
        """The camera's matrix, which the plan has made sure of."""
        assert self.matrix is not None, "a derivation was planned without its matrix"
        return self.matrix


@dataclass(frozen=True, slots=True)
class Derivation:
    """One way to get `target` from `needs`, given what the header must `require`."""

    target: str
    needs: tuple[str, ...]
    requires: Requirement | None
    function: Callable[[Source], Array]
    how: str


def _position_from_world(s: Source) -> Array:
    matrix = s.world_to_camera
    points = s.arrays["position_world"]
    flat = points.reshape(3, -1)
    out = np.empty_like(flat)
    # float64 for the product alone, because world coordinates can be large beside the scene's
    # detail, and piecewise, because it would take five times the picture's memory
    for at in range(0, flat.shape[1], _PIECE):
        piece = matrix[:3, :3] @ flat[:, at : at + _PIECE].astype(np.float64)
        piece += matrix[:3, 3:]
        out[:, at : at + _PIECE] = piece
    return out.reshape(points.shape)


def _position_from_distance(s: Source) -> Array:
    distance = s.arrays["distance"][0]
    return s.view.position_from_depth(distance / s.view.slant(*distance.shape[::-1]))


def _view(s: Source) -> Array:
    toward = unit(-s.arrays["position"])
    if s.camera is not None and not s.valid.all():
        # The sky too is looked at from somewhere.
        rays = s.camera.rays(*s.valid.shape[::-1])
        np.copyto(toward, unit(-rays), where=~s.valid)
    return _turned(rotation_of(s.world_to_camera).T, toward)


def _focal(s: Source) -> Array:
    lens = lens_of(s.header)
    assert lens is not None  # the plan has checked it
    return circle_of_confusion(s.arrays["depth"], *lens, s.view.pixels_per_unit)


_TABLE = (
    Derivation(
        "position",
        ("position_world",),
        "matrix",
        _position_from_world,
        "from world-space positions and worldToCamera",
    ),
    Derivation(
        "position",
        ("depth",),
        "fov",
        lambda s: s.view.position_from_depth(s.arrays["depth"][0]),
        "from depth and the field of view",
    ),
    Derivation(
        "position",
        ("distance",),
        "fov",
        _position_from_distance,
        "from the distance along rays and the field of view",
    ),
    Derivation(
        "depth", ("position",), None, lambda s: -s.arrays["position"][2:3], "from position: -P.z"
    ),
    Derivation(
        "normal",
        ("normal_world",),
        "matrix",
        lambda s: _turned(rotation_of(s.world_to_camera), s.arrays["normal_world"]),
        "from world-space normals and worldToCamera",
    ),
    Derivation(
        "normal",
        ("position",),
        None,
        lambda s: normals_from_positions(s.arrays["position"], s.valid),
        "from differences of neighbouring positions",
    ),
    Derivation(
        "normal_world",
        ("normal",),
        "matrix",
        lambda s: _turned(rotation_of(s.world_to_camera).T, s.arrays["normal"]),
        "from camera-space normals and worldToCamera",
    ),
    Derivation(
        "normal_object",
        ("normal_world",),
        "unmoved",
        lambda s: s.arrays["normal_world"].copy(),
        "world-space normals, of objects that were never moved",
    ),
    Derivation("view", ("position",), "matrix", _view, "from position and worldToCamera"),
    Derivation(
        "view_angle",
        ("position", "normal"),
        None,
        lambda s: _angle(-s.arrays["position"], s.arrays["normal"]),
        "the angle between -position and normal",
    ),
    Derivation(
        "view_angle",
        ("view", "normal_world"),
        None,
        lambda s: _angle(s.arrays["view"], s.arrays["normal_world"]),
        "the angle between view and world-space normal",
    ),
    Derivation("focal", ("depth",), "lens", _focal, "from depth, focus distance and aperture"),
)


def steps_to(target: str) -> list[Derivation]:
    """All rows of the table that give `target`, best first."""
    return [row for row in _TABLE if row.target == target]


def plan(
    target: str, have: Collection[str], met: Collection[str], _above: tuple[str, ...] = ()
) -> list[Derivation] | None:
    """The steps, in order, that lead from `have` to `target`; [] if it is there, None if none.

    `met` holds the requirements that the header fulfils: "fov", "matrix", "lens", "unmoved".
    """
    if target in have:
        return []
    for row in steps_to(target):
        if row.requires and row.requires not in met:
            continue
        steps: list[Derivation] = []
        for need in row.needs:
            if need in _above or need == target:
                break
            known = {*have, *(step.target for step in steps)}
            found = plan(need, known, met, (*_above, target))
            if found is None:
                break
            steps += found
        else:
            return [*steps, row]
    return None


def unmet(target: str, have: Collection[str], met: Collection[str]) -> list[Requirement]:
    """The fewest requirements that would make `target` derivable; [] if none would help."""
    missing = [r for r in _REQUIREMENTS if r not in met]
    for one in missing:
        if plan(target, have, {*met, one}) is not None:
            return [one]
    if plan(target, have, _REQUIREMENTS) is None:
        return []
    return [r for r in missing if plan(target, have, _REQUIREMENTS.keys() - {r}) is None]


def enough(missing: Collection[str]) -> str:
    """In words, what common pass all of them could be derived from; "" if there is none."""
    cameras: tuple[tuple[Requirement, ...], ...] = (("fov",), ("fov", "matrix"))
    for given in (("depth",), ("depth", "normal")):
        for met in cameras:
            if all(plan(name, given, met) is not None for name in missing):
                return f"{' and '.join(given)} with {requirement_text(met)} would do"
    return ""


def requirements(
    camera: Camera | None, matrix: NDArray[np.float64] | None, header: Mapping[str, Any]
) -> set[Requirement]:
    """Which requirements the camera and header fulfil."""
    pinhole = camera is not None and camera.projection == "perspective"
    lens = pinhole and lens_of(header) is not None
    unmoved = str(header.get("deepshade:unmoved", "")) in ("1", "1.0")
    there = {"fov": camera is not None, "matrix": matrix is not None, "lens": lens}
    there["unmoved"] = unmoved
    return {name for name in _REQUIREMENTS if there[name]}


def requirement_text(names: Collection[Requirement]) -> str:
    """The requirements in words, for an error."""
    return " and ".join(_REQUIREMENTS[name] for name in names)


def lens_of(header: Mapping[str, Any]) -> tuple[float, float] | None:
    """(focus distance, aperture diameter) of an EXR header, both in scene units, or None."""
    try:
        focus = float(header["deepshade:focus"])
        aperture = float(header["deepshade:aperture"])
    except (KeyError, TypeError, ValueError):
        return None
    good = math.isfinite(focus) and math.isfinite(aperture) and focus > 0 and aperture >= 0
    return (focus, aperture) if good else None


def circle_of_confusion(
    depth: Array, focus: float, aperture: float, pixels_per_unit: float
) -> Array:
    """D_focal: signed diameter of the blur circle, in pixels.

    A thin lens of diameter A focused at distance F images a point at planar depth D as a circle
    whose diameter, in the plane of focus, is A |D - F| / D (similar triangles through the lens).
    Seen from the lens that is 1/F as large in the image plane at distance 1, which has
    `pixels_per_unit` = (width / 2) / tan(fov / 2) pixels a unit:

        c = A (D - F) / (D F) · pixels_per_unit

    Positive behind the plane of focus, negative before it, 0 in it, A / F · pixels_per_unit at
    infinity, which is where background lies: depths <= 0 count as infinite.
    """
    safe = np.where(depth > 0, depth, np.inf)
    # 1/F - 1/D rather than (D - F)/(D F): no overflow for huge depths
    return (aperture * pixels_per_unit * (1.0 / focus - 1.0 / safe)).astype(np.float32)


def _turned(rotation: NDArray[np.float64], vectors: Array) -> Array:
    turned = rotation.astype(np.float32) @ vectors.reshape(3, -1)
    return turned.reshape(vectors.shape)


def _angle(a: Array, b: Array) -> Array:
    a, b = unit(a), unit(b)
    # atan2 of the half angle: exact near 0 and π, where arccos of a dot product is not
    difference = np.sqrt(((a - b) ** 2).sum(0, keepdims=True))
    total = np.sqrt(((a + b) ** 2).sum(0, keepdims=True))
    angle: Array = (2.0 * np.arctan2(difference, total)).astype(np.float32)
    return angle
