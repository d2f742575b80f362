"""The procedural data sets of studies; no seed of one is in another."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from deepshade import exr
from deepshade.effects import EFFECTS
from deepshade.environments import sky
from deepshade.files import replacing
from deepshade_report.studies.common.scale import Scale

if TYPE_CHECKING:
    from deepshade_workers.dataspec import DataSpec

DIVERSITY = (1, 2, 5, 10)  # families; and all of them
_SEED = 16000


def specs(scale: Scale, folder: Path) -> dict[str, DataSpec]:
    """What each set holds: every view of a procedural family shows a scene of its own.

    `folder` is where an environment map is written to.
    """
    from deepshade_workers.dataspec import DataSpec, expand_scenes

    every = expand_scenes(["procedural"])
    held = scale.val_views + scale.test_views
    pool = diverse(scale.learn_views, every)

    def plain(scenes: tuple[str, ...], views: int, side: int, spp: int) -> DataSpec:
        return DataSpec(scenes, views, size=side, frame=side, spp=spp)

    def bright(views: int, spp: int) -> DataSpec:
        side, most = scale.effect_side, scale.effect_side / 8
        return replace(
            plain(every, views, side, spp),
            effects=tuple(EFFECTS),
            environments=str(_map(folder)),
            skies=0,
            # motions, blur and scattering in proportion to smaller pictures
            max_blur=most,
            max_motion=most,
            max_scatter=most,
        )

    sets = {
        "learn": plain(every, scale.learn_views, scale.side, scale.learn_spp),
        "held": plain(every, held, scale.side, scale.held_spp),
        "diverse": plain(pool, len(pool), scale.side, scale.learn_spp),
        "wide": plain(every, scale.wide_views, scale.wide_side, 2 * scale.wide_spp),
        "effects": bright(scale.effect_views, scale.learn_spp),
        "effects-held": bright(held // 2, scale.held_spp),
    }
    return {
        name: replace(spec, seed=_SEED + number, shard_size=max(1, min(64, spec.views // 8)))
        for number, (name, spec) in enumerate(sets.items())
    }


def order(families: tuple[str, ...]) -> list[str]:
    """The families in a random order, always the same: studies take the first few."""
    return [families[k] for k in np.random.default_rng(_SEED).permutation(len(families))]


def counts(views: int, families: tuple[str, ...], several: int) -> dict[str, int]:
    """How many of `views` each of the first `several` families gets."""
    chosen = order(families)[:several]
    return {name: len(range(place, views, several)) for place, name in enumerate(chosen)}


def diverse(views: int, families: tuple[str, ...]) -> tuple[str, ...]:
    """Scenes of the pool from which `views` of any number of families can be taken."""
    several = [*(n for n in DIVERSITY if n < len(families)), len(families)]
    tables = [counts(views, families, n) for n in several]
    most = {name: max(table.get(name, 0) for table in tables) for name in families}
    return tuple(name for name in families for _ in range(most[name]))


def _map(folder: Path) -> Path:
    """A folder with one environment that is the same all around: a network can learn it.

    The paper's networks aren't told of the environment, nor of how it is turned.
    """
    where = folder / "even-sky"
    where.mkdir(parents=True, exist_ok=True)
    if not (where / "even.exr").is_file():
        radiance = sky(height=64).radiance
        even = np.broadcast_to(radiance.mean(2, keepdims=True), radiance.shape)
        with replacing(where / "even.exr") as temporary:
            exr.write(temporary, dict(zip("RGB", np.ascontiguousarray(even), strict=True)))
    return where
