"""Answers of a stream as EXR files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from deepshade import exr
from deepshade_client.live.pictures import LiveAnswer
from deepshade_client.sequences import is_pattern, numbered

_KEPT = (
    *("worldToCamera", "pixelAspectRatio", "screenWindowCenter", "screenWindowWidth"),
    *("deepshade:fov", "deepshade:focus", "deepshade:aperture", "deepshade:shutter"),
)
_PLAN = ("bundle", "bundle_sha256", "engine", "precision", "dssim", "radius")


class Folder:
    """Writes each answer to `out`: a folder, or a pattern with #### or %04d for the frame."""

    def __init__(self, out: str) -> None:
        self._out = out
        self._count = 0

    def save(self, answer: LiveAnswer) -> Path:
        """The file, written atomically: half floats, what is known of it in its header.

        One effect is "Y" or "R G B", each of several a layer. Raises OSError.
        """
        self._count += 1
        path = self._path(answer)
        effects = list(dict.fromkeys(name.partition(".")[0] for name in answer.planes))
        alone = len(effects) == 1
        channels = {
            name.partition(".")[2] if alone else name: np.asarray(plane, np.float32)
            for name, plane in answer.planes.items()
        }
        header = answer.picture.header
        attributes: dict[str, Any] = {k: _shaped(header[k]) for k in _KEPT if k in header}
        attributes["deepshade:effects"] = ",".join(effects)
        for effect in effects:
            plan: Mapping[str, Any] = answer.plans.get(effect, {})
            key = "deepshade" if alone else f"deepshade:{effect}"
            for name in _PLAN:
                if plan.get(name) is not None:
                    attributes[f"{key}:{name}"] = plan[name]
        path.parent.mkdir(parents=True, exist_ok=True)
        exr.write(path, channels, attributes=attributes, half=True)
        return path

    def _path(self, answer: LiveAnswer) -> Path:
        number = answer.picture.number
        if is_pattern(self._out):
            return Path(numbered(self._out, self._count if number is None else number))
        return Path(self._out) / f"{answer.picture.name or f'frame.{self._count:04d}'}.exr"


def _shaped(value: Any) -> Any:
    if not isinstance(value, list | tuple | np.ndarray):
        return value
    flat = np.asarray(value, np.float32).ravel()
    return flat.reshape({9: (3, 3), 16: (4, 4)}.get(flat.size, (-1,)))
