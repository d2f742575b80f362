"""Ambient occlusion of an OpenEXR G-buffer by ONNX Runtime: normals in camera space and Z.

python shade.py models/ao/fast/model.onnx samples/room.exr ao.exr RADIUS FOV [gbuffer.f32]
"""

import sys

import numpy as np
import onnxruntime
import OpenEXR

model, source, target = sys.argv[1:4]
radius, fov = map(float, sys.argv[4:6])  # scene units; the horizontal angle in degrees

with OpenEXR.File(source, separate_channels=True) as file:
    channels = {name: each.pixels.astype(np.float32) for name, each in file.channels().items()}
normal = [channels[f"normal.{axis}"] for axis in "XYZ"]
depth = channels["Z"]  # planar, positive, in scene units
height, width = depth.shape
step = 2 * np.tan(np.radians(fov) / 2) / width  # of a pixel, at depth 1
x = (np.arange(width) + 0.5 - width / 2) * step  # to the right
y = (height / 2 - np.arange(height) - 0.5)[:, None] * step  # up
gbuffer = np.stack([*normal, x * depth / radius, y * depth / radius, -depth / radius])
gbuffer[:, ~((depth > 0) & (depth < 1e10))] = 0  # background: six zeros
gbuffer = np.pad(gbuffer, ((0, 0), (0, -height % 64), (0, -width % 64)))  # and past the picture
if sys.argv[6:]:  # for the programs in C++
    gbuffer.astype(np.float32).tofile(sys.argv[6])
session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
(shade,) = session.run(["shade"], {"gbuffer": gbuffer[None].astype(np.float32)})
OpenEXR.File({}, {"Y": shade[0, 0, :height, :width].copy()}).write(target)
