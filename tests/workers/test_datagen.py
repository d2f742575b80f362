"""Data sets: the same bytes for the same seeds, whatever is killed on the way."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from safetensors.numpy import load_file

from deepshade import exr, symmetry
from deepshade.camera import Camera
from deepshade.effects import EFFECTS
from deepshade.environments.stored import read_stored, stored_path
from deepshade.errors import ConfigError, DataError, SceneError
from deepshade.files import sha256
from deepshade.manifest import Manifest, Shard
from deepshade_workers.datagen import _complete, generate, make_sample, make_shard, open_manifest
from deepshade_workers.dataspec import DataSpec, default_shard_size, expand_scenes
from deepshade_workers.maps import MAX_HEIGHT
from deepshade_workers.records import view_of
from deepshade_workers.render import render_sample
from deepshade_workers.scenes.loading import open_scene
from deepshade_workers.scenes.procedural import FAMILIES
from deepshade_workers.shards import schema, write_shard
from deepshade_workers.view import View

from ..faults import full_disk

SCENES = ("procedural:stairs", "procedural:level", "procedural:rubble")
SPEC = DataSpec(scenes=SCENES, views=12, size=32, frame=64, spp=16, seed=5, shard_size=3)
ROOT = Path(__file__).parents[2]
DEEPSHADE = Path(sys.executable).with_name("deepshade")


def command(out: Path, spec: DataSpec = SPEC) -> list[str]:
    """The command line of `spec`."""
    options = ["--out", str(out), *(x for s in spec.scenes for x in ("--scenes", s))]
    for key in ("views", "size", "frame", "spp", "seed", "shard_size"):
        options += [f"--{key.replace('_', '-')}", str(getattr(spec, key))]
    return [*options, "--json"]


@pytest.fixture(scope="module")
def expected(tmp_path_factory: Any) -> dict[str, str]:
    """Digests of the shards, made in this process without Ray."""
    folder = tmp_path_factory.mktemp("expected")
    shards = [make_shard(SPEC, k, folder, lambda: None) for k in range(SPEC.shards)]
    return {shard.file: shard.sha256 for shard in shards}


def check(folder: Path, expected: dict[str, str]) -> None:
    """`folder` holds the whole set, once, and nothing else."""
    manifest = Manifest.read(folder)
    assert manifest.count == SPEC.views
    assert {shard.file: shard.sha256 for shard in manifest.shards} == expected
    for name, digest in expected.items():
        assert sha256(folder / name) == digest
    assert {p.name for p in folder.iterdir()} == {*expected, "manifest.json"}


def test_a_sample_can_be_rendered_again_from_its_record() -> None:
    images, record = make_sample(SPEC, 4)
    again, same = make_sample(SPEC, 4)
    assert record == same
    assert json.loads(json.dumps(record)) == record
    camera = record["camera"]
    view = Camera(
        camera["fov"],
        *camera["frame"],
        np.array(camera["world_to_camera"]),
        *camera["origin"],
    )
    rendered = render_sample(
        open_scene(record["scene"]),
        View(view, record["radius"]),
        SPEC.size,
        SPEC.size,
        effects=["ao"],
        samples=SPEC.spp,
        seed=record["seed"],
    )
    for name, image in images.items():
        assert (image == again[name]).all()
        assert (image == rendered[name]).all()


def test_a_shard_holds_what_the_manifest_says(tmp_path: Path) -> None:
    shard = make_shard(SPEC, 1, tmp_path, lambda: None)
    tensors = load_file(tmp_path / shard.file)
    assert tensors["position"].dtype == np.float32
    assert tensors["normal"].dtype == np.float16
    assert tensors["reference_ao"].shape == (3, 1, 32, 32)
    assert len(shard.samples) == 3
    assert [record["scene"].split(":")[1] for record in shard.samples] == [
        SCENES[k % 3].split(":")[1] for k in SPEC.samples(1)
    ]


def test_a_full_disk_leaves_no_half_shard(tmp_path: Path) -> None:
    for room in (0, 1000, 20_000):
        with full_disk(room), pytest.raises(OSError, match="large"):
            make_shard(SPEC, 1, tmp_path, lambda: None)
        assert list(tmp_path.iterdir()) == []
    shard = make_shard(SPEC, 1, tmp_path, lambda: None)
    assert sha256(tmp_path / shard.file) == shard.sha256


def test_shards_hold_light_and_lengths(tmp_path: Path) -> None:
    """16 bits end at 65504 and resolve 1/2048: occlusion and directions fit, these don't."""
    tensors = schema(["ao", "sss"], 8)
    narrow = {name for name, entry in tensors.items() if entry["dtype"] == "float16"}
    assert narrow == {"normal", "reference_ao", "reference_ao_error"}
    bright = {
        name: np.full(t["shape"], 1.0 + 7e4 * (name not in narrow)) for name, t in tensors.items()
    }
    write_shard(tmp_path, 0, tensors, [bright], [{}])
    found = load_file(tmp_path / "shard-00000.safetensors")
    for name in ("light", "scatter", "position", "reference_sss", "reference_sss_error"):
        assert (found[name] == 70_001).all()


@pytest.fixture(scope="module")
def surrounded(tmp_path_factory: Any) -> tuple[DataSpec, Path, Shard]:
    """A shard of the three effects under environments: maps of a folder, of any size, and skies."""
    maps = tmp_path_factory.mktemp("maps")
    for height in (300, 24):
        bright = np.random.default_rng(height).random((3, height, 2 * height)).astype(np.float32)
        exr.write(maps / f"{height}.exr", dict(zip("RGB", bright, strict=True)))
    spec = replace(
        SPEC,
        scenes=("procedural:stairs:7",),
        views=5,
        shard_size=5,
        effects=("do", "full"),
        environments=str(maps),
        skies=2,
    )
    out = tmp_path_factory.mktemp("surrounded")
    return spec, out, make_shard(spec, 0, out, lambda: None)


@pytest.mark.slow
def test_each_view_has_its_environment(surrounded: tuple[DataSpec, Path, Shard]) -> None:
    """A map and a turn are drawn for each; the shard's record leads to the very map."""
    _, out, shard = surrounded
    names = {record["environment"] for record in shard.samples}
    assert names & {"300", "24"}
    assert any(name.startswith("sky-") for name in names)
    assert len({record["rotate"] for record in shard.samples}) == 5
    tensors = load_file(out / shard.file)
    for index, record in enumerate(shard.samples):
        found = read_stored(out, record["environment_sha256"], record["environment"])
        assert found.shape[0] <= MAX_HEIGHT
        scene = open_scene(record["scene"])
        view = view_of(record, scene, out)
        images = render_sample(
            scene, view, 32, 32, effects=("do", "full"), samples=16, seed=record["seed"]
        )
        for name in ("reference_do", "reference_full"):
            assert (images[name] == tensors[name][index]).all()


@pytest.mark.slow
def test_a_lost_map_is_written_again(surrounded: tuple[DataSpec, Path, Shard]) -> None:
    spec, out, shard = surrounded
    manifest = Manifest(spec.settings(), {}).with_shard(shard)
    assert _complete(spec, 0, manifest, out)
    lost = stored_path(out, shard.samples[2]["environment_sha256"])
    lost.unlink()
    assert not _complete(spec, 0, manifest, out)
    assert make_shard(spec, 0, out, lambda: None).sha256 == shard.sha256
    assert lost.is_file()


def test_without_environments_settings_stay_as_they_were() -> None:
    """Data sets that were begun before there were any go on."""
    assert not {"environments", "skies"} & set(SPEC.settings())
    with_sky = replace(SPEC, effects=("do",))
    assert with_sky.settings()["skies"] == SPEC.skies


def test_scene_names_expand(tmp_path: Path) -> None:
    assert len(expand_scenes(["procedural"])) == len(FAMILIES)
    assert expand_scenes(["procedural:room:7"]) == ("procedural:room:7",)
    for name in ("b.obj", "a.glb", "notes.txt"):
        (tmp_path / name).touch()
    assert expand_scenes([str(tmp_path)]) == (str(tmp_path / "a.glb"), str(tmp_path / "b.obj"))
    for wrong in ("nothing.obj", "procedural:rom", str(tmp_path / "notes.txt")):
        with pytest.raises(SceneError):
            expand_scenes([wrong])


@pytest.mark.parametrize(
    "change",
    [
        {"views": 0},
        {"seed": -1},
        {"frame": 8},
        {"scenes": ()},
        {"shard_size": 0},
        {"radius": -1.0},
        {"effects": ("ao", "nothing")},
        {"effects": ("do",), "skies": 0},
        {"effects": ("do",), "environments": "/nowhere"},
    ],
)
def test_impossible_jobs_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        DataSpec(**{"scenes": SCENES, "views": 1, **change})


def test_every_view_counts_where_it_is_measured() -> None:
    """Occlusion is asked for what its row measures; what sees light only has less to show of it."""
    assert DataSpec(SCENES, 1).settings()["min_contrast"] == EFFECTS["ao"].min_contrast
    assert DataSpec(SCENES, 1, effects=("gi", "dof")).settings()["min_contrast"] == 0.06
    assert DataSpec(SCENES, 1, min_contrast=0.01).settings()["min_contrast"] == 0.01


def test_shards_are_a_sixteenth_of_the_views(tmp_path: Path) -> None:
    assert [default_shard_size(n, tmp_path) for n in (1, 48, 2048, 20_000)] == [1, 3, 128, 128]
    Manifest(SPEC.settings(), {}).write(tmp_path)
    assert default_shard_size(2048, tmp_path) == SPEC.shard_size


def test_another_job_does_not_go_on(tmp_path: Path) -> None:
    Manifest(SPEC.settings(), {}).write(tmp_path)
    other = DataSpec(**{**SPEC.settings(), "scenes": SCENES, "effects": ("ao",), "seed": 6})
    with pytest.raises(DataError, match="seed 5"):
        next(generate(other, tmp_path))


def test_a_complete_set_needs_no_ray(tmp_path: Path, expected: dict[str, str]) -> None:
    manifest = Manifest(SPEC.settings(), {})
    for k in range(SPEC.shards):
        manifest = manifest.with_shard(make_shard(SPEC, k, tmp_path, lambda: None))
    manifest.write(tmp_path)
    assert list(generate(SPEC, tmp_path)) == [(12, 12)]
    check(tmp_path, expected)


@contextlib.contextmanager
def running(arguments: list[str], **options: Any) -> Iterator[subprocess.Popen[bytes]]:
    """A command in a process group of its own, all of which is gone afterwards."""
    options = {"stdout": subprocess.DEVNULL, **options}
    process = subprocess.Popen(arguments, start_new_session=True, cwd=ROOT, **options)
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def workers(parent: int, name: str) -> list[int]:
    """Ray's processes of that name that descend from process `parent`."""
    listing = subprocess.run(["ps", "-eo", "pid,ppid,args"], capture_output=True, text=True)
    rows = [line.split(None, 2) for line in listing.stdout.splitlines()[1:]]
    above = {int(pid): int(ppid) for pid, ppid, _ in rows}
    found = []
    for pid, _, args in rows:
        ancestor = int(pid)
        while ancestor in above and ancestor != parent:
            ancestor = above[ancestor]
        if ancestor == parent and args.startswith(name):
            found.append(int(pid))
    return found


def wait_for(condition: Any, seconds: float = 240) -> Any:
    """The first true value of `condition`, asked every 50 ms."""
    limit = time.monotonic() + seconds
    while time.monotonic() < limit:
        if found := condition():
            return found
        time.sleep(0.05)
    raise AssertionError("waited in vain")


@dataclass(frozen=True)
class Cluster:
    """A running cluster: its process, its head's and its dashboard's port, and the environment of
    its jobs."""

    pid: int
    port: int
    dashboard: int
    environment: dict[str, str]


def free_ports(count: int) -> list[int]:
    """Ports of 127.0.0.1 at which nobody listens now."""
    with contextlib.ExitStack() as stack:
        sockets = [
            stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)
        ]
        return [each.getsockname()[1] for each in sockets]


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: Any) -> Iterator[Cluster]:
    """One that wants a token."""
    environment = {
        **os.environ,
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_AUTH_MODE": "token",  # as a cluster should: without one, anyone may run code there
        "RAY_AUTH_TOKEN": secrets.token_hex(32),
        "PATH": path_with_venv(),
    }
    environment.pop("RAY_ADDRESS", None)
    head, dashboard, agent, clients = free_ports(4)
    ports = [f"--port={head}", f"--dashboard-port={dashboard}", "--num-cpus=2"]
    ports += [f"--dashboard-agent-listen-port={agent}", f"--ray-client-server-port={clients}"]
    ray = str(Path(sys.executable).with_name("ray"))
    start = [ray, "start", "--head", "--block", "--include-dashboard=true", *ports]
    log = tmp_path_factory.mktemp("cluster") / "ray.log"
    with log.open("w") as out, running(start, env=environment, stderr=out) as process:
        try:
            wait_for(lambda: process.poll() is None and answers_at(dashboard))
        except AssertionError:
            raise AssertionError(f"no cluster: {log.read_text()}") from None
        yield Cluster(process.pid, head, dashboard, environment)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_cluster_takes_a_submitted_job(
    tmp_path: Path, expected: dict[str, str], cluster: Cluster
) -> None:
    """As `ray job submit -- deepshade datagen`."""
    ray, answers = str(Path(sys.executable).with_name("ray")), []

    def submit(*arguments: str) -> bool:
        done = subprocess.run(
            [
                ray,
                "job",
                "submit",
                "--address",
                f"http://127.0.0.1:{cluster.dashboard}",
                "--",
                *arguments,
            ],
            env=cluster.environment,
            capture_output=True,
            timeout=240,
        )
        answers.append(done.stderr.decode()[-2000:])
        return done.returncode == 0

    try:  # an agent that isn't up yet refuses it
        wait_for(lambda: submit(str(DEEPSHADE), "datagen", *command(tmp_path / "job")))
    except AssertionError:
        raise AssertionError(answers[-1]) from None
    check(tmp_path / "job", expected)


@contextlib.contextmanager
def sshd(folder: Path) -> Iterator[tuple[Path, str]]:
    """An SSH server of our own, where `folder` is home: the key that it takes, how to reach it."""
    program = shutil.which("sshd") or "/usr/sbin/sshd"
    if os.geteuid() or not all(map(shutil.which, (program, "ssh", "rsync", "nc"))):
        pytest.skip("needs root, sshd, ssh, rsync and nc")
    Path("/run/sshd").mkdir(exist_ok=True)
    folder.mkdir()
    for key in ("host", "user"):
        subprocess.run(
            ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", folder / key], check=True
        )
    (folder / "authorized").write_text((folder / "user.pub").read_text())
    (port,) = free_ports(1)
    options = {
        "ListenAddress": f"127.0.0.1:{port}",
        "HostKey": folder / "host",
        "AuthorizedKeysFile": folder / "authorized",
        "PidFile": "none",
        "StrictModes": "no",
        "PermitRootLogin": "prohibit-password",
        "SetEnv": f"HOME={folder}",
    }
    words = [word for name, value in options.items() for word in ("-o", f"{name}={value}")]
    with running([program, "-D", "-f", "/dev/null", *words]):
        wait_for(lambda: answers_at(port), 30)
        yield folder / "user", f"nc 127.0.0.1 {port}"


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_cluster_takes_a_script_over_ssh(
    tmp_path: Path, expected: dict[str, str], cluster: Cluster
) -> None:
    """As `ray submit examples/cluster.yaml`, on one machine where Ray runs already."""
    ray = str(Path(sys.executable).with_name("ray"))
    with sshd(tmp_path / "home") as (key, proxy):
        config = yaml.safe_load((ROOT / "examples/cluster.yaml").read_text())
        config |= {"cluster_name": f"deepshade-{secrets.token_hex(4)}", "file_mounts": {}}
        config |= {"min_workers": 0, "max_workers": 0, "head_start_ray_commands": []}
        config["provider"] |= {"head_ip": "127.0.0.1", "worker_ips": []}
        config["auth"] = {
            "ssh_user": "root",
            "ssh_private_key": str(key),
            "ssh_proxy_command": proxy,
        }
        said = {name: cluster.environment[name] for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN")}
        said |= {"PATH": f"{DEEPSHADE.parent}:$PATH", "RAY_ADDRESS": f"127.0.0.1:{cluster.port}"}
        exports = " ".join(f"{name}={value}" for name, value in said.items())
        config["setup_commands"] = [f"echo 'export {exports}' >> ~/.bashrc"]
        path = tmp_path / "cluster.yaml"
        path.write_text(yaml.safe_dump(config))
        script = str(ROOT / "scripts/ray_datagen.py")
        for words in (
            ["up", "-y", str(path)],
            ["submit", str(path), script, *command(tmp_path / "out")],
        ):
            done = subprocess.run(
                [ray, *words], capture_output=True, text=True, timeout=300, env=cluster.environment
            )
            assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    check(tmp_path / "out", expected)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_killed_job_goes_on_and_a_killed_worker_costs_nothing_but_time(
    tmp_path: Path, expected: dict[str, str], cluster: Cluster
) -> None:
    """As a script, then with --address. What Ray says of the dead is no JSON."""
    address = f"127.0.0.1:{cluster.port}"
    script = [sys.executable, str(ROOT / "scripts/ray_datagen.py"), *command(tmp_path)]
    with running(script, env={**cluster.environment, "RAY_ADDRESS": address}) as process:
        wait_for(lambda: list(tmp_path.glob("shard-*")))
        os.killpg(process.pid, signal.SIGKILL)
    # What a kill in the middle of a write leaves, and a shard that was damaged later:
    (tmp_path / ".shard-00003.safetensors.0badcafe.tmp").write_bytes(b"half")
    complete = next(iter(sorted(tmp_path.glob("shard-*"))))
    complete.write_bytes(complete.read_bytes()[:-8])
    job = [str(DEEPSHADE), "datagen", *command(tmp_path), "--address", address]
    with (tmp_path.parent / "summary.json").open("w+") as printed:
        with running(job, stdout=printed, env=cluster.environment) as process:
            for name in ("ray::_shard_task", "ray::Tally"):
                os.kill(wait_for(lambda name=name: workers(cluster.pid, name))[0], signal.SIGKILL)
            assert process.wait(300) == 0
        printed.seek(0)
        assert json.load(printed)["views"] == 12
    check(tmp_path, expected)


def answers_at(port: int) -> bool:
    """Whether something listens at this machine's port."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def path_with_venv() -> str:
    """PATH with this interpreter's scripts first, as an activated environment has it."""
    return f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"


@pytest.mark.slow
def test_no_cluster_at_the_address(tmp_path: Path) -> None:
    done = subprocess.run(
        [str(DEEPSHADE), "datagen", *command(tmp_path), "--address", "127.0.0.1:1"],
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 2
    assert "no Ray cluster for us at" in done.stderr
    assert "Traceback" not in done.stderr


def test_augmented_views_are_stored_in_all_their_turns(tmp_path: Path) -> None:
    """Each is the symmetry of the plain one; where the world is seen, only the quarter turns."""
    plain = DataSpec(scenes=SCENES[:1], views=2, size=16, frame=16, spp=4, seed=3, shard_size=2)
    spec = replace(plain, augment=True)
    assert spec.turns == symmetry.ALL
    assert replace(spec, effects=("ao", "do")).turns == symmetry.ROTATIONS
    first = make_shard(plain, 0, tmp_path, lambda: None)
    before = load_file(tmp_path / first.file)
    shard = make_shard(spec, 0, tmp_path, lambda: None)
    after = load_file(tmp_path / shard.file)
    assert [record["turn"] for record in shard.samples] == list(range(8)) * 2
    for name, planes in before.items():
        for view in range(2):
            for turn in range(8):
                expected = symmetry.apply(planes[view], name, turn)
                assert np.array_equal(after[name][8 * view + turn], expected), (name, turn)
    manifest = open_manifest(spec, tmp_path).with_shard(shard)
    assert _complete(spec, 0, manifest, tmp_path)
    assert not _complete(plain, 0, manifest, tmp_path)
    assert "augment" not in plain.settings()  # older sets can still be completed
