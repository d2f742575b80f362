"""The built wheel in an environment of its own: serves outside the repository, as within it."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

ROOT = Path(__file__).parents[2]
EXR = {"Content-Type": "image/x-exr"}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with nothing but `env`, which holds the wheel and borrows what it depends on."""
    folder = tmp_path_factory.mktemp("home")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    venv.create(folder / "env")
    pip = [sys.executable, "-m", "pip", "--python", str(folder / "env"), "install", "-q"]
    subprocess.run([*pip, "--no-deps", "--no-index", str(wheel)], check=True)
    (site,) = (folder / "env").glob("lib/python*/site-packages")
    (site / "borrowed.pth").write_text(sysconfig.get_path("purelib"))
    return folder


@pytest.fixture(scope="module")
def run(home: Path) -> Callable[..., str]:
    """`run("doctor", …)`: what the installed command prints, in that folder."""

    def run(*arguments: str, command: str = "deepshade", code: int = 0) -> str:
        done = subprocess.run(
            [home / "env" / "bin" / command, *arguments],
            cwd=home,
            env=clean(),
            capture_output=True,
            text=True,
        )
        assert done.returncode == code, done.stderr
        return done.stdout

    return run


@pytest.fixture
def server(home: Path) -> Iterator[str]:
    """The address of the installed service, started with no option but a free port."""
    process = subprocess.Popen(
        [home / "env" / "bin" / "deepshade", "serve", "--port", "0", "--log-level", "warning"],
        cwd=home,
        env=clean(),
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout
    found = re.search(r"http://\S+", process.stdout.readline())
    assert found
    yield found[0]
    process.terminate()
    assert process.wait(30) == 0
    process.stdout.close()


def clean() -> dict[str, str]:
    """This environment without what would lead to the repository."""
    return {n: v for n, v in os.environ.items() if n not in ("PYTHONPATH", "DEEPSHADE_MODELS")}


@pytest.mark.slow
def test_it_serves_what_ships_to_the_bit(
    home: Path, run: Callable[..., str], server: str, start: Callable[..., Any]
) -> None:
    assert run("samples").split() == ["samples/foliage.exr", "samples/room.exr"]
    room = home / "samples" / "room.exr"
    assert room.read_bytes() == (ROOT / "samples" / "room.exr").read_bytes()
    shade = ["shade", "ao", str(room), "--quality", "fast", "-o", "ao.exr", "--server", server]
    run(*shade, command="deepshade-client")
    own = start(models=ROOT / "models", engine=None)
    answer = own.client.post("/shade/ao?quality=fast", content=room.read_bytes(), headers=EXR)
    assert answer.status_code == 200
    assert (home / "ao.exr").read_bytes() == answer.content


@pytest.mark.slow
def test_the_pages_and_their_samples_are_in_the_wheel(server: str) -> None:
    """Nothing of them comes from the repository, or from the internet."""
    with httpx.Client(base_url=server, trust_env=False) as client:
        for name in ("app.js", "live.js", "style.css", "icon.svg"):
            served = client.get(f"/page/{name}")
            assert served.content == (ROOT / "service/deepshade_service/page" / name).read_bytes()
        assert client.get("/").status_code == client.get("/live/any").status_code == 200
        assert client.get("/samples").json() == ["foliage", "room"]


@pytest.mark.slow
def test_doctor_finds_what_ships_and_advises_what_pip_can_follow(
    home: Path, run: Callable[..., str]
) -> None:
    checks = {check["name"]: check for check in json.loads(run("doctor", "--json"))}
    assert checks["models"]["detail"].startswith(str(home / "env"))
    shipped = {f"model {c.parts[-3]}/{c.parts[-2]}" for c in ROOT.glob("models/*/*/config.json")}
    assert shipped == {name for name in checks if name.startswith("model ")}
    assert all(checks[name]["ok"] for name in shipped)
    code = "from deepshade.extras import install_command; print(install_command('client'))"
    advice = shlex.split(run("-c", code, command="python"))
    requirement = advice[advice.index("install") + 1]
    assert requirement.startswith(str(home))
    assert requirement.endswith(".whl[client]")
    pip = [sys.executable, "-m", "pip", "--python", str(home / "env"), "install", "-q", "--dry-run"]
    subprocess.run([*pip, "--no-index", requirement], check=True)
