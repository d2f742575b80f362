"""A full disk and kill -9, in training and export: what was there stays, and nothing half is."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from deepshade.bundles import Bundle
from deepshade.files import sha256
from deepshade_trainer.export import export
from deepshade_trainer.run import Run
from deepshade_trainer.training import train

from ..faults import full_disk
from .synthetic import make_bundle, small


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("models")
    make_bundle("aa", found)
    return found


@pytest.fixture
def exported(root: Path, tmp_path: Path) -> tuple[Bundle, Run, Path]:
    mine = shutil.copytree(root, tmp_path / "models")
    return (
        Bundle.load(mine / "aa" / "balanced"),
        Run(mine / "runs" / "aa" / "balanced"),
        mine / "data" / "aa",
    )


def files(folder: Path) -> dict[str, str]:
    return {path.name: sha256(path) for path in folder.iterdir()}


@pytest.mark.parametrize("room", [2000, 20_000])
def test_a_full_disk_costs_no_bundle(exported: tuple[Bundle, Run, Path], room: int) -> None:
    bundle, run, data = exported
    before = files(bundle.path)
    assert room < bundle.model.stat().st_size
    with full_disk(room), pytest.raises(Exception, match=r"(?i)large|space|write|file") as caught:
        export(run, bundle.path, [data])
    assert caught.value is not None
    assert files(bundle.path) == before
    assert Bundle.load(bundle.path).sha256 == bundle.sha256
    again, _ = export(run, bundle.path, [data])
    assert again.sha256 == bundle.sha256


def test_a_full_disk_costs_no_checkpoint(exported: tuple[Bundle, Run, Path]) -> None:
    _, run, data = exported
    recipe = small("aa", "balanced").changed(steps=3)
    before = sha256(run.checkpoint)
    with full_disk(run.checkpoint.stat().st_size // 2), pytest.raises(OSError, match="large"):
        list(train(recipe, [data], run))
    assert sha256(run.checkpoint) == before
    assert not list(run.folder.glob(".*.tmp"))
    assert [progress.step for progress in train(recipe, [data], run)] == [2, 3]  # it goes on


KILLED = """
import os, signal, sys
from pathlib import Path
from deepshade_trainer import export as module
from deepshade_trainer.run import Run
module.parity = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
run, folder, data = map(Path, sys.argv[1:])
module.export(Run(run), folder, [data])
"""


@pytest.mark.slow
def test_a_killed_export_costs_no_bundle(exported: tuple[Bundle, Run, Path]) -> None:
    bundle, run, data = exported
    command = [sys.executable, "-c", KILLED, *map(str, (run.folder, bundle.path, data))]
    killed = subprocess.run(command, capture_output=True, timeout=120)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert Bundle.load(bundle.path).sha256 == bundle.sha256
    again, _ = export(run, bundle.path, [data])
    assert again.sha256 == bundle.sha256
    assert not list(bundle.path.glob(".*.tmp"))
