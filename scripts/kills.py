"""SIGKILL to each of docker-compose.yml's services in the middle of its work: nothing is lost.

    sudo python scripts/kills.py               # about ten minutes on two quiet cores

Ray's worker and head while a data set is rendered: asked again, it completes, and its shards are
byte for byte those of one that nobody disturbed. The service while pictures are asked for: clients
that try again get every one, the same bytes. The trainer in the middle of a job: started again it
goes on with the same job, and one version is published. That of PostgreSQL is in
tests/trainer/test_trainer_service.py. Ends with 1 where anything is otherwise.
"""

from __future__ import annotations

import argparse
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "scripts"))

from loop import SERVICES, SMALL, client, prepare, render, step, tune  # noqa: E402
from topology import Topology, permitted  # noqa: E402

from deepshade.files import sha256  # noqa: E402
from deepshade.manifest import NAME, Manifest  # noqa: E402
from deepshade_client import Client, Retry  # noqa: E402

PICTURES = 24


def until(what: str, true: Callable[[], object], patience: float = 600.0) -> None:
    """Wait for it. Raises RuntimeError where it doesn't come."""
    deadline = time.monotonic() + patience
    while not true():
        if time.monotonic() > deadline:
            raise RuntimeError(f"{what} doesn't come")
        time.sleep(0.1)


def shards(topology: Topology) -> dict[str, str]:
    """Names and hashes of the data set's shards, as they are. Raises RuntimeError for a bad one."""
    folder = topology.volume("shards") / "mine"
    manifest = Manifest.read(folder)
    found = {shard.file: sha256(folder / shard.file) for shard in manifest.shards}
    bad = [shard.file for shard in manifest.shards if shard.sha256 != found[shard.file]]
    if bad or manifest.count != SMALL.views:
        raise RuntimeError(f"{manifest.count} views, and damaged shards: {bad}")
    return found


def while_rendering(topology: Topology, victim: str, expected: dict[str, str]) -> None:
    """Kill one of Ray's while a data set is rendered, and have it completed."""
    folder = topology.volume("shards") / "mine"
    folder.rename(folder.with_name(f"before-{victim}"))
    with ThreadPoolExecutor(1) as pool:
        job = pool.submit(render, topology, SMALL)
        until("a shard", lambda: (folder / NAME).exists() and Manifest.read(folder).count)
        topology.kill(victim)
        if victim == "ray-head" and "ray-worker" in topology.running:
            topology.stop("ray-worker")  # it ends by itself when it misses its head, in a minute
        topology.up(*[name for name in ("ray-head", "ray-worker") if name not in topology.running])
        try:
            job.result()
        except RuntimeError:
            if victim != "ray-head":
                raise
    if victim == "ray-head":
        render(topology, SMALL)  # the job went with it: asked again
    if shards(topology) != expected:
        raise RuntimeError("other shards than undisturbed")


def while_shading(topology: Topology) -> None:
    """Kill the service while pictures are asked for."""
    body, answers = (ROOT / "samples/room.exr").read_bytes(), list[bytes]()
    lock = threading.Lock()

    def ask(_: int) -> None:
        with Client(f"http://{topology.published}:8000", retry=Retry(attempts=40, longest=2)) as c:
            content = c.shade("ao", body).content
        with lock:
            answers.append(content)

    with ThreadPoolExecutor(4) as pool:
        asked = pool.map(ask, range(PICTURES))
        until("an answer", lambda: len(answers) > PICTURES // 4)
        topology.kill("service")
        topology.up("service")
        list(asked)
    if len(answers) != PICTURES or len(set(answers)) != 1:
        raise RuntimeError(f"{len(answers)} answers, {len(set(answers))} different")


def while_training(topology: Topology) -> None:
    """Kill the trainer in the middle of a job."""
    with ThreadPoolExecutor(1) as pool:
        job = pool.submit(tune, topology, SMALL)
        until("a step", lambda: any(_steps(each) > 2 for each in client(topology, "jobs")))
        topology.kill("trainer")
        topology.up("trainer")
        with suppress(RuntimeError):  # it watched from within the container that was killed
            job.result()
    done = tune(topology, SMALL)
    jobs = client(topology, "jobs")
    (alias,) = client(topology, "bundles")
    if len(jobs) != 1 or done["begun"] != 2 or alias["versions"] != [1, 2]:
        raise RuntimeError(f"jobs {jobs}, versions {alias}")


def _steps(job: dict[str, object]) -> int:
    progress = job.get("progress")
    trains = isinstance(progress, dict) and progress.get("phase") == "training"
    return int(progress["step"]) if trains else 0  # type: ignore[index]


def main() -> int:
    """Run all of them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=ROOT / "out/kills", help="is emptied first")
    parser.add_argument("--images", type=Path)
    asked = parser.parse_args()
    if not permitted():
        print("this needs root, and leave to make namespaces and mounts", file=sys.stderr)
        return 2
    try:
        with Topology(prepare(asked.out), asked.out, asked.images) as topology:
            with step("up"):
                topology.up(*SERVICES)
            with step("service, while it shades"):
                while_shading(topology)
            with step("rendering undisturbed"):
                render(topology, SMALL)
            expected = shards(topology)
            for victim in ("ray-worker", "ray-head"):
                with step(f"{victim}, while it renders"):
                    while_rendering(topology, victim, expected)
            with step("trainer, in a job"):
                while_training(topology)
    except RuntimeError as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1
    print("nothing was lost")
    return 0


if __name__ == "__main__":
    sys.exit(main())
