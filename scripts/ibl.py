"""Write the bundles of `ibl` into models/ibl: look-ups, of which nothing is trained.

python scripts/ibl.py
"""

from __future__ import annotations

from deepshade.bundles import bundle_root
from deepshade_trainer.lookups import export_reflections

LOBES = {"balanced": 1, "best": 2}  # lobes that Phong's is replaced by

for name, lobes in LOBES.items():
    bundle, worst = export_reflections(bundle_root() / "ibl" / name, lobes)
    print(f"{bundle.path} ({bundle.short_hash}), {worst:.1e} from torch")
