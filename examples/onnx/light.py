"""Anti-aliasing of an OpenEXR picture by ONNX Runtime: an effect on light, from Z and light.

python light.py models/aa/balanced/model.onnx samples/room.exr aa.exr
"""

import sys

import numpy as np
import onnxruntime
import OpenEXR

model, source, target = sys.argv[1:4]
with OpenEXR.File(source, separate_channels=True) as file:
    channels = {name: each.pixels.astype(np.float32) for name, each in file.channels().items()}
light = np.stack([channels[f"light.{band}"] for band in "RGB"])  # linear, of the sky too
depth = np.where((channels["Z"] > 0) & (channels["Z"] < 1e10), channels["Z"], 0)
some = depth[::8, ::8]
depth = depth / np.median(some[some > 0])  # this effect's lengths are in median depths
height, width = depth.shape
past = (0, -height % 64), (0, -width % 64)
depth = np.pad(depth, past)  # past the picture there is no surface,
light = np.pad(light, ((0, 0), *past), "edge")  # but light goes on
gbuffer = np.concatenate([depth[None], light])[None].astype(np.float32)
session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
(shade,) = session.run(["shade"], {"gbuffer": gbuffer})
OpenEXR.File({}, {"RGB": shade[0, :, :height, :width].transpose(1, 2, 0).copy()}).write(target)
