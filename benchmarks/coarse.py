"""What coarse positions cost, as they are stored and repaired: DSSIM relative to exact ones.

    python benchmarks/coarse.py ao=data/test-ao do=data/test-do [--views 9] [--step 60,30,15]

Positions are cut to steps of a share of the effect's radius, at an offset from the origin, once
rounded and once cut off; the mean over views of each bundle's error, over that with exact ones.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from deepshade.bundles import Bundle, bundle_folders
from deepshade.engines import choose, load_engine
from deepshade.gbuffer.repair import repair
from deepshade.threads import thread_count
from deepshade_report.method import Network
from deepshade_report.view import View, load_views

_OFFSET = np.float64([[[31.7]], [[-77.1]], [[123.3]]])  # in radii


def coarse(view: View, share: float, *, rounded: bool, mend: bool) -> View:
    """The view with positions in steps of `share` of its radius, repaired if asked."""
    step, offset = share * view.radius, _OFFSET * view.radius
    exact = view.attributes["position"].astype(np.float64)
    whole = (np.round if rounded else np.floor)((exact + offset) / step)
    stored = np.where(view.background, 0, whole * step - offset).astype(np.float32)
    attributes = {**view.attributes, "position": stored}
    if mend:
        repair(attributes, ~view.background, view.camera, None, view.radius)
    return replace(view, attributes=attributes)


def error(network: Network, view: View) -> float:
    """DSSIM of a bundle's answer to a view."""
    network.prepare(view)
    return view.dssim(network.shade(view))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="What coarse positions cost.")
    parser.add_argument("data", nargs="+", help="effect=folder")
    parser.add_argument("--models", type=Path, default=Path("models"))
    parser.add_argument("--views", type=int, default=9)
    parser.add_argument("--among", type=int, default=45, help="of so many, evenly")
    parser.add_argument("--step", default="60,30,15", help="shares of the radius, 1 over these")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    table = []
    for pair in options.data:
        effect, _, folder = pair.partition("=")
        among = load_views(Path(folder), effect, options.among)
        views = among[:: max(1, len(among) // options.views)][: options.views]
        for path in bundle_folders(options.models):
            if path.parent.name != effect:
                continue
            bundle = Bundle.load(path)
            network = Network(bundle, load_engine(bundle, choose(bundle), threads=thread_count()))
            exact = [error(network, view) for view in views]
            for part in map(float, options.step.split(",")):
                row = {"effect": effect, "bundle": bundle.name, "step": f"R/{part:g}"}
                for mend in (False, True):
                    cost = [
                        error(network, coarse(view, 1 / part, rounded=rounded, mend=mend))
                        for view in views
                        for rounded in (True, False)
                    ]
                    row["repaired" if mend else "stored"] = float(np.mean(cost) / np.mean(exact))
                table.append(row)
                if not options.json:
                    print(
                        f"{effect}/{row['bundle']} {row['step']}: as stored {row['stored']:.3f}, "
                        f"repaired {row['repaired']:.3f}",
                        flush=True,
                    )
    if options.json:
        print(json.dumps(table, indent=2))


if __name__ == "__main__":
    main()
