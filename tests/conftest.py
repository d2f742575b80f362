"""Fixtures for all packages' tests."""

from __future__ import annotations

import importlib.util
import os
import re
import signal
import subprocess
import sys
import tempfile
import venv
from collections.abc import Callable, Iterator
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock
from packaging.requirements import Requirement

# A shell's background job ignores Ctrl-C, and so would every command that a test interrupts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Each worker of pytest-xdist has a core: its threads would only wait for each other's.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")

# No test may fill, or depend on, what this machine's services keep.
os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix="deepshade-tests-")

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for what takes long to make; the workers of pytest-xdist share it."""
    base = tmp_path_factory.getbasetemp()
    return (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "made-once"


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real meshes and images beside the project; skips where it is absent."""
    folder = ROOT.parent / "shared"
    if not (folder / "scenes").is_dir():
        pytest.skip(f"real scenes are not at {folder}")
    return folder


@pytest.fixture(scope="session")
def wheel(made_once: Path) -> Path:
    """The wheel of this tree."""
    made_once.mkdir(exist_ok=True)
    with FileLock(made_once / "wheel.lock"):
        if not (found := list(made_once.glob("*.whl"))):
            build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d"]
            subprocess.run([*build, str(made_once)], cwd=ROOT, check=True, capture_output=True)
            found = list(made_once.glob("*.whl"))
    return found[0]


@pytest.fixture(scope="session")
def environment() -> Callable[..., Path]:
    """`environment(folder, "numpy", …)`: a virtual environment with these packages; its `bin`.

    And with what they require, by the metadata, but nothing else. All are links to what is
    installed here, which takes neither the network nor time. Of deepshade only what it requires is
    there, and the `wheel`: pip finds out whether that demands more.
    """

    def make(folder: Path, *packages: str, wheel: Path | None = None) -> Path:
        venv.create(folder)
        (site,) = folder.glob("lib/python*/site-packages")
        for place in sorted(_places(packages)):
            (site / place.name).symlink_to(place)
        if wheel:
            pip = [sys.executable, "-m", "pip", "--python", str(folder), "install", "-q"]
            subprocess.run([*pip, "--no-index", "--no-compile", str(wheel)], check=True)
        return folder / "bin"

    return make


@pytest.fixture(scope="session")
def installed(made_once: Path, wheel: Path, environment: Callable[..., Path]) -> Path:
    """The commands of an environment with the wheel and all that deepshade[all] requires."""
    folder = made_once / "installed"
    with FileLock(made_once / "installed.lock"):
        if not folder.exists():
            environment(folder, "deepshade[all]", wheel=wheel)
    return folder / "bin"


def _places(packages: tuple[str, ...]) -> set[Path]:
    """The folders and modules of packages and all that they require."""
    todo, seen, found = [Requirement(name) for name in packages], set[str](), set[Path]()
    while todo:
        wanted = todo.pop()
        if str(wanted) in seen:
            continue
        seen.add(str(wanted))
        package = distribution(wanted.name)
        for needed in map(Requirement, package.requires or ()):
            extras = ("", *wanted.extras)
            if not needed.marker or any(needed.marker.evaluate({"extra": e}) for e in extras):
                todo.append(needed)
        if wanted.name != "deepshade":
            tops = {file.parts[0] for file in package.files or ()} - {"..", "__pycache__"}
            found |= {Path(str(package.locate_file(top))) for top in tops}
    return found


@pytest.fixture(scope="session")
def walk() -> Any:
    """`examples/walk.py`, which runs documents' blocks."""
    spec = importlib.util.spec_from_file_location("walk", ROOT / "examples" / "walk.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def outside() -> Iterator[None]:
    """No variable leads to the repository, or pip to the network."""
    with pytest.MonkeyPatch.context() as patch:
        for name in list(os.environ):
            if re.fullmatch(r"PYTHONPATH|VIRTUAL_ENV|RAY_ADDRESS|(DEEPSHADE|PIP)_.*", name):
                patch.delenv(name)
        patch.setenv("PIP_NO_INDEX", "1")
        patch.setenv("PIP_DISABLE_PIP_VERSION_CHECK", "1")
        yield
