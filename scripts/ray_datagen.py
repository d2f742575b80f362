"""`deepshade datagen` for `ray submit`, which runs a script on a cluster's head node.

    ray submit cluster.yaml scripts/ray_datagen.py --out /shared/ao --scenes procedural

All nodes need deepshade with the `workers` extra, and must see --out under the same path.
"""

from __future__ import annotations

import os
import sys

from deepshade.cli import main

os.environ.setdefault("RAY_ADDRESS", "auto")
sys.exit(main(["datagen", *sys.argv[1:]]))
