"""The deployment's scripts, which aren't packages."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]


def script(path: str) -> ModuleType:
    name = Path(path).stem
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, ROOT / path)
        assert spec is not None and spec.loader is not None
        module = sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return sys.modules[name]


@pytest.fixture(scope="session")
def root() -> Path:
    return ROOT


@pytest.fixture(scope="session")
def images() -> ModuleType:
    return script("scripts/images.py")


@pytest.fixture(scope="session")
def topology(images: ModuleType) -> ModuleType:
    return script("scripts/topology.py")


@pytest.fixture(scope="session")
def secrets() -> ModuleType:
    return script("deploy/env.py")
