"""One held-out view as a row of pictures: light, answers, reference and difference; and a detail.

All are exposed by the one factor that makes the reference's 99th percentile 1.
"""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np

from deepshade import pictures
from deepshade_report.view import Float, View

PANEL = 256  # pixels of a panel's longer side, at most
GAIN = 2.0  # of differences


def strip(view: View, ours: Float, rival: Float | None = None) -> pictures.Picture:
    """The effect's light, our answer, the reference, a rival's (C, H, W) and our difference.

    Above the whole view, reduced to `PANEL`; below the part where the effect changes the most, each
    of its pixels four. Red is too bright, blue too dark, by 1 / `GAIN` of white where full.
    """
    light = view.light()
    shown = [image for image in (light, ours, view.reference, rival) if image is not None]
    planes = [view.exposed(image) for image in shown]
    answer, truth = view.exposed(ours), view.exposed(view.reference)
    step = -(-max(view.height, view.width) // PANEL)
    height, width = (size // step // 2 * 2 for size in (view.height, view.width))
    change = np.abs(view.exposed(view.trivial()) - truth).mean(0)
    top, left = _busiest(change, height // 2, width // 2)

    def whole(image: Float) -> Float:
        blocks = image[:, : height * step, : width * step]
        mean: Float = blocks.reshape(-1, height, step, width, step).mean((2, 4))
        return mean

    def part(image: Float) -> Float:
        window = image[:, top : top + height // 2, left : left + width // 2]
        return window.repeat(2, 1).repeat(2, 2)

    rows = []
    for seen in (whole, part):
        row = [pictures.of_effect(seen(image), view.effect) for image in planes]
        row.append(pictures.difference(seen(answer), seen(truth), gain=GAIN))
        rows.append(pictures.beside(row))
    return pictures.below(rows)


def chosen(views: Sequence[View], count: int = 2) -> list[View]:
    """Views from the middle of what they show, of different scenes as far as there are such."""
    ranked = sorted(views, key=View.contrast)
    middle = sorted(ranked, key=lambda view: abs(ranked.index(view) - (len(ranked) - 1) / 2))
    fresh = [v for k, v in enumerate(middle) if v.scene not in {w.scene for w in middle[:k]}]
    return [*fresh, *(view for view in middle if view not in fresh)][:count]


def webp(picture: pictures.Picture, quality: int = 85) -> bytes:
    """The bytes of a WebP file."""
    from PIL import Image

    with io.BytesIO() as stream:
        Image.fromarray(picture).save(stream, "WEBP", quality=quality, method=6)
        return stream.getvalue()


def _busiest(change: Float, height: int, width: int) -> tuple[int, int]:
    """Top and left of the window with the largest sum of an (H, W) plane."""
    sums = np.pad(change.astype(np.float64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    rows = sums[height:] - sums[:-height]
    inside = rows[:, width:] - rows[:, :-width]
    top, left = np.unravel_index(int(inside.argmax()), inside.shape)
    return int(top), int(left)
