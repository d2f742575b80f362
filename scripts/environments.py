"""Write the bundles of effects under an environment into models/: nothing is trained here.

`ibl` looks its answer up. `full` chains it with the bundles of `ao` and `dof`. With --test, data
sets of 'deepshade datagen', they are measured and get their model cards; else only their graphs
are written.

python scripts/environments.py --test data/test-env
"""

from __future__ import annotations

from argparse import ArgumentParser
from pathlib import Path

from deepshade.bundles import Bundle, bundle_root
from deepshade_trainer.card import measure, write_card
from deepshade_trainer.lookups import export_lens, export_reflections

LOBES = {"balanced": 1, "best": 2}  # lobes that Phong's is replaced by
CHAINED = "ao/fast", "dof/balanced"
NOTES = {
    "ibl": "Look-ups in the map blurred by cosine lobes; Phong's over a surface is replaced by one "
    "(`balanced`) or two (`best`) with its moments.",
    "full": "The light of `ibl/balanced`, times `{}`, through the lens of `{}`, whose weights it "
    "holds: one graph, of which nothing more is trained.",
}
MORE = """ Beside the picture it takes `lobes` (`deepshade.environments.lobes.prefilter`) and `turn`
(`deepshade.environments.world_to_map`). `python scripts/environments.py` writes this folder;
[how it works](../../../docs/environments.md)."""


def main() -> None:
    """Write, and measure if asked to."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--test", type=Path, nargs="*", default=[], help="data for the cards")
    parser.add_argument("--only", nargs="*", default=[], help="such as full/balanced")
    asked, root = parser.parse_args(), bundle_root()
    made = [f"ibl/{name}" for name in LOBES] + ["full/balanced"]
    for name in asked.only or made:
        folder = root / name
        if folder.parent.name == "ibl":
            bundle, worst = export_reflections(folder, LOBES[folder.name])
        else:
            bundle, worst = export_lens(folder, *(Bundle.load(root / each) for each in CHAINED))
        if asked.test:
            bundle = measure(bundle, asked.test)
            write_card(bundle, None, NOTES[bundle.effect].format(*CHAINED) + MORE)
        print(f"{folder} ({bundle.short_hash}), {worst:.1e} from torch")


if __name__ == "__main__":
    main()
