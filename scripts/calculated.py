"""Write the bundles whose shaders are calculated into models/: nothing is trained here.

`do` and `full` hold the weights of a bundle of `ao`, as they are. With --test, data sets of
'deepshade datagen', they are measured for their model cards, which else say that they weren't.

python scripts/calculated.py --only ibl/balanced ibl/best full/balanced --test data/test-env
"""

from __future__ import annotations

from argparse import ArgumentParser
from pathlib import Path
from typing import Any

from deepshade.bundles import Bundle, bundle_root
from deepshade_trainer.calculated import export_calculated
from deepshade_trainer.card import measure, write_card

# of which kind a bundle's network is, with its settings, and whose weights a part of it has
BUNDLES: dict[str, tuple[dict[str, Any], str]] = {
    "do/balanced": ({"kind": "openings"}, "ao/balanced"),
    "dof/balanced": ({"kind": "discs"}, ""),
    "full/balanced": ({"kind": "lens"}, "ao/fast"),
    "ibl/balanced": ({"kind": "reflections", "lobes": 1}, ""),
    "ibl/best": ({"kind": "reflections", "lobes": 2}, ""),
}
_MAPS = """ Beside the picture it takes {} (`deepshade.environments.INPUTS`); [how it
works](../../../docs/environments.md)."""
_TWO = _MAPS.format("`lobes` and `turn`")
NOTES = {
    "do": "What is blocked is calculated: 12 slices through each cell of 4 x 4 pixels, 17 samples "
    "up to 145 pixels away in each, sectors of equal solid angle. It is made to add up to nearly "
    "what `{}`, whose weights it holds, says under a white map. Sampling is coarse where a radius "
    "is few pixels: contact shadows thinner than a cell are soft; what isn't in the picture blocks "
    "nothing." + _MAPS.format("`lobes`, `turn` and `camera`"),
    "dof": "Light is spread over discs of ten sizes, near and far side apart; all is calculated. "
    "Near edges of large circles are a little off where the picture doesn't show what is behind "
    "them.",
    "full": "The light of `ibl/balanced`, times `{}`, whose weights it holds, through the lens of "
    "`dof/balanced`: one graph, of which nothing more is trained." + _TWO,
    "ibl": "Look-ups in the map blurred by cosine lobes; Phong's over a surface is replaced by one "
    "(`balanced`) or two (`best`) with its moments." + _TWO,
}
_MORE = "\n\n`python scripts/calculated.py` writes this folder."


def main() -> None:
    """Write, and measure if asked to."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--test", type=Path, nargs="*", default=[], help="data for the cards")
    parser.add_argument("--only", nargs="*", choices=BUNDLES, help="such as full/balanced")
    asked, root = parser.parse_args(), bundle_root()
    for name in asked.only or BUNDLES:
        settings, of = BUNDLES[name]
        part = Bundle.load(root / of) if of else None
        bundle, worst = export_calculated(root / name, of=part, **settings)
        if asked.test:
            bundle = measure(bundle, asked.test)
        write_card(bundle, None, NOTES[bundle.effect].format(of) + _MORE)
        print(f"{root / name} ({bundle.short_hash}), {worst:.1e} from torch")


if __name__ == "__main__":
    main()
