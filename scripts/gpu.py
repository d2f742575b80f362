"""Times every bundle on a CUDA GPU with PyTorch alone, and the paper's networks.

    PYTHONPATH=core:trainer python scripts/gpu.py --models models

Needs torch, numpy, onnx and safetensors; OpenEXR to measure errors over `samples/`, too.
"""

from __future__ import annotations

import argparse
import time
from contextlib import nullcontext
from functools import partial
from importlib.util import find_spec
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
from deepshade.environments import Prepared, sky
from deepshade_trainer.networks import Shader, build, from_bundle
from deepshade_trainer.recipe import preset

SIZES = ((768, 512), (1920, 1080), (3840, 2160))
MODES = (  # name, as one CUDA graph, 16-bit type (but for what has to be in float32)
    ("fp32, eager", False, None),
    ("fp32", True, None),
    ("fp16", True, torch.float16),
)
LAYOUTS = {torch.contiguous_format: "NCHW", torch.channels_last: "NHWC"}
Given = tuple[Tensor, ...]  # a picture, and what describes the environment
RUNS, MAX_SECONDS = 10, 0.1  # in a row; altogether


def network_input(bundle: Bundle, attributes: dict[str, Any], radius: float) -> Tensor:
    """(N, C, h, w): sides padded to the network's multiple; N is 3 for effects by channel."""
    given = EFFECTS[bundle.effect], attributes, bundle.inputs, radius
    runs, step = bundle.per_channel, bundle.size_multiple
    return torch.from_numpy(tensors.tensor(*given, per_channel=runs, multiple=step))


def scene(bundle: Bundle, width: int, height: int) -> Tensor:
    """The network's input of a wall 4 away; its attributes are waves."""
    row, column = np.mgrid[0:height, 0:width].astype(np.float32)
    waves = np.stack([np.sin(column / 40), np.cos(row / 30), np.sin((row + column) / 50)])
    known = {"position": waves - np.float32([[[0]], [[0]], [[4]]]), "depth": waves[:1] + 4}
    attributes = {n: known.get(n, waves[: len(ATTRIBUTES[n].channels)]) for n in bundle.inputs}
    return network_input(bundle, attributes, bundle.radius)


def timed(network: nn.Module, ready: Given, mode: tuple[Any, ...]) -> tuple[float, float, Tensor]:
    """Median milliseconds of a run on the device, its MiB at most, and the answer."""
    _, graph, dtype = mode
    run = partial(network, *ready)
    # Autocast frees its copies of the weights, which a graph reads, when this block ends.
    with torch.no_grad(), torch.autocast("cuda", dtype) if dtype else nullcontext():
        if not ready[0].is_cuda:
            return np.nan, np.nan, run()
        torch.cuda.reset_peak_memory_stats()
        answer = run()
        if graph:
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
            events = [torch.cuda.Event(enable_timing=True) for _ in range(RUNS + 1)]
            for event in events:  # many in a row, as in a stream of pictures
                event.record()
                run()
            torch.cuda.synchronize()
            times += [a.elapsed_time(b) for a, b in pairwise(events)]
        mib = torch.cuda.max_memory_allocated() / 2**20
        return float(np.median(times)), mib, answer.float().cpu()


def errors(bundle: Bundle, network: nn.Module, modes: Any, device: str) -> dict[str, float]:
    """Mean DSSIM over the samples that have the effect's reference, by mode."""
    from deepshade import exr, gbuffer

    found: dict[str, list[float]] = {}
    prefix = f"reference_{bundle.effect}."
    for path in sorted(Path("samples").glob("*.exr")):
        if names := [n for n in exr.read_header(path).channels() if n.startswith(prefix)]:
            picture = gbuffer.load_gbuffer(path, bundle.inputs)
            reference = exr.read(path, names).stack(names)
            factor = metrics.exposure(reference) if EFFECTS[bundle.effect].is_light else 1.0
            radius = float(picture.header.get("deepshade:radius", bundle.radius))
            ready = network_input(bundle, picture.attributes, radius).to(device)
            for name, _, dtype in modes:
                answer = timed(network, (ready,), (name, False, dtype))[2].flatten(0, 1).numpy()
                answer = answer[:, : reference.shape[1], : reference.shape[2]]
                images = ((image * factor).clip(0, 1) for image in (answer, reference))
                found.setdefault(name, []).append(metrics.dssim(*images))
    return {name: float(np.mean(values)) for name, values in found.items()}


def networks(models: Path) -> list[tuple[str, Bundle, nn.Module]]:
    """Every bundle's network, and the paper's of every effect, with random weights."""
    bundles = [Bundle.load(folder) for folder in bundle_folders(models)]
    effects = {bundle.effect: bundle for bundle in bundles}
    papers = {name: Shader(EFFECTS[name], build(preset("paper", name).network)) for name in effects}
    ours = [(f"{b.effect}/{b.name}", b, from_bundle(b.path)) for b in bundles]
    return ours + [(f"{name}, the paper's", effects[name], each) for name, each in papers.items()]


def given(bundle: Bundle, device: str) -> list[Tensor]:
    """What its graph takes beside a picture: a sky, prefiltered."""
    if not bundle.environment:
        return []
    found = Prepared.of(sky(height=64)).inputs(bundle.environment, 30.0, "y", lambda: np.eye(3))
    return [torch.from_numpy(found[name]).to(device) for name in bundle.environment]


def main() -> None:
    """The command: prints a table in Markdown, row by row."""
    torch.backends.cudnn.benchmark, torch.backends.cudnn.allow_tf32 = True, False
    parser = argparse.ArgumentParser(description="Times every bundle on a GPU with PyTorch alone.")
    parser.add_argument("--models", type=Path, default=Path("models"))
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    options = parser.parse_args()
    cuda = options.device == "cuda"  # else a dry run: a CPU may take seconds in 16 bits
    sizes, modes = (SIZES, MODES) if cuda else (SIZES[:1], MODES[:2])
    print(torch.cuda.get_device_name() if cuda else "CPU", "with PyTorch", torch.__version__)
    print("\n| network | size | mode | layout | ms | MiB | from eager fp32 | DSSIM, samples |")
    print("|---|---|---|---|---|---|---|---|")
    for name, bundle, network in networks(options.models):
        network.to(options.device).eval().requires_grad_()  # autocast keeps casts of such weights
        paper = "the paper's" in name  # whose weights are random, and which knows one environment
        further = [] if paper else given(bundle, options.device)
        known = not paper and not further and find_spec("OpenEXR")
        dssim = errors(bundle, network, modes, options.device) if known else {}
        for width, height in sizes:
            ready, exact = scene(bundle, width, height).to(options.device), None
            for mode in modes if width == SIZES[0][0] else modes[1:]:
                found = []
                for layout, label in LAYOUTS.items():
                    tensor = ready.contiguous(memory_format=layout), *further
                    found.append((*timed(network.to(memory_format=layout), tensor, mode), label))
                ms, mib, answer, label = min(found, key=lambda row: row[0])  # the quicker layout
                exact = answer if exact is None else exact
                away, error = (answer - exact).abs().max(), dssim.get(mode[0], np.nan)
                row = f"| {name} | {width}x{height} | {mode[0]} | {label} | {ms:.3f} | {mib:.0f} "
                print(f"{row}| {away:.1e} | {error:.5f} |", flush=True)


if __name__ == "__main__":
    main()
