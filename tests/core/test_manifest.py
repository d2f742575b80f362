"""Manifests: complete or absent, never half."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from deepshade.errors import DataError
from deepshade.files import sha256
from deepshade.manifest import NAME, Manifest, Shard, shard_path


def example() -> Manifest:
    records = [{"scene": "a", "seed": 1, "radius": 0.5}]
    manifest = Manifest({"seed": 1}, {"position": {"dtype": "float32", "shape": [3, 8, 8]}})
    manifest = manifest.with_shard(Shard("shard-00001.safetensors", "b" * 64, records))
    return manifest.with_shard(Shard("shard-00000.safetensors", "a" * 64, records * 2))


def test_it_survives_writing(tmp_path: Path) -> None:
    example().write(tmp_path)
    found = Manifest.read(tmp_path)
    assert found == example()
    assert found.count == 3
    assert [s.file[6:11] for s in found.shards] == ["00000", "00001"]
    assert [p.name for p in tmp_path.iterdir()] == [NAME]


def test_a_shard_is_replaced_not_doubled() -> None:
    again = example().with_shard(Shard("shard-00000.safetensors", "c" * 64, []))
    assert again.count == 1


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "holds no"),
        ("{", "not JSON"),
        ("[]", "no deepshade manifest"),
        ('{"format": "other"}', "no deepshade manifest"),
        ('{"format": "deepshade-shards", "version": 99}', "version 99"),
        ('{"format": "deepshade-shards", "version": 1, "settings": {}}', "lacks"),
        (
            json.dumps(
                {
                    "format": "deepshade-shards",
                    "version": 1,
                    "settings": {},
                    "schema": {},
                    "shards": [{"file": "x", "odd": 1}],
                }
            ),
            "unknown field",
        ),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, content: str | None, message: str) -> None:
    if content is not None:
        (tmp_path / NAME).write_text(content)
    with pytest.raises(DataError, match=message):
        Manifest.read(tmp_path)


def test_names_cannot_leave_the_folder(tmp_path: Path) -> None:
    for name in ("../x", "/etc/passwd", "a/b"):
        with pytest.raises(DataError):
            shard_path(tmp_path, Shard(name, "", []))


def test_sha256_of_known_bytes(tmp_path: Path) -> None:
    (tmp_path / "abc").write_bytes(b"abc")
    assert sha256(tmp_path / "abc").startswith("ba7816bf8f01cfea414140de5dae2223")


def test_a_replaced_file_is_synced_with_its_folder(tmp_path: Path, monkeypatch) -> None:
    import os
    import stat

    from deepshade.files import replacing

    synced = []
    monkeypatch.setattr(os, "fsync", lambda d: synced.append(stat.S_ISDIR(os.fstat(d).st_mode)))
    with replacing(tmp_path / "a") as temporary:
        temporary.write_bytes(b"x")
    assert synced == [False, True]
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
