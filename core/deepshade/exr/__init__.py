"""OpenEXR images in and out: `read_header`, `read`, `write`, within `Limits`."""

from deepshade.exr.chunks import Window
from deepshade.exr.header import Header, Part
from deepshade.exr.image import COMPRESSIONS, Image, fetch, read, read_header, write
from deepshade.exr.limits import Limits
from deepshade.exr.planes import Planes

__all__ = [
    "COMPRESSIONS",
    "Header",
    "Image",
    "Limits",
    "Part",
    "Planes",
    "Window",
    "fetch",
    "read",
    "read_header",
    "write",
]
