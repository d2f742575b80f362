"""What checking a G-buffer against itself costs of a request, in turns on one core.

    python benchmarks/checks.py [--models models] [--input view.exr] [--json]

Loading with checks less loading without (`?trust=1`), over all that a request of the fastest bundle
takes: loading, the network and encoding. The checks find nothing wrong in the picture.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from deepshade import exr, tensors
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade.engines import choose, load_engine
from deepshade.gbuffer import load_gbuffer
from deepshade.gbuffer.conventions import Conventions
from deepshade.timing import Pace, alternate, ratio, spread

sys.path.insert(0, str(Path(__file__).parent))
from service import analytic_picture


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="What the checks cost of a request.")
    parser.add_argument("--models", type=Path, default=Path("models"))
    parser.add_argument("--input", type=Path, help="EXR instead of an analytic one, 768 x 512")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    body = options.input.read_bytes() if options.input else analytic_picture(512, 768)
    bundle = Bundle.load(options.models / "ao" / "fast")
    engine = load_engine(bundle, choose(bundle), threads=1)
    trust = Conventions(checks="trust")

    def load(conventions: Conventions | None = None) -> tensors.Float:
        # beside so large a radius no positions are coarse: their repair isn't a check
        gbuffer = load_gbuffer(body, bundle.inputs, conventions=conventions, radius=1e3)
        effect = EFFECTS[bundle.effect]
        return tensors.tensor(effect, gbuffer.attributes, bundle.inputs, 0.5, per_channel=False)

    ready = load()
    engine.prepare(*ready.shape[2:])
    answer = engine.predict(ready)[0]

    def rest() -> None:
        engine.predict(ready)
        exr.write(io.BytesIO(), {"Y": answer[0]}, half=True)

    def timed(work: Callable[[], object]) -> Callable[[], dict[str, float]]:
        def run() -> dict[str, float]:
            begin = time.process_time()  # of the CPU: other work on the machine doesn't count
            work()
            return {"ms": 1e3 * (time.process_time() - begin)}

        return run

    tasks = {"checked": timed(load), "trusted": timed(lambda: load(trust)), "rest": timed(rest)}
    found = alternate(tasks, Pace(options.seconds, min_rounds=10, max_rounds=200))
    times = {name: np.asarray(values["ms"]) for name, values in found.items()}
    cost, whole = times["checked"] - times["trusted"], times["checked"] + times["rest"]
    result = {
        "milliseconds": {name: spread(list(values)) for name, values in times.items()},
        "checks / request": ratio(list(cost), list(whole)),
    }
    if options.json:
        print(json.dumps(result, indent=2))
        return
    for name, value in {
        **result["milliseconds"],
        "checks / request": result["checks / request"],
    }.items():
        low, high = value["quartiles"]
        print(f"  {name:18} {value['median']:8.3f}   ({low:.3f} to {high:.3f})")


if __name__ == "__main__":
    main()
