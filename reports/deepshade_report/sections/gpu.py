"""Device time on a GPU, and the same code on the CPU where there is none: the section `gpu`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from deepshade.bundles import Bundle
from deepshade.engines import Backend, EngineError, available, load_engine
from deepshade.errors import DeepshadeError
from deepshade_report import frames
from deepshade_report.context import Context
from deepshade_report.sections.service import serving
from deepshade_report.server import Connection, request_path
from deepshade_report.statistics import ratio, significant, spread
from deepshade_report.subjects import PAPER, REFERENCE, stacked
from deepshade_report.timing import alternate

_SECONDS = 20.0
# Runs in a row on the device before it is waited for: launches overlap there, as in a stream.
_RUNS = {"cuda": 10, "cpu": 2}
_REQUESTS = 7


@dataclass(frozen=True, slots=True)
class Route:
    """A way to run a graph with its input and output on the device.

    `options` are the provider's, in ONNX Runtime's words. A CUDA graph records all launches once
    and replays them as one: for small networks the launches are what takes the time.
    """

    label: str
    provider: str
    device: str
    options: tuple[tuple[str, str], ...] = ()
    backend: Backend = REFERENCE


GPU_ROUTES = (
    Route("CUDA", "CUDAExecutionProvider", "cuda", backend=Backend("cuda", "fp32")),
    Route(
        "CUDA, CUDA graph",
        "CUDAExecutionProvider",
        "cuda",
        (("enable_cuda_graph", "1"),),
        Backend("cuda", "fp32"),
    ),
    Route(
        "TensorRT fp16",
        "TensorrtExecutionProvider",
        "cuda",
        (("trt_fp16_enable", "1"),),
        Backend("tensorrt", "fp16"),
    ),
    Route(
        "TensorRT fp16, CUDA graph",
        "TensorrtExecutionProvider",
        "cuda",
        (("trt_fp16_enable", "1"), ("trt_cuda_graph_enable", "1")),
        Backend("tensorrt", "fp16"),
    ),
)
CPU_ROUTE = Route("CPU, the same code", "CPUExecutionProvider", "cpu")


def routes() -> list[Route]:
    """What ONNX Runtime offers for GPUs here; the CPU alone where there is no GPU."""
    import onnxruntime

    present = onnxruntime.get_available_providers()
    found = [route for route in GPU_ROUTES if route.provider in present and _has_device()]
    return found or [CPU_ROUTE]


def gpu(context: Context) -> dict[str, Any]:
    """Per network and route: device time, host to host time, and end to end through the service.

    Device time: input and output stay on the device; several runs are queued, then waited for.
    Host to host: `Engine.predict`, copies included. End to end: the service's own stages.
    """
    view = frames.extended(frames.fullest(context.held_out), frames.HEIGHT, frames.WIDTH)
    chosen = routes()
    here = chosen != [CPU_ROUTE]
    networks = [(bundle.name, bundle) for bundle in context.served]
    if context.baseline:
        networks.insert(0, (PAPER, context.baseline))
    tasks: dict[str, Callable[[], object]] = {}
    runs: dict[str, int] = {}
    failed: dict[str, str] = {}
    for name, bundle in networks:
        ready = stacked(bundle, view)
        for route in chosen:
            label = f"{name}, {route.label}"
            context.advance(0.0, label)
            try:
                task = on_device(bundle, route, ready, context.threads)
                task()
            except Exception as error:  # whatever the provider raises, the others go on
                failed[label] = str(error).splitlines()[0][:300]
                continue
            tasks[f"{label}: device"], runs[f"{label}: device"] = task, _RUNS[route.device]
        for backend in dict.fromkeys(route.backend for route in chosen):
            label = f"{name}, {backend}: host to host"
            try:
                engine = load_engine(bundle, backend, threads=context.threads)
                engine.warm()
            except EngineError as error:
                failed[label] = str(error)
                continue
            tasks[label], runs[label] = _predicting(engine.predict, ready), 1
    times = alternate(tasks, context.pace(_SECONDS, fewest=5, most=20), advance=context.advance)
    rows = [
        {"what": name, "ms": spread([value / runs[name] for value in values])}
        for name, values in times.items()
    ]
    return {
        "gpu": _device_name() if here else None,
        "frame": [frames.WIDTH, frames.HEIGHT],
        "available": [str(backend) for backend in available()],
        "rows": rows,
        "end_to_end": _end_to_end(context, view, chosen),
        "failed": failed,
    }


def on_device(bundle: Bundle, route: Route, ready: Any, threads: int) -> Callable[[], object]:
    """Some runs in a row with everything on the device, and then a wait for the last.

    Raises what ONNX Runtime raises when the provider or one of its libraries is missing.
    """
    import onnxruntime

    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = threads
    settings.log_severity_level = 3
    providers: list[Any] = [(route.provider, dict(route.options))]
    session = onnxruntime.InferenceSession(str(bundle.model), settings, providers=providers)
    if route.provider not in session.get_providers():
        raise DeepshadeError(f"ONNX Runtime could not start {route.provider}")
    binding = session.io_binding()
    value = onnxruntime.OrtValue
    outputs = len(bundle.outputs)
    shape = [1, outputs, *ready.shape[2:]]
    source = value.ortvalue_from_numpy(ready, route.device, 0)
    target = value.ortvalue_from_shape_and_type(shape, np.float32, route.device, 0)
    binding.bind_ortvalue_input(bundle.input_name, source)
    binding.bind_ortvalue_output(bundle.output_name, target)

    def run() -> object:
        for _ in range(_RUNS[route.device]):
            session.run_with_iobinding(binding)
        binding.synchronize_outputs()
        return target

    return run


def _end_to_end(context: Context, view: Any, chosen: list[Route]) -> list[dict[str, Any]]:
    body = frames.body(view)
    rows = []
    with serving(context) as server:
        connection = server.connect()
        for bundle in context.served:
            plain = request_path(connection, context.effect, bundle.name, body)
            for backend in dict.fromkeys(route.backend for route in chosen):
                path = _pinned(connection, plain, backend, body)
                for _ in range(3):
                    connection.shade(path, body)
                replies = [connection.shade(path, body) for _ in range(_REQUESTS)]
                total = [reply.server for reply in replies]
                infer = [reply.stages.get("infer", 0.0) for reply in replies]
                rows.append(
                    {
                        "bundle": bundle.name,
                        "request": path,
                        "backend": replies[-1].backend,
                        "total_ms": spread(total),
                        "infer_ms": spread(infer),
                        "share_of_infer": significant(ratio(infer, total)["median"]),
                    }
                )
        connection.close()
    return rows


def _pinned(connection: Connection, path: str, backend: Backend, body: bytes) -> str:
    """The path with the backend pinned, or without where the service can't."""
    pinned = f"{path}&engine={backend.engine}&precision={backend.precision}"
    return pinned if connection.ask("POST", pinned, body).status == 200 else path


def _predicting(predict: Callable[[Any], object], ready: Any) -> Callable[[], object]:
    return lambda: predict(ready)


def _has_device() -> bool:
    from pathlib import Path

    return Path("/dev/nvidia0").exists() or Path("/proc/driver/nvidia/version").exists()


def _device_name() -> str:
    import subprocess

    try:
        found = subprocess.run(
            ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"],
            capture_output=True,
            text=True,
            timeout=20,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return "a GPU (nvidia-smi doesn't say which)"
    return found.stdout.strip().splitlines()[0]
