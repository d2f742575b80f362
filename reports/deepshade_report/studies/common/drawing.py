"""Plots of studies: curves over steps, and small PNG files."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from deepshade_report.plots import PALETTE, png, themed
from deepshade_report.studies.common.rows import Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from PIL import Image

_NAMES = ("vermillion", "green", "blue", "purple", "orange", "sky", "soft", "ink")
COLOURS = (*(PALETTE[name] for name in _NAMES), "#8c510a")
STYLES = {"train": ":", "validation": "--", "test": "-"}
_MOST = 140_000  # bytes of a picture


@contextmanager
def plot(columns: int, title: str, *, size: tuple[float, float]) -> Iterator[Plot]:
    """Axes in a row under a title; the PNG is `Plot.image` afterwards."""
    from matplotlib.figure import Figure

    with themed():
        figure = Figure(figsize=size, layout="constrained")
        made = Plot(list(figure.subplots(1, columns, squeeze=False)[0]))
        figure.suptitle(title, x=0.01, ha="left", fontsize=10, fontweight="bold")
        yield made
        made.image = smaller(png(figure))


class Plot:
    """Axes to draw in, and the image (PNG) that they make."""

    def __init__(self, axes: list[Axes]) -> None:
        self.axes, self.image = axes, b""


def curves(axes: Axes, rows: Sequence[Row], name: Callable[[Row], str], **shown: Any) -> None:
    """DSSIM over steps: a colour for each row, dotted training, dashed validation, solid test.

    `shown` may hold `splits`, those to draw.
    """
    splits = shown.get("splits", STYLES)
    for row, colour in zip(rows, COLOURS, strict=False):
        steps = [entry["step"] for entry in row["curve"]]
        for split in splits:
            values = [entry[split]["dssim"] for entry in row["curve"]]
            label = name(row) if split == "test" else None
            axes.plot(steps, values, STYLES[split], color=colour, label=label)
    axes.set_xlabel("steps")
    axes.set_ylabel("DSSIM")
    for split in splits:
        axes.plot([], [], STYLES[split], color=PALETTE["ink"], label=split)
    axes.set_ylim(bottom=0)
    axes.legend()


def bars(axes: Axes, values: Mapping[str, float], label: str) -> None:
    """Horizontal bars with their values written at them."""
    names = list(values)
    drawn = axes.barh(names[::-1], [values[n] for n in names[::-1]], color=PALETTE["blue"])
    axes.bar_label(drawn, fmt="{:.3g}", padding=3, fontsize=8)
    axes.set_xlabel(label)
    axes.margins(x=0.15)
    axes.grid(axis="y", visible=False)


def smaller(image: bytes) -> bytes:
    """A PNG of few colours that keeps below a bound, at a half or third of the size if need be."""
    from PIL import Image

    with Image.open(io.BytesIO(image)) as opened:
        whole = opened.convert("RGB")
    for shrink, colours in ((1, 256), (2, 256), (2, 160), (3, 160)):
        with io.BytesIO() as stream:
            size = whole.width // shrink, whole.height // shrink
            picture = whole.resize(size, Image.Resampling.LANCZOS) if shrink > 1 else whole
            few = picture.quantize(palette=_palette(picture, colours), dither=Image.Dither.NONE)
            few.save(stream, "PNG", optimize=True)
            image = stream.getvalue()
        if len(image) <= _MOST:
            break
    return image


def _palette(picture: Image.Image, colours: int) -> Image.Image:
    """The colours of lines, which cover little, and the picture's own."""
    from PIL import Image

    own = [int(tint[k : k + 2], 16) for tint in ("#ffffff", *COLOURS) for k in (1, 3, 5)]
    found = picture.quantize(colours - len(own) // 3).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette(own + found)
    return palette
