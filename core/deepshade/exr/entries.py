"""Entries of an EXR header that say which shot it is, by whom and through what camera.

An answer keeps those of its input, byte for byte. The names and types are OpenEXR's optional
standard attributes (openexr.com/en/latest/StandardAttributes.html) without those that say how
pixels are stored or where they lie, and what Blender stamps into its files.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass

_MAX_TEXT = 2**16  # bytes; a frame's comments, but no manifest
_LAYOUTS = {
    "envmap": "<B",
    "int": "<i",
    "float": "<f",
    "v2f": "<2f",
    "m44f": "<16f",
    "box2i": "<4i",
    "chromaticities": "<8f",
    "rational": "<iI",
    "timecode": "<2I",
    "keycode": "<7i",
}
_NAMES = {
    "string": """view owner comments capDate reelName ascFramingDecisionList renderingTransform
        lookModTransform colorInteropID cameraMake cameraModel cameraSerialNumber
        cameraFirmwareVersion cameraUuid cameraLabel lensMake lensModel lensSerialNumber
        lensFirmwareVersion Frame Camera Scene Time Marker Note Date File""",
    "float": """whiteLuminance xDensity utcOffset longitude latitude altitude focus expTime aperture
        isoSpeed shutterAngle tStop cameraCCTSetting cameraTintSetting sensorPhotositePitch
        nominalFocalLength pinholeFocalLength effectiveFocalLength entrancePupilOffset""",
    "int": "imageCounter",
    "envmap": "envmap",
    "v2f": "adoptedNeutral cameraColorBalance sensorCenterOffset sensorOverallDimensions",
    "box2i": "sensorAcquisitionRectangle",
    "m44f": "worldToNDC",
    "chromaticities": "chromaticities",
    "rational": "framesPerSecond captureRate",
    "timecode": "timeCode",
    "keycode": "keyCode",
}
_KINDS = {name: kind for kind, names in _NAMES.items() for name in names.split()}


@dataclass(frozen=True, slots=True)
class Entry:
    """The type and the bytes of a header attribute, as they stand in the file."""

    kind: str
    data: bytes


def kept(
    types: Mapping[str, str], values: Mapping[str, memoryview[int] | bytes]
) -> dict[str, Entry]:
    """What an answer keeps of a header of these types and values: known names, sound values."""
    return {
        name: Entry(kind, bytes(values[name]))
        for name, kind in _KINDS.items()
        if types.get(name) == kind and _sound(kind, values[name])
    }


def _sound(kind: str, value: memoryview[int] | bytes) -> bool:
    if kind == "string":
        return len(value) <= _MAX_TEXT
    layout = _LAYOUTS[kind]
    return len(value) == struct.calcsize(layout) and all(
        map(math.isfinite, struct.unpack(layout, value))
    )
