"""`examples/glsl` and `examples/web`: programs without deepshade shade as the bundle does."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepshade import exr, tensors
from deepshade.bundles import Bundle
from deepshade.cli import main
from deepshade.effects import EFFECTS
from deepshade.errors import EngineError
from deepshade.gbuffer import load_gbuffer
from deepshade_report.programs import gl_context
from deepshade_trainer.graph import session

ROOT = Path(__file__).resolve().parents[2]
FAST = ROOT / "models" / "ao" / "fast"
RADIUS, FOV = 10**-0.4, 50.0  # where the page's slider stands
HEIGHT, WIDTH = 60, 90  # less than the program's size
# of a browser: WebGPU on its own software renderer
FLAGS = (
    "--no-sandbox --disable-quic --no-first-run --disable-background-networking "
    "--enable-unsafe-webgpu --enable-features=Vulkan --use-webgpu-adapter=swiftshader"
)
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def shot(tmp_path_factory):
    """A part of the shipped G-buffer with a hole in it, and the bundle's answer."""
    image = exr.read(ROOT / "samples" / "room.exr")
    channels = {name: plane[150:210, 200:290].copy() for name, plane in image.pixels.items()}
    channels["Z"][10:20, :15] = np.inf
    path = tmp_path_factory.mktemp("shot") / "shot.exr"
    with path.open("wb") as file:
        exr.write(file, channels, attributes={"deepshade:fov": FOV})
    bundle = Bundle.load(FAST)
    given = load_gbuffer(path, bundle.inputs)
    gbuffer = tensors.tensor(
        EFFECTS["ao"], given.attributes, bundle.inputs, RADIUS, per_channel=False, multiple=32
    )
    shade = session(bundle.model).run(None, {"gbuffer": gbuffer})[0][0, 0, :HEIGHT, :WIDTH]
    assert shade.std() > 0.01
    return path, np.where(given.background, 1, shade)


def exported(language, folder):
    """The program, of 96 x 64."""
    assert main(["export", str(FAST), "--to", language, "--size", "96x64", "-o", str(folder)]) == 0
    return folder / f"ao-fast-96x64-{language}"


def test_a_program_of_100_lines_shades_without_a_window(shot, tmp_path):
    pytest.importorskip("moderngl")
    try:
        gl_context(430).release()
    except EngineError as error:
        pytest.skip(str(error))
    program = ROOT / "examples" / "glsl" / "shade.py"
    assert "deepshade" not in program.read_text().partition('"""\n\n')[2]
    assert len(program.read_text().splitlines()) <= 100
    path, expected = shot
    target = tmp_path / "ao.png"
    words = [exported("glsl", tmp_path), path, target, RADIUS, FOV]
    done = subprocess.run(
        [sys.executable, *map(str, [program, *words])], capture_output=True, text=True, timeout=200
    )
    assert done.returncode == 0, done.stderr
    shade = np.asarray(Image.open(target), np.float32) / 255
    np.testing.assert_allclose(shade, expected, atol=0.003)  # half a step of 8 bits, and a little


def test_a_page_shades_by_webgpu_without_a_server(shot, tmp_path):
    playwright = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("no Chromium")
    path, expected = shot
    target = tmp_path / "ao.html"
    words = [exported("wgsl", tmp_path), path, FOV, target]
    build = ROOT / "examples" / "web" / "build.py"
    done = subprocess.run(
        [sys.executable, *map(str, [build, *words])], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(executable_path=chromium, args=FLAGS.split())
        page = browser.new_page()
        page.goto(target.as_uri())
        page.wait_for_function("window.answer", timeout=240_000)
        error = page.evaluate("window.answer.error ?? ''")
        if "no WebGPU" in error:
            pytest.skip(error)
        assert not error
        assert page.evaluate("window.answer.radius") == pytest.approx(RADIUS)
        shade = np.array(page.evaluate("Array.from(window.answer.shade)"), np.float32)
        pixels = page.evaluate(
            "Array.from(document.getElementById('shade').getContext('2d')"
            f".getImageData(0, 0, {WIDTH}, {HEIGHT}).data)"
        )
        browser.close()
    shown = np.array(pixels, np.float32).reshape(HEIGHT, WIDTH, 4)[..., 0] / 255
    np.testing.assert_allclose(shown, expected, atol=0.003)
    found = np.where(expected < 1, shade.reshape(64, 96)[:HEIGHT, :WIDTH], expected)
    np.testing.assert_allclose(found, expected, atol=1e-5)
