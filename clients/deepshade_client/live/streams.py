"""`Client.stream`: answers for pictures, as an iterator, for asyncio and without."""

from __future__ import annotations

import asyncio
import queue
import secrets
import threading
from collections.abc import AsyncGenerator, AsyncIterable, Iterable, Iterator
from contextlib import aclosing, suppress
from functools import partial
from pathlib import Path
from typing import Any

from deepshade_client.live.pictures import LiveAnswer, Picture, read_picture
from deepshade_client.live.publisher import Publisher
from deepshade_client.request import Effects, Options

Pictures = Iterable[Picture | Path | str]

_AHEAD = 4  # answers that wait for a loop that isn't asyncio's


async def stream(
    server: str,
    effects: Effects,
    pictures: Pictures | AsyncIterable[Picture | Path | str],
    options: Options | None = None,
    *,
    session: str | None = None,
    every: bool = True,
    **more: Any,
) -> AsyncGenerator[LiveAnswer, None]:
    """The answers for pictures. `more` are those of `Publisher`."""
    names = effects if isinstance(effects, str) else ",".join(effects)
    settings = settings_of(options)
    name = session or f"stream-{secrets.token_hex(4)}"
    publisher = Publisher(server, name, names, settings, every=every, **more)
    feeding = asyncio.ensure_future(_feed(publisher, pictures, options))
    try:
        async with aclosing(publisher.answers()) as answers:
            async for answer in answers:
                yield answer
        if feeding.done():
            feeding.result()
    finally:
        feeding.cancel()
        await asyncio.gather(feeding, return_exceptions=True)


def stream_sync(
    server: str, effects: Effects, pictures: Pictures, options: Options | None, **more: Any
) -> Iterator[LiveAnswer]:
    """The same without asyncio: an event loop in a thread, which ends with the iterator."""
    ready: queue.Queue[LiveAnswer | BaseException | None] = queue.Queue(_AHEAD)
    stopping = threading.Event()

    async def run() -> None:
        # closed here, while the loop runs: else its end may cut off the connection's
        async with aclosing(stream(server, effects, pictures, options, **more)) as answers:
            async for answer in answers:
                while not stopping.is_set():
                    with suppress(queue.Full):
                        ready.put_nowait(answer)
                        break
                    await asyncio.sleep(0.002)
                if stopping.is_set():
                    return

    def work() -> None:
        end: BaseException | None = None
        try:
            asyncio.run(run())
        except BaseException as error:
            end = error
        while not stopping.is_set():
            with suppress(queue.Full):
                ready.put(end, timeout=0.1)
                return

    thread = threading.Thread(target=work, name="deepshade-live", daemon=True)
    thread.start()
    try:
        while (found := ready.get()) is not None:
            if isinstance(found, BaseException):
                raise found
            yield found
    finally:
        stopping.set()
        thread.join()


def settings_of(options: Options | None) -> dict[str, Any]:
    """Options as the settings of a live frame."""
    settings: dict[str, Any] = {}
    for name, value in (options or Options()).query():
        if name in ("map", "axes", "derive"):
            settings.setdefault(name, []).append(value)
        else:
            settings[name] = value
    return settings


async def _feed(
    publisher: Publisher,
    pictures: Pictures | AsyncIterable[Picture | Path | str],
    options: Options | None,
) -> None:
    """Offer all pictures; files are read in threads, with the channels that are needed."""
    mapping = options.mapping if options else None
    profile = options.profile if options else None

    async def offer(each: Picture | Path | str) -> None:
        if not isinstance(each, Picture):
            file, needs = Path(each), await asyncio.shield(publisher.inputs)
            read = partial(read_picture, mapping=mapping, profile=profile, name=file.stem)
            each = await asyncio.to_thread(read, [file], needs)
        await publisher.offer(each)

    try:
        if isinstance(pictures, AsyncIterable):
            async for picture in pictures:
                await offer(picture)
        else:
            left = iter(pictures)
            while (found := await asyncio.to_thread(next, left, None)) is not None:
                await offer(found)
    finally:
        publisher.finish()
