"""A renderer that streams: a sphere goes around above a floor, as frames on stdout.

python examples/renderer.py | deepshade-client stream ao - --live sphere
"""

import json
import struct
import sys
import time

import numpy as np

WIDTH, HEIGHT, FOV = 384, 256, 50.0
y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
slope = 2 * np.tan(np.radians(FOV / 2)) / WIDTH
ray = np.stack([(x - WIDTH / 2) * slope, (HEIGHT / 2 - y) * slope, -np.ones_like(x)])
for frame in range(int(sys.argv[1]) if len(sys.argv) > 1 else 240):
    angle = 2 * np.pi * frame / 120
    centre = np.array([0.8 * np.cos(angle), -0.5, -4 + 0.8 * np.sin(angle)])
    a, b = (ray * ray).sum(0), -np.tensordot(centre, ray, 1)
    root = b * b - a * (centre @ centre - 0.25)
    ball = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
    floor = np.where(ray[1] < 0, -1 / np.minimum(ray[1], -1e-9), np.inf)
    depth = np.minimum(ball, floor)  # planar: rays have z = -1; infinite where there is nothing
    with np.errstate(invalid="ignore"):
        normal = np.where(ball < floor, (ray * depth - centre[:, None, None]) / 0.5, 0)
    normal[1] += (floor < ball) & np.isfinite(floor)
    planes = [("Z", "float", depth.astype("<f4"))]
    planes += [(f"normal.{n}", "half", p.astype("<f2")) for n, p in zip("XYZ", normal, strict=True)]
    about = {"planes": [p[:2] for p in planes], "header": {"deepshade:fov": FOV}}
    text, now = json.dumps(about).encode(), time.time()
    head = struct.pack("<4s4B4I2d", b"DSLF", 1, 1, 0, 0, frame, WIDTH, HEIGHT, len(text), now, now)
    body = b"".join(struct.pack("<I", p[2].nbytes) + p[2].tobytes() for p in planes)
    sys.stdout.buffer.write(struct.pack("<I", len(head + text + body)) + head + text + body)
    sys.stdout.buffer.flush()
