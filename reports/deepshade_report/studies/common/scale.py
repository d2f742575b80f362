"""How much a study renders, trains and measures: minutes by default, hours with --large."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Scale:
    """Numbers of views, sides in pixels, reference rays a pixel, and training steps.

    Networks learn from `learn_views` of `side` pixels; of the held-out ones the first `val_views`
    validate and the other `test_views` test. Shipped bundles shade `wide_views` of `wide_side`.
    Curves have `curve` points; what is trained for all effects sees `effect_views` in
    `effect_steps`. Regressors see `pixels` of each view, forests have `trees`. Each training is
    done with all `seeds`.
    """

    learn_views: int = 96
    val_views: int = 12
    test_views: int = 24
    side: int = 128
    learn_spp: int = 64
    held_spp: int = 256
    steps: int = 250
    batch: int = 8
    curve: int = 5
    effect_views: int = 36
    effect_steps: int = 125
    effect_side: int = 96
    wide_views: int = 8
    wide_side: int = 512
    wide_spp: int = 128
    speed_seconds: float = 20.0
    pixels: int = 150
    trees: int = 20
    seeds: tuple[int, ...] = (0,)


SMALL = Scale()
LARGE = Scale(
    learn_views=2048,
    val_views=72,
    test_views=144,
    side=256,
    learn_spp=256,
    steps=8000,
    curve=20,
    effect_views=1024,
    effect_steps=4000,
    effect_side=256,
    wide_views=36,
    wide_spp=512,
    speed_seconds=200.0,
    pixels=200,
    trees=100,
    seeds=(0, 1, 2),
)
