"""The routes of kept uploads: send one, see what it holds, look at its layers."""

from __future__ import annotations

import io
from collections.abc import Sequence
from math import isfinite
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

from fastapi import FastAPI, Request, Response

from deepshade import exr
from deepshade.attributes import ATTRIBUTES
from deepshade.effects import EFFECTS
from deepshade.errors import DeepshadeError
from deepshade.gbuffer import channels as naming
from deepshade.gbuffer.channels import Layer
from deepshade.gbuffer.plan import Plan, plan_gbuffer
from deepshade_service import problems
from deepshade_service.described import errors
from deepshade_service.memory import bytes_to_read
from deepshade_service.models import Models
from deepshade_service.parameters import ShadeParameters
from deepshade_service.problems import Problem
from deepshade_service.uploads import FORM_TYPE, RAW_TYPES, Upload

if TYPE_CHECKING:
    from deepshade_service.app import Service

_ORDER = "rgbxyzuvwta"  # of a layer's components
_MOST = 4  # channels of a layer that are shown
_LONGEST = 200  # characters of a header's text that is repeated
_PREFIX = "reference_"
_KEPT = {
    400: "A damaged file",
    404: "No such upload or layer",
    410: "It is no longer kept: send it again",
    413: "Over a limit",
    422: "A file that can't be read as a picture",
    429: "The queue is full; see Retry-After",
}
_BINARY = {"type": "string", "format": "binary"}
_BODY = {
    "required": True,
    "content": {kind: {"schema": _BINARY} for kind in RAW_TYPES}
    | {FORM_TYPE: {"schema": {"type": "object", "additionalProperties": _BINARY}}},
}


def install(app: FastAPI, service: Service) -> None:
    """Add the routes to `app`."""
    kept, uploads, workers = service.kept, service.uploads, service.workers
    models, memory, limits = service.models, service.memory, service.settings.limits

    async def described(name: str, files: list[Upload]) -> dict[str, Any]:
        with workers.place():
            found = await workers.run(lambda _: describe(files, models, limits))
        return {"name": name, **found}

    @app.get(
        "/samples",
        tags=["uploads"],
        summary="Pictures to try everything with",
        responses=errors({}),
    )
    async def samples() -> list[str]:
        """Names for `?upload=` and `/uploads/{name}`."""
        return kept.samples

    @app.post(
        "/uploads",
        tags=["uploads"],
        summary="Keep a picture for a while",
        status_code=201,
        responses=errors({422: "A file that can't be read as a picture"}, uploads=True),
        openapi_extra={"requestBody": _BODY},
    )
    async def add(request: Request) -> dict[str, Any]:
        """The body is as that of `/shade`. The answer's `name` stands for it in `?upload=`, and the
        rest says what the picture holds. It is kept for some minutes after its last use, unless
        others need the room: then 410 says so, and it has to be sent again."""
        async with uploads.receive(request) as files:
            with workers.place():
                name = await workers.run(lambda _: kept.name(files))
            found = await described(name, files)
            kept.add(name, files)
        return found

    @app.get(
        "/uploads/{name}",
        tags=["uploads"],
        summary="What a kept picture holds",
        responses=errors(_KEPT),
    )
    async def one(name: str) -> dict[str, Any]:
        """Its layers in order, and what each effect lacks (nothing, if it can be shaded)."""
        with kept.use(name) as files:
            return await described(name, files)

    @app.get(
        "/uploads/{name}/layers/{index}",
        tags=["uploads"],
        summary="One layer's pixels",
        response_class=Response,
        responses=errors(_KEPT) | {200: {"content": {"image/x-exr": {"schema": _BINARY}}}},
    )
    async def layer(name: str, index: int) -> Response:
        """An uncompressed EXR of `Y`, or of `R G B A` as far as the layer has channels, in the
        order in which the picture's description names them; where the layer lies in the file."""
        with kept.use(name) as files, workers.place():
            headers = await workers.run(lambda _: _headers(files, limits))
            layers = _layers(headers, files)
            if not 0 <= index < len(layers):
                raise Problem(
                    404,
                    "no-layer",
                    f"the picture has no layer {index}",
                    fix=f"0 to {len(layers) - 1} are there",
                )
            file = layers[index].file
            header, channels = headers[file], _channels(layers[index], headers[file])
            async with memory.hold(bytes_to_read(header, len(channels), memory.total)):
                content = await workers.run(lambda _: _pixels(files[file], header, channels))
        return Response(content, media_type="image/x-exr", headers={"Cache-Control": "no-store"})


def describe(files: Sequence[Upload], models: Models, limits: exr.Limits) -> dict[str, Any]:
    """What the files of a view hold, by their headers, as plain JSON values.

    Keys: files, layers (name, file, channels, type, attribute, unit and reference where known,
    data_window), display_window, settings that the header holds, fov, profile, and effects: what
    each still `lacks` ("" if one of its bundles has all). Raises what `exr.read_header` and
    `plan_gbuffer` raise.
    """
    headers = _headers(files, limits)
    stems = [PurePath(file.name).stem for file in files]
    plan = plan_gbuffer(headers, stems, list(ATTRIBUTES))
    known = {(c.file, frozenset(c.channels)): name for name, c in plan.choices.items()}
    first = headers[0].parts[0]
    return {
        "files": [{"name": file.filename or file.field, "bytes": len(file.data)} for file in files],
        "display_window": list(first.display_window),
        "profile": plan.profile.name if plan.profile else None,
        "fov": plan.camera.fov if plan.camera else None,
        "settings": {
            key.removeprefix("deepshade:"): value
            for key, value in plan.attributes.items()
            if key.startswith("deepshade:") and _plain(value)
        },
        "layers": [_layer(layer, headers[layer.file], known) for layer in _layers(headers, files)],
        "effects": {
            name: {"lacks": _lacks(plan, [b.inputs for b in models.bundles(name)])}
            for name in EFFECTS
        },
    }


def _plain(value: object) -> bool:
    """Whether JSON can hold it, and a page show it."""
    if isinstance(value, str):
        return len(value) <= _LONGEST
    return isinstance(value, int | float) and isfinite(value)


def _headers(files: Sequence[Upload], limits: exr.Limits) -> list[exr.Header]:
    return [exr.read_header(file.data, limits) for file in files]


def _layers(headers: Sequence[exr.Header], files: Sequence[Upload]) -> list[Layer]:
    """Those of which something can be shown."""
    stems = [PurePath(file.name).stem for file in files]
    found = naming.layers(headers, stems)
    return [layer for layer in found if _channels(layer, headers[layer.file])]


def _channels(layer: Layer, header: exr.Header) -> list[str]:
    """Its channels in order, those of one size, as `Header.channels` calls them."""
    places = header.channels()
    components = sorted(layer.components, key=lambda c: (_ORDER + c).index(c))
    names = [name for component in components for name in layer.components[component]]
    whole = [n for n in names if places[n][1] not in header.parts[places[n][0]].subsampled]
    return [n for n in whole if places[n][0] == places[whole[0]][0]][:_MOST]


def _layer(
    layer: Layer, header: exr.Header, known: dict[tuple[int, frozenset[str]], str]
) -> dict[str, Any]:
    channels, places = _channels(layer, header), header.channels()
    part = header.parts[places[channels[0]][0]]
    attribute = known.get((layer.file, frozenset(layer.channels)))
    effect = layer.name.removeprefix(_PREFIX)
    return {
        "name": layer.name or ", ".join(channels),
        "file": layer.file,
        "channels": channels,
        "type": "half" if {part.channels[places[n][1]] for n in channels} == {"half"} else "float",
        "data_window": list(part.data_window),
        "attribute": attribute,
        "unit": ATTRIBUTES[attribute].unit.name if attribute in ATTRIBUTES else None,
        "reference": effect if layer.name.startswith(_PREFIX) and effect in EFFECTS else None,
    }


def _lacks(plan: Plan, bundles: Sequence[Sequence[str]]) -> str:
    """Why no bundle can have its inputs, and what to do; "" if one can."""
    why = "there is no bundle of it here"
    for inputs in bundles:
        try:
            plan.require(inputs)
        except DeepshadeError as error:
            problem = problems.from_error(error, ShadeParameters.model_fields)
            why = "; ".join(filter(None, (problem.detail, problem.more.get("fix"))))
        else:
            return ""
    return why


def _pixels(file: Upload, header: exr.Header, channels: Sequence[str]) -> bytes:
    image = exr.read(file.data, channels, header=header)
    names = "Y" if len(channels) == 1 else "RGBA"
    places = header.channels()
    part = header.parts[places[channels[0]][0]]
    stream = io.BytesIO()
    exr.write(
        stream,
        {name: image.pixels[c] for name, c in zip(names, channels, strict=False)},
        compression="none",
        half={
            name
            for name, c in zip(names, channels, strict=False)
            if part.channels[places[c][1]] == "half"
        },
        data_window=part.data_window,
        display_window=part.display_window,
    )
    return stream.getvalue()
