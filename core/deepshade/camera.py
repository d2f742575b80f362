"""The camera of an image: where its pixels are, and how world and camera space relate."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepshade.errors import CameraError

_STRIDE = 4  # every how many pixels normals are compared
_FLAT = 1e-3  # share of a singular value that is rounding
LEAST_FOV = 1e-6  # degrees; of less a pixel spans nothing in float32
Window = tuple[int, int, int, int]
Projection = Literal["perspective", "orthographic", "latlong"]
PROJECTIONS: tuple[Projection, ...] = get_args(Projection)
# attribute -> (shape, least value)
_PLACING: dict[str, tuple[tuple[int, ...], float | None]] = {
    "pixelAspectRatio": ((), float(np.finfo(np.float32).tiny)),
    "screenWindowCenter": ((2,), None),
    "screenWindowWidth": ((), 0.0),
    "worldToCamera": ((4, 4), None),
}


@dataclass(frozen=True)
class Camera:
    """A pinhole camera, or with another `projection` one whose rays are parallel, or go all around.

    Camera space is right-handed: +x right, +y up, looking down -z. `fov` is the full horizontal
    angle in degrees across the whole frame (the display window, `width` x `height` pixels).
    `world_to_camera` is (4, 4) float64 and multiplies column vectors; None when unknown.
    `x0`, `y0` is where the stored pixels (the data window) start within the frame.
    `center` is the optical axis' offset from the frame's middle (OpenEXR's screenWindowCenter,
    in units of the image plane at distance 1), for shifted lenses. `pixel_aspect` is a pixel's
    width divided by its height (OpenEXR's pixelAspectRatio): 2 for an anamorphic squeeze.
    An "orthographic" frame is `across` scene units wide. A "latlong" frame spans the sphere: row 0
    is up, the centre column -z, and columns to the right of it turn towards +x. Both leave out
    `fov`.
    """

    fov: float
    width: int
    height: int
    world_to_camera: NDArray[np.float64] | None = field(default=None, compare=False)
    x0: int = 0
    y0: int = 0
    center: tuple[float, float] = (0.0, 0.0)
    pixel_aspect: float = 1.0
    projection: Projection = "perspective"
    across: float = 0.0

    def __post_init__(self) -> None:
        if self.projection == "orthographic":
            if not (math.isfinite(self.across) and self.across > 0):
                raise CameraError(
                    f"an orthographic frame is {self.across} scene units wide, it must be above 0",
                    fix="give its width in scene units: --ortho-width 10",
                )
        elif self.projection == "perspective" and not (
            math.isfinite(self.fov) and LEAST_FOV <= self.fov < 180.0
        ):
            raise CameraError(
                f"the field of view is {self.fov}°, it must lie between {LEAST_FOV} and 180",
                fix="give the full horizontal angle in degrees: --fov 50",
            )
        if self.width < 1 or self.height < 1:
            raise CameraError(f"the frame is {self.width} x {self.height} pixels")
        if self.world_to_camera is not None:
            object.__setattr__(self, "world_to_camera", _checked_matrix(self.world_to_camera))

    @classmethod
    def look_at(
        cls, eye: ArrayLike, target: ArrayLike, up: ArrayLike, fov: float, width: int, height: int
    ) -> Camera:
        """A camera at `eye` looking to `target`, both (3,) in world space; `up` points up.

        Where `up` is parallel to the view (or zero), +z or else +y replaces it.
        Raises CameraError when eye and target coincide or any value isn't finite.
        """
        eye_, target_, up_ = (np.asarray(v, np.float64).reshape(3) for v in (eye, target, up))
        backward = eye_ - target_  # camera +z, away from the target
        distance = float(np.linalg.norm(backward))
        if not (np.isfinite(up_).all() and math.isfinite(distance) and distance > 0):
            raise CameraError(
                f"can't look from {eye_.tolist()} to {target_.tolist()}",
                fix="give two different, finite points",
            )
        backward /= distance
        right = np.zeros(3)
        for candidate in (up_, np.array([0.0, 0, 1]), np.array([0.0, 1, 0])):
            right = np.cross(candidate, backward)
            length = float(np.linalg.norm(right))
            if length > 1e-9 * float(np.linalg.norm(candidate)):
                right /= length
                break
        matrix = np.eye(4)
        matrix[:3, :3] = right, np.cross(backward, right), backward
        matrix[:3, 3] = -matrix[:3, :3] @ eye_
        return cls(float(fov), int(width), int(height), matrix)

    @property
    def eye(self) -> NDArray[np.float64]:
        """The camera's place in world space, (3,). Raises CameraError without a matrix."""
        return np.asarray(np.linalg.solve(self.matrix, (0.0, 0.0, 0.0, 1.0))[:3], np.float64)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """`world_to_camera`, or CameraError when it is unknown."""
        if self.world_to_camera is None:
            raise CameraError(
                "the camera's matrix is unknown",
                fix="write the standard header attribute 'worldToCamera' (M44f)",
            )
        return self.world_to_camera

    @property
    def pixels_per_unit(self) -> float:
        """Pixels that a horizontal length of 1 at distance 1 spans: (width / 2) / tan(fov / 2)."""
        if self.projection != "perspective":
            across = self.across if self.projection == "orthographic" else 2 * math.pi
            return self.width / across
        return 0.5 * self.width / math.tan(math.radians(self.fov) / 2)

    def rays(self, width: int | None = None, height: int | None = None) -> NDArray[np.float32]:
        """Camera-space directions with z = -1 through the stored pixels' centres: (3, H, W).

        Of a latlong camera they have length 1 instead. `width` and `height` are those of the data
        window; the whole frame by default.
        """
        width, height = width or self.width, height or self.height
        columns, rows = np.arange(width), np.arange(height)[:, None]
        out = np.empty((3, height, width), np.float32)
        out[0], out[1], out[2] = self._directions(columns, rows)
        return out

    def rays_at(
        self, columns: NDArray[np.integer[Any]], rows: NDArray[np.integer[Any]]
    ) -> NDArray[np.float64]:
        """The same through some of the stored pixels, by their numbers (...): (3, ...)."""
        x, y, z = self._directions(columns, rows)
        return np.stack(np.broadcast_arrays(x, y, z))

    def points_at(
        self,
        columns: NDArray[np.integer[Any]],
        rows: NDArray[np.integer[Any]],
        depth: NDArray[np.floating[Any]],
    ) -> NDArray[np.float64]:
        """Camera-space positions (3, ...) of some pixels at these depths (...)."""
        if self.projection == "orthographic":
            return np.stack(np.broadcast_arrays(*self._slopes(columns, rows), -depth))
        return self.rays_at(columns, rows) * depth

    def _directions(
        self, columns: NDArray[np.integer[Any]], rows: NDArray[np.integer[Any]]
    ) -> tuple[Any, Any, Any]:
        if self.projection == "orthographic":
            return 0.0 * columns, 0.0 * rows, -1.0
        if self.projection == "latlong":
            turn = (columns + (self.x0 + 0.5 - 0.5 * self.width)) * (2 * math.pi / self.width)
            rise = (0.5 * self.height - self.y0 - 0.5 - rows) * (math.pi / self.height)
            return np.cos(rise) * np.sin(turn), np.sin(rise), -np.cos(rise) * np.cos(turn)
        return *self._slopes(columns, rows), -1.0

    def _slopes(
        self, columns: NDArray[np.integer[Any]], rows: NDArray[np.integer[Any]]
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """x and y of the stored pixels' centres at distance 1, of parallel rays at any."""
        scale = 1.0 / self.pixels_per_unit
        x = (columns + (self.x0 + 0.5 - 0.5 * self.width)) * scale + self.center[0]
        y = 0.5 * self.height - self.y0 - 0.5 - rows
        return x, y * (scale / self.pixel_aspect) + self.center[1]

    def position_from_depth(self, depth: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        """P_s, (3, H, W), from planar depth (H, W) in scene units; non-finite depth stays so.

        A latlong camera has no plane: its depth is the distance.
        """
        depth = np.asarray(depth, np.float32)
        height, width = depth.shape
        if self.projection == "latlong":
            out = self.rays(width, height)
            with np.errstate(invalid="ignore", over="ignore"):
                out *= depth
            return out
        x, y = self._slopes(np.arange(width), np.arange(height)[:, None])
        out = np.empty((3, height, width), np.float32)
        if self.projection == "orthographic":
            out[0], out[1] = x, y
        else:
            with np.errstate(invalid="ignore", over="ignore"):  # 0 * inf on background pixels
                np.multiply(depth, x.astype(np.float32), out=out[0])
                np.multiply(depth, y.astype(np.float32), out=out[1])
        np.negative(depth, out=out[2])
        return out

    def slant(self, width: int, height: int) -> NDArray[np.float32]:
        """The length of each stored pixel's ray: distance / depth, (H, W)."""
        rays = self.rays(width, height)
        return np.asarray(np.sqrt((rays * rays).sum(0)), np.float32)

    def to_header(self) -> dict[str, Any]:
        """The EXR attributes that `from_header` reads (the windows are the writer's)."""
        header: dict[str, Any] = {"screenWindowCenter": tuple(float(c) for c in self.center)}
        if self.projection == "perspective":
            header["deepshade:fov"] = float(self.fov)
            # OpenEXR's screen window is the image plane at distance 1
            header["screenWindowWidth"] = 2.0 * math.tan(math.radians(self.fov) / 2)
        elif self.projection == "orthographic":
            header["deepshade:ortho_width"] = float(self.across)
        if self.pixel_aspect != 1.0:
            header["pixelAspectRatio"] = float(self.pixel_aspect)
        if self.world_to_camera is not None:
            # Imath multiplies row vectors, so the file holds the transpose
            header["worldToCamera"] = self.world_to_camera.T.astype(np.float32)
        return header

    @classmethod
    def from_header(
        cls,
        attributes: Mapping[str, Any],
        data_window: Window,
        display_window: Window,
        *,
        fov: float | None = None,
    ) -> Camera | None:
        """The camera an EXR header describes, or None if it has no field of view.

        Windows are (x0, y0, x1, y1), inclusive. `fov` (degrees) overrides the header. Without
        `deepshade:fov` the angle comes from `screenWindowWidth`, but only where that isn't 1,
        the value that most programs write when they know nothing.
        Raises CameraError when a matrix or angle is there but unusable.
        """
        screen_width = _number(attributes.get("screenWindowWidth"))
        if fov is None:
            fov = _number(attributes.get("deepshade:fov"))
        if fov is None and screen_width is not None and 0 < screen_width != 1.0:
            fov = math.degrees(2.0 * math.atan(screen_width / 2))
        if fov is None:
            return None
        matrix = matrix_from_header(attributes)
        return cls.framed(attributes, data_window, display_window, matrix, fov=float(fov))

    @classmethod
    def framed(
        cls,
        attributes: Mapping[str, Any],
        data_window: Window,
        display_window: Window,
        matrix: NDArray[np.float64] | None,
        *,
        fov: float = 0.0,
        projection: Projection = "perspective",
        across: float = 0.0,
    ) -> Camera:
        """A camera of this lens, with the windows and the shape of pixels that a header states.

        Raises CameraError for a lens that is none.
        """
        aspect = _number(attributes.get("pixelAspectRatio"))
        return cls(
            fov=fov,
            width=display_window[2] - display_window[0] + 1,
            height=display_window[3] - display_window[1] + 1,
            world_to_camera=matrix,
            x0=data_window[0] - display_window[0],
            y0=data_window[1] - display_window[1],
            center=_pair(attributes.get("screenWindowCenter")),
            pixel_aspect=aspect if aspect is not None and aspect > 0 else 1.0,
            projection=projection,
            across=across,
        )


def matrix_from_header(attributes: Mapping[str, Any]) -> NDArray[np.float64] | None:
    """`worldToCamera` of an EXR header as a column-vector matrix (4, 4), or None."""
    value = attributes.get("worldToCamera")
    if value is None:
        return None
    try:
        matrix = np.asarray(value, np.float64).reshape(4, 4).T
    except (TypeError, ValueError):
        raise CameraError("the header's worldToCamera is no 4 x 4 matrix") from None
    return _checked_matrix(matrix.T if _by_columns(matrix) else matrix)


def matrix_of(value: Any) -> NDArray[np.float64] | None:
    """`matrix_from_header` of a value; None where it is none, or can't be inverted."""
    try:
        return None if value is None else matrix_from_header({"worldToCamera": value})
    except CameraError:
        return None


def _by_columns(matrix: NDArray[np.float64]) -> bool:
    """Whether it was written as it multiplies columns, as pbrt does."""
    return bool(matrix[3, :3].any() and not matrix[:3, 3].any())


def parse_matrix(text: str) -> NDArray[np.float64]:
    """worldToCamera (4, 4), for column vectors, of 16 numbers row by row, or of the first 12.

    Between the numbers may stand blanks, commas, semicolons and brackets, as numpy, JSON and
    Blender print a matrix. Raises CameraError for anything else.
    """
    words = re.split(r"[\s,;()\[\]]+", text.strip(" \t\r\n,;()[]"))
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) == 12:
        numbers += [0, 0, 0, 1]
    if len(numbers) != 16:
        few = len(numbers) == 9
        raise CameraError(
            "a rotation alone doesn't say where the camera is"
            if few
            else f"worldToCamera must be 16 numbers, or the first 12, not '{text:.60}'",
            fix="add the translation to each row"
            if few
            else "write its rows one after the other, with commas between the numbers",
        )
    matrix = np.reshape(numbers, (4, 4))
    if not matrix[:3, 3].any() and matrix[3, :3].any() and matrix[3, 3] == 1:
        raise CameraError(
            "worldToCamera is transposed: its translation stands in the last row",
            fix="write it as it multiplies column vectors, the translation in the last column",
        )
    return _checked_matrix(matrix)


def placement_of(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """The attributes of an EXR header that place its pixels, if they are usable.

    Out of pixelAspectRatio > 0, screenWindowCenter (2 numbers), screenWindowWidth >= 0 and
    worldToCamera (4, 4), as they stand there; what isn't finite is left out.
    """
    found: dict[str, Any] = {}
    for name, (shape, least) in _PLACING.items():
        value = np.asarray(attributes.get(name))
        usable = value.shape == shape and value.dtype.kind == "f" and np.isfinite(value).all()
        if usable and (least is None or value >= least):
            found[name] = attributes[name]
    return found


def rotation_of(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """The (3, 3) part of an affine matrix that turns directions, without its scale.

    A polar decomposition takes scale and shear out; a rigid (or mirroring) matrix stays as it is.
    """
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    return np.asarray(u @ vt, np.float64)


def camera_to_world(
    attributes: Mapping[str, NDArray[np.floating[Any]]], camera: Camera | None = None
) -> NDArray[np.float64]:
    """The (3, 3) that turns camera space into the world, which a left-handed world mirrors.

    As `attributes` "normal" and "normal_world" (3, H, W) have it where they are given and point
    more than one way, else as `camera` has it; without either, what fits them. (The nearest
    orthogonal matrix: Schönemann, "A Generalized Solution of the Orthogonal Procrustes Problem",
    1966.)
    """
    matrix = camera.world_to_camera if camera is not None else None
    moment = np.zeros((3, 3))
    if {"normal", "normal_world"} <= attributes.keys():
        seen, there = (
            np.asarray(attributes[name][:, ::_STRIDE, ::_STRIDE], np.float64).reshape(3, -1)
            for name in ("normal", "normal_world")
        )
        moment = there @ seen.T
    u, size, vt = np.linalg.svd(moment)
    if size[1] <= _FLAT * size[0] and matrix is not None:
        return rotation_of(matrix).T
    if size[2] <= _FLAT * size[0]:  # of one plane's directions: which way the third, isn't said
        u[:, 2] *= np.sign(np.linalg.det(u @ vt))
    return np.asarray(u @ vt)


def _checked_matrix(matrix: ArrayLike) -> NDArray[np.float64]:
    result = np.array(matrix, np.float64)
    if result.shape != (4, 4) or not np.isfinite(result).all():
        raise CameraError("worldToCamera must be a finite 4 x 4 matrix")
    linear = result[:3, :3]
    scale = float(np.abs(linear).max())
    # relative to its own size: a scene in kilometres may scale by 1e-3 without being singular
    if scale == 0 or abs(np.linalg.det(linear / scale)) < 1e-9:
        raise CameraError("worldToCamera can't be inverted", fix="check the renderer's camera")
    if abs(result[3, 3]) < 1e-12 or np.abs(result[3, :3]).max() > 1e-6 * abs(result[3, 3]):
        raise CameraError(
            "worldToCamera has a projective part; it must be affine",
            fix="write the view matrix alone, without the projection",
        )
    result /= result[3, 3]
    result[3] = 0, 0, 0, 1
    result.flags.writeable = False
    return result


def _number(value: Any) -> float | None:
    if isinstance(value, (int, float, np.floating, np.integer)) and math.isfinite(value):
        return float(value)
    return None


def _pair(value: Any) -> tuple[float, float]:
    if isinstance(value, (Sequence, np.ndarray)) and len(value) == 2:
        x, y = _number(value[0]), _number(value[1])
        if x is not None and y is not None:
            return x, y
    return 0.0, 0.0
