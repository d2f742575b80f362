"""`examples/artist.py`, from the wheel: docs/artists.md's commands on frames of several files."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from deepshade import exr

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
@pytest.mark.usefixtures("outside")
def test_the_commands_bring_frames_to_the_comp(
    wheel: Path, environment: Callable[..., Path], tmp_path: Path
) -> None:
    bin = environment(tmp_path / "env", "deepshade[service,client]", wheel=wheel)
    command = [bin / "python", ROOT / "examples" / "artist.py", "walk"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "4 frames, 3 files a frame: beauty, depth, normal" in done.stderr
    walk = tmp_path / "walk"
    for k in range(1, 5):
        name = f"shot.{k:04d}.exr"
        assert exr.read(walk / "ao" / f"ao.{k:04d}.exr").pixels["Y"].std() > 0.01
        beauty = exr.read(walk / "renders" / name).pixels
        comp = exr.read(walk / "comp" / name).pixels
        assert comp.keys() == {*beauty, "Z", "normal.X", "normal.Y", "normal.Z", "AO.Y"}
        final = exr.read(walk / "final" / name).pixels
        for band in "RGB":
            np.testing.assert_array_equal(comp[band], beauty[band])
            np.testing.assert_allclose(final[band], beauty[band] * comp["AO.Y"], rtol=2e-3)
    headers = [exr.read_header(path).parts[0].attributes for path in (walk / "comp").iterdir()]
    assert len({header["deepshade:radius"] for header in headers}) == 1  # no flicker
