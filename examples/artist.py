"""The artist's path: from frames, a file for each pass, to frames for the comp.

    python examples/artist.py walk    # in the folder `walk`; about half a minute

Makes a short sequence out of a sample, as a renderer would leave it, and runs the commands of
docs/artists.md on it. `walk/ao` then holds the occlusion, `walk/comp` EXRs with it as a layer, and
`walk/final` the multiplied beauty.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from walk import block, run

from deepshade import exr
from deepshade.files import shipped

FRAMES = 4
PASSES = {"_normal": "normal.", "_depth": "Z", "": "light."}  # file name's end -> channels


def make_frames(folder: Path) -> None:
    """`shot.####.exr` with depth alone, and `renders/shot_<pass>.####.exr` with a file for each."""
    sample = exr.read(shipped("samples") / "room.exr")
    fov = sample.header.parts[0].attributes["deepshade:fov"]
    (folder / "renders").mkdir(parents=True, exist_ok=True)
    for frame in range(FRAMES):
        # every fourth pixel, each time another one: a camera that moves a little
        seen = {n: p[frame::FRAMES, frame::FRAMES].copy() for n, p in sample.pixels.items()}
        exr.write(folder / f"shot.{frame + 1:04d}.exr", {"Z": seen["Z"]})
        for end, start in PASSES.items():
            channels = {n: plane for n, plane in seen.items() if n.startswith(start)}
            if start == "light.":  # a beauty has plain names
                channels = {n.removeprefix(start): plane for n, plane in channels.items()}
            path = folder / "renders" / f"shot{end}.{frame + 1:04d}.exr"
            exr.write(path, channels, attributes={"deepshade:fov": fov})


def main() -> int:
    """Make the frames and shade them; the exit code is that of the first command that fails."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else "")
    parser.add_argument("folder", type=Path, help="where to; made if it isn't there")
    folder = parser.parse_args().folder
    make_frames(folder)
    guide = "docs/artists.md"
    return run(block(guide, "A sequence"), block(guide, "Into the comp"), folder=folder)


if __name__ == "__main__":
    sys.exit(main())
