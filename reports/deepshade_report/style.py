"""How plots look: one palette for the colour-blind, PNG for files, themed SVG for the page."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito, "Color Universal Design", 2008; name -> (on white, on near black).
PALETTE = {
    "vermillion": ("#d55e00", "#ff8a3d"),
    "green": ("#009e73", "#2fc99b"),
    "blue": ("#0072b2", "#58b4ee"),
    "purple": ("#cc79a7", "#e39bc4"),
    "orange": ("#e69f00", "#f2b535"),
    "sky": ("#56b4e9", "#7cc9f2"),
    "ink": ("#1c2126", "#e8eaed"),
    "soft": ("#6b737c", "#9aa3ad"),
    "line": ("#d9dde1", "#3a4047"),
    "paper": ("#ffffff", "#14171a"),
}
DPI = 100


def colour(name: str) -> str:
    """A palette colour as plots draw it."""
    return PALETTE[name][0]


OF_NAME = {
    "fast": "vermillion",
    "balanced": "green",
    "best": "blue",
    "paper": "ink",
}
_SPARE = ("sky", "purple", "orange", "soft")
MARKERS = {"fp32": "o", "bf16": "s", "fp16": "D", "int8": "^"}


def colours(names: list[str]) -> dict[str, str]:
    """A colour for each name: its own where it has one, else the next that is free."""
    spare = [colour(name) for name in _SPARE]
    chosen: dict[str, str] = {}
    for name in dict.fromkeys(names):
        own = OF_NAME.get(name)
        chosen[name] = colour(own) if own else spare[len(chosen) % len(spare)]
    return chosen


@contextmanager
def themed() -> Iterator[None]:
    """Matplotlib's settings for a plot, restored afterwards."""
    from matplotlib import rc_context

    ink, soft, line, paper = (colour(name) for name in ("ink", "soft", "line", "paper"))
    settings: Any = {
        "font.family": "DejaVu Sans",
        "font.size": 9,
        "text.color": ink,
        "axes.labelcolor": ink,
        "axes.edgecolor": soft,
        "axes.facecolor": paper,
        "figure.facecolor": paper,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "axes.axisbelow": True,
        "axes.titlesize": 10,
        "axes.titlelocation": "left",
        "grid.color": line,
        "grid.linewidth": 0.6,
        "xtick.color": soft,
        "ytick.color": soft,
        "xtick.labelcolor": ink,
        "ytick.labelcolor": ink,
        "legend.frameon": False,
        "legend.fontsize": 8,
        "lines.linewidth": 1.6,
        "svg.fonttype": "none",
        "figure.dpi": DPI,
    }
    with rc_context(settings):
        yield


def figure(width: float, height: float, columns: int = 1) -> tuple[Figure, list[Axes]]:
    """A figure of so many inches with a row of axes; call it inside `themed`."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(width, height), layout="constrained")
    axes = drawn.subplots(1, columns, squeeze=False)
    return drawn, list(axes[0])


def plain(axis: Any, *, subs: tuple[int, ...] = (1, 2, 5)) -> None:
    """Ordinary numbers at a log axis, at these multiples of the powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    form = FuncFormatter(lambda value, _: f"{value:g}")
    axis.set_major_locator(LogLocator(10, subs=subs))
    axis.set_major_formatter(form)
    axis.set_minor_formatter(NullFormatter())


def png(drawn: Figure) -> bytes:
    """The figure at twice the page's resolution, on white."""
    with io.BytesIO() as stream:
        drawn.savefig(stream, format="png", dpi=2 * DPI)
        return stream.getvalue()


def svg(drawn: Figure, name: str) -> str:
    """The figure for a page: text stays text, colours follow the page's variables.

    `name` keeps its ids apart from those of other plots. No address outside it is left.
    """
    from matplotlib import rc_context

    with io.StringIO() as stream, rc_context({"svg.hashsalt": name}):
        drawn.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
        text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'href="#', f'href="#{name}-', text)
    text = re.sub(r"url\(#", f"url(#{name}-", text)
    text = re.sub(r"'DejaVu Sans'|DejaVu Sans", "system-ui, sans-serif", text)
    for key, (light, _) in PALETTE.items():
        text = re.sub(re.escape(light), f"var(--{key})", text, flags=re.IGNORECASE)
    # the size is the page's to choose
    return re.sub(r'(<svg[^>]*?) height="[^"]*"([^>]*?) width="[^"]*"', r"\1\2", text, count=1)
