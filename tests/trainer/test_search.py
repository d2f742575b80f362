"""The search: its frontier, its proposals, and that it goes on where it stood."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from deepshade.errors import DataError
from deepshade_trainer.networks import NetworkConfig, build
from deepshade_trainer.recipe import preset
from deepshade_trainer.search import (
    Trial,
    _next,
    frontier,
    label,
    milliseconds,
    read_trials,
    search,
)

TINY = NetworkConfig(widths=(8, 12), steps=(2,), down=(1, 1), up=(1,))


def trial(ms: float, dssim: float, network: NetworkConfig = TINY, rung: int = 0) -> Trial:
    return Trial(network, rung, 8, dssim, dssim / 0.1, ms, "test/fp32", 1, 1, 1.0)


def test_the_frontier_is_what_nothing_beats() -> None:
    rng = np.random.default_rng(0)
    trials = [trial(*pair) for pair in rng.uniform(size=(60, 2)).round(2)]
    expected = [
        t
        for t in trials
        if not any(
            o.ms <= t.ms and o.dssim <= t.dssim and (o.ms < t.ms or o.dssim < t.dssim)
            for o in trials
        )
    ]
    found = frontier(trials)
    assert {(t.ms, t.dssim) for t in found} == {(t.ms, t.dssim) for t in expected}
    assert [t.ms for t in found] == sorted(t.ms for t in found)


def test_proposals_are_new_sound_and_named_apart() -> None:
    rng = np.random.default_rng(1)
    tried: list[Trial] = []
    for n in range(12):
        network, rung = _next(tried, TINY, rng, set())
        if rung == 0:
            assert network not in [t.network for t in tried]
            assert build(network).size_multiple <= 128
        tried.append(trial(n, 1 / (n + 1), network, rung))
    names = [label(t.network) for t in tried if t.rung == 0]
    assert len(set(names)) == len(names)


def test_the_best_of_a_rung_climb() -> None:
    networks = [replace(TINY, widths=(8, w)) for w in (8, 16, 24, 32)]
    pairs = [(4.0, 0.9), (3.0, 0.5), (2.0, 0.6), (5.0, 0.7)]
    tried = [trial(*pair, network) for pair, network in zip(pairs, networks, strict=True)]
    network, rung = _next(tried, TINY, np.random.default_rng(0), set())
    assert rung == 1
    assert network in (networks[1], networks[2])


def test_a_damaged_log_is_an_error(tmp_path: Path) -> None:
    log = tmp_path / "trials.jsonl"
    assert read_trials(log) == []
    log.write_text(json.dumps(asdict(trial(1, 2))) + "\n{")
    with pytest.raises(DataError, match="damaged"):
        read_trials(log)


def test_time_is_measured_at_any_size() -> None:
    ms, backend = milliseconds(TINY, "ao", threads=1, size=(60, 100))
    assert ms > 0
    assert backend.partition("/")[2] in ("fp32", "bf16")


@pytest.mark.slow
def test_a_search_goes_on_where_it_stood(data: Path, tmp_path: Path) -> None:
    recipe = replace(preset("balanced", "ao"), batch=2)
    first = next(search(recipe, [data], tmp_path, minutes=5, steps=2, most_ms=1e6))
    assert read_trials(tmp_path / "trials.jsonl") == [first]
    assert (tmp_path / first.label / "recipe.json").exists()
    second = next(search(recipe, [data], tmp_path, minutes=5, steps=2, most_ms=1e6))
    assert second.network != first.network
    assert len(read_trials(tmp_path / "trials.jsonl")) == 2
    assert list(search(recipe, [data], tmp_path, minutes=0)) == []
