"""docker-compose.yml's services as processes: what the file promises is so, seen from inside."""

from __future__ import annotations

import errno
import json
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def within(topology: ModuleType, factory: pytest.TempPathFactory, name: str) -> Path:
    """A folder where other users come in."""
    if not topology.permitted():
        pytest.skip("namespaces and mounts need root, and leave to make them")
    if any(place.is_relative_to("/tmp") for place in (topology.ROOT, Path(sys.prefix))):
        pytest.skip("containers have a tmpfs at /tmp, which hides a clone there")
    folder = factory.mktemp(name)
    for place in (folder, *folder.parents[:2]):  # pytest's are for its own user alone
        place.chmod(0o755)
    return folder


def test_the_loop_closes(
    root: Path, topology: ModuleType, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """`scripts/loop.py --small`: rendered on Ray, fine-tuned, published, served, rolled back."""
    folder = within(topology, tmp_path_factory, "loop")
    command = [sys.executable, root / "scripts/loop.py", "--small", "--out", folder / "out"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    assert "published as ao/balanced 2" in done.stdout


ASK = """
import os, sys, urllib.error, urllib.request
request = urllib.request.Request("http://trainer:8001/jobs")
if len(sys.argv) > 1:
    request.add_header("Authorization", f"Bearer {os.environ['DEEPSHADE_TOKEN']}")
try:
    print(urllib.request.urlopen(request, timeout=20).status)
except urllib.error.HTTPError as error:
    print(error.code)
"""


@pytest.fixture(scope="module")
def running(
    root: Path, topology: ModuleType, secrets: ModuleType, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Any]:
    """The service and the trainer."""
    folder = within(topology, tmp_path_factory, "topology")
    assert secrets.main(["--out", str(folder / ".env")]) == 0
    document = topology.read(root / "docker-compose.yml", folder / ".env")
    with topology.Topology(document, folder) as up:
        up.up("service", "trainer")
        yield up


def inside(running: Any, name: str, *command: str) -> str:
    done = running.execute(name, *command, check=False)
    return str(done.stdout + done.stderr)


def test_the_published_port_answers_and_no_other(running: Any) -> None:
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(f"http://{running.published}:8000/readyz", timeout=20) as answer:
        assert "ao/balanced" in json.load(answer)["bundles"]
    with pytest.raises(OSError):  # a machine's proxy may accept the connection, but has no trainer
        opener.open(f"http://{running._addresses['trainer']}:8001/healthz", timeout=2)


def test_the_trainer_wants_the_token_that_both_have(running: Any) -> None:
    assert inside(running, "service", "python3", "-c", ASK).split() == ["401"]
    assert inside(running, "service", "python3", "-c", ASK, "token").split() == ["200"]


@pytest.mark.parametrize("name", ["service", "trainer"])
def test_nobody_is_root_or_writes_where_it_should_not(running: Any, name: str) -> None:
    status = inside(running, name, "cat", "/proc/self/status")
    facts = {k: v.split() for k, _, v in (line.partition(":") for line in status.splitlines())}
    assert set(facts["Uid"]) == set(facts["Gid"]) == {"10001"}
    assert facts["NoNewPrivs"] == ["1"]
    assert {facts[each][0] for each in ("CapPrm", "CapEff", "CapBnd")} == {"0" * 16}
    for place in ("/", "/etc", "/usr"):
        assert "Read-only" in inside(running, name, "touch", f"{place}/new"), place
    assert inside(running, name, "touch", "/tmp/new") == ""
    models = inside(running, name, "touch", "/models/new")
    assert ("Read-only" in models) == (name == "service")


def test_inside_there_is_no_way_out(running: Any) -> None:
    out = "import socket; print(socket.socket().connect_ex(('192.0.2.1', 80)))"
    assert int(inside(running, "trainer", "python3", "-c", out)) == errno.ENETUNREACH
    assert inside(running, "trainer", "cat", "/proc/net/route").count("\n") == 2  # its own network


def test_tokens_are_in_no_log_and_lines_are_json(running: Any) -> None:
    tokens = running.services["trainer"]["environment"]
    for name in ("service", "trainer"):
        log = running.log(name)
        assert tokens["DEEPSHADE_TOKEN"] not in log and tokens["RAY_AUTH_TOKEN"] not in log
        entries = [json.loads(line) for line in log.splitlines() if line.startswith("{")]
        assert any(entry["logger"].startswith("uvicorn") for entry in entries)


def test_one_that_is_killed_comes_back(running: Any) -> None:
    running.kill("service")
    with pytest.raises(OSError):
        urllib.request.urlopen(f"http://{running.published}:8000/readyz", timeout=2)
    running.start("service")
    running.wait("service")
    assert running.stop("trainer") == 0
    running.up("trainer")
