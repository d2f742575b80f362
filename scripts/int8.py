"""Times 8 bits against fp32 and bf16 on OpenVINO, and what they cost on `samples/`, on two CPUs.

    ONEDNN_MAX_CPU_ISA=AVX2_VNNI taskset -c 0,1 python scripts/int8.py

The variable holds oneDNN to an instruction set: AVX2, AVX2_VNNI, AVX512_CORE_VNNI; unset it for all
that the CPU has. Then bf16 is timed too, where the CPU calculates in it. 8 bits are timed where the
rule of `deepshade.engines` doesn't offer them, too.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from statistics import mean, median

import numpy as np

from deepshade import exr, metrics, tensors
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade.engines import Backend
from deepshade.engines.openvino import OpenVino, precisions
from deepshade.gbuffer import load_gbuffer

ROOT = Path(__file__).resolve().parent.parent


def main() -> None:
    """The command: a line for each of ao's bundles."""
    held = os.environ.get("ONEDNN_MAX_CPU_ISA")
    bf16 = held is None and "bf16" in precisions()
    print(held or "all instructions", "; ms at 768 x 512, DSSIM on the samples")
    for name in ("fast", "balanced", "best"):
        bundle = Bundle.load(ROOT / "models" / "ao" / name)
        engines = {
            precision: OpenVino(bundle, Backend("openvino", precision), threads=2)
            for precision in ("fp32", "int8", *(["bf16"] if bf16 else []))
        }
        if held:  # what 8 bits leave out would run in 16 bits that are only emulated
            engines["int8"]._type = "f32"
        noise = np.random.default_rng(0).normal(size=(1, 6, 512, 768)).astype(np.float32)
        noise[:, 5] = -np.abs(noise[:, 5]) - 3
        times: dict[str, list[float]] = {precision: [] for precision in engines}
        for turn in range(11):
            for precision, engine in engines.items():
                start = time.perf_counter()
                engine.predict(noise)
                if turn > 1:
                    times[precision].append(1e3 * (time.perf_counter() - start))
        for precision, engine in engines.items():
            error = mean(dssim(engine, path) for path in sorted((ROOT / "samples").glob("*.exr")))
            print(f"  {name:9}{precision:5}{median(times[precision]):8.1f} ms  {error:.5f}")


def dssim(engine: OpenVino, path: Path) -> float:
    """The error of an engine on a sample."""
    bundle, gbuffer = engine.bundle, load_gbuffer(path, engine.bundle.inputs)
    reference = exr.read(path, ["reference_ao.V"]).stack(["reference_ao.V"])
    given = tensors.tensor(
        EFFECTS["ao"],
        gbuffer.attributes,
        bundle.inputs,
        float(gbuffer.header["deepshade:radius"]),
        per_channel=False,
        multiple=bundle.size_multiple,
    )
    height, width = gbuffer.shape
    return metrics.dssim(engine.predict(given)[0, :, :height, :width].clip(0, 1), reference)


if __name__ == "__main__":
    main()
