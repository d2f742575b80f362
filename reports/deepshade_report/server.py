"""`deepshade serve` as a process of its own: started, asked, its memory read, stopped."""

from __future__ import annotations

import http.client
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from deepshade.errors import DeepshadeError

STAGES = ("decode", "plan", "infer", "encode")
_MAIN = "import sys; from deepshade.cli import main; sys.exit(main())"
_START = 90.0  # seconds for the service to become ready


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
        return {name: float(value) for name, value in found if name in STAGES}

    @property
    def server(self) -> float:
        """Milliseconds of all stages together."""
        return sum(self.stages.values())

    @property
    def backend(self) -> str:
        """What the answer says that it was made with, as "openvino/bf16"."""
        return "/".join(self.headers[f"deepshade-{name}"] for name in ("engine", "precision"))


class Server:
    """A running service with one kept-alive connection; use it as a context manager.

    `options` are those of `deepshade serve`. The standard library's client spends little CPU.
    """

    def __init__(self, models: Path, options: Sequence[str] = ()) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        self._log = tempfile.TemporaryFile()  # noqa: SIM115
        command = [sys.executable, "-c", _MAIN, "serve", "--port", str(port)]
        command += ["--models", str(models), "--log-level", "warning", *options]
        self.process = subprocess.Popen(
            command,
            stdout=subprocess.DEVNULL,
            stderr=self._log,
            start_new_session=True,  # Ctrl-C is ours to handle; we stop it in `stop`
        )
        self._http = http.client.HTTPConnection("127.0.0.1", port, timeout=600.0)
        try:
            self._wait()
        except BaseException:
            self.stop()
            raise

    def ask(self, method: str, path: str, body: bytes | None = None) -> Reply:
        """Send one request, read its whole answer. Raises OSError, http.client.HTTPException."""
        headers = {"Content-Type": "image/x-exr"} if body is not None else {}
        start = time.perf_counter()
        try:
            self._http.request(method, path, body, headers)
            response = self._http.getresponse()
        except (http.client.RemoteDisconnected, ConnectionError):  # it was idle for too long
            self._http.close()
            start = time.perf_counter()
            self._http.request(method, path, body, headers)
            response = self._http.getresponse()
        content = response.read()
        took = 1e3 * (time.perf_counter() - start)
        names = {name.lower(): value for name, value in response.getheaders()}
        return Reply(response.status, names, content, took)

    def shade(self, path: str, body: bytes) -> Reply:
        """POST a picture. Raises DeepshadeError for any answer but 200."""
        reply = self.ask("POST", path, body)
        if reply.status != 200:
            said = reply.content[:400].decode("utf-8", "replace")
            raise DeepshadeError(f"POST {path} was answered with {reply.status}: {said}")
        return reply

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
            time.sleep(0.05)
            lowest = min(lowest, self.resident)
        return lowest

    def stop(self) -> None:
        """End it, by force if it doesn't end within 20 s."""
        self._http.close()
        self.process.send_signal(signal.SIGTERM)
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._log.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    def _wait(self) -> None:
        """Until it is ready. Raises DeepshadeError with what it printed where it isn't."""
        deadline = time.monotonic() + _START
        while time.monotonic() < deadline and self.process.poll() is None:
            with suppress(OSError, http.client.HTTPException):
                if self.ask("GET", "/readyz").status == 200:
                    return
            self._http.close()
            time.sleep(0.1)
        self._log.seek(0)
        last = self._log.read().decode("utf-8", "replace").strip().splitlines()[-3:]
        raise DeepshadeError(f"the service doesn't start: {' '.join(last) or 'it said nothing'}")

    def _status(self, field: str) -> int:
        with suppress(OSError):
            text = Path(f"/proc/{self.process.pid}/status").read_text()
            if match := re.search(rf"^{field}:\s+(\d+) kB", text, re.MULTILINE):
                return 1024 * int(match[1])
        return 0
