"""Data sets: splits, batches, damage."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from deepshade import symmetry
from deepshade.errors import DataError
from deepshade_trainer.dataset import Dataset, batches, rounded

from .conftest import sample


def test_samples_come_back_as_written(data: Path) -> None:
    found = Dataset([data], "ao")
    assert len(found.entries) == 24
    for number in (0, 13, 23):
        loaded, written = found.load(number), sample(number)
        for name, values in loaded.items():
            assert (values == written[name].astype(np.float32)).all()
    assert found.radius(3) == 0.5
    gbuffer = found.gbuffer(found.load(3), 0.5)
    assert gbuffer.shape == (1, 6, 64, 64)
    assert np.allclose(gbuffer[0, 3:], sample(3)["position"] / 0.5)


def test_no_scene_is_on_both_sides_of_the_split(data: Path) -> None:
    found = Dataset([data], "ao")
    training, held = found.split(0.3, seed=0)
    assert sorted(training + held) == list(range(24))
    assert held
    scenes = [{found.entries[k].record["scene"] for k in side} for side in (training, held)]
    assert not scenes[0] & scenes[1]
    assert found.split(0.3, seed=0) == (training, held)


def test_at_least_one_scene_is_held_out(data: Path) -> None:
    training, held = Dataset([data], "ao").split(1e-9, seed=0)
    assert len(held) == 2  # the two samples of one scene
    assert len(training) == 22
    assert Dataset([data], "ao").split(0.0, seed=0)[1] == []


def test_sixteen_bits_are_left_out_where_they_overflow() -> None:
    small, large = np.float32([0.1, 6e4]), np.float32([0.1, 7e4])
    assert (rounded(small) != small).any()
    assert (rounded(large) == large).all()


def test_a_step_sees_the_same_batch_whenever_it_is_read(data: Path) -> None:
    found = Dataset([data], "ao")
    numbers = list(range(24))
    whole = list(batches(found, numbers, 5, seed=1, first=0, last=6))
    late = list(batches(found, numbers, 5, seed=1, first=4, last=6))
    for a, b in zip(whole[4:], late, strict=True):
        assert a.step == b.step
        assert a.numbers == b.numbers
        assert (a.gbuffer == b.gbuffer).all()
        assert (a.reference == b.reference).all()


def test_every_sample_comes_once_an_epoch(data: Path) -> None:
    found = Dataset([data], "ao")
    read = batches(found, list(range(24)), 6, seed=2, first=0, last=8)
    seen = [n for batch in read for n in batch.numbers]
    assert sorted(seen[:24]) == list(range(24))
    assert sorted(seen[24:]) == list(range(24))
    assert seen[:24] != seen[24:]


def test_augmented_batches_are_symmetric_images_of_the_sample(data: Path) -> None:
    found = Dataset([data], "ao")
    reference = sample(5)["reference_ao"].astype(np.float32)
    all_turns = [symmetry.apply(reference, None, k) for k in range(8)]
    matched = set()
    for seed in range(24):
        _, turned = found.batch([5], np.random.default_rng(seed))
        hits = [k for k in range(8) if (turned[0].numpy() == all_turns[k]).all()]
        assert hits
        matched |= set(hits)
    assert len(matched) >= 5


def test_an_abandoned_reader_stops(data: Path) -> None:
    source = batches(Dataset([data], "ao"), list(range(24)), 4, seed=0, first=0, last=10_000)
    next(source)
    source.close()  # type: ignore[attr-defined]


def test_what_is_wrong_is_said(data: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"holds no manifest\.json"):
        Dataset([tmp_path], "ao")
    with pytest.raises(DataError, match="has no"):
        Dataset([data], "gi")
    document = json.loads((data / "manifest.json").read_text())
    (tmp_path / "manifest.json").write_text(json.dumps(document))
    with pytest.raises(DataError, match="missing"):
        Dataset([tmp_path], "ao")
    for shard in document["shards"]:
        (tmp_path / shard["file"]).write_bytes(b"not a shard")
    broken = Dataset([tmp_path], "ao")
    with pytest.raises(DataError, match="not the file that the manifest describes"):
        broken.load(0)
    for shard in document["shards"]:
        shard["sha256"] = hashlib.sha256(b"not a shard").hexdigest()
    (tmp_path / "manifest.json").write_text(json.dumps(document))
    with pytest.raises(DataError, match="can't be read"):
        Dataset([tmp_path], "ao").load(0)
    document["shards"][0]["file"] = "../elsewhere"
    (tmp_path / "manifest.json").write_text(json.dumps(document))
    with pytest.raises(DataError, match="not in its folder"):
        Dataset([tmp_path], "ao")
