"""Views from EXR files as `deepshade render` writes them, such as those of `samples/`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from deepshade import exr
from deepshade.attributes import ATTRIBUTES
from deepshade.effects import EFFECTS, SETTINGS
from deepshade.environments import Environment, Surroundings, sky
from deepshade.errors import CameraError
from deepshade.gbuffer import load_gbuffer
from deepshade_report.view import View


def sample_views(folder: Path, effect: str) -> list[View]:
    """The views of a folder's EXR files that have a reference of `effect` which shows something.

    What an effect takes is derived where a file leaves it out. Raises what `load_gbuffer` does, and
    CameraError where the header has no field of view.
    """
    found = (_view(path, effect) for path in sorted(folder.glob("*.exr")))
    least = EFFECTS[effect].min_contrast
    return [view for view in found if view is not None and view.contrast() >= least]


def _view(path: Path, effect: str) -> View | None:
    row = EFFECTS[effect]
    inside = {name for part in exr.read_header(path.read_bytes()).parts for name in part.channels}
    bands = ("V",) if len(row.outputs) == 1 else row.outputs

    def layer(name: str) -> Any:
        """(C, H, W), or None where the file has no such layer."""
        channels = [f"{name}.{band}" for band in bands]
        return exr.read(path, channels).stack(channels) if inside.issuperset(channels) else None

    reference = layer(f"reference_{effect}")
    if reference is None:
        return None
    beside = [row.trivial_layer] if row.trivial_layer in ATTRIBUTES else []
    loaded = load_gbuffer(path, list(dict.fromkeys([*row.inputs, *beside])))
    if loaded.camera is None:
        raise CameraError(f"the header of {path} has no field of view", fix="render it again")
    planes = dict(loaded.attributes)
    if row.trivial_layer and not beside:
        planes[row.trivial_layer] = layer(row.trivial_layer)
    settings = {name: loaded.header.get(SETTINGS[name].header) for name in row.settings}
    record = {name: value for name, value in settings.items() if value is not None}
    return View(
        str(loaded.header.get("deepshade:scene", path.name)),
        row,
        planes,
        loaded.background,
        np.ascontiguousarray(reference, np.float32),
        float(record.get("radius", 1.0)),
        loaded.camera,
        record,
        layer(f"reference_{effect}_error"),
        _surroundings(loaded.header),
    )


def _surroundings(header: Mapping[str, Any]) -> Surroundings | None:
    """The sky that the service has, where the header says that it lit the view."""
    if header.get("deepshade:environment_sha256") != _sky().sha256:
        return None
    return Surroundings(_sky(), float(header.get("deepshade:rotate", 0.0)))


@lru_cache(maxsize=1)
def _sky() -> Environment:
    return sky(height=512)
