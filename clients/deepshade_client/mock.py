"""A service in miniature, for tests of code that uses the client: no network, no models."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
from numpy.typing import ArrayLike

from deepshade import exr
from deepshade.effects import EFFECTS
from deepshade.errors import DeepshadeError, LimitError, MissingAttributeError
from deepshade.gbuffer import GBuffer, load_gbuffer

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
        mapping = dict(entry.split("=", 1) for entry in query.get_list("map"))
        try:
            gbuffer = load_gbuffer(
                _files(request),
                EFFECTS[effect].inputs,
                profile=query.get("profile"),
                mapping=mapping,
                fov=float(query["fov"]) if "fov" in query else None,
            )
        except MissingAttributeError as error:
            facts = {"missing": error.missing, "found": error.found, "near": error.near}
            return _problem(422, "missing-attribute", str(error), fix=error.fix, **facts)
        except LimitError as error:
            return _problem(413, "over-limit", str(error), fix=error.fix)
        except DeepshadeError as error:
            return _problem(400, "unusable-input", str(error), fix=error.fix)
        shade = np.asarray(self._shade(gbuffer), np.float32)
        planes = shade.reshape(-1, *shade.shape[-2:])
        stream = io.BytesIO()
        exr.write(stream, dict(zip(EFFECTS[effect].outputs, planes, strict=True)))
        headers = {
            "Content-Type": "image/x-exr",
            "Server-Timing": "decode;dur=0, plan;dur=0, infer;dur=0, encode;dur=0",
            "Deepshade-Effect": effect,
            "Deepshade-Bundle": "mock",
            "Deepshade-Radius": query.get("radius", "1"),
            "Deepshade-Background-Pixels": str(int(gbuffer.background.sum())),
            "Deepshade-Nonfinite-Pixels": str(gbuffer.nonfinite),
        }
        return httpx.Response(200, content=stream.getvalue(), headers=headers)


def _files(request: httpx.Request) -> list[tuple[str, bytes]]:
    """The request's EXR files: its body, or those of its form."""
    boundary = re.search(r"boundary=(\S+)", request.headers.get("content-type", ""))
    if boundary is None:
        return [("", request.content)]
    files = []
    for piece in request.content.split(b"--" + boundary[1].encode())[1:-1]:
        head, _, data = piece.partition(b"\r\n\r\n")
        filename = re.search(rb'filename="([^"]*)"', head)
        files.append((filename[1].decode() if filename else "", data.removesuffix(b"\r\n")))
    return files


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
    document = {"type": f"urn:deepshade:problem:{kind}", "status": status, "detail": detail}
    return httpx.Response(
        status, json=document | more, headers={"Content-Type": "application/problem+json"}
    )
