"""Intel Open Image Denoise for ambient occlusion, through Mitsuba's own binding.

The binding (package mitsuba-oidn) bundles the library and runs it on Dr.Jit's threads, so ray
tracing and denoising share one pool; where there is a GPU that the library supports, it is used.
"""

from __future__ import annotations

import mitsuba_oidn as oidn
import numpy as np

from deepshade_report.method import Float

# The library's networks: small, large with narrower arithmetic where the device has it, large.
QUALITIES = {
    "fast": oidn.Quality.Fast,
    "balanced": oidn.Quality.Balanced,
    "high": oidn.Quality.High,
}


def version() -> str:
    """Version of the bundled library, such as 2.5.1."""
    found: str = oidn.oidn_version()
    return found


class Denoiser:
    """The library's RT filter at one of `QUALITIES`, for one channel in [0, 1].

    The noise of a few rays a pixel is clipped to [0, 1], and the filter's mode for pictures of
    low dynamic range takes it for that of a brighter, clipped signal: at 4 rays a pixel its answer
    is .03 to .05 too bright on average. Its mode for high dynamic range keeps the mean, so that
    one runs, with a scale of 1 rather than one guessed from the picture.
    """

    def __init__(self, quality: str) -> None:
        self.quality = quality
        self._shape = (0, 0)
        self._normal = self._albedo = np.empty((0, 0, 3), np.float32)

    def prepare(self, normal: Float) -> None:
        """Take the (3, H, W) unit normals, zero in background, and build the filter.

        The filter wants an albedo with every normal: occlusion has none, so it's white.
        """
        self._normal = np.ascontiguousarray(normal.transpose(1, 2, 0), np.float32)
        self._albedo = np.ones_like(self._normal)
        shape = (normal.shape[1], normal.shape[2])
        if shape != self._shape:
            self._shape = shape
            self.denoise(np.ones(shape, np.float32))

    def denoise(self, noisy: Float) -> Float:
        """(H, W) without the noise; may leave [0, 1] by a little."""
        clean = oidn.denoise(
            noisy,
            albedo=self._albedo,
            normal=self._normal,
            hdr=True,
            input_scale=1.0,
            clean_aux=True,  # primary hits through pixel centres have no noise
            quality=QUALITIES[self.quality],
        )
        return np.asarray(clean, np.float32)
