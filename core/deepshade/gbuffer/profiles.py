"""How renderers name their channels, and in which space and handedness they write them.

Each profile is one row of a table. Blender, Arnold, RenderMan, V-Ray, Unreal and 3Delight use fixed
names; others' are chosen by whoever wrote the scene (Mitsuba's), or mean something else to more
usual renderers (Mantra's P), so their rows count only in files that say by whom they are, or when
the profile is asked for. Depths along the view axis are the attribute
`depth`, those along the ray the quantity `distance`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from deepshade.attributes import ATTRIBUTES
from deepshade.errors import ConfigError
from deepshade.gbuffer.lenses import number

# What a file may hold beyond the attributes themselves; attributes are derived from them.
QUANTITIES: dict[str, int] = {
    **{name: len(attribute.channels) for name, attribute in ATTRIBUTES.items()},
    "position_world": 3,  # world-space position
    "distance": 1,  # depth along the ray
    "alpha": 1,
    "beauty": 3,  # the finished picture; nothing is derived from it
}

Header = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Source:
    """A quantity, the layer names it goes by, and what turns the stored values into ours.

    Motion may be `per_frame`: that of the whole interval between two frames, not of an exposure.
    """

    quantity: str
    layers: tuple[str, ...]
    signs: tuple[int, ...] = ()
    components: str = ""
    per_frame: bool = False


@dataclass(frozen=True, slots=True)
class Profile:
    """One renderer's conventions: its names for quantities, and the files that `made_by` knows.

    `world` is the handedness of world space, and `up` its up axis. `free_names` are only a scene's
    author's, and count in files of that renderer alone. `fov` are header attributes with the
    horizontal field of view in degrees, and `matrix` makes worldToCamera of others.
    """

    name: str
    sources: tuple[Source, ...]
    made_by: Callable[[Header], bool]
    world: Literal["right", "left"] = "right"
    up: Literal["y", "z"] = "y"
    free_names: bool = False
    fov: tuple[str, ...] = ()
    matrix: Callable[[Header], NDArray[np.float64] | None] | None = None


def profile(name: str) -> Profile:
    """The profile of that name. Raises ConfigError naming the nearest one."""
    if name not in PROFILES:
        raise ConfigError(name, PROFILES, detail=f"unknown profile '{name}'")
    return PROFILES[name]


def detect(header: Header) -> Profile | None:
    """The profile of the renderer that signed this header, or None."""
    return next((p for p in PROFILES.values() if p.made_by(header)), None)


def match_rank(layer: str, alias: str, *, from_stem: bool = False) -> int | None:
    """How well a layer name fits an alias: 0 the same, 1 under a prefix, +2 in another case.

    Prefixes end at a dot, slash or colon ("ViewLayer.Normal"), or at an underscore for aliases of
    three letters and more ("shot_normal"); file stems (`from_stem`) may have any of those, and a
    frame number, a version ("v012") or the name of a grey channel at the end. None when it doesn't
    fit.
    """
    if from_stem:
        layer = re.sub(r"([._\-\s]*\d+|[._\-\s]+(v\d+|[yvl]))+$", "", layer, flags=re.I)
        layer = re.sub(r"[_\-\s]+", ".", layer)
        alias = alias.replace("_", ".")
    lower, wanted = layer.lower(), alias.lower()
    if not lower.endswith(wanted):
        return None
    prefix = layer[: len(layer) - len(alias)]
    if prefix and prefix[-1] not in (".:/" if len(alias) < 3 else ".:/_"):
        return None
    return (1 if prefix else 0) + (0 if layer.endswith(alias) else 2)


def _signed(*prefixes: str) -> Callable[[Header], bool]:
    return lambda header: any(key.startswith(prefixes) for key in header)


def _software(name: str) -> Callable[[Header], bool]:
    keys = ("software", "generatedby", "renderer", "creator")
    return lambda header: any(
        name in str(value).lower() for key, value in header.items() if key.lower() in keys
    )


def _blender(header: Header) -> bool:
    return _signed("cycles.", "blender")(header) or str(header.get("File", "")).endswith(".blend")


def _unreal_matrix(header: Header) -> NDArray[np.float64] | None:
    """World (left-handed, z up, x forward at zero rotation, cm) to our camera space."""
    place, turn = (
        [number(header, f"unreal/camera/{kind}/{axis}") for axis in axes]
        for kind, axes in (("curPos", "xyz"), ("curRot", ("pitch", "yaw", "roll")))
    )
    if not np.isfinite(place + turn).all():
        return None
    (sp, sy, sr), (cp, cy, cr) = np.sin(np.radians(turn)), np.cos(np.radians(turn))
    forward = (cp * cy, cp * sy, sp)
    right = (sr * sp * cy - cr * sy, sr * sp * sy + cr * cy, -sr * cp)
    up = (-(cr * sp * cy + sr * sy), cy * sr - cr * sp * sy, cr * cp)
    matrix = np.eye(4)
    matrix[:3, :3] = right, up, np.negative(forward)
    matrix[:3, 3] = -matrix[:3, :3] @ np.asarray(place)
    return matrix


_UP_TO_DOWN = (1, -1)  # image v points down
_INTO_SCREEN = (1, 1, -1)  # a left-handed camera's z

# what people call them besides
_ALSO = {
    "depth": ("Z", "depth", "Pz", "distance_to_image_plane"),  # Pz: Houdini's
    "position": ("position", "P_camera", "P.camera", "position_camera"),  # 3Delight has dots
    "normal": ("normal", "N_camera", "N.camera", "normal_camera"),
}
_CANONICAL = tuple(Source(name, _ALSO.get(name, (name,))) for name in ATTRIBUTES)

_TABLE: Sequence[Profile] = (
    Profile(
        "deepshade",
        (
            *_CANONICAL,
            Source("position_world", ("position_world",)),
            Source("distance", ("distance", "distance_to_camera")),
            Source("alpha", ("A",)),
            Source("beauty", ("beauty", "Combined", "Image", "rgba", "rgb", "Ci")),
        ),
        # its names are their own signature: header facts like deepshade:fov may be added to
        # any renderer's file
        lambda header: False,
    ),
    Profile(
        "blender",
        (
            Source("position_world", ("Position",)),
            Source("normal_world", ("Normal",)),
            Source("depth", ("Depth", "Z")),
            Source("diffuse", ("DiffCol",)),
            # X Y lead to the previous frame, Z W to the next; v up
            Source("motion", ("Vector",), _UP_TO_DOWN, components="zw", per_frame=True),
        ),
        _blender,
        up="z",
    ),
    Profile(
        "mitsuba",
        (
            Source("position_world", ("position", "pos", "p")),
            Source("normal_world", ("sh_normal", "normal", "nn", "n")),
            Source("distance", ("depth", "dd.y", "dd")),
            Source("diffuse", ("albedo",)),
        ),
        lambda header: "mitsuba" in str(header.get("generatedBy", "")).lower(),
        free_names=True,
    ),
    Profile(
        "arnold",
        (
            Source("position_world", ("P",)),
            Source("normal_world", ("N",)),
            Source("depth", ("Z",)),
            Source("diffuse", ("diffuse_albedo",)),
            Source("motion", ("motionvector",), _UP_TO_DOWN),
        ),
        _signed("arnold/"),
    ),
    Profile(
        "renderman",
        (
            Source("position_world", ("Pworld", "__Pworld")),
            Source("normal_world", ("Nworld", "__Nworld")),
            Source("normal", ("Nn", "__Nn"), _INTO_SCREEN),
            Source("depth", ("z",)),
            Source("motion", ("motionFore",), _UP_TO_DOWN),
        ),
        _signed("rman", "prman", "PixarRenderMan", "renderman"),
    ),
    Profile(
        "pbrt",  # its G-buffer film, in camera space (coordinateSystem "camera", the default)
        (
            Source("position", ("P",), _INTO_SCREEN),
            Source("normal", ("Ns",), _INTO_SCREEN),
            Source("diffuse", ("Albedo",)),
        ),
        lambda header: {"samplesPerPixel", "renderTimeSeconds"} <= header.keys(),
        free_names=True,
    ),
    Profile(
        "vray",
        (
            Source("normal", ("normals",)),
            Source("depth", ("zDepth", "Z")),
            Source("diffuse", ("diffuse_filter",)),
            Source("motion", ("velocity",), _UP_TO_DOWN, per_frame=True),
        ),
        _signed("vray", "VRay"),
        up="z",
    ),
    Profile(
        "unreal",
        (  # lengths in centimetres
            Source("normal_world", ("WorldNormal", "FinalImageWorldNormal")),
            Source("position_world", ("WorldPosition", "FinalImageWorldPosition")),
            Source(
                "depth",
                ("SceneDepth", "WorldDepth", "FinalImageSceneDepth", "FinalImageWorldDepth"),
            ),
            Source("diffuse", ("BaseColor", "FinalImageBaseColor")),
        ),
        _signed("unreal/"),
        up="z",
        world="left",
        fov=("unreal/camera/FinalImage/fov", "unreal/camera/fov"),
        matrix=_unreal_matrix,
    ),
    Profile(
        "3delight",  # NSI names variables by their space: "P.camera", "N.world"
        (
            Source("position", ("P.camera", "P_camera")),
            Source("normal", ("N.camera", "N_camera")),
            Source("position_world", ("P.world", "P_world")),
            Source("normal_world", ("N.world", "N_world")),
            Source("depth", ("z",)),
        ),
        _software("3delight"),
    ),
    Profile(
        "mantra",  # shades in camera space, and so exports P and N
        (
            Source("position", ("P",)),
            Source("normal", ("N",)),
            Source("depth", ("Pz",)),
        ),
        _software("mantra"),
        free_names=True,
    ),
    Profile(
        "karma",  # what its rays hit, in world space
        (
            Source("position_world", ("P", "hitP")),
            Source("normal_world", ("N", "hitN")),
            Source("depth", ("Pz", "hitPz")),
            Source("diffuse", ("albedo",)),
        ),
        lambda header: (
            {"renderTime_s", "renderMemory_s"} <= header.keys() or _software("karma")(header)
        ),
        free_names=True,
    ),
    Profile(
        "luxcore",  # film outputs; DEPTH is how far the ray went
        (
            Source("position_world", ("POSITION",)),
            Source("normal_world", ("SHADING_NORMAL", "AVG_SHADING_NORMAL")),
            Source("distance", ("DEPTH",)),
            Source("diffuse", ("ALBEDO",)),
        ),
        _software("luxcore"),
        up="z",
        free_names=True,
    ),
    Profile(
        "blenderproc",  # normals of camera space, encoded
        (
            Source("normal", ("normals",)),
            Source("depth", ("depth",)),
            Source("distance", ("distance",)),
        ),
        _software("blenderproc"),
        up="z",
        free_names=True,
    ),
    Profile(
        "replicator",  # Omniverse's annotators
        (
            Source("normal_world", ("normals", "PtWorldNormal", "NormalSD", "SmoothNormal")),
            Source("position_world", ("PtWorldPos",)),
            Source("depth", ("distance_to_image_plane", "DistanceToImagePlaneSD", "PtZDepth")),
            Source("distance", ("distance_to_camera", "DistanceToCameraSD")),
            Source("diffuse", ("DiffuseAlbedo",)),
        ),
        _software("omniverse"),
        up="z",
        free_names=True,
    ),
)

PROFILES: dict[str, Profile] = {row.name: row for row in _TABLE}
