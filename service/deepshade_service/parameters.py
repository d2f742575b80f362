"""The parameters of a shading request, as the query string carries them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from enum import StrEnum
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidatorFunctionWrapHandler,
    WithJsonSchema,
    field_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError

from deepshade.attributes import ATTRIBUTES
from deepshade.camera import parse_matrix
from deepshade.effects import EFFECTS, SETTINGS, Effect
from deepshade.effects.settings import MAX_LENGTH, MIN_LENGTH
from deepshade.errors import CameraError, ConfigError
from deepshade.exr import COMPRESSIONS
from deepshade.gbuffer.channels import parse_mapping
from deepshade.gbuffer.conventions import (
    ENCODINGS,
    Checks,
    Conventions,
    parse_axes,
    parse_conventions,
)
from deepshade.gbuffer.depths import KINDS, MEANINGS
from deepshade.gbuffer.profiles import PROFILES
from deepshade_service.problems import Problem

MAX_VIEWS = 8  # in one answer
LENS = ("focus", "aperture")  # settings from which the blur circle is derived
CAMERA = (*LENS, "shutter")
LIGHT = ("environment", "rotate", "up")

# what pydantic can't know: a percentage is read by a validator
_RADIUS_SCHEMA = {
    "anyOf": [
        {"type": "number", "minimum": MIN_LENGTH, "maximum": MAX_LENGTH},
        {"type": "string", "pattern": r"^[\d.]+%$"},
        {"type": "null"},
    ]
}

Compression = StrEnum("Compression", {name: name for name in COMPRESSIONS})  # type: ignore[misc]
Normals = StrEnum("Normals", {name: name for name in ENCODINGS})  # type: ignore[misc]
Depth = StrEnum("Depth", {name: name for name in KINDS})  # type: ignore[misc]
Derivable = StrEnum("Derivable", {name: name for name in ATTRIBUTES})  # type: ignore[misc]
Profile = StrEnum("Profile", {name: name for name in PROFILES})  # type: ignore[misc]


class Share(float):
    """A radius as a share of the picture's median depth: .1 for "10%"."""


def _setting(name: str, instead: str = "") -> FieldInfo:
    setting = SETTINGS[name]
    if setting.stored:
        without = f"what the header's `{setting.header}` says{instead}"
    else:
        without = f"{setting.default}"
    return Field(  # type: ignore[no-any-return]
        ge=setting.lowest,
        le=setting.highest,
        allow_inf_nan=False,
        description=f"{setting.meaning.capitalize()}, in {setting.unit}. Without it, {without}.",
    )


class ShadeParameters(BaseModel):
    """What a request may ask for. An unknown parameter is an error, not a silent no-op."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    upload: Annotated[
        str | None,
        Field(
            description="In place of a body: the `name` of a kept upload (POST /uploads) or of a"
            " sample (GET /samples)."
        ),
    ] = None
    radius: Annotated[
        float | None,
        _setting("radius", ", else 15%: a percentage is of the picture's median depth"),
        WithJsonSchema(_RADIUS_SCHEMA),
    ] = None
    focus: Annotated[float | None, _setting("focus")] = None
    aperture: Annotated[float | None, _setting("aperture")] = None
    shutter: Annotated[
        float | None, _setting("shutter", ", for which its motion holds; that is scaled")
    ] = None
    environment: Annotated[
        str | None,
        Field(description="The map that lights the scene (GET /environments); else `sky`."),
    ] = None
    rotate: Annotated[float | None, _setting("rotate")] = None
    up: Annotated[
        Literal["y", "z"] | None,
        Field(description="The world's up axis; else the one of the renderer, else `y`."),
    ] = None
    world_to_camera: Annotated[
        str | None,
        Field(
            description="The camera's matrix, in place of the header's `worldToCamera`: 16 numbers"
            " row by row, as it multiplies column vectors, so that every fourth is of the"
            " translation; or the first 12. The camera looks down -z."
        ),
    ] = None
    fov: Annotated[
        float | None,
        Field(
            gt=0,
            lt=180,
            allow_inf_nan=False,
            description="Full horizontal field of view in degrees, where positions have to be"
            " derived from depth and the header doesn't say.",
        ),
    ] = None
    projection: Annotated[
        Literal["perspective", "orthographic", "latlong"] | None,
        Field(
            description="How the camera projects; else what the header says, else `perspective`."
            " `orthographic` needs `ortho_width`, `latlong` is a panorama all around."
        ),
    ] = None
    ortho_width: Annotated[
        float | None,
        Field(
            gt=0,
            allow_inf_nan=False,
            description="Width of an orthographic camera's frame in scene units.",
        ),
    ] = None
    view: Annotated[
        str | None,
        Field(
            max_length=200,
            description="Which view of a stereo or multi-view file, as `left`, or which part by its"
            " name; else the file's default one. Several, as `left,right`, are answered in one"
            " multi-view EXR.",
        ),
    ] = None
    profile: Annotated[
        Profile | None, Field(description="The renderer whose channel names to expect.")
    ] = None
    map: Annotated[
        list[str],
        Field(description="`attribute=channel or layer`, repeatable: where an attribute is."),
    ] = []
    axes: Annotated[
        list[str],
        Field(
            description="`vector:axes`, repeatable: our x, y and z (right, up, towards the viewer)"
            " from the stored ones, as `position:x,-y,-z`, or `opengl`, `opencv`, `directx`,"
            " `unity` or `unreal`; without a vector, of position and normal."
            " Else they are found out."
        ),
    ] = []
    normals: Annotated[
        Normals | None,
        Field(
            description="How normals are stored: `signed`, `encoded` (n / 2 + 1 / 2) or `scaled`"
            " (of any length). Else it is found out."
        ),
    ] = None
    depth: Annotated[
        Depth | None,
        Field(
            description="What is stored as depth: "
            + "; ".join(f"`{kind}`, {meaning}" for kind, meaning in MEANINGS.items())
            + ". Else it is found out."
        ),
    ] = None
    near: Annotated[
        float | None,
        Field(gt=0, allow_inf_nan=False, description="Depth of the near plane, scene units."),
    ] = None
    far: Annotated[
        float | None,
        Field(gt=0, allow_inf_nan=False, description="Depth of the far plane, scene units."),
    ] = None
    derive: Annotated[
        list[Derivable],
        Field(description="Attributes to derive from others, repeatable, though they are there."),
    ] = []
    strict: Annotated[
        bool, Field(description="What would be a warning about the G-buffer is an error.")
    ] = False
    trust: Annotated[
        bool, Field(description="Believe the G-buffer; it isn't checked against itself.")
    ] = False
    bundle: Annotated[
        str | None,
        Field(description="Which of the effect's bundles; else `balanced`, else the least error."),
    ] = None
    quality: Annotated[
        Literal["fast", "balanced", "best"] | None,
        Field(description="The bundle of that name."),
    ] = None
    max_error: Annotated[
        float | None,
        Field(
            gt=0,
            le=1,
            allow_inf_nan=False,
            description="The largest error (DSSIM, as published with the bundle): the fastest"
            " bundle within it.",
        ),
    ] = None
    budget_ms: Annotated[
        float | None,
        Field(
            gt=0,
            allow_inf_nan=False,
            description="Milliseconds that the network may take, by what it took while it was"
            " loaded: the most accurate bundle within it.",
        ),
    ] = None
    engine: Annotated[
        str | None,
        Field(description="What the network must run on, as `onnxruntime` or `openvino`."),
    ] = None
    precision: Annotated[
        Literal["fp32", "bf16", "int8"] | None,
        Field(description="How exactly it must calculate."),
    ] = None
    explain: Annotated[
        bool,
        Field(description="The plan as JSON instead of the picture; nothing is computed."),
    ] = False
    format: Annotated[
        Literal["exr", "png"],
        Field(
            description="`exr` is linear, for work; `png` is 8 bits, for eyes: sRGB for light,"
            " the plain value for ao, which is a factor."
        ),
    ] = "exr"
    compression: Annotated[Compression, Field(description="Of the EXR.")] = Compression("zip")
    half: Annotated[bool, Field(description="16-bit pixels in the EXR, else 32-bit.")] = True
    append: Annotated[
        bool,
        Field(description="The picture's own channels too, and the answer as a layer beside them."),
    ] = False
    layer: Annotated[
        str | None,
        Field(
            max_length=100,
            description="The name of the answer's layer, as `AO`; with `append` else the effect's.",
        ),
    ] = None
    multiply: Annotated[
        bool,
        Field(
            description="The picture's beauty times the answer, in place of the answer alone."
            " `map=beauty=…` says where it is, else its name (`Combined`, `rgba`, …) or R G B."
        ),
    ] = False

    @field_validator("layer")
    @classmethod
    def _check_layer(cls, name: str | None) -> str | None:
        if name is not None and not re.fullmatch(r"\w[\w.:-]*", name, re.ASCII):
            raise ValueError(
                f"'{name}' is no layer's name: letters, digits, _ . : and - may be in it"
            )
        return name

    @field_validator("map")
    @classmethod
    def _check_map(cls, entries: list[str]) -> list[str]:
        try:
            parse_mapping(entries)
        except ConfigError as error:
            raise ValueError(str(error)) from None  # which names the parameter
        return entries

    @field_validator("axes")
    @classmethod
    def _check_axes(cls, entries: list[str]) -> list[str]:
        try:
            parse_axes(entries)
        except ConfigError as error:
            raise ValueError(f"{error}; {error.fix}" if error.fix else str(error)) from None
        return entries

    @property
    def conventions(self) -> Conventions:
        """How values are stored, as far as it is said, and how they are checked.

        Raises ConfigError for a kind of depth without its planes.
        """
        checks: Checks = "trust" if self.trust else "strict" if self.strict else "usual"
        return parse_conventions(self.axes, self.normals, self.depth, self.near, self.far, checks)

    @field_validator("radius", mode="wrap")
    @classmethod
    def _read_share(cls, value: object, number: ValidatorFunctionWrapHandler) -> object:
        if isinstance(value, str) and value.rstrip().endswith("%"):
            return Share(number(value.rstrip()[:-1]) / 100)
        return number(value)

    @field_validator("world_to_camera")
    @classmethod
    def _check_matrix(cls, text: str | None) -> str | None:
        try:
            if text is not None:
                parse_matrix(text)
        except CameraError as error:
            why = "; ".join(filter(None, (str(error), error.fix)))
            raise PydanticCustomError("matrix", "{why}", {"why": why}) from None
        return text

    @property
    def matrix(self) -> NDArray[np.float64] | None:
        """`world_to_camera` as (4, 4), for column vectors."""
        return None if self.world_to_camera is None else parse_matrix(self.world_to_camera)

    @property
    def views(self) -> list[str]:
        """The views that are asked for; none where it is left to the file."""
        names = [name.strip() for name in (self.view or "").split(",")]
        return list(dict.fromkeys(filter(None, names)))

    @property
    def orthographic(self) -> bool:
        """Whether a camera with parallel rays is asked for."""
        return self.projection == "orthographic" or self.ortho_width is not None

    @property
    def mapping(self) -> dict[str, str]:
        """`map` as attribute -> channel or layer."""
        return parse_mapping(self.map)

    def check(self, effects: Sequence[Effect]) -> None:
        """Raises Problem 422 for a setting that none of the effects has, or settings that don't go
        together, and ConfigError for a kind of depth without its planes."""
        for name, setting in SETTINGS.items():
            if getattr(self, name) is None or any(effect.takes(setting) for effect in effects):
                continue
            asked = " and ".join(f"'{effect.name}'" for effect in effects)
            having = [effect.name for effect in EFFECTS.values() if effect.takes(setting)]
            raise Problem(
                422,
                "bad-parameter",
                f"{asked} {'has' if len(effects) == 1 else 'have'} no setting '{name}'",
                fix=f"leave out ?{name}=; it is a setting of {', '.join(having)}",
                effects=having,
            )
        if len(self.views) > 1 and (self.append or self.multiply or self.format == "png"):
            name = "append" if self.append else "multiply" if self.multiply else "format"
            raise Problem(
                422,
                "bad-parameter",
                f"?{name}= is for one view, and several were asked for",
                fix=f"leave out ?{name}=, or ask for one ?view= at a time",
            )
        if len(self.views) > MAX_VIEWS:
            raise Problem(
                422,
                "bad-parameter",
                f"{len(self.views)} views are more than the {MAX_VIEWS} that one answer may hold",
                fix="ask for fewer at a time: ?view=left",
            )
        if self.ortho_width is not None and self.projection not in (None, "orthographic"):
            raise Problem(
                422,
                "bad-parameter",
                f"ortho_width is of an orthographic camera, not of a {self.projection} one",
                fix="leave out ?ortho_width= or ?projection=",
            )
        if self.fov is not None and self.orthographic:
            raise Problem(
                422,
                "bad-parameter",
                "an orthographic camera has no field of view",
                fix="leave out ?fov=; ?ortho_width= is the frame's width in scene units",
            )
        if self.strict and self.trust:
            raise Problem(
                422,
                "bad-parameter",
                "strict checks everything and trust nothing",
                fix="leave out ?strict= or ?trust=",
            )
        self.conventions  # noqa: B018 (raises)
        if self.format == "png" and len(effects) > 1:
            raise Problem(
                422,
                "bad-parameter",
                "a PNG holds one picture, and several effects were asked for",
                fix="leave out ?format=png for an EXR of their layers, or ask for one effect",
            )
