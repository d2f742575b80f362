"""The built wheel in an environment of its own, by docs/install.md: serves as the clone does."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepshade import exr

ROOT = Path(__file__).parents[2]
EXR = {"Content-Type": "image/x-exr"}
# seconds, but what starts so many programs waits long where others compute
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900), pytest.mark.usefixtures("home")]


@pytest.fixture(scope="module")
def home(
    outside: None,
    wheel: Path,
    environment: Callable[..., Path],
    walk: Any,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """A folder where the commands of "From a wheel" were run; `said` is what they printed.

    What the extras require lay in `env` before, so nothing is downloaded.
    """
    folder = tmp_path_factory.mktemp("home")
    shutil.copy(wheel, folder)
    environment(folder / "env", "deepshade[service,client]")
    first, *commands = walk.lines(walk.block("docs/install.md", "From a wheel"))
    assert first.startswith("pip wheel")
    with (folder / "said").open("w") as log:
        assert walk.run("\n".join(commands), folder=folder, log=log) == 0
    return folder


def test_what_the_page_says_serves_what_ships_to_the_bit(
    home: Path, start: Callable[..., Any]
) -> None:
    bin, said = home / "env" / "bin", (home / "said").read_text()
    assert re.search(rf"ok +models: {re.escape(str(bin.parent))}", said)
    for config in ROOT.glob("models/*/*/config.json"):
        assert re.search(rf"ok +model {config.parts[-3]}/{config.parts[-2]}: sha256", said)
    assert re.search(r"'trainer': missing: .*torch", said)  # doctor sees what is not there

    room = home / "samples" / "room.exr"
    assert room.read_bytes() == (ROOT / "samples" / "room.exr").read_bytes()
    own = start(models=ROOT / "models", engine=None)
    answer = own.client.post("/shade/ao?quality=fast", content=room.read_bytes(), headers=EXR)
    assert answer.status_code == 200
    assert (home / "room-ao.exr").read_bytes() == answer.content

    # what doctor advises is what pip can follow
    code = "from deepshade.extras import install_command; print(install_command('client'))"
    advice = shlex.split(subprocess.check_output([bin / "python", "-c", code], text=True))
    requirement = advice[advice.index("install") + 1]
    assert requirement.startswith(str(home))
    assert requirement.endswith(".whl[client]")
    pip = [sys.executable, "-m", "pip", "--python", str(home / "env"), "install", "-q"]
    subprocess.run([*pip, "--dry-run", requirement], check=True)


def test_the_pages_are_in_the_wheel(wheel: Path) -> None:
    """Nothing of them comes from the repository, or from the internet."""
    folder = ROOT / "service" / "deepshade_service" / "page"
    with zipfile.ZipFile(wheel) as archive:
        for path in filter(Path.is_file, folder.rglob("*")):
            name = path.relative_to(ROOT / "service").as_posix()
            assert archive.read(name) == path.read_bytes()


def test_the_artist_s_commands_bring_frames_to_the_comp(home: Path) -> None:
    """`examples/artist.py`, which runs those of docs/artists.md, in the environment of above."""
    command = [home / "env" / "bin" / "python", ROOT / "examples" / "artist.py", "walk"]
    done = subprocess.run(command, cwd=home, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "4 frames, 3 files a frame: beauty, depth, normal" in done.stderr
    walk = home / "walk"
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
