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
from urllib.request import urlopen

from deepshade.errors import DeepshadeError

STAGES = ("decode", "plan", "infer", "encode")
_MAIN = "import sys; from deepshade.cli import main; sys.exit(main())"
_MAX_START = 90.0  # seconds for the service to become ready
_MAX_IDLE = 2.0  # seconds after which the service may have closed a connection


@dataclass(frozen=True, slots=True)
class Reply:
    """An answer's headers, in lower case, and the milliseconds that its client waited."""

    headers: dict[str, str]
    milliseconds: float

    @property
    def backend(self) -> str:
        """What the answer says that it was made with, as "openvino/bf16"."""
        return "/".join(self.headers[f"deepshade-{name}"] for name in ("engine", "precision"))

    @property
    def figures(self) -> dict[str, float]:
        """Milliseconds of each stage, their "total", the client's and "transport" beside; "tiles".

        Stages are those of Server-Timing.
        """
        found = re.findall(r"([\w-]+);dur=(\d+(?:\.\d+)?)", self.headers["server-timing"])
        stages = {name: float(value) for name, value in found if name in STAGES}
        total = sum(stages.values())
        waited = {"client": self.milliseconds, "transport": self.milliseconds - total}
        return {**stages, **waited, "total": total, "tiles": float(self.headers["deepshade-tiles"])}


class Server:
    """A running service with one kept-alive connection; use it as a context manager.

    `options` are those of `deepshade serve`. The standard library's client spends little CPU.
    """

    def __init__(self, models: Sequence[Path], options: Sequence[str] = ()) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        self._log = tempfile.TemporaryFile()  # noqa: SIM115
        command = [sys.executable, "-c", _MAIN, "serve", "--port", str(port)]
        command += [word for root in models for word in ("--models", str(root))]
        command += ["--log-level", "warning", *options]
        self.process = subprocess.Popen(
            command,
            stdout=subprocess.DEVNULL,
            stderr=self._log,
            start_new_session=True,  # Ctrl-C is ours to handle; we stop it in `stop`
        )
        self._http = http.client.HTTPConnection("127.0.0.1", port, timeout=600.0)
        self._asked = 0.0
        try:
            self._wait()
        except BaseException:
            self.stop()
            raise

    def shade(self, path: str, body: bytes) -> Reply:
        """POST a picture. Raises DeepshadeError for any answer but 200.

        Raises OSError or http.client.HTTPException where there is no answer.
        """
        if time.monotonic() - self._asked > _MAX_IDLE:
            self._http.close()  # and the request opens it
        start = time.perf_counter()
        self._http.request("POST", path, body, {"Content-Type": "image/x-exr"})
        response = self._http.getresponse()
        content = response.read()
        took = 1e3 * (time.perf_counter() - start)
        self._asked = time.monotonic()
        if response.status != 200:
            said = content[:400].decode("utf-8", "replace")
            raise DeepshadeError(f"POST {path} was answered with {response.status}: {said}")
        return Reply({name.lower(): value for name, value in response.getheaders()}, took)

    def forget_peak(self) -> bool:
        """Let `peak` begin anew; False where the system can't."""
        try:
            Path(f"/proc/{self.process.pid}/clear_refs").write_text("5")
        except OSError:
            return False
        return True

    @property
    def peak(self) -> int:
        """The most bytes of physical memory since `forget_peak`; 0 where it isn't known."""
        return self._memory("VmHWM")

    def settle(self, seconds: float) -> int:
        """The least bytes of physical memory while it hands back what it doesn't need."""
        deadline = time.monotonic() + seconds
        least = self._memory("VmRSS")
        while time.monotonic() < deadline:
            time.sleep(0.05)
            least = min(least, self._memory("VmRSS"))
        return least

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
        deadline = time.monotonic() + _MAX_START
        while time.monotonic() < deadline and self.process.poll() is None:
            with suppress(OSError), urlopen(f"http://127.0.0.1:{self._http.port}/readyz"):
                return
            time.sleep(0.1)
        self._log.seek(0)
        last = self._log.read().decode("utf-8", "replace").strip().splitlines()[-3:]
        raise DeepshadeError(f"the service doesn't start: {' '.join(last) or 'it said nothing'}")

    def _memory(self, field: str) -> int:
        with suppress(OSError):
            text = Path(f"/proc/{self.process.pid}/status").read_text()
            if match := re.search(rf"^{field}:\s+(\d+) kB", text, re.MULTILINE):
                return 1024 * int(match[1])
        return 0
