"""Maps beside a data set."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepshade.environments import Environment
from deepshade.environments.stored import read_stored, store
from deepshade.errors import DataError


def test_a_map_comes_back_by_its_hash(tmp_path: Path) -> None:
    radiance = np.random.default_rng(1).random((3, 4, 8), np.float32) * 1e5
    environment = Environment("bright", radiance)
    path = store(tmp_path, environment)
    before = path.stat().st_mtime_ns
    assert store(tmp_path, environment) == path
    assert path.stat().st_mtime_ns == before
    found = read_stored(tmp_path, environment.sha256, "bright")
    assert (found.radiance == radiance).all()
    assert (found.name, found.sha256) == ("bright", environment.sha256)


def test_another_map_or_none_is_refused(tmp_path: Path) -> None:
    white, grey = (Environment("", np.full((3, 2, 4), v, np.float32)) for v in (1, 0.5))
    with pytest.raises(DataError, match="missing"):
        read_stored(tmp_path, white.sha256)
    store(tmp_path, grey).rename(store(tmp_path, white))
    with pytest.raises(DataError, match="another map"):
        read_stored(tmp_path, white.sha256)
