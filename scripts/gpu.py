"""Times every bundle on a CUDA GPU with PyTorch alone, beside the paper's network.

    PYTHONPATH=core:trainer python scripts/gpu.py --models models --json gpu.json

Needs torch, numpy, onnx and safetensors. With OpenEXR it also measures errors over `samples/`.
`--device cpu` is a dry run.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import statistics
import time
from collections.abc import Iterator
from contextlib import nullcontext
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from deepshade import metrics, tensors
from deepshade.attributes import ATTRIBUTES
from deepshade.bundles import Bundle, bundle_folders
from deepshade.effects import EFFECTS
from deepshade_trainer.networks import Shader, build, from_bundle
from deepshade_trainer.recipe import preset

SIZES = ((768, 512), (1920, 1080), (3840, 2160))
# Name, whether it is one CUDA graph, TF32 in convolutions, their 16-bit type. The networks
# themselves keep in float32 what has to be.
MODES = (
    ("fp32, eager", False, False, None),
    ("fp32", True, False, None),
    ("TF32", True, True, None),
    ("fp16", True, False, torch.float16),
    ("bf16", True, False, torch.bfloat16),
)
LAYOUTS = {torch.contiguous_format: "NCHW", torch.channels_last: "NHWC"}
FORMS = {"ms": ".3f", "mib": ".0f", "difference": ".1e", "dssim": ".5f"}
RUNS, MAX_SECONDS = 10, 0.2  # in a row; altogether


def scene(inputs: tuple[str, ...], width: int, height: int) -> dict[str, Any]:
    """Attributes (C, H, W) of a wavy floor seen at 50 degrees; those of materials are noise."""
    row, column = np.mgrid[0:height, 0:width].astype(np.float32)
    depth = 4 + np.sin(column / 40) * np.cos(row / 30)
    ray = np.stack([column / width - 0.5, (height / 2 - row) / width, np.full_like(row, -1 / 0.93)])
    position = ray * depth * np.float32(0.93)
    normal = np.cross(np.gradient(position, axis=1), np.gradient(position, axis=2), axis=0)
    normal /= np.linalg.norm(normal, axis=0)
    known = {"position": position, "depth": depth[None], "normal": normal, "normal_world": normal}
    noise = np.random.default_rng(0).random((3, height, width), np.float32)
    return {name: known.get(name, noise[: len(ATTRIBUTES[name].channels)]) for name in inputs}


def network_input(bundle: Bundle, attributes: dict[str, Any], radius: float) -> Tensor:
    """(N, C, h, w): sides padded to the network's multiple; N is 3 for effects by channel."""
    given = EFFECTS[bundle.effect], attributes, bundle.inputs, radius
    runs, step = bundle.per_channel, bundle.size_multiple
    return torch.from_numpy(tensors.tensor(*given, per_channel=runs, multiple=step))


def timed(network: nn.Module, ready: Tensor, mode: tuple[Any, ...]) -> tuple[float, float, Tensor]:
    """Median milliseconds of a run on the device, its MiB at most, and the answer."""
    cuda, (_, graph, torch.backends.cudnn.allow_tf32, dtype) = ready.is_cuda, mode

    def run() -> Any:
        return network(ready)

    # Autocast frees its copies of the weights, which a graph reads, when this block ends.
    with torch.no_grad(), torch.autocast(ready.device.type, dtype) if dtype else nullcontext():
        if cuda:
            torch.cuda.reset_peak_memory_stats()
        answer = run()
        if graph and cuda:
            with torch.cuda.stream(torch.cuda.Stream()):  # cuDNN's workspaces belong to a stream
                run()
            recording = torch.cuda.CUDAGraph()
            with torch.cuda.graph(recording):
                answer = run()
            run = recording.replay
            run()
        times: list[float] = []
        end = time.perf_counter() + MAX_SECONDS
        while len(times) < 3 or (len(times) < 10 * RUNS and time.perf_counter() < end):
            begin = time.perf_counter()
            if not cuda:
                run()
                times.append(1e3 * (time.perf_counter() - begin))
                continue
            events = [torch.cuda.Event(enable_timing=True) for _ in range(RUNS + 1)]
            for event in events:  # many in a row, as in a stream of pictures
                event.record()
                run()
            torch.cuda.synchronize()
            times += [a.elapsed_time(b) for a, b in pairwise(events)]
        mib = torch.cuda.max_memory_allocated() / 2**20 if cuda else float("nan")
        return statistics.median(times), mib, answer.float().cpu()


def errors(bundle: Bundle, network: nn.Module, folder: Path, device: str) -> dict[str, float]:
    """Mean DSSIM over the samples that have the effect's reference, by mode."""
    from deepshade import exr
    from deepshade.gbuffer import load_gbuffer

    found: dict[str, list[float]] = {}
    for path in sorted(folder.glob("*.exr")):
        names = exr.read_header(path).channels()
        if not (names := [n for n in names if n.startswith(f"reference_{bundle.effect}.")]):
            continue
        reference, gbuffer = exr.read(path, names).stack(names), load_gbuffer(path, bundle.inputs)
        radius = float(gbuffer.header.get("deepshade:radius", bundle.radius))
        ready = network_input(bundle, gbuffer.attributes, radius).to(device)
        for mode in MODES:
            answer = timed(network, ready, (mode[0], False, *mode[2:]))[2].flatten(0, 1).numpy()
            answer = answer[:, : reference.shape[1], : reference.shape[2]]
            light = EFFECTS[bundle.effect].is_light
            factor = metrics.exposure(reference) if light else 1.0
            images = ((image * factor).clip(0, 1) for image in (answer, reference))
            found.setdefault(mode[0], []).append(metrics.dssim(*images))
    return {mode: statistics.mean(values) for mode, values in found.items()}


def networks(models: Path) -> Iterator[tuple[str, Bundle, nn.Module]]:
    """Every bundle's network; before an effect's first the paper's, with random weights."""
    seen: set[str] = set()
    for bundle in map(Bundle.load, bundle_folders(models)):
        if bundle.effect not in seen:
            seen.add(bundle.effect)
            paper = build(preset("paper", bundle.effect).network)
            yield f"{bundle.effect}, paper's", bundle, Shader(EFFECTS[bundle.effect], paper)
        yield f"{bundle.effect}/{bundle.name}", bundle, from_bundle(bundle.path)


def main() -> None:
    """The command: prints a table in Markdown, row by row."""
    parser = argparse.ArgumentParser(description="Times every bundle on a GPU with PyTorch alone.")
    parser.add_argument("--models", type=Path, default=Path("models"))
    parser.add_argument("--samples", type=Path, default=Path("samples"))
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--json", type=Path, help="where all figures are written, too")
    options = parser.parse_args()
    device, rows = options.device, []
    torch.backends.cudnn.benchmark = True
    card = torch.cuda.get_device_name() if device == "cuda" else "CPU: a dry run"
    print(f"{card}, PyTorch {torch.__version__}; one picture, input and output on the device\n")
    print("| network | size | mode | layout | ms | MiB | from eager fp32 | DSSIM, samples |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    for name, bundle, network in networks(options.models):
        network.to(device).eval().requires_grad_()  # autocast keeps casts of such weights
        known = name.endswith(f"/{bundle.name}") and importlib.util.find_spec("OpenEXR")
        dssim = errors(bundle, network, options.samples, device) if known else {}
        for width, height in SIZES if device == "cuda" else SIZES[:1]:
            ready = network_input(bundle, scene(bundle.inputs, width, height), bundle.radius)
            exact: Tensor | None = None
            for mode in MODES:
                found = []
                for layout, label in LAYOUTS.items():
                    network.to(memory_format=layout)
                    tensor = ready.to(device).contiguous(memory_format=layout)
                    found.append((*timed(network, tensor, mode), label))
                ms, mib, answer, label = min(found, key=lambda row: row[0])  # the quicker layout
                exact = answer if exact is None else exact
                difference = float((answer - exact).abs().max())
                row = {"network": name, "size": f"{width}x{height}", "mode": mode[0]}
                row |= {"layout": label, "ms": ms, "mib": mib, "difference": difference}
                rows.append(row | {"dssim": dssim.get(mode[0], float("nan"))})
                cells = [f"{value:{FORMS.get(key, '')}}" for key, value in rows[-1].items()]
                print(f"| {' | '.join(cells)} |", flush=True)
    if options.json:
        found = {"device": card, "torch": torch.__version__, "rows": rows}
        options.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
