"""Publishes pictures to a live session, and gives their answers; comes back when a link breaks."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncGenerator, Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import quote, urlsplit

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import (
    ConnectionClosed,
    InvalidHandshake,
    InvalidMessage,
    InvalidStatus,
)
from websockets.typing import Subprotocol

from deepshade import exr, live
from deepshade.errors import ImageError
from deepshade_client.exceptions import (
    BadAnswer,
    ClientError,
    ConnectionFailed,
    ServerProblem,
    problem,
)
from deepshade_client.live.link import Link
from deepshade_client.live.pace import Pace
from deepshade_client.live.pictures import LiveAnswer, Picture

PROTOCOL = "deepshade.live.1"
_FIRST, _LONGEST = 0.1, 1.0  # seconds between attempts
_REST = 0.2  # seconds without a new picture, after which it is sent whole
_IN_VAIN = {401, 403, 404, 409, 413, 421, 422}
_OUT = 4  # answers that may wait for who takes them, where each is wanted
_MEASURE_FIRST, _MEASURE_EVERY = 8, 8  # frames whose way is timed


@dataclass(frozen=True, slots=True)
class Event:
    """What happened beside answers: "open", "lost", "back", "status"; `text` in words."""

    kind: str
    text: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict)


class Publisher:
    """One stream. `every` answers each picture; else the newest wins, and lag never builds up.

    `answers` and `codec` name codecs; None chooses by how fast the link is. `fps` shades smaller
    pictures where that rate can't be held, and the whole one when it rests. It comes back by
    itself for `patience` seconds.
    """

    def __init__(
        self,
        server: str,
        session: str,
        effects: str,
        settings: Mapping[str, Any] | None = None,
        *,
        every: bool = False,
        half: bool = True,
        answers: str | None = None,
        codec: str | None = None,
        fps: float | None = None,
        history: bool = False,
        token: str | None = None,
        patience: float = 60.0,
        heard: Callable[[Event], None] | None = None,
    ) -> None:
        parts = urlsplit(server)
        scheme = {"http": "ws", "https": "wss"}.get(parts.scheme)
        if scheme is None or not parts.netloc:
            raise ClientError(
                f"'{server}' is no address of a service", fix="write it like http://127.0.0.1:8000"
            )
        path = f"{parts.path.rstrip('/')}/live/{quote(session, safe='')}/publish"
        self._url = f"{scheme}://{parts.netloc}{path}"
        self._local = parts.hostname in ("127.0.0.1", "localhost", "::1")
        self._server, self.session = server, session
        self._hello = {
            "type": "hello",
            "protocol": 1,
            "effects": effects,
            "settings": dict(settings or {}),
            "half": half,
            "every": every,
            "history": history,
        }
        self._every, self._wanted, self._codec = every, answers, codec
        self._token, self._patience, self._heard = token, patience, heard or (lambda event: None)
        self._pace = Pace(fps) if fps else None
        self._ids = 0
        self._pending: Picture | None = None
        self._arrived = asyncio.Event()
        self._taken = asyncio.Event()
        self._under_way: dict[int, tuple[Picture, int, int, float]] = {}
        self._again: list[Picture] = []
        self._sending: Picture | None = None  # taken, and not yet on its way
        self._last: tuple[Picture, bool] | None = None  # sent last, and whether it was whole
        self._finished = False
        self._credit = asyncio.Event()
        self._out: asyncio.Queue[LiveAnswer] = asyncio.Queue(_OUT)
        self._plans: Mapping[str, Any] = {}
        self._link: Link | None = None
        self._round_trip = float("inf")
        self._link_seconds = 0.0
        self.inputs: asyncio.Future[list[str]] = asyncio.get_running_loop().create_future()
        self.overwritten = 0

    async def offer(self, picture: Picture) -> None:
        """Send this next; with `every` it waits until the one before is on its way."""
        while self._every and self._pending is not None:
            self._taken.clear()
            await self._taken.wait()
        self.overwritten += self._pending is not None
        self._pending = picture
        self._arrived.set()

    def finish(self) -> None:
        """No picture follows; `run` ends when the last is answered."""
        self._finished = True
        self._arrived.set()

    async def answers(self) -> AsyncGenerator[LiveAnswer, None]:
        """All answers as they come, until everything is answered. Raises ClientError."""
        running = asyncio.ensure_future(self.run())
        try:
            while True:
                answer = asyncio.ensure_future(self._out.get())
                await asyncio.wait({running, answer}, return_when=asyncio.FIRST_COMPLETED)
                if answer.done():
                    yield answer.result()
                    continue
                answer.cancel()
                while not self._out.empty():
                    yield self._out.get_nowait()
                running.result()
                return
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)

    async def run(self) -> None:
        """Publish until everything is answered. Raises ClientError when that can't be."""
        resume: str | None = None
        lost_at: float | None = None
        pause = _FIRST
        while True:
            try:
                async with self._connected() as socket:
                    welcome = await self._welcomed(socket, resume)
                    resume = welcome["resume"]
                    if lost_at is not None:
                        away = time.monotonic() - lost_at
                        self._heard(Event("back", f"back after {away:.1f} s", {"seconds": away}))
                    else:
                        self._heard(Event("open", f"publishing to {self._url}", welcome))
                    lost_at, pause = None, _FIRST
                    if await self._speak(socket):
                        return
                raise ConnectionFailed("the service closed the connection")
            except (OSError, ConnectionClosed, InvalidHandshake, InvalidMessage) as error:
                refused = _refusal(error)
                if refused is not None:
                    raise refused from None
                reason = str(error) or type(error).__name__
            except ConnectionFailed as error:
                reason = str(error)
            except ServerProblem as error:
                if error.status in _IN_VAIN:
                    raise
                reason = str(error)
            if lost_at is None:
                lost_at = time.monotonic()
                self._heard(Event("lost", f"lost {self._server}: {reason}; trying again"))
                self._recall()
            if time.monotonic() - lost_at > self._patience:
                raise ConnectionFailed(
                    f"{self._server} can't be reached for {self._patience:g} s: {reason}"
                )
            await asyncio.sleep(pause)
            pause = min(2 * pause, _LONGEST)

    def _connected(self) -> connect:
        headers = {"Authorization": f"Bearer {self._token}"} if self._token else {}
        more: dict[str, Any] = {"proxy": None} if self._local else {}
        return connect(
            self._url,
            subprotocols=[Subprotocol(PROTOCOL)],
            additional_headers=headers,
            compression=None,
            max_size=2**28,
            open_timeout=5,
            close_timeout=1,
            ping_interval=4,
            ping_timeout=8,
            **more,
        )

    async def _welcomed(self, socket: ClientConnection, resume: str | None) -> dict[str, Any]:
        hello = self._hello | {"resume": resume, "answers": self._wanted or "deflate"}
        if self._wanted is None and "lz4" in live.available():
            hello["answers"] = "lz4"
        await socket.send(json.dumps(hello))
        async for message in socket:
            said = _read(message)
            if said.get("type") == "problem":
                raise problem(said["problem"]["status"], said["problem"], None)
            if said.get("type") == "welcome":
                if self._link is None:
                    self._link = Link(said["codecs"], self._codec)
                if not self.inputs.done():
                    names = (name for each in said["inputs"].values() for name in each)
                    self.inputs.set_result(list(dict.fromkeys(names)))
                self._most = int(said["limits"]["frame_bytes"])
                return said
        raise ConnectionFailed("the service said no welcome")

    async def _speak(self, socket: ClientConnection) -> bool:
        """Send and receive until all is answered (True) or the connection ends."""
        self._credit.clear()
        tasks = [
            asyncio.ensure_future(self._receive(socket)),
            asyncio.ensure_future(self._send(socket)),
        ]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
            return tasks[1].done()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _send(self, socket: ClientConnection) -> None:
        """Send what is offered until it is finished and answered."""
        while True:
            taken = await self._next()
            if taken is None:
                if self._finished and not self._under_way:
                    await socket.send('{"type":"end"}')
                    return
                continue
            picture, whole = taken
            while True:
                self._sending = picture
                packed = await asyncio.to_thread(self._packed, picture, whole)
                if not await self._newer():
                    break
                picture, whole = self._take(), False
            id, message, step, pixels = packed
            self._credit.clear()
            now = time.time()
            live.stamp(message, time=picture.made or now, sent=now)
            self._under_way[id] = picture, len(message), pixels, picture.made or now
            self._last, self._sending = (picture, step == 1), None
            began = time.monotonic()
            await socket.send(message)
            if id <= _MEASURE_FIRST or id % _MEASURE_EVERY == 0:
                asyncio.get_running_loop().create_task(self._measure(socket, len(message), began))

    async def _newer(self) -> bool:
        """Waits until the service wants a frame: False; or a newer picture has come: True.

        So what is packed while a link carries the frame before is at most one packing old.
        """
        if self._every:
            await self._credit.wait()
        while not self._credit.is_set() and self._pending is None:
            self._arrived.clear()
            events = [asyncio.ensure_future(e.wait()) for e in (self._credit, self._arrived)]
            try:
                await asyncio.wait(events, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for event in events:
                    event.cancel()
        return not self._credit.is_set()

    async def _next(self) -> tuple[Picture, bool] | None:
        """(what is sent next, whether it has to be whole); None where there is nothing now."""
        if self._again:
            return self._again.pop(0), False
        if self._pending is None:
            self._arrived.clear()
            if self._finished and not self._under_way and self._rested():
                return None
            wait = None if self._rested() else _REST
            if self._finished and self._under_way:
                wait = 0.02 if wait is None else min(wait, 0.02)
            with suppress(TimeoutError):
                async with asyncio.timeout(wait):
                    await self._arrived.wait()
            if self._pending is None:
                if self._rested() or self._last is None or self._under_way:
                    return None
                return self._last[0], True
        return self._take(), False

    def _rested(self) -> bool:
        """Whether the picture that was sent last needn't be sent whole."""
        return self._last is None or self._last[1]

    def _take(self) -> Picture:
        picture, self._pending = self._pending, None
        assert picture is not None, "it is there"
        self._taken.set()
        return picture

    def _packed(self, picture: Picture, whole: bool) -> tuple[int, bytearray, int, int]:
        """(id, message, step, pixels), in a thread; times are stamped on it when it is sent.

        A picture that doesn't say when it was made, as those of a file, was so when it is sent.
        Raises ClientError.
        """
        assert self._link is not None, "it was welcomed"
        width, height = picture.size
        step = 1 if whole or self._pace is None else self._pace.choose(width * height)
        small = picture.smaller(step)
        self._ids += 1
        size = sum(plane.nbytes for plane in small.planes.values())
        if self._ids == 1 and self._codec is None:
            self._link.learn(small.planes.values())
        codec = self._link.choose(size)
        about = small.about() | ({"full": [width, height]} if step > 1 else {})
        flags = (live.CUT if picture.cut else 0) | (live.REST if whole else 0)
        message = live.pack(
            live.GBUFFER,
            self._ids,
            small.planes,
            about,
            codec=codec,
            time=0.0,
            sent=0.0,
            flags=flags,
        )
        self._link.packed(codec, size, len(message))
        if len(message) > self._most:
            raise ClientError(
                f"{picture.name or 'a picture'} is {len(message):,} bytes as a frame, and the"
                f" service takes {self._most:,}",
                fix="send a smaller picture, or start the service with a higher --live-frame",
            )
        return self._ids, message, step, width * height // step**2

    async def _measure(self, socket: ClientConnection, size: int, began: float) -> None:
        """How long the link took for a frame: until a ping behind it has come back."""
        with suppress(ConnectionClosed):
            await (await socket.ping())
            took = time.monotonic() - began
            start = time.monotonic()
            await (await socket.ping())
            self._round_trip = min(self._round_trip, time.monotonic() - start)
            assert self._link is not None, "a frame was sent"
            self._link_seconds = max(took - self._round_trip, 1e-5)
            self._link.sent(size, self._link_seconds)

    async def _receive(self, socket: ClientConnection) -> None:
        async for message in socket:
            if isinstance(message, bytes):
                await self._answered(message)
                continue
            said = _read(message)
            match said.get("type"):
                case "next":
                    self._credit.set()
                case "ping":
                    pong = {"type": "pong", "t": said.get("t"), "clock": time.time()}
                    await socket.send(json.dumps(pong))
                case "status":
                    self._heard(Event("status", facts=said))
                case "about":
                    self._plans = said.get("effects", {})
                case "problem" if "id" in said:
                    await self._failed(said)
                case "problem":
                    raise problem(said["problem"]["status"], said["problem"], None)
        raise ConnectionFailed("the service closed the connection")

    async def _answered(self, message: bytes) -> None:
        try:
            frame = live.parse(message, exr.Limits())
            planes = await asyncio.to_thread(frame.planes)
        except ImageError as error:
            raise BadAnswer(f"the answer can't be decoded: {error}") from error
        sent = self._under_way.get(frame.id)
        for id in [id for id in self._under_way if id <= frame.id]:
            del self._under_way[id]
        if sent is None:
            return  # of before the connection broke, and sent again since
        picture, size, pixels, made = sent
        took = {str(k): float(v) for k, v in frame.about.get("took_ms", {}).items()}
        if self._pace is not None and not frame.flags & live.REST:
            self._pace.took(pixels, took, self._link_seconds)
        await self._hand_out(
            LiveAnswer(
                frame.id,
                picture,
                planes,
                age=time.time() - made,
                took_ms=took,
                dropped=int(frame.about.get("dropped", 0)) + self.overwritten,
                sharp=bool(frame.flags & live.REST),
                received_bytes=len(message),
                sent_bytes=size,
                plans=self._plans,
            )
        )

    async def _failed(self, said: Mapping[str, Any]) -> None:
        sent = self._under_way.pop(said["id"], None)
        if sent is None:
            return
        error = problem(said["problem"]["status"], dict(said["problem"]), None)
        await self._hand_out(LiveAnswer(said["id"], sent[0], {}, age=0.0, error=error))

    async def _hand_out(self, answer: LiveAnswer) -> None:
        if not self._every and self._out.full():
            self._out.get_nowait()
            self.overwritten += 1
        await self._out.put(answer)

    def _recall(self) -> None:
        """What was under way is lost: it is sent again if every picture counts, else the newest."""
        lost = [self._under_way[id][0] for id in sorted(self._under_way)]
        if not lost and self._last is not None and not self._every:
            lost = [self._last[0]]  # nobody has an answer to it any more
        if self._sending is not None:
            lost.append(self._sending)
        self._again = [*lost, *self._again] if self._every else lost[-1:]
        self._sending = None
        self._under_way.clear()


def _read(message: str | bytes) -> dict[str, Any]:
    try:
        said = json.loads(message)
    except ValueError:
        said = None
    if not isinstance(said, dict):
        raise BadAnswer("the service says what is no JSON object")
    return said


def _refusal(error: Exception) -> ClientError | None:
    """What a refused handshake or a close code says where trying again is in vain."""
    if isinstance(error, InvalidStatus) and error.response.status_code in _IN_VAIN:
        status = error.response.status_code
        try:
            document = json.loads(error.response.body or b"")
        except ValueError:
            document = None
        if not isinstance(document, dict):
            document = {
                "detail": f"no live sessions are served there (HTTP {status})",
                "fix": "is it a deepshade service, of this version, without a proxy before it?",
            }
        return problem(status, document, None)
    if isinstance(error, ConnectionClosed) and error.rcvd is not None:
        status = error.rcvd.code - 4000
        if status in _IN_VAIN:
            detail = error.rcvd.reason or "the service refuses this stream"
            return problem(status, {"detail": detail}, None)
        if error.rcvd.code == 1009:
            return problem(413, {"detail": "the service takes no frames of this size"}, None)
    return None
