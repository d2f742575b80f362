"""OpenEXR images in and out: `read_header`, `read`, `write`, within `Limits`."""

from deepshade.exr.image import (
    COMPRESSIONS,
    Header,
    Image,
    Limits,
    Part,
    Window,
    fetch,
    read,
    read_header,
    write,
)

__all__ = [
    "COMPRESSIONS",
    "Header",
    "Image",
    "Limits",
    "Part",
    "Window",
    "fetch",
    "read",
    "read_header",
    "write",
]
