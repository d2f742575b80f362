"""What the service adds to the network: requests against the bare network, in turns.

    python benchmarks/service.py [--models models] [--input view.exr] [--bundle fast] [--json]

A service runs in a process of its own, the network alone in this one, on the backend that the
service answers with. The ratio is the median over rounds of the service's own stages
(Server-Timing) over the network's time, so that drift of the machine cancels. Without `--input` the
picture is an analytic one, 768x512, normals and positions as half floats, ZIP.
"""

from __future__ import annotations

import argparse
import io
import json
from pathlib import Path

import numpy as np

from deepshade import exr, tensors
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade.engines import Backend, load_engine
from deepshade.gbuffer import load_gbuffer
from deepshade.machine import cpu_count, describe
from deepshade.timing import Pace, alternate, ratio, spread
from deepshade_report.server import STAGES, Server


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="What the service adds to the network.")
    parser.add_argument("--models", type=Path, default=Path("models"))
    parser.add_argument("--input", type=Path, help="EXR to shade instead of the analytic one")
    parser.add_argument("--effect", default="ao")
    parser.add_argument("--bundle", default="fast")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--threads", type=int, default=cpu_count())
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()

    body = options.input.read_bytes() if options.input else analytic_picture(512, 768)
    bundle = Bundle.load(options.models / options.effect / options.bundle)
    path = f"/shade/{options.effect}?bundle={options.bundle}"
    with Server([options.models], ("--threads", str(options.threads))) as server:
        backend = server.shade(path, body).backend
        engine = load_engine(bundle, Backend(*backend.split("/", 1)), threads=options.threads)
        ready = network_input(bundle, body)
        engine.prepare(*ready.shape[2:])

        tasks = {
            "service": lambda: server.shade(path, body).figures,
            "network": lambda: engine.predict(ready),
        }
        found = alternate(tasks, Pace(options.seconds, min_rounds=6, max_rounds=60))
    times = {"network": found["network"]["ms"], "service": found["service"]["total"]}
    times |= {name: found["service"][name] for name in (*STAGES, "transport")}
    result = {
        "machine": describe(),
        "bundle": f"{options.effect}/{options.bundle} {bundle.short_hash}",
        "engine": f"{backend}, {options.threads} threads",
        "picture": f"{ready.shape[3]}x{ready.shape[2]}, {len(body):,} bytes",
        "milliseconds": {name: spread(values) for name, values in times.items()},
        "ratio": ratio(times["service"], times["network"]),
    }
    if options.json:
        print(json.dumps(result, indent=2))
        return
    print("\n".join(str(result[key]) for key in ("machine", "bundle", "engine", "picture")))
    for name, value in {**result["milliseconds"], "service / network": result["ratio"]}.items():
        low, high = value["quartiles"]
        print(f"  {name:18} {value['median']:8.2f}   ({low:.2f} to {high:.2f})")


def network_input(bundle: Bundle, body: bytes) -> np.ndarray:
    """(N, C, h, w): what the service gives the network of a picture."""
    gbuffer = load_gbuffer(body, bundle.inputs)
    return tensors.tensor(
        EFFECTS[bundle.effect],
        gbuffer.attributes,
        bundle.inputs,
        bundle.radius,
        per_channel=bundle.per_channel,
        multiple=bundle.size_multiple,
    )


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


if __name__ == "__main__":
    main()
