"""The researcher's path: the commands of README's "Making your own shader", one after the other.

    python examples/researcher.py            # as they stand there; about a quarter of an hour
    python examples/researcher.py --small    # tiny views and two steps: does every command work?

Run it where `models/ao/balanced` lies, in small `models/ao/fast`. Each command is shown with the
time it took; the first that fails ends it.
"""

from __future__ import annotations

import argparse
import re
import shlex
import sys
import time
from pathlib import Path

README = Path(__file__).resolve().parent.parent / "README.md"
# In small: the lightest bundle in place of the balanced one, and of an option that is given twice
# the last counts.
SMALL = {
    "render": "--size 96x64 --spp 8",
    "datagen": "--views 4 --size 64 --spp 8 --shard-size 4",
    "train": "--preset fast --set steps=2 --set warmup=1 --set batch=2",
    "bench": "--models models --quick",
    "report": "--models models --quick --only error --views 1",
}


def commands(document: str, heading: str) -> list[list[str]]:
    """The `deepshade` commands of the first shell block under a heading, as lists of words."""
    block = re.search(rf"^## {heading}$.*?^```sh\n(.*?)^```", document, re.DOTALL | re.MULTILINE)
    if block is None:
        raise ValueError(f"no shell block under {heading!r}")
    lines = block[1].replace("\\\n", " ").splitlines()
    return [
        words for line in lines if (words := shlex.split(line, comments=True))[:1] == ["deepshade"]
    ]


def main() -> int:
    """Run them; the exit code is that of the first that fails."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else "")
    parser.add_argument("--small", action="store_true", help="tiny views and two steps")
    options = parser.parse_args()

    from deepshade.cli import main as deepshade

    for words in commands(README.read_text("utf-8"), "Making your own shader"):
        if options.small:
            words = [word.replace("ao/balanced", "ao/fast") for word in words]
            words += SMALL.get(words[1], "").split()
        print(f"$ {shlex.join(words)}", flush=True)
        begun = time.monotonic()
        code = deepshade(words[1:])
        print(f"# {time.monotonic() - begun:.0f} s\n", flush=True)
        if code:
            return code
    return 0


if __name__ == "__main__":
    sys.exit(main())
