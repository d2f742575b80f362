"""Running a bundle's network, on whichever engine and in whichever precision this machine has.

    from deepshade.engines import choose, load_engine

    engine = load_engine(bundle, choose(bundle), threads=cpu_count())
    engine.warm()
    shade = engine.predict(gbuffer)  # (N, C, H, W) float32 to (N, C', H, W) float32

Nothing heavy is imported before it is asked for.
"""

import sys

from deepshade.engines.base import Backend, Engine
from deepshade.engines.registry import REFERENCE, available, choose, load_engine, usable
from deepshade.errors import EngineError

# OpenVINO's wheel brings this package and, whenever it is imported, reports that to its makers over
# the internet, from a forked process. Where it can't be imported OpenVINO does without.
sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]

__all__ = [
    "REFERENCE",
    "Backend",
    "Engine",
    "EngineError",
    "available",
    "choose",
    "load_engine",
    "usable",
]
