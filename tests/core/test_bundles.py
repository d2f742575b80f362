"""Bundles: written, found, verified; refused when anything doesn't fit."""

import hashlib
import json

import pytest

from deepshade.bundles import Bundle, bundle_folders, bundle_root, write_config
from deepshade.errors import BundleError


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "models" / "ao" / "default"
    path.mkdir(parents=True)
    (path / "model.onnx").write_bytes(b"graph")
    (path / "model.safetensors").write_bytes(b"weights")
    return path


def make(folder, **changes):
    settings = {
        "effect": "ao",
        "name": "default",
        "inputs": ("normal", "position"),
        "outputs": ("Y",),
        "radius": 0.5,
        "fov": 50.0,
        "size_multiple": 64,
        "halo": 96,
        "ranges": {"position": (-40.0, 40.0)},
        "metrics": {"dssim": 0.1},
    } | changes
    return write_config(folder, **settings)


def edit(folder, **changes):
    path = folder / "config.json"
    config = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({k: v for k, v in config.items() if v is not None}))


def test_round_trip(folder):
    written = make(folder)
    loaded = Bundle.load(folder)
    assert loaded == written
    assert loaded.inputs == ("normal", "position")
    assert loaded.position_scale == "1/radius"
    assert (loaded.input_name, loaded.output_name) == ("gbuffer", "shade")
    assert loaded.hashes["model.onnx"] == hashlib.sha256(b"graph").hexdigest()
    assert loaded.sha256 == hashlib.sha256(b"graph").hexdigest()
    assert loaded.short_hash == loaded.sha256[:12]
    assert loaded.metrics == {"dssim": 0.1}
    config = json.loads((folder / "config.json").read_text())
    assert config["hashes"] == loaded.hashes
    assert config["ranges"] == {"position": [-40.0, 40.0]}
    assert bundle_folders(folder.parents[1]) == [folder]
    assert not [p for p in folder.iterdir() if p.name.endswith(".tmp")]


def test_no_folder_holds_no_bundles(tmp_path):
    assert bundle_folders(tmp_path / "nowhere") == []


def test_where_models_are(tmp_path, monkeypatch):
    monkeypatch.delenv("DEEPSHADE_MODELS", raising=False)
    monkeypatch.chdir(tmp_path)
    assert bundle_root().parts[-1] == "models"
    assert (bundle_root().parent / "core").is_dir()
    (tmp_path / "models").mkdir()
    assert bundle_root().resolve() == tmp_path / "models"
    monkeypatch.setenv("DEEPSHADE_MODELS", "/elsewhere")
    assert str(bundle_root()) == "/elsewhere"


def test_optional_files_are_verified_too(folder):
    plain = make(folder)
    assert plain.int8 is None
    assert plain.probe is None
    for name in ("model.int8.onnx", "probe.exr"):
        (folder / name).write_bytes(name.encode())
    make(folder)
    loaded = Bundle.load(folder)
    assert loaded.int8 == folder / "model.int8.onnx"
    assert loaded.probe == folder / "probe.exr"
    (folder / "probe.exr").write_bytes(b"other")
    with pytest.raises(BundleError, match="is not the file"):
        Bundle.load(folder)


def test_background_reaches_as_far_as_the_halo_or_less(folder):
    assert make(folder).background_halo == 96
    assert "background_halo" not in json.loads((folder / "config.json").read_text())
    assert make(folder, background_halo=8).background_halo == 8
    assert Bundle.load(folder).background_halo == 8


@pytest.mark.parametrize("name", ["model.onnx", "model.safetensors"])
def test_refuses_changed_and_missing_files(folder, name):
    make(folder)
    (folder / name).write_bytes(b"other")
    with pytest.raises(BundleError, match="is not the file"):
        Bundle.load(folder)
    (folder / name).unlink()
    with pytest.raises(BundleError, match="missing"):
        Bundle.load(folder)


def test_unknown_entries_name_the_nearest(folder):
    make(folder)
    edit(folder, raduis=3)
    with pytest.raises(BundleError, match="raduis") as caught:
        Bundle.load(folder)
    assert "radius" in caught.value.fix


@pytest.mark.parametrize(
    "changes",
    [
        {"radius": None},
        {"radius": -1},
        {"radius": True},
        {"fov": 180},
        {"effect": "oa"},
        {"effect": ["ao"]},
        {"radius": 10**400},
        {"inputs": ["normals"]},
        {"inputs": []},
        {"outputs": ["Y", "Y"]},
        {"halo": -1},
        {"halo": 1.5},
        {"background_halo": -1},
        {"size_multiple": 0},
        {"name": "../../etc"},
        {"position_scale": "radius"},
        {"hashes": {}},
        {"hashes": {"../model.onnx": "0" * 64}},
        {"ranges": {"position": [1]}},
    ],
)
def test_refuses_impossible_entries(folder, changes):
    make(folder)
    edit(folder, **changes)
    with pytest.raises(BundleError):
        Bundle.load(folder)


@pytest.mark.parametrize("text", ["", "[]", "{", "[" * 100_000, "\ufeff"])
def test_refuses_what_is_no_configuration(folder, text):
    make(folder)
    (folder / "config.json").write_text(text)
    with pytest.raises(BundleError):
        Bundle.load(folder)


def test_refuses_a_huge_configuration(folder):
    make(folder)
    (folder / "config.json").write_text(" " * (2 << 20))
    with pytest.raises(BundleError, match="bytes"):
        Bundle.load(folder)


def test_a_failed_write_leaves_the_old_bundle(folder):
    make(folder)
    before = (folder / "config.json").read_text()
    with pytest.raises(BundleError):
        make(folder, radius=-1)
    assert (folder / "config.json").read_text() == before
    Bundle.load(folder)
