"""One web page that shades by WebGPU, with all it needs inside: open it from disk, no server.

deepshade export models/ao/fast --to wgsl --size 512x384 -o shaders
python build.py shaders/ao-fast-512x384-wgsl samples/room.exr FOV ao.html [onnxruntime-web model]

For browsers without WebGPU the last two arguments put ONNX Runtime's WebAssembly in (20 MB): the
folder of `npm install onnxruntime-web`, and `deepshade export … --to onnx` of the same size.
"""

import base64
import json
import sys
from pathlib import Path

import numpy as np
import OpenEXR


def text_of(content):
    """Bytes as a page holds them."""
    return base64.b64encode(content).decode()


def picture_of(source, size):
    """Normals and depth of an EXR, padded to (height, width): what the page makes its input of."""
    with OpenEXR.File(str(source), separate_channels=True) as file:
        channels = {name: each.pixels.astype(np.float32) for name, each in file.channels().items()}
    planes = np.stack([*(channels[f"normal.{axis}"] for axis in "XYZ"), channels["Z"]])
    height, width = planes.shape[1:]
    if height > size[0] or width > size[1]:
        sys.exit(f"{source} is {width}x{height}: export with --size of that or more")
    planes[:, ~((planes[3] > 0) & (planes[3] < 1e10))] = 0
    padded = np.pad(planes, ((0, 0), (0, size[0] - height), (0, size[1] - width)))
    return {"planes": text_of(padded.tobytes()), "width": width, "height": height}


def main():
    """Write the page."""
    folder, source, fov, target = Path(sys.argv[1]), sys.argv[2], float(sys.argv[3]), sys.argv[4]
    program = json.loads((folder / "program.json").read_text())
    size = program["inputs"][0]["shape"][2:]
    held = {
        "program": program,
        "kernels": {path.stem: path.read_text() for path in folder.glob("*.wgsl")},
        "weights": text_of((folder / "weights.f32").read_bytes()),
        "numbers": text_of((folder / "passes.i32").read_bytes()),
        "picture": picture_of(source, size) | {"fov": fov},
    }
    if len(sys.argv) > 6:
        web, model = Path(sys.argv[5]) / "dist", Path(sys.argv[6])
        held["wasm"] = {
            "script": text_of((web / "ort.wasm.bundle.min.mjs").read_bytes()),
            "binary": text_of((web / "ort-wasm-simd-threaded.wasm").read_bytes()),
            "model": text_of(model.read_bytes()),
        }
    page = (Path(__file__).parent / "page.html").read_text()
    inside = json.dumps(held).replace("<", "\\u003c")  # nothing in it ends the script
    Path(target).write_text(page.replace("HELD", inside))
    print(f"{target}: {Path(target).stat().st_size / 2**20:.1f} MiB")


if __name__ == "__main__":
    main()
