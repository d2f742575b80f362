"""`examples/engine.py`, on what the wheel holds: the commands of docs/onnx.md."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from deepshade import exr

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.usefixtures("outside")
def test_the_commands_run_the_network_without_deepshade(
    installed: Path, environment: Callable[..., Path], tmp_path: Path
) -> None:
    (shipped,) = installed.parent.glob("lib/python*/site-packages/deepshade/shipped")
    for name in ("models", "samples"):
        (tmp_path / name).symlink_to(shipped / name)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    environment(tmp_path / "engine", "onnxruntime", "numpy", "OpenEXR")  # no network for pip
    done = subprocess.run(
        [installed / "python", "examples/engine.py"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert not list((tmp_path / "engine").glob("lib/python*/site-packages/deepshade*"))
    shade = exr.read(tmp_path / "ao.exr").pixels["Y"]
    assert shade.std() > 0.01
    assert exr.read(tmp_path / "aa.exr").pixels.keys() == set("RGB")
    assert len(list((tmp_path / "graphs").glob("*.onnx"))) == 3  # of a size, of any, in 16 bits
    if shutil.which("g++"):
        planes = np.fromfile(tmp_path / "shade.f32", np.float32).reshape(shade.shape)
        np.testing.assert_allclose(planes, shade, atol=1e-5)
        run = [tmp_path / "shade_openvino", tmp_path / "models/ao/fast/model.onnx", "512", "384"]
        short = subprocess.run(run, input=b"none", capture_output=True)
        assert short.returncode == 1
        assert f"fewer than {6 * 4 * shade.size} bytes" in short.stderr.decode()
