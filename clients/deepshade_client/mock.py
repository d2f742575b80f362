"""A transport without a network, for tests of code that uses the client."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping

import httpx
from numpy.typing import ArrayLike

from deepshade import exr


class MockTransport(httpx.MockTransport):
    """Gives each request to `handler(request)`, which returns the response or raises.

    For `Client` and `AsyncClient`, as their `transport`. `requests` keeps what was asked. A
    handler makes pictures with `mock_answer`, the rest with `httpx.Response`:

        def handler(request):
            if request.url.path == "/shade/ao":
                return mock_answer({"Y": np.ones((4, 6))}, radius=2)
            return httpx.Response(404, json={"detail": "not here"})
    """

    def __init__(self, handler: Callable[[httpx.Request], httpx.Response]) -> None:
        self.requests: list[httpx.Request] = []

        def record(request: httpx.Request) -> httpx.Response:
            self.requests.append(request)
            return handler(request)

        super().__init__(record)


def mock_answer(channels: Mapping[str, ArrayLike], **facts: object) -> httpx.Response:
    """The response of a service that shaded a picture: an EXR of (H, W) `channels`.

    `facts` become its headers, as in `Answer.facts`: radius=2, radius_source="request". Those of
    several effects are mappings by name: mock_answer({"ao.Y": …, "gi.R": …, …},
    ao={"bundle": "best"}, gi={"bundle": "fast"}).
    """
    stream = io.BytesIO()
    exr.write(stream, channels)
    several = [name for name, fact in facts.items() if isinstance(fact, Mapping)]
    if several:
        facts = {"effects": ",".join(several)} | facts
    headers = {
        f"Deepshade-{name.replace('_', '-')}": json.dumps(fact) if name in several else str(fact)
        for name, fact in facts.items()
    }
    headers["Content-Type"] = "image/x-exr"
    return httpx.Response(200, content=stream.getvalue(), headers=headers)
