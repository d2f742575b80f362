"""The built wheel in an environment of its own, by docs/install.md: serves as the clone does."""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
EXR = {"Content-Type": "image/x-exr"}
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("outside")]


def test_what_the_page_says_serves_what_ships_to_the_bit(
    wheel: Path,
    environment: Callable[..., Path],
    walk: Any,
    tmp_path: Path,
    start: Callable[..., Any],
) -> None:
    shutil.copy(wheel, tmp_path)
    bin = environment(tmp_path / "env", "deepshade[service,client]")  # nothing to be downloaded
    first, *block = walk.lines(walk.block("docs/install.md", "From a wheel"))
    assert first.startswith("pip wheel")
    assert walk.run("\n".join(block), folder=tmp_path) == 0

    room = tmp_path / "samples" / "room.exr"
    assert room.read_bytes() == (ROOT / "samples" / "room.exr").read_bytes()
    own = start(models=ROOT / "models", engine=None)
    answer = own.client.post("/shade/ao", content=room.read_bytes(), headers=EXR)
    assert answer.status_code == 200
    assert (tmp_path / "room-ao.exr").read_bytes() == answer.content

    def output(*words: str) -> str:
        done = subprocess.run([bin / words[0], *words[1:]], cwd=tmp_path, capture_output=True)
        assert done.returncode == 0, done.stderr
        return done.stdout.decode()

    checks = {check["name"]: check for check in json.loads(output("deepshade", "doctor", "--json"))}
    assert checks["models"]["detail"].startswith(str(tmp_path / "env"))
    assert not checks["extra 'trainer'"]["ok"]
    shipped = {f"model {c.parts[-3]}/{c.parts[-2]}" for c in ROOT.glob("models/*/*/config.json")}
    assert shipped == {name for name in checks if name.startswith("model ")}
    assert all(checks[name]["ok"] for name in shipped)
    # what doctor advises is what pip can follow
    code = "from deepshade.extras import install_command; print(install_command('client'))"
    advice = shlex.split(output("python", "-c", code))
    requirement = advice[advice.index("install") + 1]
    assert requirement.startswith(str(tmp_path))
    assert requirement.endswith(".whl[client]")
    pip = [sys.executable, "-m", "pip", "--python", str(tmp_path / "env"), "install", "-q"]
    subprocess.run([*pip, "--dry-run", requirement], check=True)


def test_the_pages_are_in_the_wheel(wheel: Path) -> None:
    """Nothing of them comes from the repository, or from the internet."""
    folder = ROOT / "service" / "deepshade_service" / "page"
    with zipfile.ZipFile(wheel) as archive:
        for path in filter(Path.is_file, folder.rglob("*")):
            name = path.relative_to(ROOT / "service").as_posix()
            assert archive.read(name) == path.read_bytes()
