"""What the service adds to the network: POST /shade/ao against the bare network, in one process.

    python benchmarks/service.py [--models models] [--input view.exr] [--rounds 40] [--json]

A service runs in a thread of this process. Each round measures, one after the other so that drift
hits both alike: the network alone on ready-made input, and a request through HTTP, of which the
service's own stages (Server-Timing) count. The ratio is the median over rounds of stages/network.
Without `--input` the picture is an analytic one, 768x512, normals and positions as half floats.
"""

from __future__ import annotations

import argparse
import io
import json
import statistics
import sys
import threading
import time
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import uvicorn

from deepshade import exr
from deepshade.effects import EFFECTS
from deepshade.machine import cpu_count, describe
from deepshade_client import answer
from deepshade_service import shading
from deepshade_service.app import Service, create_app
from deepshade_service.calibration import chosen_path
from deepshade_service.choice import Choices
from deepshade_service.cli import listen
from deepshade_service.config import Settings
from deepshade_service.parameters import ShadeParameters
from deepshade_service.planner import Scene
from deepshade_service.uploads import Upload

TARGET = 3.0
STAGES = ("decode", "plan", "infer", "encode")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--models", type=Path, default=Path("models"))
    parser.add_argument("--input", type=Path, help="EXR to shade instead of the analytic one")
    parser.add_argument("--effect", default="ao")
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--threads", type=int, default=cpu_count())
    parser.add_argument("--quality", help="fast, balanced or best")
    parser.add_argument(
        "--calibration", default="", help="file of 'deepshade bench --calibrate', or 'off'"
    )
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()

    body = options.input.read_bytes() if options.input else analytic_picture(512, 768)
    calibration = chosen_path(options.calibration)
    app = create_app(
        Settings(models=options.models, threads=options.threads, calibration=calibration)
    )
    listener = listen("127.0.0.1", 0)
    server = uvicorn.Server(uvicorn.Config(app, log_config=None, timeout_graceful_shutdown=5))
    thread = threading.Thread(target=server.run, args=([listener],))
    thread.start()
    try:
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        with httpx.Client(base_url=url, trust_env=False, timeout=60) as client:
            result = measure(client, app.state.service, options, body)
    finally:
        server.should_exit = True
        thread.join()
    if options.json:
        print(json.dumps(result, indent=2))
    else:
        show(result)
    return 0 if result["ratio"] <= TARGET else 1


def measure(
    client: httpx.Client, service: Service, options: argparse.Namespace, body: bytes
) -> dict[str, Any]:
    """Times pairs of a bare prediction and a request; all times in milliseconds."""
    effect, rounds, asked = options.effect, options.rounds, ShadeParameters(quality=options.quality)
    while (state := client.get("/readyz")).status_code != 200 or state.json().get("calibrating"):
        time.sleep(0.05)
    chosen = Choices.of(service.models, effect, asked).plain
    engine = service.models.engine(chosen)
    limits = service.settings.limits
    headers = [exr.read_header(body, limits)]
    gbuffer = shading.decode(
        [Upload("", "", body)], headers, engine.bundle, ShadeParameters(), limits
    )
    scene = Scene(gbuffer, EFFECTS[effect])
    plan = scene.plan(engine.bundle, ShadeParameters(), service.settings.memory)
    if len(plan.tiling) != 1:
        raise SystemExit("the picture is no single tile: take one that is covered, or smaller")
    ready = shading.first_input(gbuffer, plan, engine.bundle)

    times: dict[str, list[float]] = {
        name: [] for name in ("network", "service", "transport", *STAGES)
    }
    warm_up = 12  # engines prepare for sizes that come often
    for turn in range(warm_up + rounds):
        start = time.perf_counter()
        engine.predict(ready)
        network = 1e3 * (time.perf_counter() - start)

        start = time.perf_counter()
        response = client.post(
            f"/shade/{effect}",
            params={"quality": options.quality} if options.quality else {},
            content=body,
            headers={"Content-Type": "image/x-exr"},
        )
        total = 1e3 * (time.perf_counter() - start)
        response.raise_for_status()
        stages = answer.timing(response.headers["server-timing"])
        if turn < warm_up:
            continue
        spent = sum(stages.values())
        for name, value in (
            ("network", network),
            ("service", spent),
            ("transport", total - spent),
            *((stage, stages[stage]) for stage in STAGES),
        ):
            times[name].append(value)
    ratios = [a / b for a, b in zip(times["service"], times["network"], strict=True)]
    height, width = gbuffer.shape
    return {
        "machine": describe(),
        "bundle": f"{effect}/{engine.bundle.name} {engine.bundle.short_hash}",
        "engine": f"{engine.backend}, {service.settings.threads} threads",
        "picture": f"{width}x{height}, {len(body):,} bytes",
        "rounds": rounds,
        "milliseconds": {name: spread(values) for name, values in times.items()},
        "ratio": round(statistics.median(ratios), 3),
        "ratio_quartiles": spread(ratios)["quartiles"],
        "target": TARGET,
    }


def analytic_picture(height: int, width: int) -> bytes:
    """A wavy floor under a sphere seen from above: half floats, ZIP, fov 50."""
    y, x = (np.mgrid[0:height, 0:width] + 0.5).astype(np.float64)
    slope = np.tan(np.radians(25)) * 2 / width
    ray = np.stack([(x - width / 2) * slope, (height / 2 - y) * slope, -np.ones_like(x)])
    depth = 4 / (1 + 0.5 * ray[1]) + 0.03 * np.sin(x / 7) * np.cos(y / 9)
    position = ray * depth
    centre, radius = np.array([0.2, 0.1, -3.2]), 0.9
    a, b = (ray**2).sum(0), -(ray * centre[:, None, None]).sum(0)
    root = b**2 - a * (centre @ centre - radius**2)
    hit = root > 0
    distance = (-b - np.sqrt(np.where(hit, root, 0))) / a
    position[:, hit] = (ray * distance)[:, hit]
    du, dv = np.gradient(position, axis=2), np.gradient(position, axis=1)
    normal = np.cross(dv, du, axis=0)
    normal /= np.linalg.norm(normal, axis=0)
    channels = {
        f"{name}.{axis}": array[index]
        for name, array in (("normal", normal), ("position", position))
        for index, axis in enumerate("XYZ")
    }
    stream = io.BytesIO()
    exr.write(stream, channels, half=True, attributes={"deepshade:fov": 50.0})
    return stream.getvalue()


def spread(values: list[float]) -> dict[str, Any]:
    """Median and quartiles."""
    low, middle, high = statistics.quantiles(values, n=4)
    return {"median": round(middle, 3), "quartiles": [round(low, 3), round(high, 3)]}


def show(result: dict[str, Any]) -> None:
    """Prints the result for people."""
    print(result["machine"])
    print(f"{result['bundle']}  {result['engine']}  {result['picture']}  {result['rounds']} rounds")
    for name, value in result["milliseconds"].items():
        low, high = value["quartiles"]
        print(f"  {name:10} {value['median']:8.1f} ms   ({low:.1f} to {high:.1f})")
    verdict = "met" if result["ratio"] <= result["target"] else "MISSED"
    print(f"service / network: {result['ratio']:.2f}   target {result['target']}: {verdict}")


if __name__ == "__main__":
    sys.exit(main())
