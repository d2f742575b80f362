"""A whole quick report of a tiny bundle over a tiny data set, as the command makes it."""

from __future__ import annotations

import hashlib
import json
from importlib.resources import files
from pathlib import Path

import jsonschema
import numpy as np
import onnx
import onnx.reference
import pytest
from onnx import TensorProto, helper, numpy_helper
from safetensors.numpy import save
from typer.testing import CliRunner

from deepshade import exr
from deepshade.bundles import write_config
from deepshade.camera import Camera
from deepshade.errors import ConfigError
from deepshade.gbuffer.derivation import normals_from_positions
from deepshade.manifest import Manifest, Shard
from deepshade_report import baselines as contenders
from deepshade_report import frames
from deepshade_report.cli import report
from deepshade_report.subjects import Network, stacked
from deepshade_report.views import load_views

SIZE = 64


def network(width: int, seed: int) -> bytes:
    """Two 3x3 convolutions, 6 channels in, 1 out, in [0, 1]."""
    rng = np.random.default_rng(seed)
    weights = [
        numpy_helper.from_array(rng.normal(0, 0.2, shape).astype(np.float32), name)
        for name, shape in (("a", (width, 6, 3, 3)), ("b", (1, width, 3, 3)))
    ]
    nodes = [
        helper.make_node("Conv", ["gbuffer", "a"], ["x"], pads=[1] * 4),
        helper.make_node("LeakyRelu", ["x"], ["y"], alpha=0.01),
        helper.make_node("Conv", ["y", "b"], ["z"], pads=[1] * 4),
        helper.make_node("Sigmoid", ["z"], ["shade"]),
    ]
    sizes = ["N", 6, "H", "W"], ["N", 1, "H", "W"]
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
        for name, shape in zip(("gbuffer", "shade"), sizes, strict=True)
    ]
    graph = helper.make_graph(nodes, "tiny", ends[:1], ends[1:], weights)
    opset = [helper.make_opsetid("", 18)]
    return helper.make_model(graph, opset_imports=opset, ir_version=10).SerializeToString()


def write_bundle(folder: Path, width: int, seed: int) -> None:
    folder.mkdir(parents=True)
    (folder / "model.onnx").write_bytes(network(width, seed))
    (folder / "model.safetensors").write_bytes(b"\x02\0\0\0\0\0\0\0{}")
    write_config(
        folder,
        effect="ao",
        name=folder.name,
        inputs=("normal", "position"),
        outputs=("Y",),
        radius=0.5,
        fov=50.0,
        size_multiple=8,
        halo=2,
    )


def write_data(folder: Path, count: int = 3) -> None:
    folder.mkdir(parents=True)
    samples = []
    for k in range(count):
        y, x = np.mgrid[0:SIZE, 0:SIZE] / SIZE
        wave = np.sin((6 + k) * x) * np.sin(9 * y)
        depth = (4 + 0.3 * wave).astype(np.float32)
        depth[: 2 * k] = np.inf
        there = np.isfinite(depth)
        position = Camera(50, SIZE, SIZE).position_from_depth(depth)
        position[:, ~there] = 0
        samples.append(
            {
                "position": position.astype(np.float32),
                "normal": normals_from_positions(position, there).astype(np.float16),
                "reference_ao": np.where(there, 0.6 - 0.35 * wave, 1)[None].astype(np.float16),
            }
        )
    content = save({name: np.stack([s[name] for s in samples]) for name in samples[0]})
    (folder / "shard-00000.safetensors").write_bytes(content)
    camera = {
        "fov": 50.0,
        "frame": [SIZE, SIZE],
        "origin": [0, 0],
        "world_to_camera": np.eye(4).tolist(),
    }
    records = [
        {"scene": f"wave:{k}", "seed": k, "radius": 0.5, "camera": camera} for k in range(count)
    ]
    schema = {n: {"dtype": str(v.dtype), "shape": list(v.shape)} for n, v in samples[0].items()}
    digest = hashlib.sha256(content).hexdigest()
    shard = Shard("shard-00000.safetensors", digest, records)
    Manifest({"test": True}, schema).with_shard(shard).write(folder)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    write_bundle(folder / "models" / "ao" / "fast", 4, 0)
    write_bundle(folder / "paper", 16, 1)
    write_data(folder / "data")
    return folder


def arguments(root: Path, *more: str) -> list[str]:
    found = []
    for name in ("models", "data", "paper", "out"):
        found += [f"--{name}", str(root / name)]
    return [*found, *more]


def command(*options: str) -> tuple[int, str]:
    import typer

    app = typer.Typer()
    app.command()(report)
    result = CliRunner().invoke(app, list(options), catch_exceptions=False)
    return result.exit_code, result.output


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_a_quick_report_has_every_section(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contenders, "MODULES", {"absent": "deepshade_report.absent"})
    code, output = command(*arguments(root, "--quick"))
    assert code == 0, output
    found = json.loads((root / "out" / "report.json").read_text())
    schema = json.loads(files("deepshade_report").joinpath("report.schema.json").read_text())
    jsonschema.Draft202012Validator(schema).validate(found)
    sections = found["sections"]
    assert {name: s.get("reason") for name, s in sections.items() if s["status"] != "done"} == {}
    ids = {row["id"] for row in sections["speed"]["data"]["rows"]}
    assert {"fast onnxruntime/fp32", "paper onnxruntime/fp32"} <= ids
    assert sections["error"]["data"]["missing"] == {"absent": "not in this installation"}
    (service,) = sections["service"]["data"]["rows"]
    assert service["request"] == "/shade/ao?quality=fast"
    assert service["total_ms"]["median"] > service["bare_ms"]["median"] > 0
    assert all(row["refused"] == 0 for row in sections["clients"]["data"]["rows"])
    assert sections["gpu"]["data"]["rows"]
    assert all(row["most_changed"] < 1e-3 for row in sections["savings"]["data"]["rows"])
    assert (root / "out" / "comparison.png").stat().st_size > 10_000
    judged = {row["target"]: row["met"] for row in found["targets"]}
    assert sum(met is not None for met in judged.values()) >= 8
    assert "index.html" in output
    again, _ = command(*arguments(root, "--quick", "--resume"))
    assert again == 0
    kept = json.loads((root / "out" / "report.json").read_text())["sections"]
    assert kept == sections


@pytest.mark.slow
def test_without_views_each_section_says_so(root: Path, tmp_path: Path) -> None:
    options = ["--models", str(root / "models"), "--data", str(tmp_path), "--out", str(tmp_path)]
    code, output = command(*options, "--only", "speed", "--only", "savings")
    assert code == 0
    assert output.count("no held-out views") == 2


def test_unknown_sections_and_effects_are_refused(root: Path) -> None:
    with pytest.raises(ConfigError, match="no section is called 'sped'"):
        command(*arguments(root, "--only", "sped"))
    with pytest.raises(ConfigError, match="no effect is called 'oa'"):
        command(*arguments(root, "--effect", "oa"))


def test_frames_of_any_size_keep_the_view_s_pixels(root: Path) -> None:
    view = load_views(root / "data", "ao", 1)[0]
    large = frames.extended(view, 100, 150)
    assert np.array_equal(large.position[:, :SIZE, :SIZE], view.position)
    assert np.array_equal(
        large.position[:, :, SIZE : 2 * SIZE], large.position[:, :, SIZE - 1 :: -1]
    )
    small = frames.extended(view, 16, 24)
    assert np.array_equal(small.normal, view.normal[:, :16, :24])
    for shape in ("sky", "object"):
        empty = frames.emptied(large, 0.5, shape)
        assert empty.background.mean() == 0.5
        assert not empty.position[:, empty.background].any()
        kept = ~empty.background
        assert np.array_equal(empty.normal[:, kept], large.normal[:, kept])


def test_a_large_body_holds_the_view_and_compresses_like_a_real_one(root: Path) -> None:
    view = load_views(root / "data", "ao", 3)[2]
    whole = frames.extended(view, 300, 400)
    grained = frames.large_body(view, 300, 400)
    image = exr.read(grained).pixels
    for axis, plane in zip("XYZ", whole.position, strict=True):
        assert np.allclose(image[f"position.{axis}"], plane, rtol=4e-3, atol=1e-6)
        assert not image[f"position.{axis}"][whole.background].any()
    assert len(grained) > 2 * len(frames.body(whole))
    assert exr.read_header(grained).channels().keys() == image.keys()


def test_a_network_s_answer_is_that_of_its_graph(root: Path) -> None:
    from deepshade.bundles import Bundle
    from deepshade.engines import Backend, load_engine

    bundle = Bundle.load(root / "models" / "ao" / "fast")
    view = frames.extended(load_views(root / "data", "ao", 3)[2], 37, 53)
    engine = load_engine(bundle, Backend("onnxruntime", "fp32"), threads=1)
    method = Network(bundle, engine, "fast")
    method.prepare(view)
    ready = stacked(bundle, view)
    assert ready.shape == (1, 6, 40, 56)
    assert not ready[0, :, :37, :53][:, view.background].any()
    graph = onnx.reference.ReferenceEvaluator(onnx.load(bundle.model))
    inputs = np.concatenate([view.normal, view.position / 0.5])[None]
    padded = np.zeros_like(ready)
    padded[..., :37, :53] = np.where(view.background, 0, inputs)
    (expected,) = graph.run(None, {"gbuffer": padded})
    assert np.allclose(method.shade(view), expected[0, 0, :37, :53], atol=1e-5)
