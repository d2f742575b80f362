"""`examples/onnx`: programs without deepshade give the service's answers."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import numpy as np
import pytest

from deepshade import exr, tensors
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade.gbuffer import load_gbuffer

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples" / "onnx"
RADIUS, FOV = 0.4, 50.0
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def shot(tmp_path_factory):
    """A part of the shipped G-buffer with a hole in it: sides that must be padded, background."""
    image = exr.read(ROOT / "samples" / "room.exr")
    channels = {name: plane[60:160, 90:390].copy() for name, plane in image.pixels.items()}
    channels["Z"][20:50, 200:] = np.inf
    path = tmp_path_factory.mktemp("shot") / "shot.exr"
    with path.open("wb") as file:
        exr.write(file, channels, attributes={"deepshade:fov": FOV})
    return path


@pytest.fixture
def served(start, tmp_path, shot):
    """What the service answers: `served("ao", "fast")`, (C, H, W)."""
    for name in ("ao/fast", "aa/balanced"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).symlink_to(ROOT / "models" / name)
    client = start(models=tmp_path, engine="onnxruntime", memory=2**30).client

    def shade(effect):
        query = f"?half=false&radius={RADIUS}" if effect == "ao" else "?half=false"
        headers = {"Content-Type": "image/x-exr"}
        response = client.post(
            f"/shade/{effect}{query}", content=shot.read_bytes(), headers=headers
        )
        assert response.status_code == 200, response.text
        return planes(response.content, effect)

    return shade


def planes(body, effect):
    pixels = exr.read(body).pixels
    return np.stack([pixels[name] for name in EFFECTS[effect].outputs])


@pytest.mark.parametrize(
    ("program", "effect", "model", "words"),
    [("shade.py", "ao", "ao/fast", [RADIUS, FOV]), ("light.py", "aa", "aa/balanced", [])],
)
def test_a_program_of_20_lines_gives_the_services_answer(
    program, effect, model, words, served, shot, tmp_path
):
    source = (EXAMPLES / program).read_text()
    assert "deepshade" not in source.partition('"""\n\n')[2]
    graph, target = ROOT / "models" / model / "model.onnx", tmp_path / "out.exr"
    command = [sys.executable, EXAMPLES / program, graph, shot, target, *words]
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    answer = served(effect)
    assert answer.std() > 0.01
    np.testing.assert_allclose(planes(target.read_bytes(), effect), answer, atol=1e-5)


def headers_of_onnxruntime():
    """The folder with ONNX Runtime's C++ headers; its package for Python has none."""
    named = os.environ.get("ONNXRUNTIME_INCLUDE")
    places = [named] if named else ["/usr/include/onnxruntime", "/usr/local/include/onnxruntime"]
    return next((p for p in map(Path, places) if (p / "onnxruntime_cxx_api.h").exists()), None)


def test_cpp_gives_the_services_answer(served, shot, tmp_path):
    """`tests/walks/test_engine.py` has OpenVINO's."""
    compiler = shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        pytest.skip("no C++ compiler")
    include = headers_of_onnxruntime()
    if include is None:
        pytest.skip("no onnxruntime_cxx_api.h: name its folder in ONNXRUNTIME_INCLUDE")
    files = [str(file.locate()) for file in distribution("onnxruntime").files or ()]
    found = next(
        (Path(file) for file in files if Path(file).match("capi/libonnxruntime.so.*")), None
    )
    if found is None:
        pytest.skip("no shared library of ONNX Runtime on this system")
    # a package has the library by its full version alone, programs ask for its first number
    (tmp_path / ".".join(found.name.split(".")[:3])).symlink_to(found)
    options = ["-std=c++17", "-Wall", "-Werror", f"-Wl,-rpath,{found.parent}:{tmp_path}"]
    sources = ["-isystem", include, EXAMPLES / "shade.cpp", found, "-o", tmp_path / "shade"]
    built = subprocess.run([compiler, *options, *sources], capture_output=True, text=True)
    assert built.returncode == 0, built.stderr[:2000]
    bundle = Bundle.load(ROOT / "models" / "ao" / "fast")
    given = load_gbuffer(shot, bundle.inputs)
    gbuffer = tensors.tensor(
        EFFECTS["ao"], given.attributes, bundle.inputs, RADIUS, per_channel=False, multiple=64
    )
    height, width = gbuffer.shape[2:]
    run = [tmp_path / "shade", bundle.model, str(width), str(height)]
    done = subprocess.run(run, input=gbuffer.tobytes(), capture_output=True, timeout=120)
    assert done.returncode == 0, done.stderr
    shade = np.frombuffer(done.stdout, np.float32).reshape(1, height, width)
    np.testing.assert_allclose(
        shade[:, : given.shape[0], : given.shape[1]], served("ao"), atol=1e-5
    )
    short = subprocess.run(run, input=b"none", capture_output=True, timeout=120)
    assert short.returncode == 1
    assert f"fewer than {gbuffer.nbytes} bytes" in short.stderr.decode()
