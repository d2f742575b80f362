"""The G-buffer: per-pixel attributes of one view, and what is known of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from deepshade import exr
from deepshade.camera import Camera, placement_of
from deepshade.exr.entries import Entry


@dataclass(slots=True)
class GBuffer:
    """Attributes of one view, ready for a network.

    `attributes` maps names to (C, H, W) float32, C-contiguous; where `background` (H, W) is true
    all are 0 but those that say something of it (`Attribute.in_background`). `nonfinite` counts
    the pixels that held NaN or infinities (an infinite depth is a renderer's way to say
    background and doesn't count). `mapped` tells which channels each quantity came from,
    `decoded` all that were read for that, as (file, channel), and `derived` how the others were
    computed, or how what is there had to be read; `warnings` say what looks unlikely. The
    windows, (x0, y0, x1, y1) inclusive, are those of the part that the attributes came from,
    `part_header` its own attributes, `entries` those of the shot; `header` holds those of all
    parts and files, the first of each name. `up` is the world's up axis, as its renderer has it.
    Motion that is `per_frame` is of the whole interval between two frames, whatever the shutter.
    """

    attributes: dict[str, NDArray[np.float32]]
    background: NDArray[np.bool_]
    camera: Camera | None = None
    nonfinite: int = 0
    mapped: dict[str, str] = field(default_factory=dict)
    decoded: tuple[tuple[int, str], ...] = ()
    derived: dict[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    header: dict[str, Any] = field(default_factory=dict)
    part_header: dict[str, Any] = field(default_factory=dict)
    entries: dict[str, Entry] = field(default_factory=dict)
    data_window: exr.Window = (0, 0, 0, 0)
    display_window: exr.Window = (0, 0, 0, 0)
    up: Literal["y", "z"] = "y"
    per_frame: bool = False

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return cast(tuple[int, int], self.background.shape)

    def placement(self) -> dict[str, Any]:
        """EXR attributes that, beside the windows, put an answer exactly where its input lies.

        Pixel aspect, screen window and worldToCamera: the camera's, or without one (no field of
        view is known) what the part's header says of them, as far as it is usable. The matrix is
        the header's own, where it has one, whichever way its camera looks.
        """
        said = placement_of(self.part_header)
        camera = self.camera.to_header() if self.camera else {}
        if "worldToCamera" in said:
            camera.pop("worldToCamera", None)
        return said | camera
