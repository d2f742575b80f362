"""Fixtures for all packages' tests."""

from __future__ import annotations

import os
import signal
import tempfile
from pathlib import Path

import pytest

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
