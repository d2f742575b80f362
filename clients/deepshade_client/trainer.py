"""Talks to a trainer service: jobs, their events, data sets to send, and published bundles."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, TypeVar
from urllib.parse import quote

import httpx

from deepshade.files import replacing
from deepshade.manifest import NAME, Manifest, shard_path
from deepshade.tokens import VARIABLE
from deepshade.tracing import carried
from deepshade_client.exceptions import BadAnswer, ClientError, TransportError
from deepshade_client.request import base_url, check, read_list, read_object, transport_error
from deepshade_client.settings import Retry, Timeout

T = TypeVar("T")

DEFAULT_TRAINER = "http://127.0.0.1:8001"
_CHUNK = 1 << 20


@dataclass(frozen=True)
class Event:
    """What a job says: `kind` "job" (its state changed), "progress" or "end"."""

    kind: str
    data: dict[str, Any]


class Trainer:
    """A trainer service. Use it as a context manager, or `close` it.

    `server` defaults to $DEEPSHADE_TRAINER, else http://127.0.0.1:8001, `token` to
    $DEEPSHADE_TOKEN. `bundles`, `pin`, `unpin` and `roll_back` are answered by shading services
    too. Every method raises ClientError, and OSError for a file that can't be read.
    """

    def __init__(
        self,
        server: str | None = None,
        *,
        token: str | None = None,
        timeout: Timeout | None = None,
        retry: Retry | None = None,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        address = server or os.environ.get("DEEPSHADE_TRAINER") or DEFAULT_TRAINER
        self.server = address.rstrip("/")
        self._retry = retry or Retry()
        token = token or os.environ.get(VARIABLE)
        self._http = httpx.Client(
            base_url=base_url(self.server),
            timeout=(timeout or Timeout()).as_httpx(),
            headers={"Authorization": f"Bearer {token}"} if token else None,
            transport=transport,
        )

    def train(self, effect: str, **asked: Any) -> dict[str, Any]:
        """Ask for a job; the same is found, not done again. docs/trainer.md has the settings."""
        body = {key: value for key, value in asked.items() if value is not None}
        return self._ask("POST", f"train/{quote(effect, safe='')}", read_object, json=body)

    def jobs(self) -> list[dict[str, Any]]:
        """All jobs, the last first."""
        return self._ask("GET", "jobs", read_list)

    def job(self, number: str) -> dict[str, Any]:
        """One job."""
        return self._ask("GET", f"jobs/{quote(number, safe='')}", read_object)

    def cancel(self, number: str) -> dict[str, Any]:
        """Stop a job."""
        return self._ask("DELETE", f"jobs/{quote(number, safe='')}", read_object)

    def preview(self, number: str, path: Path) -> bool:
        """Save the job's last picture; whether there is one yet."""

        def read(response: httpx.Response) -> bool:
            if response.status_code == 404:
                return False
            check(response)
            path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(path) as temporary:
                temporary.write_bytes(response.content)
            return True

        return self._ask("GET", f"jobs/{quote(number, safe='')}/preview", read)

    def events(self, number: str) -> Iterator[Event]:
        """A job's events until it ends; a broken connection is taken up where it broke."""
        last, attempt = "", 0
        while True:
            headers = {"Last-Event-ID": last} if last else {}
            url = f"jobs/{quote(number, safe='')}/events"
            try:
                with self._http.stream("GET", url, headers=headers) as response:
                    if not response.is_success:
                        response.read()
                    check(response)
                    for event, seen in _parsed(response.iter_lines(), last):
                        last, attempt = seen, 0
                        yield event
                        if event.kind == "end":
                            return
                error: ClientError = TransportError("the trainer ended the job's events")
            except httpx.HTTPError as cause:
                error = transport_error(cause, self.server)
            attempt += 1
            if attempt >= self._retry.attempts:
                raise error
            time.sleep(min(self._retry.longest, self._retry.first * 2.0**attempt))

    def upload(self, name: str, folder: Path, told: Callable[[int, int], None]) -> None:
        """Send a data folder of 'deepshade datagen' under a name; what is there isn't sent again.

        `told` hears how many files of how many are there.
        """
        manifest = Manifest.read(folder)
        paths = [shard_path(folder, shard) for shard in manifest.shards]
        paths += sorted((folder / "environments").glob("*.exr"))
        there = self._ask("GET", f"data/{quote(name, safe='')}", read_object)["files"]
        known = {each["file"]: each["sha256"] for each in there}
        files = [*paths, folder / NAME]  # the manifest last: only then it is complete
        for done, path in enumerate(files):
            told(done, len(files))
            file = path.relative_to(folder).as_posix()
            if known.get(file) != _digest(path):
                url = f"data/{quote(name, safe='')}/{quote(file)}"
                self._ask("PUT", url, read_object, path=path)
        told(len(files), len(files))

    def bundles(self) -> list[dict[str, Any]]:
        """What was published, with its versions."""
        return self._ask("GET", "bundles", read_list)

    def pin(self, effect: str, name: str, number: int) -> dict[str, Any]:
        """Answer with that version, whatever is published."""
        url = f"{_bundle(effect, name)}/pin"
        return self._ask("POST", url, read_object, params={"version": number})

    def unpin(self, effect: str, name: str) -> dict[str, Any]:
        """Follow what is published again."""
        return self._ask("DELETE", f"{_bundle(effect, name)}/pin", read_object)

    def roll_back(self, effect: str, name: str) -> dict[str, Any]:
        """Answer with the version before the current one."""
        return self._ask("POST", f"{_bundle(effect, name)}/rollback", read_object)

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _ask(
        self,
        method: str,
        url: str,
        read: Callable[[httpx.Response], T],
        *,
        path: Path | None = None,
        **options: Any,
    ) -> T:
        attempt = 0
        while True:
            attempt += 1
            try:
                try:
                    if path is not None:
                        options["content"] = _pieces(path)
                    headers = carried()
                    return read(self._http.request(method, url, headers=headers, **options))
                except httpx.HTTPError as error:
                    raise transport_error(error, self.server) from error
            except ClientError as error:
                # going back twice would be another thing than going back once
                again = not url.endswith("/rollback")
                pause = self._retry.pause(error, attempt) if again else None
                if pause is None:
                    raise
            time.sleep(pause)


def _bundle(effect: str, name: str) -> str:
    return f"bundles/{quote(effect, safe='')}/{quote(name, safe='')}"


def _pieces(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while piece := file.read(_CHUNK):
            yield piece


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _parsed(lines: Iterator[str], last: str) -> Iterator[tuple[Event, str]]:
    """Server-sent events (WHATWG HTML, 9.2.6) and the last id seen by then."""
    kind, data = "message", list[str]()
    for line in lines:
        field, _, value = line.partition(":")
        value = value.removeprefix(" ")
        if field == "event":
            kind = value
        elif field == "data":
            data.append(value)
        elif field == "id":
            last = value
        elif not line:
            if data:
                try:
                    document = json.loads("\n".join(data))
                except ValueError as error:
                    raise BadAnswer("an event is no JSON; is this a trainer service?") from error
                yield Event(kind, document), last
            kind, data = "message", []
