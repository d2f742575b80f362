"""`deepshade serve` as a process of its own: started, asked, its memory read, stopped."""

from __future__ import annotations

import http.client
import json
import os
import re
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from deepshade.errors import DeepshadeError

STAGES = ("decode", "plan", "infer", "encode")
_MAIN = "import sys; from deepshade.cli import main; sys.exit(main())"
_START = 90.0  # seconds for the service to become ready
_STILL = 2  # hundredths of a second of CPU time, of 0.3 s, that are nothing


@dataclass(frozen=True, slots=True)
class Reply:
    """One answer: its status, headers in lower case, content, and the client's milliseconds."""

    status: int
    headers: dict[str, str]
    content: bytes
    milliseconds: float

    @property
    def stages(self) -> dict[str, float]:
        """Milliseconds of the service's stages, from Server-Timing."""
        found = re.findall(r"([\w-]+);dur=(\d+(?:\.\d+)?)", self.headers.get("server-timing", ""))
        return {name: float(value) for name, value in found}

    @property
    def server(self) -> float:
        """Milliseconds of all stages together."""
        return sum(self.stages.values())

    @property
    def backend(self) -> str:
        """What the answer says that it was made with, as "openvino/bf16"."""
        return "/".join(
            self.headers.get(f"deepshade-{name}", "?") for name in ("engine", "precision")
        )

    def text(self) -> str:
        """The start of the content, for messages."""
        return self.content[:400].decode("utf-8", "replace")


class Connection:
    """One client's kept-alive connection. The standard library's: little CPU is spent here."""

    def __init__(self, port: int, timeout: float = 600.0) -> None:
        self._http = http.client.HTTPConnection("127.0.0.1", port, timeout=timeout)

    def ask(self, method: str, path: str, body: bytes | None = None) -> Reply:
        """Send one request, read its whole answer.

        A connection that the server closed because it was idle is opened again first. Raises
        OSError, http.client.HTTPException.
        """
        if self._stale():
            self._http.close()  # and the request opens it again
        headers = {"Content-Type": "image/x-exr"} if body is not None else {}
        start = time.perf_counter()
        self._http.request(method, path, body, headers)
        response = self._http.getresponse()
        content = response.read()
        took = 1e3 * (time.perf_counter() - start)
        names = {name.lower(): value for name, value in response.getheaders()}
        return Reply(response.status, names, content, took)

    def _stale(self) -> bool:
        """Whether the server has hung up: something to read, before anything was asked."""
        if self._http.sock is None:
            return False
        return bool(select.select([self._http.sock], [], [], 0)[0])

    def shade(self, path: str, body: bytes) -> Reply:
        """POST a picture. Raises DeepshadeError for any answer but 200."""
        reply = self.ask("POST", path, body)
        if reply.status != 200:
            raise DeepshadeError(f"POST {path} was answered with {reply.status}: {reply.text()}")
        return reply

    def close(self) -> None:
        """Hang up."""
        self._http.close()


class Server:
    """A running service; use it as a context manager. `options` are those of `deepshade serve`.

    `chosen` is whether it has measured this machine, and so chosen its engines.
    """

    def __init__(self, models: Path, options: Sequence[str] = ()) -> None:
        self.chosen = False
        self._log = tempfile.TemporaryFile()  # noqa: SIM115
        command = [sys.executable, "-c", _MAIN, "serve", "--port", "0", "--models", str(models)]
        self.process = subprocess.Popen(
            [*command, "--log-level", "warning", *options],
            stdout=subprocess.PIPE,
            stderr=self._log,
            start_new_session=True,  # Ctrl-C is ours to handle; we stop it in `stop`
        )
        try:
            self.port = self._port()
            self._ready()
        except BaseException:
            self.stop()
            raise

    def connect(self) -> Connection:
        """A new client's connection."""
        return Connection(self.port)

    def wait_until_chosen(self, seconds: float) -> None:
        """Wait for `chosen`, at most so many seconds; nothing else is asked of it meanwhile."""
        deadline = time.monotonic() + seconds
        connection = self.connect()
        try:
            while json.loads(connection.ask("GET", "/readyz").content).get("calibrating"):
                if time.monotonic() > deadline:
                    return
                time.sleep(0.25)
            self.chosen = True
        finally:
            connection.close()

    @property
    def resident(self) -> int:
        """Bytes of its physical memory now; 0 where the system doesn't say."""
        return self._status("VmRSS")

    @property
    def peak(self) -> int:
        """The most bytes of physical memory since `forget_peak`; 0 where it isn't known."""
        return self._status("VmHWM")

    def forget_peak(self) -> bool:
        """Let `peak` begin anew; False where the system can't."""
        try:
            Path(f"/proc/{self.process.pid}/clear_refs").write_text("5")
        except OSError:
            return False
        return True

    def settle(self, seconds: float = 3.0) -> int:
        """`resident` once it has stopped falling: memory is handed back when work has ended."""
        deadline = time.monotonic() + seconds
        lowest = self.resident
        while time.monotonic() < deadline:
            time.sleep(0.1)
            lowest = min(lowest, self.resident)
        return lowest

    def rest(self, seconds: float) -> None:
        """Wait until it computes nothing, at most so many seconds.

        It compiles what came often in the background, while it answers. Where the system doesn't
        say what it computes, all these seconds are waited.
        """
        deadline = time.monotonic() + seconds
        before = self._ticks()
        while time.monotonic() < deadline:
            time.sleep(0.3)
            now = self._ticks()
            if now is not None and before is not None and now - before <= _STILL:
                return
            before = now

    def stop(self) -> None:
        """End it, by force if it doesn't end within 20 s."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            try:
                self.process.wait(20)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        if self.process.stdout:
            self.process.stdout.close()
        self._log.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    def _port(self) -> int:
        """From the line that it prints once it listens."""
        assert self.process.stdout is not None
        text = ""
        deadline = time.monotonic() + _START
        while time.monotonic() < deadline and self.process.poll() is None:
            ready, _, _ = select.select([self.process.stdout], [], [], 0.2)
            if not ready:
                continue
            text += os.read(self.process.stdout.fileno(), 4096).decode("utf-8", "replace")
            if match := re.search(r"http://[^\s/]+:(\d+)", text):
                return int(match[1])
        raise self._failed("doesn't start")

    def _ready(self) -> None:
        deadline = time.monotonic() + _START
        while time.monotonic() < deadline and self.process.poll() is None:
            connection = Connection(self.port, timeout=10)
            with suppress(OSError, http.client.HTTPException):
                if connection.ask("GET", "/readyz").status == 200:
                    connection.close()
                    return
            connection.close()
            time.sleep(0.1)
        raise self._failed("doesn't become ready")

    def _failed(self, what: str) -> DeepshadeError:
        self._log.seek(0)
        last = self._log.read().decode("utf-8", "replace").strip().splitlines()[-3:]
        return DeepshadeError(f"the service {what}: {' '.join(last) or 'it printed nothing'}")

    def _ticks(self) -> int | None:
        """Hundredths of a second of CPU time that it has used; None where it isn't known."""
        with suppress(OSError, ValueError, IndexError):
            stat = Path(f"/proc/{self.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
            return int(stat[11]) + int(stat[12])
        return None

    def _status(self, field: str) -> int:
        with suppress(OSError):
            text = Path(f"/proc/{self.process.pid}/status").read_text()
            if match := re.search(rf"^{field}:\s+(\d+) kB", text, re.MULTILINE):
                return 1024 * int(match[1])
        return 0


def request_path(connection: Connection, effect: str, bundle: str, body: bytes) -> str:
    """How to ask for a bundle: by ?quality= where the service knows it as one, else ?bundle=.

    Raises DeepshadeError when neither is answered.
    """
    for query in (f"quality={bundle}", f"bundle={bundle}"):
        path = f"/shade/{effect}?{query}"
        if (reply := connection.ask("POST", path, body)).status == 200:
            return path
    raise DeepshadeError(f"POST {path} was answered with {reply.status}: {reply.text()}")
