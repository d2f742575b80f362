"""Fixtures for all packages' tests."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real meshes and images beside the project; skips where it is absent."""
    folder = ROOT.parent / "shared"
    if not (folder / "scenes").is_dir():
        pytest.skip(f"real scenes are not at {folder}")
    return folder
