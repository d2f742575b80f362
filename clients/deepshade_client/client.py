"""The client, once blocking and once for asyncio."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterable, AsyncIterator, Awaitable, Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar

import httpx

from deepshade.files import replacing
from deepshade.tracing import carried, span
from deepshade_client.answer import Answer, Saved
from deepshade_client.exceptions import ClientError
from deepshade_client.request import (
    Effects,
    Options,
    Picture,
    base_url,
    environment_request,
    get_request,
    read_answer,
    read_list,
    read_object,
    read_saved,
    shade_request,
    transport_error,
)
from deepshade_client.settings import Retry, Timeout, default_server

if TYPE_CHECKING:
    from deepshade_client.live.pictures import LiveAnswer
    from deepshade_client.live.pictures import Picture as LivePicture

T = TypeVar("T")
Waiting = Callable[[ClientError, float], None]


def _carry(request: httpx.Request) -> None:
    request.headers.update(carried())


async def _carry_too(request: httpx.Request) -> None:
    _carry(request)


class Client:
    """Talks to one service; may be shared by threads. Use it as a context manager, or `close` it.

    `server` defaults to $DEEPSHADE_SERVER, else http://127.0.0.1:8000. `transport` replaces the
    network (see `MockTransport`). A number as `timeout` is the seconds until the answer. `waiting`
    hears of an error, and of the seconds until the next attempt, each time that one follows. Every
    method raises ClientError.
    """

    def __init__(
        self,
        server: str | None = None,
        *,
        timeout: Timeout | float | None = None,
        retry: Retry | None = None,
        transport: httpx.BaseTransport | None = None,
        waiting: Waiting | None = None,
    ) -> None:
        self.server = (server or default_server()).rstrip("/")
        self._retry = retry or Retry()
        self._waiting = waiting or (lambda error, seconds: None)
        self._http = httpx.Client(
            base_url=base_url(self.server),
            timeout=Timeout.of(timeout).as_httpx(),
            transport=transport,
            event_hooks={"request": [_carry]},
        )

    def shade(self, effect: Effects, picture: Picture, options: Options | None = None) -> Answer:
        """Shade a picture: a file, its bytes, several files of one view, or attribute -> file.

        Several effects ("ao,gi" or a list) are one request and one answer: see `Answer.arrays`.
        Also raises OSError for a file that can't be read.
        """
        return self._ask(shade_request(effect, picture, options), read_answer)

    def shade_to(
        self, path: Path | str, effect: Effects, picture: Picture, options: Options | None = None
    ) -> Saved:
        """Like `shade`, but the answer goes to a file as it arrives, and memory holds none of it.

        Missing folders are made; a file there is replaced only when all is written.
        """
        request = shade_request(effect, picture, options)
        return self._try(lambda: self._save(Path(path), request))

    def explain(
        self, effect: Effects, picture: Picture, options: Options | None = None
    ) -> dict[str, Any]:
        """How the service would shade a picture, and why: its plan, without shading it.

        For several effects a plan for each, by its name.
        Which bundle on which engine, what of the picture would be computed, which channels are
        read; docs/service.md has an example. Also raises OSError for a file that can't be read.
        """
        return self._ask(shade_request(effect, picture, options, explain=True), read_object)

    def stream(
        self,
        effect: Effects,
        pictures: Iterable[LivePicture | Path | str],
        options: Options | None = None,
        **more: Any,
    ) -> Iterator[LiveAnswer]:
        """Answers for pictures as they come, over one connection, each stage at work all the time.

        A picture is an EXR file, or a `live.Picture` of arrays. `more`: a `session` that others
        can watch; `every=False`, the newest picture wins; `half`, `fps`, `history`, `token` and
        what else `live.Publisher` takes. A link that breaks is mended. docs/streaming.md.
        """
        from deepshade_client.live.streams import stream_sync

        return stream_sync(self.server, effect, pictures, options, **more)

    def effects(self) -> list[dict[str, Any]]:
        """Every effect: name, title, inputs, outputs, settings with ranges, and its bundles."""
        return self._ask(get_request("effects"), read_list)

    def effect(self, name: str) -> dict[str, Any]:
        """One effect, as in `effects`."""
        return self._ask(get_request("effects", name), read_object)

    def environments(self) -> list[dict[str, Any]]:
        """Every environment map: name, source, and its hash and size once it has been used."""
        return self._ask(get_request("environments"), read_list)

    def add_environment(self, name: str, source: Path | str | bytes) -> dict[str, Any]:
        """Add a map (EXR or HDR, latitude-longitude), or replace the one of that name.

        Also raises OSError for a file that can't be read.
        """
        return self._ask(environment_request(name, source), read_object)

    def wait_until_ready(self) -> dict[str, Any]:
        """Returns once the service's models are loaded, within what `Retry` allows."""
        return self._ask(get_request("readyz"), read_object)

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _ask(self, request: dict[str, Any], read: Callable[[httpx.Response], T]) -> T:
        def ask() -> T:
            with _released(self._http.request(**request)) as response:
                return read(response)

        with span("ask", kind="CLIENT"):
            return self._try(ask)

    def _save(self, path: Path, request: dict[str, Any]) -> Saved:
        response = self._http.send(self._http.build_request(**request), stream=True)
        with _released(response), contextlib.closing(response):
            if not response.is_success:
                response.read()
            saved = read_saved(response, path)
            path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(path) as temporary, temporary.open("wb") as file:
                for chunk in response.iter_bytes():
                    file.write(chunk)
            return saved

    def _try(self, ask: Callable[[], T]) -> T:
        attempt = 0
        while True:
            attempt += 1
            try:
                try:
                    return ask()
                except httpx.HTTPError as error:
                    raise transport_error(error, self.server) from error
            except ClientError as error:
                pause = self._retry.pause(error, attempt)
                if pause is None:
                    raise
                self._waiting(error, pause)
            time.sleep(pause)


class AsyncClient:
    """`Client` for asyncio."""

    def __init__(
        self,
        server: str | None = None,
        *,
        timeout: Timeout | float | None = None,
        retry: Retry | None = None,
        transport: httpx.AsyncBaseTransport | None = None,
        waiting: Waiting | None = None,
    ) -> None:
        self.server = (server or default_server()).rstrip("/")
        self._retry = retry or Retry()
        self._waiting = waiting or (lambda error, seconds: None)
        self._http = httpx.AsyncClient(
            base_url=base_url(self.server),
            timeout=Timeout.of(timeout).as_httpx(),
            transport=transport,
            event_hooks={"request": [_carry_too]},
        )

    async def shade(
        self, effect: Effects, picture: Picture, options: Options | None = None
    ) -> Answer:
        """Like `Client.shade`; files are read in a thread."""
        request = await asyncio.to_thread(shade_request, effect, picture, options)
        return await self._ask(request, read_answer)

    async def shade_to(
        self, path: Path | str, effect: Effects, picture: Picture, options: Options | None = None
    ) -> Saved:
        """Like `Client.shade_to`; files are read and written in threads."""
        request = await asyncio.to_thread(shade_request, effect, picture, options)
        return await self._try(lambda: self._save(Path(path), request))

    async def explain(
        self, effect: Effects, picture: Picture, options: Options | None = None
    ) -> dict[str, Any]:
        """Like `Client.explain`; files are read in a thread."""
        request = await asyncio.to_thread(shade_request, effect, picture, options, explain=True)
        return await self._ask(request, read_object)

    def stream(
        self,
        effect: Effects,
        pictures: Iterable[LivePicture | Path | str] | AsyncIterable[LivePicture | Path | str],
        options: Options | None = None,
        **more: Any,
    ) -> AsyncIterator[LiveAnswer]:
        """Like `Client.stream`; `pictures` may be asynchronous."""
        from deepshade_client.live.streams import stream

        return stream(self.server, effect, pictures, options, **more)

    async def effects(self) -> list[dict[str, Any]]:
        """Like `Client.effects`."""
        return await self._ask(get_request("effects"), read_list)

    async def effect(self, name: str) -> dict[str, Any]:
        """Like `Client.effect`."""
        return await self._ask(get_request("effects", name), read_object)

    async def environments(self) -> list[dict[str, Any]]:
        """Like `Client.environments`."""
        return await self._ask(get_request("environments"), read_list)

    async def add_environment(self, name: str, source: Path | str | bytes) -> dict[str, Any]:
        """Like `Client.add_environment`; the file is read in a thread."""
        request = await asyncio.to_thread(environment_request, name, source)
        return await self._ask(request, read_object)

    async def wait_until_ready(self) -> dict[str, Any]:
        """Like `Client.wait_until_ready`."""
        return await self._ask(get_request("readyz"), read_object)

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *error: object) -> None:
        await self.close()

    async def _ask(self, request: dict[str, Any], read: Callable[[httpx.Response], T]) -> T:
        async def ask() -> T:
            with _released(await self._http.request(**request)) as response:
                return read(response)

        with span("ask", kind="CLIENT"):
            return await self._try(ask)

    async def _save(self, path: Path, request: dict[str, Any]) -> Saved:
        response = await self._http.send(self._http.build_request(**request), stream=True)
        with _released(response):
            async with contextlib.aclosing(response):
                if not response.is_success:
                    await response.aread()
                saved = read_saved(response, path)
                await asyncio.to_thread(path.parent.mkdir, parents=True, exist_ok=True)
                async with _in_threads(replacing(path)) as temporary:
                    with temporary.open("wb") as file:
                        async for chunk in response.aiter_bytes():
                            await asyncio.to_thread(file.write, chunk)
                return saved

    async def _try(self, ask: Callable[[], Awaitable[T]]) -> T:
        attempt = 0
        while True:
            attempt += 1
            try:
                try:
                    return await ask()
                except httpx.HTTPError as error:
                    raise transport_error(error, self.server) from error
            except ClientError as error:
                pause = self._retry.pause(error, attempt)
                if pause is None:
                    raise
                self._waiting(error, pause)
            await asyncio.sleep(pause)


@contextlib.contextmanager
def _released(response: httpx.Response) -> Iterator[httpx.Response]:
    """A context that ends with breaking httpx's cycle of a response and its stream.

    Else the request's picture and the answer stay in memory until a garbage collection.
    """
    try:
        yield response
    finally:
        response.stream = httpx.ByteStream(b"")


@contextlib.asynccontextmanager
async def _in_threads(manager: contextlib.AbstractContextManager[T]) -> AsyncIterator[T]:
    """A context whose beginning and good end wait for the disk; a bad end only cleans up."""
    value = await asyncio.to_thread(manager.__enter__)
    try:
        yield value
    except BaseException as error:
        manager.__exit__(type(error), error, error.__traceback__)
        raise
    await asyncio.to_thread(manager.__exit__, None, None, None)
