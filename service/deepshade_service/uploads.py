"""Receiving a request's EXR files: one raw body, or the files of a multipart form.

A body is received completely before anything waits for a worker, so a slow client holds nothing
but its own bytes, and those are limited three ways: for each request, in time, and in sum. In
the sum a body counts twice while it arrives, because joining its pieces needs that much.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fastapi import Request
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from deepshade.errors import LimitError
from deepshade.gbuffer import source_name
from deepshade_service.config import Settings
from deepshade_service.problems import Problem

if TYPE_CHECKING:
    from python_multipart.multipart import MultipartCallbacks

RAW_TYPES = ("image/x-exr", "image/exr", "application/octet-stream")
FORM_TYPE = "multipart/form-data"


@dataclass(frozen=True, slots=True)
class Upload:
    """One EXR file: the form field and the file name it came with ("" if raw), and its bytes."""

    field: str
    filename: str
    data: bytes

    @property
    def name(self) -> str:
        """What the file is called: its field if that names an attribute, else its file name."""
        return source_name(self.field, self.filename)


def refuse_body(request: Request) -> None:
    """Raises Problem 422 for a request with a body, where an upload stands in its place."""
    headers = request.headers
    if headers.get("content-length", "0") != "0" or "transfer-encoding" in headers:
        raise Problem(
            422,
            "bad-parameter",
            "upload: the request has a body too",
            fix="leave out ?upload= or the body",
        )


class Uploads:
    """Receives bodies and counts the bytes that are held, so that their sum stays bounded."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self.held = 0

    @asynccontextmanager
    async def receive(self, request: Request) -> AsyncIterator[list[Upload]]:
        """The files of a request, held until the block is left.

        Raises Problem: 400 (a damaged form), 408 (too slow), 413, 415, 422 (a form field that is
        no file), 429 (too many bytes are held already).
        """
        kind, parameters = parse_options_header(request.headers.get("content-type", ""))
        media_type = kind.decode("latin-1")
        if media_type not in (*RAW_TYPES, FORM_TYPE):
            raise Problem(
                415,
                "unsupported-type",
                f"the body's Content-Type is '{media_type[:100]}'",
                fix=f"send one EXR as {RAW_TYPES[0]}, or files as {FORM_TYPE}",
                supported=[*RAW_TYPES, FORM_TYPE],
            )
        body = _Body(self, self._settings.limits.body_bytes, self._settings.uploads)
        try:
            if media_type == FORM_TYPE:
                reading = _read_form(
                    body.chunks(request), parameters.get(b"boundary"), self._settings.files
                )
            else:
                reading = _read_raw(body.chunks(request), request.headers)
            files = await self._in_time(reading)
            body.joined()
            yield files
        finally:
            self.held -= body.held

    async def _in_time(self, reading: Awaitable[list[Upload]]) -> list[Upload]:
        try:
            async with asyncio.timeout(self._settings.body_timeout):
                return await reading
        except TimeoutError:
            raise Problem(
                408,
                "too-slow",
                f"the body did not arrive within {self._settings.body_timeout:g} s",
            ) from None


@dataclass(slots=True)
class _Body:
    """One body on its way in, checked against the limits before it is kept."""

    uploads: Uploads
    limit: int
    room: int
    size: int = 0
    held: int = 0

    async def chunks(self, request: Request) -> AsyncIterator[bytes]:
        declared = request.headers.get("content-length", "")
        self._check(int(declared) if declared.isdecimal() else 0, 0)
        async for chunk in request.stream():
            self._check(self.size + len(chunk), len(chunk))
            self.size += len(chunk)
            self._hold(2 * self.size)
            yield chunk

    def joined(self) -> None:
        """Its pieces are one, and gone."""
        self._hold(self.size)

    def _hold(self, amount: int) -> None:
        self.uploads.held += amount - self.held
        self.held = amount

    def _check(self, size: int, more: int) -> None:
        if size > self.limit:
            raise LimitError("body_bytes", size, self.limit)
        if self.uploads.held + 2 * max(more, size - self.size) > self.room:
            raise Problem(
                429,
                "uploads-full",
                "the service holds as many uploaded bytes as it may",
                fix="try again later, or send fewer pictures at a time",
                headers={"Retry-After": "2"},
            )


class _Form:
    """The callbacks of the multipart parser; collects the files."""

    def __init__(self, most: int) -> None:
        self.files: list[tuple[str, str, list[bytes]]] = []
        self.complete = False
        self._most = most
        self._name = self._value = b""
        self._disposition = b""
        self._field = self._filename = ""
        self._data: list[bytes] = []

    def callbacks(self) -> MultipartCallbacks:
        return {
            "on_part_begin": self._part_begin,
            "on_header_field": self._header_field,
            "on_header_value": self._header_value,
            "on_header_end": self._header_end,
            "on_headers_finished": self._headers_finished,
            "on_part_data": self._part_data,
            "on_part_end": self._part_end,
            "on_end": self._end,
        }

    def _part_begin(self) -> None:
        self._disposition = b""
        self._data = []

    def _header_field(self, data: bytes, start: int, end: int) -> None:
        self._name += data[start:end]

    def _header_value(self, data: bytes, start: int, end: int) -> None:
        self._value += data[start:end]

    def _header_end(self) -> None:
        if self._name.lower() == b"content-disposition":
            self._disposition = self._value
        self._name = self._value = b""

    def _headers_finished(self) -> None:
        _, options = parse_options_header(self._disposition)
        self._field = options.get(b"name", b"").decode("utf-8", "replace")
        if b"filename" not in options:
            raise Problem(
                422,
                "not-a-file",
                f"the form's field '{self._field[:100]}' is no file",
                fix="attach EXR files (curl: -F name=@file.exr); parameters go into the query",
            )
        self._filename = options[b"filename"].decode("utf-8", "replace")
        if len(self.files) == self._most:
            raise LimitError("files", self._most + 1, self._most)

    def _part_data(self, data: bytes, start: int, end: int) -> None:
        self._data.append(data[start:end])

    def _part_end(self) -> None:
        self.files.append((self._field, self._filename, self._data))
        self._data = []

    def _end(self) -> None:
        self.complete = True


async def _read_raw(chunks: AsyncIterator[bytes], headers: Mapping[str, str]) -> list[Upload]:
    """One file, which may be named as a part of a form is."""
    _, options = parse_options_header(headers.get("content-disposition", ""))
    name = options.get(b"filename", b"").decode("utf-8", "replace")
    return [Upload("", name, await _join([chunk async for chunk in chunks]))]


async def _read_form(
    chunks: AsyncIterator[bytes], boundary: bytes | None, most: int
) -> list[Upload]:
    if not boundary:
        raise _bad_form("its Content-Type names no boundary")
    form = _Form(most)
    try:
        parser = MultipartParser(boundary, form.callbacks())
        async for chunk in chunks:
            parser.write(chunk)
        parser.finalize()
    except FormParserError as error:
        raise _bad_form(str(error)[:200]) from None
    if not form.complete:
        raise _bad_form("it ends before its last boundary")
    if not form.files:
        raise _bad_form("it holds no file")
    return [Upload(field, filename, await _join(pieces)) for field, filename, pieces in form.files]


async def _join(pieces: list[bytes]) -> bytes:
    """In a thread if there is much to copy, which bytes.join does without holding the GIL."""
    if len(pieces) < 256:  # 16 MiB as they come from the socket
        return b"".join(pieces)
    return await asyncio.to_thread(b"".join, pieces)


def _bad_form(why: str) -> Problem:
    return Problem(400, "damaged-form", f"the multipart form can't be read: {why}")
