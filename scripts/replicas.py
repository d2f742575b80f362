"""Ray Serve on this machine: how throughput grows with replicas, and one killed under load.

    python scripts/replicas.py --replicas 1 2 --seconds 20        # needs the extra `scaling`

A picture of --side pixels is sent by twice as many clients as there are replicas, of one thread
each. Where there are fewer cores than replicas they share them: the figures then say what Serve
costs, not what more machines would bring. Then one replica gets SIGKILL under load; every picture
must be answered, to clients that try again as `deepshade_client` does.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np

from deepshade import exr
from deepshade_client import Client, Retry

PORT = 8765


def picture(side: int) -> bytes:
    """A bumpy floor that recedes: normals and positions."""
    import io

    y, x = (np.mgrid[0:side, 0:side] + 0.5) / side
    depth = 3 + y + 0.2 * np.sin(14 * x) * np.cos(10 * y)
    position = np.stack([(x - 0.5) * depth, (0.5 - y) * depth, -depth])
    across, along = np.gradient(position, axis=2), np.gradient(position, axis=1)
    normal = np.cross(along, across, axis=0)
    normal /= np.linalg.norm(normal, axis=0)
    channels = {
        f"{name}.{axis}": values[k].astype(np.float32)
        for name, values in (("normal", normal), ("position", position))
        for k, axis in enumerate("XYZ")
    }
    stream = io.BytesIO()
    exr.write(stream, channels)
    return stream.getvalue()


class Load:
    """Clients that ask again and again until told to stop; what they got is counted."""

    def __init__(self, clients: int, body: bytes) -> None:
        self.answered, self.lost, self.slowest = 0, list[str](), 0.0
        self._body, self._stop, self._lock = body, threading.Event(), threading.Lock()
        self._threads = [threading.Thread(target=self._ask) for _ in range(clients)]
        for thread in self._threads:
            thread.start()

    def _ask(self) -> None:
        with Client(f"http://127.0.0.1:{PORT}", retry=Retry(attempts=12, longest=5)) as client:
            while not self._stop.is_set():
                begun = time.monotonic()
                try:
                    client.shade("ao", self._body)
                except Exception as error:
                    with self._lock:
                        self.lost.append(f"{type(error).__name__}: {error}")
                    continue
                with self._lock:
                    self.answered += 1
                    self.slowest = max(self.slowest, time.monotonic() - begun)

    def end(self) -> None:
        """Let each have its last answer."""
        self._stop.set()
        for thread in self._threads:
            thread.join()


def replica_pids() -> list[int]:
    """The processes of our replicas."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            name = (entry / "cmdline").read_bytes() if entry.name.isdecimal() else b""
        except OSError:
            continue
        if b"ServeReplica:deepshade:shading" in name:
            found.append(int(entry.name))
    return sorted(found)


def main() -> int:
    """Measure, kill, print JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--replicas", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--side", type=int, default=256)
    asked = parser.parse_args()
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    import ray
    from ray import serve

    from deepshade_service.scaling import application

    cpus = max(asked.replicas) + 1
    ray.init("local", num_cpus=cpus, include_dashboard=False, log_to_driver=False)
    serve.start(http_options={"host": "127.0.0.1", "port": PORT})
    body, results = picture(asked.side), []
    for count in asked.replicas:
        app = application({"threads": "1"}, replicas=count)
        serve.run(app, name="deepshade")
        warm = Load(4 * count, body)
        time.sleep(min(10.0, asked.seconds))
        warm.end()
        load, begun = Load(2 * count, body), time.monotonic()
        time.sleep(asked.seconds)
        load.end()
        rate = load.answered / (time.monotonic() - begun)
        results.append({"replicas": count, "per_second": round(rate, 2), "lost": load.lost[:3]})
        print(json.dumps(results[-1]), flush=True)
    load = Load(2 * max(asked.replicas), body)
    time.sleep(asked.seconds / 4)
    victims = replica_pids()
    os.kill(victims[0], signal.SIGKILL)
    time.sleep(asked.seconds)
    load.end()
    killed = {
        "killed": 1,
        "of": len(victims),
        "answered": load.answered,
        "lost": load.lost[:3],
        "slowest_s": round(load.slowest, 2),
    }
    print(json.dumps(killed), flush=True)
    serve.shutdown()
    ray.shutdown()
    return 1 if load.lost or any(each["lost"] for each in results) else 0


if __name__ == "__main__":
    sys.exit(main())
