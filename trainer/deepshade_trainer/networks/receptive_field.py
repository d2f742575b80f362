"""Runs of pixels along one axis, and what each kind of layer needs of the one before it."""

from __future__ import annotations

from collections.abc import Callable

# First and last.
Span = tuple[int, int]


def grown(span: Span, reach: int) -> Span:
    """What a convolution that reaches `reach` pixels needs."""
    return span[0] - reach, span[1] + reach


def doubled(span: Span) -> Span:
    """What bilinear x 2 needs of the coarser level: the two nearest of each pixel."""
    return (span[0] - 1) // 2, (span[1] - 1) // 2 + 1


def folded(span: Span, factor: int) -> Span:
    """What pooling or folding by `factor` needs of the finer level."""
    return span[0] * factor, span[1] * factor + factor - 1


def joined(a: Span, b: Span) -> Span:
    """The run that holds both."""
    return min(a[0], b[0]), max(a[1], b[1])


def halo(field: Callable[[int], Span], period: int) -> int:
    """How many pixels away an input may change an output, at most.

    `field` gives the input columns that an output column depends on, alike every `period` columns.
    """
    ends = ((pixel, field(pixel)) for pixel in range(period))
    return max(max(pixel - first, last - pixel) for pixel, (first, last) in ends)
