"""The engine programmer's path: the networks without deepshade, as docs/onnx.md says.

    python examples/engine.py    # in a clone, or wherever examples, models and samples lie

Makes the environment `engine` with three packages, shades a sample by ONNX Runtime, writes graphs
for one size and any, and compiles and runs the C++ programs: OpenVINO's where there is a compiler,
ONNX Runtime's where the variable ORT says where its release lies. Takes about a minute.
"""

from __future__ import annotations

import os
import shutil
import sys

from walk import block, run


def main() -> int:
    """Run the commands; the exit code is that of the first that fails."""
    guide = "docs/onnx.md"
    blocks = [block(guide, "The network in a renderer of your own"), block(guide, "Operators")]
    if shutil.which("g++") is None:
        print("no g++: the programs in C++ are left out", file=sys.stderr)
    else:
        blocks += [block(guide, "C++", number=k) for k in (0, 1) if k or "ORT" in os.environ]
    return run(*blocks)


if __name__ == "__main__":
    sys.exit(main())
