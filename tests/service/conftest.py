"""A small real network as a bundle, pictures to shade, and services to send them to."""

from __future__ import annotations

import asyncio
import faulthandler
import io
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Coroutine, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import onnx
import pytest
import uvicorn
from onnx import TensorProto, helper, numpy_helper

from deepshade import exr
from deepshade.bundles import write_config
from deepshade.engines import Engine
from deepshade_service.app import Service, create_app
from deepshade_service.cli import listen
from deepshade_service.config import Settings

REPOSITORY = Path(__file__).parents[2]
LEVELS = 3
# ONNX Runtime compiles nothing for each size, as OpenVINO does, which would make tests slow.
ORDINARY: dict[str, Any] = {"memory": 2**30, "engine": "onnxruntime"}


def unet(width: int = 4, levels: int = 3, seed: int = 0) -> onnx.ModelProto:
    """The paper's U-shape for AO: 6 channels in, 1 out, background (zero normal) out as 1.

    `width` is the paper's u0 and `levels` its number of resolutions; width 8 with 6 levels is the
    size of the published AO network. Down steps are grouped 3x3 convolutions and 2x2 means, up
    steps are a bilinear doubling, a concatenation and a grouped 3x3 convolution.
    """
    rng = np.random.default_rng(seed)
    nodes: list[onnx.NodeProto] = []
    weights: list[onnx.TensorProto] = []

    def constant(name: str, value: np.ndarray) -> str:
        weights.append(numpy_helper.from_array(value.astype(np.float32), name))
        return name

    def node(kind: str, inputs: list[str], output: str, **attributes: object) -> str:
        nodes.append(helper.make_node(kind, inputs, [output], **attributes))
        return output

    def conv(x: str, name: str, cin: int, cout: int, groups: int) -> str:
        scale = np.sqrt(2.0 / (9 * cin / groups))
        kernel = rng.normal(0, scale, (cout, cin // groups, 3, 3))
        bias = rng.normal(0, 0.1, cout)
        return node(
            "Conv",
            [x, constant(f"{name}.w", kernel), constant(f"{name}.b", bias)],
            name,
            pads=[1, 1, 1, 1],
            group=groups,
        )

    def double(x: str, name: str, channels: int) -> str:
        tap = np.array([0.25, 0.75, 0.75, 0.25])
        kernel = np.broadcast_to(np.outer(tap, tap), (channels, 1, 4, 4)).copy()
        return node(
            "ConvTranspose",
            [x, constant(f"{name}.w", kernel)],
            name,
            strides=[2, 2],
            pads=[1, 1, 1, 1],
            group=channels,
        )

    skips: list[tuple[str, int]] = []
    x, channels = "gbuffer", 6
    for n in range(levels):
        out = width * 2**n
        groups = 1 if n == 0 else 2**n
        x = node("LeakyRelu", [conv(x, f"down{n}", channels, out, groups)], f"act{n}", alpha=0.01)
        skips.append((x, out))
        if n < levels - 1:
            x = node("AveragePool", [x], f"pool{n}", kernel_shape=[2, 2], strides=[2, 2])
        channels = out
    for n in reversed(range(levels - 1)):
        skip, skip_channels = skips[n]
        up = double(x, f"double{n}", channels)
        x = node("Concat", [up, skip], f"join{n}", axis=1)
        out = 1 if n == 0 else width * 2**n
        x = conv(x, f"up{n}", channels + skip_channels, out, 1 if n == 0 else 2**n)
        if n > 0:
            x = node("LeakyRelu", [x], f"upact{n}", alpha=0.01)
        channels = out
    shade = node("Sigmoid", [x], "sigmoid")
    for name, value in (("start", 0), ("stop", 3), ("axis", 1)):
        weights.append(numpy_helper.from_array(np.array([value], np.int64), name))
    normal = node("Slice", ["gbuffer", "start", "stop", "axis"], "normal")
    squared = node("ReduceSumSquare", [normal, "axis"], "squared", keepdims=1)
    hit = node("Greater", [squared, constant("zero", np.zeros(1))], "hit")
    node("Where", [hit, shade, constant("one", np.ones(1))], "shade")

    graph = helper.make_graph(
        nodes,
        "unet",
        [helper.make_tensor_value_info("gbuffer", TensorProto.FLOAT, ["N", 6, "H", "W"])],
        [helper.make_tensor_value_info("shade", TensorProto.FLOAT, ["N", 1, "H", "W"])],
        weights,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.checker.check_model(model)
    return model


def write_bundle(
    folder: Path, model: onnx.ModelProto, *, levels: int, dssim: float = 0.25, **config: Any
) -> None:
    """A bundle around a model that `unet` made."""
    folder.mkdir(parents=True)
    (folder / "model.onnx").write_bytes(model.SerializeToString())
    settings = {
        "effect": "ao",
        "name": folder.name,
        "inputs": ("normal", "position"),
        "outputs": ("Y",),
        "radius": 0.5,
        "fov": 50.0,
        "size_multiple": 2 ** (levels - 1),
        "halo": 6 * 2**levels,
        "bytes_per_pixel": 128,
    }
    write_config(folder, settings | config, {"error": {"test-real": {"exact": {"dssim": dssim}}}})


@pytest.fixture(scope="session")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A models folder with one small AO bundle."""
    root = tmp_path_factory.mktemp("models")
    write_bundle(root / "ao" / "tiny", unet(4, LEVELS), levels=LEVELS)
    return root


@pytest.fixture
def make_bundle() -> Callable[..., None]:
    """`make_bundle(folder, **config)`: the small network as a bundle of one's own."""

    def make(folder: Path, **config: Any) -> None:
        write_bundle(folder, unet(4, LEVELS), levels=LEVELS, **config)

    return make


def picture(height: int, width: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Channels of a bumpy floor that recedes: unit normals and camera-space positions, float32."""
    rng = np.random.default_rng(seed)
    y, x = (np.mgrid[0:height, 0:width] + 0.5) / max(height, width)
    bumps = rng.uniform(0, 2 * np.pi, 4)
    a, b = 14 * x + bumps[0], 10 * y + bumps[1]
    depth = 3 + y + 0.4 * np.sin(a) * np.cos(b)
    right, down = 5.6 * np.cos(a) * np.cos(b), 1 - 4 * np.sin(a) * np.sin(b)  # the depth's changes
    position = np.stack([(x - 0.5) * depth, (0.5 - y) * depth, -depth])
    across = np.stack([depth + (x - 0.5) * right, (0.5 - y) * right, -right])
    along = np.stack([(x - 0.5) * down, (0.5 - y) * down - depth, -down])
    normal = np.cross(along, across, axis=0)
    normal /= np.linalg.norm(normal, axis=0)
    planes = dict(zip("XYZ", range(3), strict=True))
    return {
        f"{name}.{axis}": array[index].astype(np.float32)
        for name, array in (("normal", normal), ("position", position))
        for axis, index in planes.items()
    }


def encode(channels: dict[str, np.ndarray], **options: Any) -> bytes:
    stream = io.BytesIO()
    exr.write(stream, channels, **options)
    return stream.getvalue()


@pytest.fixture(scope="session")
def make_picture() -> Callable[..., dict[str, np.ndarray]]:
    return picture


@pytest.fixture(scope="session")
def make_exr() -> Callable[..., bytes]:
    """`make_exr(height, width, **options of exr.write)` or `make_exr(channels, **options)`."""

    def make(*args: Any, **options: Any) -> bytes:
        channels = args[0] if isinstance(args[0], dict) else picture(*args)
        return encode(channels, **options)

    return make


class Local:
    """The application behind uvicorn in a thread of this process, with a client to it."""

    def __init__(self, settings: Settings) -> None:
        self.app = create_app(settings)
        self.service: Service = self.app.state.service
        config = uvicorn.Config(
            self.app, log_config=None, lifespan="on", timeout_graceful_shutdown=5
        )
        self._server = uvicorn.Server(config)
        listener = listen("127.0.0.1", 0)
        self.address = listener.getsockname()
        self._thread = threading.Thread(target=asyncio.run, args=(self._serve(listener),))
        self._thread.start()
        url = f"http://127.0.0.1:{self.address[1]}"
        self.client = httpx.Client(base_url=url, trust_env=False, timeout=60)

    async def _serve(self, listener: socket.socket) -> None:
        self.loop = asyncio.get_running_loop()
        await self._server.serve([listener])

    def run(self, work: Coroutine[Any, Any, Any]) -> Any:
        """Run a coroutine on the service's event loop."""
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(30)

    def engine(self, name: str = "tiny") -> Engine:
        """The engine of that AO bundle, loaded if it isn't yet."""
        (bundle,) = self.service.models.find("ao", name)
        return self.run(self.service.models.engine(bundle, self.service.models.backend(bundle)))

    def wait(self, path: str = "/readyz") -> None:
        deadline = time.monotonic() + 30
        while self.client.get(path).status_code != 200:
            assert time.monotonic() < deadline, f"{path} doesn't become 200"
            time.sleep(0.01)

    def stop(self) -> None:
        self.client.close()
        self._server.should_exit = True
        self._thread.join(30)
        if self._thread.is_alive():
            for task in asyncio.all_tasks(self.loop):
                task.print_stack()
            faulthandler.dump_traceback()
            raise AssertionError("the service doesn't end: see the tasks and threads above")


@pytest.fixture(scope="session")
def service(models: Path) -> Iterator[Local]:
    """A service with ordinary settings, shared by all tests that need no others."""
    local = Local(Settings(**ORDINARY, models=models))
    local.wait()
    yield local
    local.stop()


@pytest.fixture(scope="session")
def client(service: Local) -> httpx.Client:
    return service.client


def until(true: Callable[[], object]) -> None:
    """Wait for a condition."""
    deadline = time.monotonic() + 60  # where much else is computed
    while not true():
        assert time.monotonic() < deadline, "it doesn't come true"
        time.sleep(0.005)


@pytest.fixture(scope="session")
def wait_until() -> Callable[..., None]:
    return until


@pytest.fixture
def start(models: Path) -> Iterator[Callable[..., Local]]:
    """`start(ready=True, **settings)`: a service of one's own."""
    started: list[Local] = []

    def start(*, ready: bool = True, **settings: Any) -> Local:
        local = Local(Settings(**(ORDINARY | {"models": models} | settings)))
        started.append(local)
        local.wait("/readyz" if ready else "/healthz")
        return local

    yield start
    for local in started:
        local.stop()


@dataclass
class Server:
    """A real `deepshade serve` process at a free loopback port."""

    process: subprocess.Popen[str]
    url: str

    @property
    def resident(self) -> int:
        """Bytes of physical memory."""
        pages = Path(f"/proc/{self.process.pid}/statm").read_text().split()[1]
        return int(pages) * os.sysconf("SC_PAGE_SIZE")

    def stop(self, number: int = signal.SIGTERM) -> int:
        """Signal it and return its exit status."""
        self.process.send_signal(number)
        return self.process.wait(timeout=30)


@pytest.fixture(scope="session")
def start_server(models: Path) -> Iterator[Callable[..., Server]]:
    servers: list[Server] = []

    def start(*options: str, wait: bool = True, folder: Path | None = None) -> Server:
        command = "import sys; from deepshade.cli import main; sys.exit(main())"
        arguments = ["--models", str(folder or models), "--engine", "onnxruntime"]
        process = subprocess.Popen(
            [sys.executable, "-c", command, "serve", "--port", "0", *arguments, *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert process.stdout
        line = process.stdout.readline()
        match = re.search(r"http://\S+", line)
        assert match, f"the service printed {line!r}"
        server = Server(process, match[0])
        servers.append(server)
        deadline = time.monotonic() + 30
        while wait:
            try:
                if httpx.get(f"{server.url}/readyz", trust_env=False).status_code == 200:
                    break
            except httpx.TransportError:
                pass
            assert time.monotonic() < deadline, "the service doesn't become ready"
            time.sleep(0.05)
        return server

    yield start
    for server in servers:
        if server.process.poll() is None:
            server.stop(signal.SIGKILL)
        if server.process.stdout:
            server.process.stdout.close()
