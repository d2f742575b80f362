"""A soak: many mixed requests against one service process, whose memory must stay flat.

Of every ten requests seven are good (effects by turns, and sizes, forms of one file and of two,
several effects at once, plans), one is damaged, one has impossible parameters, and one client
vanishes while it sends or waits. Prints JSON: what was answered, and the process's memory by the
thousand. Exits with 1 where a request got a 5xx, or memory grew by more than a tenth between the
first quarter and the last.

    python benchmarks/soak.py                      # 10,000 requests
    python benchmarks/soak.py --requests 500
"""

from __future__ import annotations

import argparse
import io
import json
import random
import socket
import statistics
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import httpx
import numpy as np

from deepshade import exr
from deepshade.files import shipped

EXR = {"Content-Type": "image/x-exr"}
# few sizes: each is compiled, and what is soaked is the rest
SIZES = ((48, 64), (64, 96), (33, 57), (1, 1))
EFFECTS = ("ao", "aa", "dof", "mb", "ao,aa")
GROWTH = 1.1


def bodies() -> dict[tuple[int, int], bytes]:
    """Windows of the shipped room, by (height, width)."""
    path = shipped("samples") / "room.exr"
    (part,) = exr.read_header(path.read_bytes()).parts
    names = [name for name in part.channels if not name.startswith("reference")]
    image = exr.read(path, names)
    kept = ("deepshade:fov", "deepshade:radius", "deepshade:focus", "deepshade:aperture")
    facts = {name: part.attributes[name] for name in kept}
    found = {}
    for height, width in SIZES:
        planes = {name: image.pixels[name][90 : 90 + height, 120 : 120 + width] for name in names}
        stream = io.BytesIO()
        exr.write(
            stream,
            {name: np.ascontiguousarray(plane) for name, plane in planes.items()},
            attributes=facts | {"deepshade:shutter": 1.0},
            data_window=(120, 90, 119 + width, 89 + height),
            display_window=(0, 0, 511, 383),
        )
        found[height, width] = stream.getvalue()
    return found


class Soak:
    """Sends requests to the service at `url`, and counts how they were answered."""

    def __init__(self, url: str) -> None:
        self.url, self.random = url, random.Random(0)
        self.client = httpx.Client(base_url=url, trust_env=False, timeout=120)
        self.bodies = bodies()
        self.answers: Counter[str] = Counter()

    def one(self, number: int) -> None:
        """The next request; which kind follows from its number."""
        body = self.random.choice(list(self.bodies.values()))
        effect = EFFECTS[number % len(EFFECTS)]
        kind = number % 10
        if kind == 7:
            damaged = bytearray(body[: self.random.randrange(1, len(body))])
            damaged[self.random.randrange(len(damaged))] ^= 1 << self.random.randrange(8)
            self.count("damaged", self.post(effect, bytes(damaged)))
        elif kind == 8:
            query = self.random.choice(["radius=-1", "nothing=1", "map=normal=x", "axes=q"])
            self.count("impossible", self.post(f"{effect}?{query}", body))
        elif kind == 9:
            self.vanish(effect, body)
        elif kind == 6:
            form = {"file": ("shot.exr", body)}
            self.count("form", self.client.post(f"/shade/{effect}", files=form))
        elif kind == 5:
            self.count("plan", self.post(f"{effect}?explain=1", body))
        else:
            self.count("picture", self.post(effect, body))

    def post(self, path: str, body: bytes) -> httpx.Response:
        """A raw body."""
        return self.client.post(f"/shade/{path}", content=body, headers=EXR)

    def vanish(self, effect: str, body: bytes) -> None:
        """A client that closes its connection in the middle of its body, or behind it."""
        sent = self.random.choice([len(body) // 2, len(body)])
        host, port = self.url.removeprefix("http://").split(":")
        with socket.create_connection((host, int(port)), timeout=10) as connection:
            head = f"POST /shade/{effect} HTTP/1.1\r\nHost: {host}:{port}\r\n"
            head += f"Content-Type: image/x-exr\r\nContent-Length: {len(body)}\r\n\r\n"
            connection.sendall(head.encode() + body[:sent])
        self.answers["vanished"] += 1

    def count(self, kind: str, answer: httpx.Response) -> None:
        """Note a status."""
        self.answers[f"{kind} {answer.status_code}"] += 1


def resident(pid: int) -> float:
    """MiB of physical memory of a process."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096 / 2**20


def soak(requests: int, *options: str) -> dict[str, object]:
    """Start a service, send that many requests, and stop it: answers, memory and the verdict."""
    command = "import sys; from deepshade.cli import main; sys.exit(main())"
    process = subprocess.Popen(
        [sys.executable, "-c", command, "serve", "--port", "0", "--log-level", "error", *options],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        url = process.stdout.readline().split(" at ")[1].split()[0]
        run = Soak(url)
        while run.client.get("/readyz").status_code != 200:
            time.sleep(0.1)
        memory, every = [], max(1, requests // 40)
        for number in range(requests):
            run.one(number)
            if number % every == every - 1:
                memory.append(round(resident(process.pid), 1))
                print(f"{number + 1}/{requests}  {memory[-1]} MiB", file=sys.stderr, flush=True)
    finally:
        process.terminate()
        status = process.wait(60)
    quarter = max(1, len(memory) // 4)
    # the first are of a service that still compiles
    early = statistics.median(memory[quarter : 2 * quarter] or memory)
    late = statistics.median(memory[-quarter:])
    bad = [kind for kind in run.answers if kind[-3:].isdigit() and kind[-3] == "5"]
    return {
        "requests": requests,
        "answers": dict(sorted(run.answers.items())),
        "memory_mib": memory,
        "growth": round(late / early, 3),
        "status": status,
        "good": not bad and late <= early * GROWTH and status == 0,
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--requests", type=int, default=10_000)
    asked, more = parser.parse_known_args()
    result = soak(asked.requests, *more)
    print(json.dumps(result, indent=2))
    sys.exit(not result["good"])
