"""Bundles: written, found, verified; refused when anything doesn't fit."""

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from deepshade.bundles import Bundle, bundle_folders, bundle_roots, overlooked, write_config
from deepshade.errors import BundleError, ConfigError


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "models" / "ao" / "default"
    path.mkdir(parents=True)
    (path / "model.onnx").write_bytes(b"graph")
    return path


def make(folder, **changes):
    config = {
        "effect": "ao",
        "name": "default",
        "inputs": ["normal", "position"],
        "outputs": ["Y"],
        "radius": 0.5,
        "fov": 50.0,
        "size_multiple": 64,
        "halo": 96,
        "bytes_per_pixel": 100,
        "float32": ["t1"],
        "network": {"kind": "fold"},
        "ranges": {"position": [-40.0, 40.0]},
    } | changes
    return write_config(folder, config, {"error": {"test": {"exact": {"dssim": 0.1}}}})


def edit(folder, **changes):
    path = folder / "config.json"
    config = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({k: v for k, v in config.items() if v is not None}))


def test_round_trip(folder):
    written = make(folder)
    loaded = Bundle.load(folder)
    assert loaded == written
    assert loaded.inputs == ("normal", "position")
    assert loaded.channels == 6
    assert loaded.dssim == 0.1
    assert loaded.float32 == ("t1",)
    assert (loaded.input_name, loaded.output_name) == ("gbuffer", "shade")
    assert loaded.hashes["model.onnx"] == hashlib.sha256(b"graph").hexdigest()
    assert loaded.sha256 == hashlib.sha256(b"graph").hexdigest()
    assert loaded.short_hash == loaded.sha256[:12]
    assert loaded.network == {"kind": "fold"}
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
    shipped = Path(__file__).resolve().parents[2] / "models"
    assert bundle_roots() == (shipped,)
    mine, others = tmp_path / "mine", tmp_path / "others"
    for place in (mine, others):
        place.mkdir()
    assert bundle_roots([mine, "shipped"]) == (mine, shipped)
    monkeypatch.setenv("DEEPSHADE_MODELS", f"{others}:shipped")
    assert bundle_roots() == (others, shipped)
    assert bundle_roots([mine]) == (mine,)
    monkeypatch.setenv("DEEPSHADE_MODELS", "/nowhere")
    with pytest.raises(ConfigError, match="/nowhere; DEEPSHADE_MODELS says"):
        bundle_roots()


def test_models_here_are_pointed_out_and_not_used(folder, monkeypatch):
    monkeypatch.delenv("DEEPSHADE_MODELS", raising=False)
    here = folder.parents[1]
    monkeypatch.chdir(here.parent)
    assert overlooked(bundle_roots()) == ""  # holds no bundle yet
    make(folder)
    assert "./models aren't used" in overlooked(bundle_roots())
    assert overlooked([here]) == ""


def test_of_two_bundles_of_one_name_the_folder_named_first_has_it(folder, tmp_path):
    make(folder)
    root, other = folder.parents[1], tmp_path / "other"
    shutil.copytree(root, other)
    shutil.copytree(folder, other / "ao" / "more")
    more = other / "ao" / "more"
    assert bundle_folders(root, other) == [folder, more]
    assert bundle_folders(other, root) == [other / "ao" / "default", more]


def test_a_run_for_each_colour_channel_sees_one_of_them(folder):
    light = {"effect": "dof", "inputs": ["focal", "light"], "outputs": ["R", "G", "B"]}
    assert make(folder, **light, per_channel=True).channels == 2
    assert make(folder, **light).channels == 4


@pytest.mark.parametrize(
    "error", [{}, None, {"test": {}}, {"test-real": {"exact": {"dssim": "low"}}}]
)
def test_an_unknown_error_is_none(folder, error):
    make(folder)
    metrics = folder / "metrics.json"
    metrics.write_text(json.dumps({"error": error}))
    assert Bundle.load(folder).dssim is None


def test_refuses_changed_and_missing_files(folder):
    make(folder)
    (folder / "model.onnx").write_bytes(b"other")
    with pytest.raises(BundleError, match="is not the file"):
        Bundle.load(folder)
    (folder / "model.onnx").unlink()
    with pytest.raises(BundleError, match="missing"):
        Bundle.load(folder)


def test_refuses_a_graph_that_reads_other_files(folder):
    """A stranger's graph could have the service read what isn't the stranger's."""
    onnx = pytest.importorskip("onnx")
    weight = onnx.numpy_helper.from_array(np.ones(4, np.float32), "w")
    graph = onnx.helper.make_graph([], "g", [], [], [weight])
    model = onnx.helper.make_model(graph)
    onnx.save(model, folder / "model.onnx")
    make(folder)
    Bundle.load(folder)
    onnx.save(model, folder / "model.onnx", save_as_external_data=True, size_threshold=0)
    make(folder)
    with pytest.raises(BundleError, match="tensors in other files"):
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
        {"bytes_per_pixel": 0},
        {"per_channel": "yes"},
        {"float32": "t1"},
        {"float32": [1]},
        {"network": []},
        {"size_multiple": 0},
        {"name": "../../etc"},
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
