"""The environment maps of a data set: those of a folder and generated skies, of a bounded size."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepshade.environments import SUFFIXES, Environment, read_environment, sky
from deepshade.errors import ConfigError

# Rows of a map, at most: its file has 1.5 MB then, and a pixel is little larger than the sun.
MAX_HEIGHT = 256
# How many views have a generated sky, where there are other maps too.
SKY_SHARE = 0.4
# The sun's height (degrees), how hazy the air is, and the ground's reflectance.
ELEVATIONS = (3.0, 80.0)
TURBIDITIES = (2.0, 9.0)
GROUNDS = (0.05, 0.5)


def map_files(folder: str) -> list[Path]:
    """The maps in `folder`, in order of their names; ConfigError if there are none."""
    found = [p for p in Path(folder).glob("*") if p.suffix.lower() in SUFFIXES]
    if not found:
        raise ConfigError(
            "environments",
            detail=f"the folder {folder} holds no environment maps ({', '.join(SUFFIXES)})",
        )
    return sorted(found)


def draw_map(
    rng: np.random.Generator, folder: str | None, skies: int, seed: int
) -> tuple[Environment, float]:
    """A map of `folder` or one of `skies` generated ones, which `seed` stands for, and a rotation.

    The rotation, about the world's up axis, is in degrees from 0 to 360.
    """
    files = map_files(folder) if folder is not None else []
    rotation = float(rng.uniform(0, 360))
    generated = rng.random() < SKY_SHARE
    if skies and (generated or not files):
        return _sky(int(rng.integers(skies)), seed), rotation
    if not files:
        raise ConfigError("environments", detail="there are neither maps nor skies to draw from")
    return _read(files[int(rng.integers(len(files)))]), rotation


def reduced(environment: Environment, height: int = MAX_HEIGHT) -> Environment:
    """The map with at most `height` rows: pixels' means, weighted by the solid angles they have."""
    rows, columns = environment.shape
    if rows <= height:
        return environment
    # The solid angle between two rows' edges is that between their heights on the unit sphere.
    fine, coarse = (-np.cos(np.pi * np.linspace(0, 1, n + 1)) for n in (rows, height))
    down = _shares(fine, coarse)
    across = _shares(np.linspace(0, 1, columns + 1), np.linspace(0, 1, 2 * height + 1))
    smaller = down @ environment.radiance.astype(np.float64) @ across.T
    return Environment(environment.name, smaller.astype(np.float32))


def _shares(fine: NDArray[np.float64], coarse: NDArray[np.float64]) -> NDArray[np.float64]:
    """(C, F): what share of each of C intervals lies in each of F, by their increasing edges."""
    low, high = coarse[:-1, None], coarse[1:, None]
    overlap = np.minimum(fine[1:], high) - np.maximum(fine[:-1], low)
    return np.asarray(np.clip(overlap, 0, None) / (high - low))


@lru_cache(maxsize=16)
def _read(path: Path) -> Environment:
    return reduced(read_environment(path))


@lru_cache(maxsize=16)
def _sky(number: int, seed: int) -> Environment:
    rng = np.random.default_rng([seed, number, 0x736B79])
    elevation, turbidity, ground = (
        float(rng.uniform(*span)) for span in (ELEVATIONS, TURBIDITIES, GROUNDS)
    )
    return sky(
        f"sky-{number}",
        elevation=elevation,
        turbidity=turbidity,
        ground=ground,
        height=MAX_HEIGHT,
    )
