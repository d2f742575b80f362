"""A service in miniature, for tests of code that uses the client: no network, no models."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
from numpy.typing import ArrayLike

from deepshade import exr
from deepshade.effects import EFFECTS
from deepshade.errors import ConfigError, DeepshadeError
from deepshade.gbuffer import GBuffer, load_gbuffer, source_name
from deepshade.gbuffer.channels import parse_mapping
from deepshade.problems import MEDIA_TYPE, facts_of, kind_of, type_uri

Shade = Callable[[GBuffer], ArrayLike]


class MockTransport(httpx.BaseTransport, httpx.AsyncBaseTransport):
    """Shades in this process with `shade(gbuffer)`, which returns (H, W) or (C, H, W).

    Give it to `Client` or `AsyncClient` as `transport`. `requests` keeps what was asked.
    """

    def __init__(self, shade: Shade) -> None:
        self._shade = shade
        self.requests: list[httpx.Request] = []

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """Answer a request of the blocking client."""
        request.read()
        return self._answer(request)

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        """Answer a request of the asyncio client."""
        await request.aread()
        return self._answer(request)

    def _answer(self, request: httpx.Request) -> httpx.Response:
        self.requests.append(request)
        path = request.url.path.strip("/").split("/")
        effect = EFFECTS.get(path[-1])
        match request.method, path[-2:]:
            case "GET", [*_, "readyz"]:
                return httpx.Response(200, json={"status": "ready", "bundles": ["mock"]})
            case "GET", [*_, "effects"]:
                return httpx.Response(200, json=[_described(name) for name in EFFECTS])
            case "GET", ["effects", name] if effect:
                return httpx.Response(200, json=_described(name))
            case "POST", ["shade", name] if effect:
                return self._shaded(name, request)
        return _problem(404, "not-found", f"there is no {request.url.path}")

    def _shaded(self, effect: str, request: httpx.Request) -> httpx.Response:
        query = request.url.params
        try:
            gbuffer = load_gbuffer(
                _files(request),
                EFFECTS[effect].inputs,
                profile=query.get("profile"),
                mapping=parse_mapping(query.get_list("map")),
                fov=_number(query, "fov", below=180.0),
            )
            radius = _number(query, "radius") or 1.0
        except DeepshadeError as error:
            status, kind = kind_of(error)
            return _problem(status, kind, str(error), fix=error.fix, **facts_of(error))
        if query.get("explain") in ("true", "1"):
            return httpx.Response(200, json=_plan(effect, gbuffer, radius))
        shade = np.asarray(self._shade(gbuffer), np.float32)
        planes = shade.reshape(-1, *shade.shape[-2:])
        if query.get("format") == "png":
            from deepshade import pictures

            content, kind = pictures.png(pictures.of_effect(planes, EFFECTS[effect])), "image/png"
        else:
            stream = io.BytesIO()
            exr.write(stream, dict(zip(EFFECTS[effect].outputs, planes, strict=True)))
            content, kind = stream.getvalue(), "image/x-exr"
        headers = {
            "Content-Type": kind,
            "Server-Timing": "decode;dur=0, plan;dur=0, infer;dur=0, encode;dur=0",
            "Deepshade-Effect": effect,
            "Deepshade-Bundle": "mock",
            "Deepshade-Radius": f"{radius:g}",
            "Deepshade-Background-Pixels": str(int(gbuffer.background.sum())),
            "Deepshade-Nonfinite-Pixels": str(gbuffer.nonfinite),
        }
        return httpx.Response(200, content=content, headers=headers)


def _files(request: httpx.Request) -> list[tuple[str, bytes]]:
    """The request's EXR files: its body, or those of its form."""
    boundary = re.search(r"boundary=(\S+)", request.headers.get("content-type", ""))
    if boundary is None:
        return [("", request.content)]
    files = []
    for piece in request.content.split(b"--" + boundary[1].encode())[1:-1]:
        head, _, data = piece.partition(b"\r\n\r\n")
        field = re.search(rb'\bname="([^"]*)"', head)
        filename = re.search(rb'filename="([^"]*)"', head)
        name = source_name(*(found[1].decode() if found else "" for found in (field, filename)))
        files.append((name, data.removesuffix(b"\r\n")))
    return files


def _number(query: httpx.QueryParams, name: str, below: float = math.inf) -> float | None:
    """A positive parameter below a bound; ConfigError for another."""
    if name not in query:
        return None
    try:
        value = float(query[name])
    except ValueError:
        value = math.nan
    if not 0 < value < below:
        raise ConfigError(name, detail=f"query.{name}: '{query[name]:.100}' is out of range")
    return value


def _plan(effect: str, gbuffer: GBuffer, radius: float) -> dict[str, Any]:
    height, width = gbuffer.shape
    background = int(gbuffer.background.sum())
    pixels = {"width": width, "height": height, "all": width * height, "background": background}
    return {
        "effect": effect,
        "reason": "it is the only one",
        "bundle": "mock",
        "radius": radius,
        "pixels": pixels | {"computed": width * height, "share": 1.0, "tiles": 1},
    }


def _described(name: str) -> dict[str, Any]:
    effect = EFFECTS[name]
    return {
        "name": name,
        "title": effect.title,
        "inputs": [{"attribute": attribute} for attribute in effect.inputs],
        "outputs": effect.outputs,
        "bundles": [{"name": "mock", "radius": 1.0}],
    }


def _problem(status: int, kind: str, detail: str, **more: Any) -> httpx.Response:
    document = {"type": type_uri(kind), "status": status, "detail": detail}
    return httpx.Response(status, json=document | more, headers={"Content-Type": MEDIA_TYPE})
