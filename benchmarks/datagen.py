"""Rate of `deepshade datagen` on two Ray workers against two bare rendering processes.

Both render the same views, take turns, and count from the start of the first process to the last
file: Ray's start-up and scheduling, shards and the manifest are all in its time.

    python benchmarks/datagen.py --views 160 --rounds 2
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import statistics
import tempfile
import time
from pathlib import Path

from deepshade.machine import describe
from deepshade_workers.datagen import generate, make_sample
from deepshade_workers.dataspec import DataSpec, expand_scenes

WORKERS = 2


def bare(spec: DataSpec, first: int) -> None:
    """Render every second view in this process, on one thread, and keep nothing."""
    import drjit as dr

    from deepshade_workers.backend import mitsuba

    mitsuba()
    dr.set_thread_count(1)
    for index in range(first, spec.views, WORKERS):
        make_sample(spec, index)


def bare_seconds(spec: DataSpec) -> float:
    """Seconds of two bare processes."""
    start = time.perf_counter()
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=bare, args=(spec, k)) for k in range(WORKERS)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    if any(process.exitcode for process in processes):
        raise SystemExit("a bare process failed")
    return time.perf_counter() - start


def datagen_seconds(spec: DataSpec) -> float:
    """Seconds of the same views through Ray."""
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        for _ in generate(spec, Path(folder)):
            pass
    return time.perf_counter() - start


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=160)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    scenes = expand_scenes(["procedural"])
    shard = max(1, options.views // 10)
    spec = DataSpec(scenes, options.views, frame=512, seed=11, shard_size=shard)
    times: dict[str, list[float]] = {"bare": [], "datagen": []}
    for _ in range(options.rounds):
        times["bare"].append(bare_seconds(spec))
        times["datagen"].append(datagen_seconds(spec))
    rates = {name: spec.views / statistics.median(found) for name, found in times.items()}
    result = {
        "machine": describe(),
        "views": spec.views,
        "seconds": times,
        "views_per_second": rates,
        "ratio": rates["datagen"] / rates["bare"],
    }
    if options.json:
        print(json.dumps(result))
        return
    print(
        f"{describe()}: {options.views} views of 256 x 256 at 256 rays a pixel, "
        f"{options.rounds} rounds"
    )
    for name, rate in rates.items():
        print(f"  {name:8} {rate:.2f} views a second")
    print(f"  ratio    {result['ratio']:.2f}")


if __name__ == "__main__":
    main()
