"""What EXR headers say of a camera's field of view, by whichever attributes say it.

OpenEXR's own (openexr.com/en/latest/StandardAttributes.html), and those that renderers write
beside them. A fact that makes no sense counts as one that isn't there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.camera import Projection, matrix_of
from deepshade.exr import Window

Header = Mapping[str, Any]

# the full horizontal angle in degrees
_ANGLES = ("fieldOfViewHorizontal", "horizontalFieldOfView", "CameraFov")
# (focal length, width of the film behind it), in the same unit
_FILMS = (
    ("CameraFocalLength", "CameraFilmApertureHorizontal"),  # Arnold
    ("pinholeFocalLength", "sensorOverallDimensions"),  # OpenEXR, mm
    ("effectiveFocalLength", "sensorOverallDimensions"),
    ("nominalFocalLength", "sensorOverallDimensions"),
    ("focalLength", "horizontalAperture"),  # USD's names, as Karma and Omniverse have them
    ("focalLength", "filmWidth"),
    ("focalLength", "sensorWidth"),
    ("unreal/camera/FinalImage/focalLength", "unreal/camera/FinalImage/sensorWidth"),
    ("unreal/camera/focalLength", "unreal/camera/sensorWidth"),
)
LATLONG = 0  # OpenEXR's number of it in `envmap`


@dataclass(frozen=True, slots=True)
class Lens:
    """A projection; `width` is the field of view in degrees, or across in scene units."""

    projection: Projection
    width: float


def envmap(header: Header) -> int | None:
    """OpenEXR's number of a whole surrounding, or None; a file may hold anything by that name."""
    found = header.get("envmap")
    return found if isinstance(found, int) else None


def lens_in(header: Header, display: Window, fov: tuple[str, ...] = ()) -> Lens | None:
    """What a header says of the lens, or None. `fov` are more attributes with an angle."""
    if envmap(header) == LATLONG:
        return Lens("latlong", 360.0)
    across = number(header, "deepshade:ortho_width")
    if across > 0:
        return Lens("orthographic", across)
    angle = number(header, "deepshade:fov", *fov, *_ANGLES)
    if 0 < angle < 180:
        return Lens("perspective", angle)
    window = number(header, "screenWindowWidth")
    if window > 0 and window != 1:  # which most programs write when they know nothing
        return Lens("perspective", _angle(window))
    return _of_matrices(header, display) or _of_film(header)


def _of_film(header: Header) -> Lens | None:
    for focal, film in _FILMS:
        value = header.get(film)
        wide = number({film: value[0] if isinstance(value, tuple) and value else value}, film)
        length = number(header, focal)
        if wide > 0 and length > 0:
            return Lens("perspective", _angle(wide / length))
    return None


def _of_matrices(header: Header, display: Window) -> Lens | None:
    """From worldToCamera and worldToNDC: what lies between them projects.

    NDC go from 0 to 1 across the display window (OpenEXR's and RenderMan's), or from -1 to 1 (what
    many write): the optical axis, in the middle of either, tells which. pbrt scales both axes
    alike, so that the shorter side goes from 0 to 1.
    """
    to_camera = matrix_of(header.get("worldToCamera"))
    stored = np.asarray(header.get("worldToNDC", 0.0))
    if to_camera is None or stored.shape != (4, 4) or not np.isfinite(stored).all():
        return None
    for to_ndc in (stored.T, stored):  # for row vectors; pbrt writes it for columns
        projection = to_ndc.astype(np.float64) @ np.linalg.inv(to_camera)
        if np.allclose(projection, np.eye(4), atol=1e-4):
            return None  # the camera's matrix again, as some write it
        *turned, depends, alone = projection[3]
        weight = max(abs(depends), abs(alone))
        if (
            weight > 0
            and np.abs(turned).max() < 1e-3 * weight
            and min(abs(depends), abs(alone)) < 1e-3 * weight
        ):
            return _projecting(projection, header, display)
    return None


def _projecting(projection: NDArray[np.float64], header: Header, display: Window) -> Lens | None:
    """The lens of a matrix (4, 4) that projects from camera space to NDC."""
    parallel = abs(projection[3, 3]) > abs(projection[3, 2])
    weight = projection[3, 3 if parallel else 2]
    x, y = (abs(projection[axis, axis] / weight) for axis in (0, 1))
    middle = abs(projection[0, 3 if parallel else 2] / weight)
    if not (np.isfinite([x, y, middle]).all() and x > 0 and y > 0):
        return None
    reach = 1.0 if abs(middle - 0.5) < 0.25 or "renderTimeSeconds" in header else 2.0
    wide = reach / x
    width, height = display[2] - display[0] + 1, display[3] - display[1] + 1
    aspect = number(header, "pixelAspectRatio")
    shape = width * (aspect if aspect > 0 else 1) / height
    if abs(y / x / shape - 1) > 0.02:  # it isn't the picture that goes from 0 to 1
        if abs(y / x - 1) > 0.02:
            return None
        wide *= max(1.0, shape)
    return Lens("orthographic", wide) if parallel else Lens("perspective", _angle(wide))


def _angle(wide: float) -> float:
    """The angle across, in degrees, of an image plane so wide at distance 1."""
    return math.degrees(2 * math.atan(wide / 2))


def number(header: Header, *keys: str) -> float:
    """The first of these attributes that is a number; NaN if none is."""
    for key in keys:
        try:
            value = float(header[key])
        except (KeyError, TypeError, ValueError):
            continue
        if math.isfinite(value):
            return value
    return math.nan
