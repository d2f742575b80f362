"""Bundles: exact in ONNX Runtime, verified, measured."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch

from deepshade import metrics
from deepshade.bundles import Bundle
from deepshade.engines import REFERENCE, Backend, load_engine, usable
from deepshade.errors import DataError, EngineError
from deepshade.probe import dssim, read_probe
from deepshade_trainer.card import write_card
from deepshade_trainer.dataset import Dataset
from deepshade_trainer.evaluation import Variant, contact_sheet, document, evaluate, summary
from deepshade_trainer.export import TOLERANCE, choose_probe, export, load_shader, parity
from deepshade_trainer.recipe import preset
from deepshade_trainer.run import Run
from deepshade_trainer.training import train


@pytest.fixture(scope="module")
def trained(data: Path, tmp_path_factory: Any) -> Run:
    """A few steps of a small network."""
    run = Run(tmp_path_factory.mktemp("run"))
    recipe = preset("default", "ao").changed(
        network={"widths": (8, 12), "steps": (2,), "down": (1, 1), "up": (1,)},
        batch=4,
        steps=8,
        precision="fp32",
    )
    list(train(recipe, [data], run))
    return run


@pytest.fixture(scope="module")
def bundle(trained: Run, data: Path, tmp_path_factory: Any) -> Bundle:
    folder = tmp_path_factory.mktemp("models") / "ao" / "tiny"
    found, worst = export(trained, folder, [data], radius=0.5)
    assert worst <= TOLERANCE
    return found


def test_the_bundle_loads_and_says_what_it_needs(bundle: Bundle, trained: Run) -> None:
    loaded = Bundle.load(bundle.path)
    _, model = load_shader(trained)
    assert loaded.inputs == ("normal", "position")
    assert (loaded.size_multiple, loaded.halo) == (model.size_multiple, model.halo)
    assert loaded.metrics["parity"]["onnxruntime_vs_torch_max"] <= TOLERANCE
    write_card(loaded, trained, "Trained for a test.")
    assert "Trained for a test." in (bundle.path / "README.md").read_text()


@pytest.mark.parametrize("shape", [(1, 32, 32), (2, 64, 96), (1, 160, 32)])
def test_onnx_runtime_equals_torch_at_any_size(
    bundle: Bundle, trained: Run, shape: tuple[int, int, int]
) -> None:
    count, height, width = shape
    _, model = load_shader(trained)
    generator = torch.Generator().manual_seed(1)
    gbuffer = torch.randn(count, 6, height, width, generator=generator)
    gbuffer[:, 5] = -gbuffer[:, 5].abs() - 3
    gbuffer[:, :, :5] = 0
    assert parity(model, bundle.model, [gbuffer]) <= TOLERANCE


def test_an_export_that_differs_is_refused(
    trained: Run, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("deepshade_trainer.export.parity", lambda *_: 0.01)
    with pytest.raises(DataError, match="differs from torch"):
        export(trained, tmp_path / "ao" / "bad", [data])
    assert not (tmp_path / "ao" / "bad" / "config.json").exists()


def test_an_empty_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no checkpoint"):
        load_shader(Run(tmp_path))


def test_evaluation_equals_the_metrics_by_hand(bundle: Bundle, data: Path) -> None:
    rows = list(evaluate(bundle, [data], limit=3))
    assert len(rows) == 3
    session = ort.InferenceSession(str(bundle.model), providers=["CPUExecutionProvider"])
    assert session.get_inputs()[0].shape[1] == 6
    for row in rows:
        assert row.figures["ssim"] == pytest.approx(metrics.ssim(row.image, row.reference))
        white = np.ones_like(row.reference)
        assert row.figures["trivial_dssim"] == pytest.approx(metrics.dssim(white, row.reference))
        assert row.contrast >= 0.12
    mean = summary(rows)
    assert mean["ratio"] == pytest.approx(mean["dssim"] / mean["trivial_dssim"])
    assert contact_sheet(rows, columns=1).shape == (3 * 64 + 2 * 4, 4 * 64 + 3 * 4, 3)
    assert json.loads(json.dumps(document(bundle, rows, Variant())))["mean"]["views"] == 3


def test_an_export_brings_an_int8_graph_and_a_probe(bundle: Bundle, data: Path) -> None:
    """Eight bits stay near 32, and the probe's error equals the evaluation's by hand."""
    assert bundle.int8 is not None
    int8 = onnx.load(str(bundle.int8))
    inputs = [node.input[0] for node in int8.graph.node if node.op_type == "Conv"]
    exact = [name for name in inputs if "DequantizeLinear" not in name]
    # The first convolutions and the last two stay in float.
    assert "gbuffer" in {n.input[0] for n in int8.graph.node if set(n.output) & set(exact)}
    assert 3 <= len(exact) < len(inputs)
    assert set(inputs[-2:]) <= set(exact)
    windows = read_probe(bundle)
    assert 1 <= len(windows) <= 4
    errors = {}
    for backend in usable(bundle):
        engine = load_engine(bundle, backend, threads=1)
        errors[backend] = dssim(engine, windows)
        gbuffer = windows[0][0][None]
        difference = engine.predict(gbuffer) - load_engine(bundle, REFERENCE, threads=1).predict(
            gbuffer
        )
        assert np.abs(difference).max() < 0.1, backend
    assert {backend.precision for backend in errors} >= {"fp32", "int8"}
    for error in errors.values():
        assert error == pytest.approx(errors[REFERENCE], rel=0.2)


def test_the_probe_holds_scenes_that_training_did_not_see(data: Path) -> None:
    samples = Dataset([data], "ao")
    training, held = samples.split(0.3)
    seen = [samples.gbuffer(samples.load(k), 0.5) for k in training]
    windows = choose_probe(samples, held, 16)
    assert 0 < len(windows) <= 4
    largest = [np.abs(gbuffer).max() for gbuffer, _ in windows]
    assert largest == sorted(largest)
    assert not any(np.array_equal(window[0], one) for window in windows for one in seen)
    assert choose_probe(samples, held, 128) == []


def test_evaluation_on_every_backend(bundle: Bundle, data: Path) -> None:
    exact = summary(list(evaluate(bundle, [data], limit=3)))
    for backend in usable(bundle):
        mean = summary(list(evaluate(bundle, [data], limit=3, backend=backend)))
        assert mean["ssim"] == pytest.approx(exact["ssim"], abs=0.05)
    with pytest.raises(EngineError):
        list(evaluate(bundle, [data], backend=Backend("openvino", "fp64")))


def test_variants_change_inputs_and_little_else(bundle: Bundle, data: Path) -> None:
    exact = summary(list(evaluate(bundle, [data], limit=4)))
    for variant, most in ((Variant(scale=1e-3), 1e-3), (Variant(scale=1e4), 1e-3)):
        changed = summary(list(evaluate(bundle, [data], limit=4, variant=variant)))
        assert changed["ssim"] == pytest.approx(exact["ssim"], abs=most)
    # Networks only learn to bear short normals, and this one has hardly learnt anything.
    short = summary(list(evaluate(bundle, [data], limit=4, variant=Variant(stretch=0.1))))
    assert short["ssim"] == pytest.approx(exact["ssim"], abs=1e-2)
    half = summary(list(evaluate(bundle, [data], limit=4, variant=Variant(half=("position",)))))
    assert half["ssim"] != exact["ssim"]


def test_no_telling_view_is_an_error(bundle: Bundle, data: Path) -> None:
    with pytest.raises(DataError, match="contrast"):
        list(evaluate(bundle, [data], min_contrast=0.9))
