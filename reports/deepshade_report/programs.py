"""Exported shader programs run without a window: GLSL by OpenGL, WGSL and HLSL by WebGPU.

Each runner takes a folder of `deepshade export --to …` and gives `answer(inputs)`.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from deepshade.errors import DataError, EngineError

Float = NDArray[np.float32]
ROW = 512  # numbers in a row of an array texture, and rows in a layer
_NUMBERS = 256  # bytes of them a pass
GLSLANG = "glslangValidator"


class Runner(Protocol):
    """A program, ready."""

    def answer(self, inputs: Mapping[str, Float]) -> Float:
        """What it makes of its inputs."""
        ...


class _Program:
    """The files of an exported program."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.told: dict[str, Any] = json.loads((folder / "program.json").read_text("utf-8"))
        self.passes = self.told["passes"]
        self.sizes: list[int] = self.told["buffers"]
        self.weights: Float = np.fromfile(folder / "weights.f32", np.float32)
        self.numbers = np.fromfile(folder / "passes.i32", np.int32).reshape(-1, _NUMBERS // 4)
        self.kernels = sorted({each["kernel"] for each in self.passes})

    def given(self, inputs: Mapping[str, Float]) -> list[tuple[int, Float]]:
        """Which buffer holds what when it starts."""
        held = [(slot["buffer"], inputs[slot["name"]]) for slot in self.told["inputs"]]
        return [(k, np.ascontiguousarray(each, np.float32)) for k, each in held]

    def shaped(self, content: bytes | memoryview) -> Float:
        """The answer, of what its buffer begins with."""
        shape = self.told["output"]["shape"]
        found: Float = np.frombuffer(content, np.float32, int(np.prod(shape))).reshape(shape)
        return found


def gl_context(version: int) -> Any:
    """OpenGL of a version (430 is 4.3) without a window, through EGL.

    Raises EngineError: there is none.
    """
    import moderngl

    how: Any = {"backend": "egl"}  # by moderngl's types it could be no string
    try:
        return moderngl.create_context(standalone=True, require=version, **how)
    except Exception as error:  # whatever EGL and its driver think of
        raise EngineError(
            f"no OpenGL {version // 100}.{version // 10 % 10} by EGL here: {error}",
            fix="install a driver; Debian's in software: apt-get install libegl1 libgl1-mesa-dri",
        ) from error


class GlCompute:
    """GLSL compute shaders on OpenGL 4.3, through EGL."""

    def __init__(self, folder: Path) -> None:
        program = self.program = _Program(folder)
        self.gl = gl_context(430)
        self.shaders = {
            name: self.gl.compute_shader((folder / f"{name}.comp").read_text("utf-8"))
            for name in program.kernels
        }
        self.buffers = [self.gl.buffer(reserve=4 * size) for size in program.sizes]
        self.buffers[0].write(program.weights.tobytes())
        self.numbers = self.gl.buffer(program.numbers.tobytes())

    def answer(self, inputs: Mapping[str, Float]) -> Float:
        """See `Runner`."""
        for k, array in self.program.given(inputs):
            self.buffers[k].write(array.tobytes())
        for k, each in enumerate(self.program.passes):
            for at, buffer in enumerate((*each["reads"], each["writes"])):
                self.buffers[buffer].bind_to_storage_buffer(at)
            self.numbers.bind_to_uniform_block(0, offset=k * _NUMBERS, size=_NUMBERS)
            self.shaders[each["kernel"]].run(*each["groups"])
            self.gl.memory_barrier()
        return self.program.shaped(self.buffers[self.program.told["output"]["buffer"]].read())


class GlFragment:
    """GLSL fragment shaders on OpenGL 3.3, through EGL: buffers are array textures."""

    def __init__(self, folder: Path) -> None:
        program = self.program = _Program(folder)
        self.gl = gl_context(330)
        stages = [(folder / f"layers.{each}").read_text("utf-8") for each in ("vert", "geom")]
        self.arrays, self.shaders = {}, {}
        for name in program.kernels:
            shader = self.gl.program(
                vertex_shader=stages[0],
                geometry_shader=stages[1],
                fragment_shader=(folder / f"{name}.frag").read_text("utf-8"),
            )
            for at, letter in enumerate("abc"):
                if f"data_{letter}" in shader:
                    shader[f"data_{letter}"] = at
            self.shaders[name] = shader
            self.arrays[name] = self.gl.vertex_array(shader, [])
        self.textures = [
            self.gl.texture_array((ROW, ROW, -(-size // ROW**2)), 1, dtype="f4")
            for size in program.sizes
        ]
        self.targets = [self.gl.framebuffer([each]) for each in self.textures]
        self._fill(0, program.weights)
        self.numbers = self.gl.buffer(program.numbers.tobytes())

    def _fill(self, k: int, array: Float) -> None:
        texture = self.textures[k]
        flat = np.zeros(ROW**2 * texture.layers, np.float32)
        flat[: array.size] = array.ravel()
        texture.write(flat.tobytes())

    def answer(self, inputs: Mapping[str, Float]) -> Float:
        """See `Runner`."""
        program = self.program
        for k, array in program.given(inputs):
            self._fill(k, array)
        for k, each in enumerate(program.passes):
            for at, buffer in enumerate(each["reads"]):
                self.textures[buffer].use(at)
            self.numbers.bind_to_uniform_block(0, offset=k * _NUMBERS, size=_NUMBERS)
            count, chunk, pitch, start = (int(n) for n in program.numbers[k, :4])
            end = start + (-(-count // chunk) - 1) * pitch + chunk
            self.targets[each["writes"]].use()
            self.gl.viewport = (0, 0, ROW, min(ROW, -(-end // ROW)))
            self.arrays[each["kernel"]].render(vertices=3, instances=-(-end // ROW**2))
        return program.shaped(self.textures[program.told["output"]["buffer"]].read())


class WebGpu:
    """WGSL compute shaders by wgpu."""

    def __init__(self, folder: Path) -> None:
        import wgpu

        program = self.program = _Program(folder)
        if not wgpu.gpu.enumerate_adapters_sync():
            raise EngineError(
                "no Vulkan, Metal or Direct3D here for WebGPU",
                fix="install a driver; Debian's in software: apt-get install mesa-vulkan-drivers",
            )
        adapter = wgpu.gpu.request_adapter_sync(power_preference="high-performance")
        most = adapter.limits["max-storage-buffer-binding-size"]
        self.device = adapter.request_device_sync(
            required_limits={
                "max-storage-buffer-binding-size": most,
                "max-buffer-size": adapter.limits["max-buffer-size"],
            }
        )
        kinds: tuple[Any, ...] = ("read-only-storage",) * 3 + ("storage", "uniform")
        entries: list[Any] = [
            {"binding": at, "visibility": wgpu.ShaderStage.COMPUTE, "buffer": {"type": kind}}
            for at, kind in enumerate(kinds)
        ]
        self.layout = self.device.create_bind_group_layout(entries=entries)
        layout = self.device.create_pipeline_layout(bind_group_layouts=[self.layout])
        self.pipelines = {
            name: self.device.create_compute_pipeline(
                layout=layout,
                compute={
                    "module": self.device.create_shader_module(code=self.code(name)),
                    "entry_point": "main",
                },
            )
            for name in program.kernels
        }
        use = wgpu.BufferUsage
        every = use.STORAGE | use.COPY_SRC | use.COPY_DST
        self.buffers = [
            self.device.create_buffer(size=4 * max(size, 1), usage=every) for size in program.sizes
        ]
        self.device.queue.write_buffer(self.buffers[0], 0, program.weights)
        self.numbers = self.device.create_buffer_with_data(data=program.numbers, usage=use.UNIFORM)
        self.groups = [self._bind(k) for k in range(len(program.passes))]

    def code(self, name: str) -> Any:
        """A kernel's text."""
        return (self.program.folder / f"{name}.wgsl").read_text("utf-8")

    def _bind(self, k: int) -> Any:
        """What a pass reads and writes."""
        each = self.program.passes[k]
        entries: list[Any] = [
            {"binding": at, "resource": {"buffer": self.buffers[buffer]}}
            for at, buffer in enumerate((*each["reads"], each["writes"]))
        ]
        told = {"buffer": self.numbers, "offset": k * _NUMBERS, "size": _NUMBERS}
        entries.append({"binding": 4, "resource": told})
        return self.device.create_bind_group(layout=self.layout, entries=entries)

    def answer(self, inputs: Mapping[str, Float]) -> Float:
        """See `Runner`."""
        program = self.program
        for k, array in program.given(inputs):
            self.device.queue.write_buffer(self.buffers[k], 0, array)
        encoder = self.device.create_command_encoder()
        compute = encoder.begin_compute_pass()
        for k, each in enumerate(program.passes):
            compute.set_pipeline(self.pipelines[each["kernel"]])
            compute.set_bind_group(0, self.groups[k])
            compute.dispatch_workgroups(*each["groups"])
        compute.end()
        self.device.queue.submit([encoder.finish()])
        output = self.buffers[program.told["output"]["buffer"]]
        return program.shaped(self.device.queue.read_buffer(output))


class Hlsl(WebGpu):
    """The HLSL ones instead, made SPIR-V by glslang."""

    def code(self, name: str) -> Any:
        """A kernel, compiled."""
        with TemporaryDirectory() as scratch:
            made = Path(scratch) / "kernel.spv"
            source = self.program.folder / f"{name}.hlsl"
            done = subprocess.run(
                [GLSLANG, "-D", "-V", "-S", "comp", "-e", "main", "-o", made, source],
                capture_output=True,
                text=True,
            )
            if done.returncode:
                raise DataError(f"{source}: {done.stdout.strip()}")
            return made.read_bytes()
