"""Ambient occlusion of an OpenEXR G-buffer by OpenGL compute shaders, without a window.

deepshade export models/ao/fast --to glsl --size 512x384 -o shaders
python shade.py shaders/ao-fast-512x384-glsl samples/room.exr ao.png RADIUS FOV

Needs moderngl, numpy, OpenEXR and Pillow, and OpenGL 4.3 through EGL (Mesa's will do).
"""

import json
import sys
from pathlib import Path

import moderngl
import numpy as np
import OpenEXR
from PIL import Image

NUMBERS = 256  # bytes of `passes.i32` that a pass is told
ROUNDS = 10  # that are timed, where there is a GPU


class Program:
    """An exported program in OpenGL's hands: kernels, buffers, and what each pass is told."""

    def __init__(self, folder):
        self.told = json.loads((folder / "program.json").read_text())
        self.gl = moderngl.create_context(standalone=True, require=430, backend="egl")
        self.kernels = {
            name: self.gl.compute_shader((folder / f"{name}.comp").read_text())
            for name in {each["kernel"] for each in self.told["passes"]}
        }
        self.buffers = [self.gl.buffer(reserve=4 * size) for size in self.told["buffers"]]
        self.buffers[0].write((folder / "weights.f32").read_bytes())
        self.numbers = self.gl.buffer((folder / "passes.i32").read_bytes())

    def run(self):
        """All passes in turn. In an engine this is what a frame does."""
        for k, each in enumerate(self.told["passes"]):
            for at, buffer in enumerate((*each["reads"], each["writes"])):
                self.buffers[buffer].bind_to_storage_buffer(at)
            self.numbers.bind_to_uniform_block(0, offset=k * NUMBERS, size=NUMBERS)
            self.kernels[each["kernel"]].run(*each["groups"])
            self.gl.memory_barrier(moderngl.SHADER_STORAGE_BARRIER_BIT)

    def shade(self, gbuffer):
        """(1, C, H, W) float32 in, (1, outputs, H, W) out."""
        self.buffers[self.told["inputs"][0]["buffer"]].write(gbuffer.tobytes())
        self.run()
        output = self.told["output"]
        content = self.buffers[output["buffer"]].read(4 * int(np.prod(output["shape"])))
        return np.frombuffer(content, np.float32).reshape(output["shape"])

    def milliseconds(self):
        """The median of what the GPU itself says."""
        found = []
        for _ in range(ROUNDS):
            with self.gl.query(time=True) as query:
                self.run()
            found.append(query.elapsed / 1e6)
        return sorted(found)[ROUNDS // 2]


def gbuffer_of(source, size, radius, fov):
    """What `ao` takes, and where there is a surface: docs/onnx.md has the units."""
    with OpenEXR.File(str(source), separate_channels=True) as file:
        channels = {name: each.pixels.astype(np.float32) for name, each in file.channels().items()}
    normal = [channels[f"normal.{axis}"] for axis in "XYZ"]
    depth = channels["Z"]  # planar, positive, in scene units
    height, width = depth.shape
    if height > size[0] or width > size[1]:
        sys.exit(f"{source} is {width}x{height}: export with --size of that or more")
    step = 2 * np.tan(np.radians(fov) / 2) / width  # of a pixel, at depth 1
    x = (np.arange(width) + 0.5 - width / 2) * step  # to the right
    y = (height / 2 - np.arange(height) - 0.5)[:, None] * step  # up
    surface = (depth > 0) & (depth < 1e10)
    with np.errstate(invalid="ignore"):
        planes = np.stack([*normal, x * depth / radius, y * depth / radius, -depth / radius])
    planes[:, ~surface] = 0  # background: six zeros, and so past the picture
    padded = np.pad(planes, ((0, 0), (0, size[0] - height), (0, size[1] - width)))
    return padded[None].astype(np.float32), surface


def main():
    """Shade a file."""
    folder, source, target = map(Path, sys.argv[1:4])
    radius, fov = map(float, sys.argv[4:6])  # scene units; the horizontal angle in degrees
    program = Program(folder)
    size = program.told["inputs"][0]["shape"][2:]
    gbuffer, surface = gbuffer_of(source, size, radius, fov)
    shade = program.shade(gbuffer)[0, 0, : surface.shape[0], : surface.shape[1]]
    shade = np.where(surface, shade, 1)
    Image.fromarray(np.uint8(np.clip(shade, 0, 1) * 255 + 0.5)).save(target)
    renderer = program.gl.info["GL_RENDERER"]
    software = "llvmpipe" in renderer or "softpipe" in renderer
    time = "no GPU" if software else f"{program.milliseconds():.2f} ms"
    print(f"{target}: mean {shade.mean():.4f}, {renderer}, {time}")


if __name__ == "__main__":
    main()
