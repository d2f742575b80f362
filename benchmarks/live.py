"""What a live session keeps of the network's rate, over which link, beside how many viewers.

    python benchmarks/live.py [--seconds 30] [--bundle balanced] [--json]

A service in a process of its own; publisher and viewers in this one. All rates are taken in turns
within one run, so that drift of the machine cancels:

- local: frames a second of a session over those of the bare network on the same threads; the
  95th percentile of the answers' age in frame times; the service's memory before and after each;
- link: a source of 60 frames a second, of which the newest counts, through a proxy that lets
  100 Mbit/s through, each way;
- viewers: the service's CPU seconds a frame with 1 and with 10 viewers, each less those without;
  the publisher's rate beside a viewer that reads nothing.

Five minutes of the first alone: `--seconds 300 --only local`.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from service import analytic_picture, network_input
from websockets.asyncio.client import connect

from deepshade import exr
from deepshade.bundles import Bundle
from deepshade.engines import Backend, load_engine
from deepshade.machine import cpu_count, describe
from deepshade_client import Options
from deepshade_client.live import Picture
from deepshade_client.live.streams import stream
from deepshade_report.server import Server

RATE = 100e6 / 8  # bytes a second of the slow link
PIECE = 16384
SLACK = 0.02  # seconds by which this process may be late and catch up, as a link's queue does
TURNS = 3


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="What live sessions cost.")
    parser.add_argument("--models", type=Path, default=Path("models"))
    parser.add_argument("--bundle", default="balanced")
    parser.add_argument("--seconds", type=float, default=30.0, help="of each measurement")
    parser.add_argument("--only", choices=("local", "link", "viewers"))
    parser.add_argument("--threads", type=int, default=cpu_count())
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    body = analytic_picture(512, 768)
    image = exr.read(body)
    planes = {n: p.astype("<f2") for n, p in image.pixels.items() if n.startswith("normal")}
    planes["Z"] = -image.pixels["position.Z"].astype("<f4")  # what an engine has
    picture = Picture(planes, {"deepshade:fov": 50.0})
    bundle = Bundle.load(options.models / "ao" / options.bundle)
    with Server([options.models], ("--threads", str(options.threads))) as server:
        path = f"/shade/ao?bundle={options.bundle}"
        backend = server.shade(path, body).backend
        engine = load_engine(bundle, Backend(*backend.split("/", 1)), threads=options.threads)
        ready = network_input(bundle, body)
        engine.predict(ready)

        def bare(seconds: float) -> float:
            begun, count = time.perf_counter(), 0
            while time.perf_counter() < begun + seconds:
                engine.predict(ready)
                count += 1
            return count / (time.perf_counter() - begun)

        found = asyncio.run(_measure(server, picture, options, bare))
    result = {"machine": describe(), "bundle": f"ao/{options.bundle}", "engine": backend, **found}
    if options.json:
        print(json.dumps(result, indent=2))
        return
    for name, value in result.items():
        print(f"{name}: {value if isinstance(value, str) else json.dumps(value)}")


async def _measure(server: Server, picture: Picture, options: Any, bare: Any) -> dict[str, Any]:
    url = f"http://127.0.0.1:{server._http.port}"
    asked = Options(bundle=options.bundle, radius=0.5)
    each = options.seconds / TURNS

    async def run(seconds: float, address: str = url, session: str = "bench", **how: Any) -> Any:
        return await _streamed(address, session, picture, asked, seconds, **how)

    await run(3)  # loads and compiles
    parts = {
        "local": lambda: _local(server, run, each, bare),
        "link": lambda: _link(server, run, options.seconds),
        "viewers": lambda: _watched(server, run, url, each),
    }
    found: dict[str, Any] = {}
    for name, part in parts.items():
        if options.only in (None, name):
            found |= await part()
    return found


async def _local(server: Server, run: Any, seconds: float, bare: Any) -> dict[str, Any]:
    memory, ratios, ages, rates = [server._memory("VmRSS")], [], [], []
    for _ in range(TURNS):
        network = bare(seconds / 4)
        live = await run(seconds)
        network = (network + bare(seconds / 4)) / 2
        rates.append(live["fps"])
        ratios.append(live["fps"] / network)
        ages.append(live["p95"] * live["fps"])
        memory.append(server._memory("VmRSS"))
    return {
        "local": {
            "rate / network's": _rounded(ratios),
            "p95 age, frame times": _rounded(ages),
            "memory, MiB": [round(each / 2**20) for each in memory],
            "fps": _rounded(rates),
        }
    }


async def _link(server: Server, run: Any, seconds: float) -> dict[str, Any]:
    async with _proxy(server._http.port) as port:
        slow = await run(seconds, f"http://127.0.0.1:{port}", "slow", rate=60)
    link = {k: round(slow[k], 3) for k in ("fps", "p95", "oldest")} | {"bytes": slow["bytes"]}
    return {"link of 100 Mbit/s": link}


async def _watched(server: Server, run: Any, url: str, seconds: float) -> dict[str, Any]:
    costs, rates = {}, {}
    for count in (0, 1, 10):
        async with _viewers(url, "seen", count):
            before = _cpu(server.process.pid)
            seen = await run(seconds, session="seen")
            costs[count] = (_cpu(server.process.pid) - before) / seen["frames"]
    for stalled in (0, 1, 0, 1):
        async with _viewers(url, "stall", stalled, reads=False):
            rates.setdefault(stalled, []).append((await run(seconds, session="stall"))["fps"])
    encoding = costs[1] - costs[0]
    return {
        "ten viewers, in encodings for one": round((costs[10] - costs[0]) / encoding, 2),
        "rate beside a stalled viewer": round(sum(rates[1]) / sum(rates[0]), 3),
    }


async def _streamed(
    url: str, session: str, picture: Picture, asked: Options, seconds: float, rate: float = 0
) -> dict[str, Any]:
    """Frames as fast as they are answered, or at a `rate`, of which the newest counts; rates and
    ages without the first second's."""
    begun = time.monotonic()

    def frames() -> Any:
        count = 0
        while time.monotonic() < begun + seconds + 1:
            yield replace(picture, made=time.time()) if rate else picture
            count += 1
            time.sleep(max(0.0, begun + count / rate - time.monotonic()) if rate else 0)

    ages: list[float] = []
    times: list[float] = []
    size = 0
    async for answer in stream(url, "ao", frames(), asked, session=session, every=not rate):
        if answer.error is not None:
            raise answer.error
        if time.monotonic() > begun + 1:
            ages.append(answer.age)
            times.append(time.monotonic())
            size = answer.sent_bytes
    ages.sort()
    return {
        "fps": (len(times) - 1) / (times[-1] - times[0]),
        "frames": len(times),
        "p95": ages[int(0.95 * (len(ages) - 1))],
        "oldest": ages[-1],
        "bytes": size,
    }


@asynccontextmanager
async def _proxy(port: int) -> AsyncIterator[int]:
    """A port behind which each direction of a connection carries `RATE`."""

    async def carry(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        free = time.monotonic()
        with suppress(OSError):
            while part := await reader.read(PIECE):
                free = max(free, time.monotonic() - SLACK) + len(part) / RATE
                await asyncio.sleep(max(0.0, free - time.monotonic()))
                writer.write(part)
                await writer.drain()
            writer.close()

    async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there = await asyncio.open_connection("127.0.0.1", port, limit=PIECE)
        there[1].transport.set_write_buffer_limits(PIECE)
        await asyncio.gather(carry(reader, there[1]), carry(there[0], writer))

    listening = await asyncio.start_server(accept, "127.0.0.1", 0, limit=PIECE)
    async with listening:
        yield listening.sockets[0].getsockname()[1]


@asynccontextmanager
async def _viewers(
    url: str, session: str, count: int, *, reads: bool = True
) -> AsyncIterator[None]:
    """So many viewers of a session, as soon as it is there; they acknowledge what they read."""

    async def watch() -> None:
        while True:
            with suppress(OSError, Exception):
                where = f"{url.replace('http', 'ws')}/live/{session}/view"
                async with connect(where, compression=None, proxy=None, max_queue=1) as socket:
                    while not reads:
                        await asyncio.sleep(1)
                    async for message in socket:
                        if isinstance(message, bytes):
                            id_ = int(np.frombuffer(message, "<u4", 1, 8)[0])
                            await socket.send(json.dumps({"type": "ack", "id": id_}))
            await asyncio.sleep(0.05)

    tasks = [asyncio.ensure_future(watch()) for _ in range(count)]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _cpu(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _rounded(values: list[float]) -> list[float]:
    return [round(value, 3) for value in values]


if __name__ == "__main__":
    main()
