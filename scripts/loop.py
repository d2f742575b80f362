"""The whole loop on docker-compose.yml's services, without a container engine.

    sudo python scripts/loop.py --small        # minutes; without --small a quarter of an hour
    sudo python scripts/loop.py --scene scenes/living_room.gltf

Services up with new tokens; `ray job submit -- deepshade datagen` renders views of one scene, a
procedural one or a file, whose folder is copied, and one more, at which the script looks; the
trainer fine-tunes ambient occlusion to them and publishes it; the shading service answers with the
new version, and after a rollback with the old; all down. Says what it does and how long it took,
and ends with 1 where anything is otherwise. OUT/before-after-reference.png is that other view.
`--images` takes roots of scripts/images.py.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from deepshade import exr, metrics, pictures

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "scripts"))

from topology import Topology, permitted, read  # noqa: E402

SERVICES = ("service", "ray-head", "ray-worker", "trainer")


@dataclass(frozen=True)
class Size:
    """How much is rendered and trained."""

    views: int
    pixels: int
    rays: int
    looked: tuple[str, ...]  # at one more view
    library: dict[str, tuple[str, ...]]  # older views: to rehearse, and that mustn't get worse
    training: tuple[str, ...]


SMALL = Size(
    48,
    128,
    32,
    ("--size", "128x128", "--spp", "64"),
    {},
    ("--steps", "24", "--lr", "0.001", "--worse", "1", "--slower", "100"),
)
WHOLE = Size(
    64,
    256,
    128,
    ("--size", "768x512", "--spp", "512"),
    {
        "rehearsal": ("--views", "96", "--frame", "512", "--spp", "128", "--seed", "201"),
        "test": ("--views", "36", "--frame", "512", "--spp", "512", "--seed", "202"),
    },
    ("--minutes", "8"),
)
SCENE = "procedural:fences:3"


@contextmanager
def step(text: str) -> Iterator[None]:
    """Say what is done and how long it took."""
    print(f"{text} ...", end=" ", flush=True)
    begun = time.monotonic()
    yield
    print(f"{time.monotonic() - begun:.1f} s", flush=True)


def prepare(out: Path) -> dict[str, Any]:
    """An empty folder with a new .env, and the services that it describes."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    made = [sys.executable, str(ROOT / "deploy/env.py"), "--out", str(out / ".env")]
    subprocess.run(made, check=True, stdout=subprocess.DEVNULL)
    return read(ROOT / "docker-compose.yml", out / ".env")


def shaded(topology: Topology, view: Path = ROOT / "samples/room.exr") -> tuple[str, bytes]:
    """The hash of the bundle that answers, and the picture."""
    answer = httpx.post(
        f"http://{topology.published}:8000/shade/ao",
        content=view.read_bytes(),
        headers={"Content-Type": "image/x-exr"},
        timeout=120,
        trust_env=False,
    )
    answer.raise_for_status()
    return answer.headers["Deepshade-Bundle-Sha256"], answer.content


def render(topology: Topology, size: Size, scene: str = SCENE) -> None:
    """Have Ray render a data set of a scene, as its workers see it, into the volume `shards`."""
    settings = ("--views", size.views, "--size", size.pixels, "--spp", size.rays)
    datagen(topology, "/shards/mine", scene, *map(str, settings))


def datagen(topology: Topology, out: str, scenes: str, *settings: str) -> None:
    """`deepshade datagen` as a job of Ray's."""
    topology.execute(
        "ray-head",
        *("ray", "job", "submit", "--address", "http://127.0.0.1:8265", "--"),
        *("deepshade", "datagen", "--out", out, "--scenes", scenes, *settings),
    )


def look(topology: Topology, size: Size, scene: str = SCENE) -> Path:
    """Have one more view rendered, from where most of the scene is seen, with its reference."""
    where = ("-o", "/shards/view.exr", *size.looked)
    topology.execute("ray-head", "deepshade", "render", scene, *where)
    return topology.volume("shards") / "view.exr"


def compare(view: Path, before: bytes, after: bytes, out: Path) -> str:
    """A picture of both answers beside the reference; a sentence on their errors."""
    reference = exr.read(view, ["reference_ao.V"]).pixels["reference_ao.V"]
    answers = [exr.read(each, ["Y"]).pixels["Y"] for each in (before, after)]
    row = [pictures.shading(each) for each in (*answers, reference)]
    pictures.save(out / "before-after-reference.png", pictures.beside(row))
    first, second = (metrics.dssim(each, reference) for each in answers)
    return f"another view: DSSIM {first:.4f} before, {second:.4f} after"


def client(topology: Topology, *words: str, check: bool = True) -> Any:
    """What `deepshade-client --json` says in the trainer's container."""
    done = topology.execute("trainer", "deepshade-client", *words, "--json", check=False)
    if check and done.returncode:
        raise RuntimeError(f"deepshade-client {' '.join(words)}: {done.stdout}{done.stderr}")
    return json.loads(done.stdout) if done.stdout.strip() else None


def tune(topology: Topology, size: Size) -> Any:
    """Have it fine-tuned and published; the job. Raises RuntimeError where it isn't."""
    return client(topology, "train", "ao", "--data", "mine", *size.training)


def within(topology: Topology, scene: str) -> str:
    """A scene's name in the containers; a file's folder is copied to the volume `shards`."""
    path = Path(scene)
    if not path.is_file():
        return scene
    folder = topology.volume("shards") / "scene"
    shutil.copytree(path.parent, folder, copy_function=shutil.copyfile)
    subprocess.run(["chmod", "-R", "a+rX", folder], check=True)
    return f"/shards/scene/{path.name}"


def loop(topology: Topology, size: Size, out: Path, scene: str = SCENE) -> None:
    """Once around. Raises RuntimeError where something isn't as it should be."""
    with step(f"up: {', '.join(SERVICES)}"):
        topology.up(*SERVICES)
    with step(f"ray job submit: {size.views} views of {scene}"):
        inside = within(topology, scene)
        render(topology, size, inside)
    for use, settings in size.library.items():
        with step(f"ray job submit: the library's ao/{use}"):
            datagen(topology, f"/library/ao/{use}", "procedural", *settings)
    with step("deepshade render: one more"):
        view = look(topology, size, inside)
    first, before = shaded(topology, view)
    with step("train"):
        job = tune(topology, size)
    print(f"  {job['sentence']}")
    second, after = shaded(topology, view)
    if second == first:
        raise RuntimeError("the service answers with the old version")
    print(f"  {compare(view, before, after, out)}")
    with step("rollback"):
        client(topology, "rollback", "ao/balanced")
    if shaded(topology, view) != (first, before):
        raise RuntimeError("after the rollback the service doesn't answer with the old version")
    with step("down"):
        ended = {name: topology.stop(name) for name in reversed(SERVICES)}
    print(f"  exit codes {ended}")
    if ended["service"] or ended["trainer"]:
        raise RuntimeError("service and trainer end with 0 when they are asked to")


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--out", type=Path, default=ROOT / "out/loop", help="is emptied first")
    parser.add_argument("--scene", default=SCENE)
    parser.add_argument("--images", type=Path)
    asked = parser.parse_args()
    if not permitted():
        print("this needs root, and leave to make namespaces and mounts", file=sys.stderr)
        return 2
    try:
        with Topology(prepare(asked.out), asked.out, asked.images) as topology:
            loop(topology, SMALL if asked.small else WHOLE, asked.out, asked.scene)
    except (RuntimeError, httpx.HTTPError) as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
