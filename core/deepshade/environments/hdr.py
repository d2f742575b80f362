"""Reads Radiance HDR pictures (RGBE), whose bytes come from people we don't know.

Format: Ward, "Real Pixels", Graphics Gems II, 1991, and the "Radiance File Formats" reference
(radsite.lbl.gov/radiance/refer/filefmts.pdf). Read are plain and run-length encoded scanlines
from the top left; not the run-length code from before 1991, and not XYZ colours.
"""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from deepshade.errors import DamagedImageError, ImageError
from deepshade.exr import Limits

MAGIC = (b"#?RADIANCE", b"#?RGBE")

_MAX_HEADER = 2**16
_SIZE = re.compile(rb"-Y +(\d{1,9}) +\+X +(\d{1,9})")
_MIN_RUN_WIDTH, _MAX_RUN_WIDTH = 8, 0x7FFF  # narrower and wider scanlines are never encoded


def decode(data: bytes, limits: Limits) -> NDArray[np.float32]:
    """(3, H, W) linear radiance of an HDR file's bytes; EXPOSURE and COLORCORR are undone.

    Raises ImageError (another kind), DamagedImageError, LimitError.
    """
    limits.check("body_bytes", len(data))
    if not data.startswith(MAGIC):
        raise ImageError("not a Radiance HDR picture", fix="send an .exr or .hdr file")
    head, _, body = data[:_MAX_HEADER].partition(b"\n\n")
    line = body.partition(b"\n")[0]
    size = _SIZE.fullmatch(line.strip())
    if size is None:
        raise ImageError(
            f"the HDR picture's size line is '{line[:40].decode('latin-1')}', not '-Y … +X …'",
            fix="save it again with rows from the top and columns from the left",
        )
    height, width = int(size[1]), int(size[2])
    limits.check("pixels", height * width)
    limits.check("decoded_bytes", 12 * height * width)
    if height * width == 0:
        raise DamagedImageError("the HDR picture has no pixels")
    gain = _gain(head)
    start = len(head) + 2 + len(line) + 1
    pixels = np.empty((height, 4, width), np.uint8)
    # Ward: mantissas of 8 bits and an exponent that they share, 128 + 8 too large; 0 is black
    _rows(data, start, pixels)
    scale = np.ldexp(np.float32(1), pixels[:, 3].astype(np.int32) - 136)
    scale[pixels[:, 3] == 0] = 0
    with np.errstate(over="ignore"):
        planes = pixels[:, :3].transpose(1, 0, 2) * scale * gain[:, None, None]
    return np.ascontiguousarray(planes, np.float32)


def _gain(head: bytes) -> NDArray[np.float32]:
    """(3,): what the header's exposures say that values were multiplied by, undone."""
    gain = np.ones(3)
    for line in head.split(b"\n"):
        key, _, value = line.partition(b"=")
        try:
            if key == b"EXPOSURE":
                gain /= float(value)
            elif key == b"COLORCORR":
                gain /= np.array([float(number) for number in value.split()])
        except (ValueError, ZeroDivisionError):
            gain[:] = np.nan
        if key == b"FORMAT" and value.strip() != b"32-bit_rle_rgbe":
            raise ImageError(
                f"the HDR picture is '{value[:40].decode('latin-1')}', only RGBE is read",
                fix="save it as 32-bit_rle_rgbe, or as EXR",
            )
    if gain.shape != (3,) or not (np.isfinite(gain) & (gain > 0)).all():
        raise DamagedImageError("the HDR picture's EXPOSURE or COLORCORR is no positive number")
    return gain.astype(np.float32)


def _rows(data: bytes, at: int, pixels: NDArray[np.uint8]) -> None:
    """Fills `pixels` (H, 4, W) from the scanlines that begin at `at`."""
    height, _, width = pixels.shape
    encoded = _MIN_RUN_WIDTH <= width <= _MAX_RUN_WIDTH
    mark = bytes((2, 2, width >> 8, width & 255)) if encoded else b"none"
    raw = np.frombuffer(data, np.uint8)
    for row in range(height):
        if data[at : at + 4] == mark:
            at = _encoded_row(data, raw, at + 4, pixels[row], row)
            continue
        flat = raw[at : at + 4 * width]
        if flat.size < 4 * width:
            raise _damaged(row)
        if data[at : at + 3] == b"\1\1\1":
            raise ImageError(
                "the HDR picture has the run-length code from before 1991",
                fix="save it again with a current program",
            )
        pixels[row] = flat.reshape(width, 4).T
        at += 4 * width


def _encoded_row(
    data: bytes, raw: NDArray[np.uint8], at: int, out: NDArray[np.uint8], row: int
) -> int:
    """Decodes one scanline, a channel after the other, into `out` (4, W); where the next begins.

    A count above 128 repeats the byte after it count - 128 times; else so many bytes follow.
    """
    width = out.shape[1]
    starts: list[int] = []
    counts: list[int] = []
    try:
        for _ in range(4):
            left = width
            while left > 0:
                count = data[at]
                starts.append(at)
                if count > 128:
                    count -= 128
                    at += 2
                else:
                    at += count + 1
                if not 0 < count <= left:
                    raise _damaged(row)
                counts.append(count)
                left -= count
    except IndexError:
        raise _damaged(row) from None
    if at > len(data):
        raise _damaged(row)
    first = np.array(starts)
    sizes = np.array(counts)
    # where each byte lies: the one after a count, and for plain bytes as many further
    step = np.repeat(raw[first] <= 128, sizes)
    within = np.arange(4 * width) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    out.reshape(-1)[:] = raw[np.repeat(first + 1, sizes) + within * step]
    return at


def _damaged(row: int) -> DamagedImageError:
    return DamagedImageError(
        f"the HDR picture is damaged or ends early: scanline {row}", fix="get the file again"
    )
