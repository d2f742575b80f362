"""The researcher's path: the commands of README's "Making your own shader", one after the other.

    python examples/researcher.py            # as they stand there; about a quarter of an hour
    python examples/researcher.py --small    # tiny views and two steps: does every command work?

Run it where `models/ao/balanced` lies, in small `models/ao/fast`. Each command is shown with the
time it took; the first that fails ends it.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import time

from walk import block, lines

# In small: the lightest bundle in place of the balanced one, and of an option that is given twice
# the last counts.
SMALL = {
    "render": "--size 96x64 --spp 8",
    "datagen": "--views 4 --size 64 --spp 8 --shard-size 4",
    "train": "--preset fast --set steps=2 --set warmup=1 --set batch=2",
    "bench": "--models models --quick",
    "report": "--models models --quick --only error --views 1",
}


def commands() -> list[list[str]]:
    """README's, but for the first, which installs: as lists of words."""
    found = [
        shlex.split(line, comments=True)
        for line in lines(block("README.md", "Making your own shader"))
    ]
    return [words for words in found if words[0] == "deepshade"]


def main() -> int:
    """Run them; the exit code is that of the first that fails."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else "")
    parser.add_argument("--small", action="store_true", help="tiny views and two steps")
    options = parser.parse_args()

    from deepshade.cli import main as deepshade

    for words in commands():
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
