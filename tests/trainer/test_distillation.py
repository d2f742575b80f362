"""A bundle's answers as references."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from deepshade import symmetry
from deepshade.bundles import Bundle
from deepshade.cli import main
from deepshade.errors import ConfigError, DataError
from deepshade.manifest import NAME, Manifest, write_shard
from deepshade_trainer.dataset import TEACHER, Dataset
from deepshade_trainer.distillation import distill
from deepshade_trainer.evaluation import evaluate


@pytest.fixture(scope="module")
def taught(base: Path, data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("taught") / "waves"
    steps = list(distill(Bundle.load(base), data, out))
    assert steps == [(k, 24) for k in range(1, 25)]
    return out


def turned(folder: Path, out: Path, turn: int) -> Path:
    """The data of a folder, each view turned."""
    out.mkdir()
    found = Manifest.read(folder)
    manifest = Manifest(found.settings, found.schema)
    for shard in found.shards:
        tensors = {
            name: symmetry.apply(planes, name, turn)
            for name, planes in load_file(folder / shard.file).items()
        }
        manifest = manifest.with_shard(write_shard(out, shard.file, tensors, shard.samples))
    manifest.write(out)
    return out


def references(folder: Path) -> np.ndarray:
    data = Dataset([folder], "ao")
    return np.stack([data.load(k)["reference_ao"] for k in range(len(data.entries))])


def test_only_references_are_others(data: Path, taught: Path) -> None:
    given, made = Dataset([data], "ao"), Dataset([taught], "ao")
    for k in range(len(given.entries)):
        one, other = given.load(k), made.load(k)
        assert (one["normal"] == other["normal"]).all()
        assert (one["position"] == other["position"]).all()
        assert given.radius(k) == made.radius(k)
        assert np.abs(one["reference_ao"] - other["reference_ao"]).max() > 0.01
        assert made.error(k) is None


def test_a_turned_view_is_taught_the_turned_answer(
    base: Path, data: Path, taught: Path, tmp_path: Path
) -> None:
    other = turned(data, tmp_path / "turned", 5)
    list(distill(Bundle.load(base), other, tmp_path / "out"))
    theirs = symmetry.apply(references(tmp_path / "out"), None, symmetry.inverse(5))
    assert np.abs(theirs - references(taught)).max() < 2e-3  # 16 bits


def test_averaging_errs_less_than_one_answer(base: Path, data: Path, taught: Path) -> None:
    """Of squared error that is so for any teacher (Jensen's inequality)."""
    once = [
        np.mean((row.image - row.reference) ** 2)
        for turn in symmetry.ALL
        for row in _evaluated(base, data, taught.parent / f"turn-{turn}", turn)
    ]
    mean = np.mean((references(taught) - references(data)) ** 2)
    assert mean <= np.mean(once) + 1e-6


def _evaluated(base: Path, data: Path, folder: Path, turn: int) -> list:
    return list(evaluate(Bundle.load(base), [turned(data, folder, turn)], min_contrast=0))


def test_what_is_taught_is_not_validated_on(data: Path, taught: Path) -> None:
    both = Dataset([data, taught], "ao")
    training, held = both.split(0.3, seed=1)
    assert held == Dataset([data], "ao").split(0.3, seed=1)[1]
    scenes = {both.entries[k].record["scene"] for k in held}
    assert not any(both.entries[k].record["scene"] in scenes for k in training)
    assert sum(TEACHER in both.entries[k].record for k in training) == len(training) / 2


def test_it_goes_on_where_it_stopped(base: Path, data: Path, taught: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    for done, _ in distill(Bundle.load(base), data, out):
        if done == 14:  # within the second shard
            break
    assert len(Manifest.read(out).shards) == 1
    assert next(iter(distill(Bundle.load(base), data, out))) == (12, 24)
    list(distill(Bundle.load(base), data, out))
    for path in sorted(taught.iterdir()):
        assert path.read_bytes() == (out / path.name).read_bytes()


def test_errors(base: Path, data: Path, taught: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="another bundle taught it"):
        list(distill(Bundle.load(base), data, data))
    (tmp_path / "bundle").mkdir()
    for path in base.iterdir():
        (tmp_path / "bundle" / path.name).write_bytes(path.read_bytes())
    config = json.loads((base / "config.json").read_text())
    config["network"]["kind"] = "perceptron"
    (tmp_path / "bundle/config.json").write_text(json.dumps(config))
    with pytest.raises(ConfigError, match="perceptron"):
        list(distill(Bundle.load(tmp_path / "bundle"), data, tmp_path / "x"))


def test_the_command(base: Path, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "taught"
    assert main(["distill", str(base), "--data", str(data), "--out", str(out)]) == 0
    assert f"the data is in {out}" in capsys.readouterr().out
    assert (out / NAME).is_file()
    assert main(["distill", str(base), "--data", str(tmp_path / "none"), "--out", "x"]) == 2
    assert "datagen" in capsys.readouterr().err
