"""Bundles: exact in ONNX Runtime, verified, measured."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from deepshade import metrics, tensors
from deepshade.bundles import Bundle, bundle_root
from deepshade.effects import EFFECTS
from deepshade.engines import Backend, available
from deepshade.errors import DataError, EngineError
from deepshade.gbuffer import load_gbuffer
from deepshade_trainer.card import write_card
from deepshade_trainer.dataset import Dataset
from deepshade_trainer.evaluation import Variant, contact_sheet, document, evaluate, summary
from deepshade_trainer.export import (
    INPUT,
    TOLERANCE,
    export,
    gbuffers,
    load_shader,
    parity,
    write_onnx,
)
from deepshade_trainer.graph import bytes_per_pixel, float32_marks, session
from deepshade_trainer.networks import Shader, build, from_bundle
from deepshade_trainer.recipe import Recipe, preset
from deepshade_trainer.run import Run
from deepshade_trainer.training import train

from .synthetic import SMALL

SAMPLES = Path(__file__).resolve().parents[2] / "samples"


@pytest.fixture(scope="module")
def trained(data: Path, tmp_path_factory: Any) -> Run:
    """A few steps of a small network."""
    run = Run(tmp_path_factory.mktemp("run"))
    recipe = preset("balanced", "ao").changed(
        network=SMALL,
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


def test_an_export_splits_scenes_as_training_did(data: Path, recipe: Recipe) -> None:
    """With the run's own seed: another one's held-out scenes were trained on."""
    samples = Dataset([data], "ao")
    for seed in range(4):
        training, held = samples.split(recipe.val_fraction, seed=seed)
        whole = {
            samples.gbuffer(samples.load(k), samples.radius(k)).tobytes(): k
            for k in (*training, *held)
        }
        learnt, unseen = (
            {whole[gbuffer.numpy().tobytes()] for gbuffer in found}
            for found in gbuffers(recipe.changed(seed=seed), [data], per_channel=False)
        )
        assert learnt == set(training)
        assert unseen == set(held)


@pytest.mark.parametrize("name", ["fast", "balanced", "best"])
def test_the_shipped_bundles_are_what_torch_computes(name: str) -> None:
    """Their graphs are the reference: a change of the network's arithmetic would show here."""
    bundle = Bundle.load(bundle_root() / "ao" / name)
    shader = from_bundle(bundle.path)
    assert (shader.size_multiple, shader.halo) == (bundle.size_multiple, bundle.halo)
    gbuffer = load_gbuffer(SAMPLES / "room.exr", bundle.inputs)
    given = tensors.tensor(
        EFFECTS["ao"],
        gbuffer.attributes,
        bundle.inputs,
        bundle.radius,
        per_channel=False,
        multiple=bundle.size_multiple,
    )
    assert parity(shader, bundle.model, [torch.from_numpy(given)]) <= 1e-5
    assert float(given.std()) > 0.05


def test_a_shipped_network_exports_as_it_was(tmp_path: Path) -> None:
    """The same marks for float32, a little less memory, the same answer, and weights by name."""
    bundle = Bundle.load(bundle_root() / "ao" / "fast")
    shader = from_bundle(bundle.path)
    graph = write_onnx(shader, tmp_path / "model.onnx")
    float32, after = float32_marks(graph, shader.network.rounded)
    assert (len(float32), after) == (len(bundle.float32), [])
    # shipped graphs still choose by If, and hold a plane or two for that
    assert 0 <= bundle.bytes_per_pixel - bytes_per_pixel(graph, INPUT, (6, 256, 256)) <= 3
    names = {tensor.name for tensor in graph.graph.initializer}
    assert names >= shader.network.state_dict().keys()
    gbuffer = torch.randn(1, 6, 64, 96, generator=torch.Generator().manual_seed(0))
    gbuffer[:, 5] = -gbuffer[:, 5].abs() - 3
    assert parity(shader, tmp_path / "model.onnx", [gbuffer]) <= 1e-5
    assert parity(shader, bundle.model, [gbuffer]) <= 1e-5


def test_filters_that_are_not_learnt_stay_in_float32(tmp_path: Path) -> None:
    """They calculate with lengths: 16 bits would begin after them, not before."""
    network = {"widths": (8, 12), "steps": (2,), "down": (0, 1), "up": (1,), "detail": ()}
    recipe = preset("balanced", "ao").changed(network={**network, "fine": 4})
    torch.manual_seed(0)
    shader = Shader(EFFECTS["ao"], build(recipe.network)).eval()
    graph = write_onnx(shader, tmp_path / "model.onnx")
    marks, after = float32_marks(graph, shader.network.rounded)
    (fixed,) = [
        node
        for node in graph.graph.node
        if node.op_type == "Conv" and not node.input[1].endswith(".weight")
    ]
    met = set(fixed.output)
    for node in graph.graph.node:  # ONNX keeps them in order
        if met.intersection(node.input) - set(marks):
            assert node.op_type not in ("Conv", "ConvTranspose")
            met.update(node.output)
    assert met.intersection(marks)
    assert after == []
    gbuffer = torch.randn(1, 6, 64, 96, generator=torch.Generator().manual_seed(0))
    gbuffer[:, 5] = -gbuffer[:, 5].abs() - 3
    assert parity(shader, tmp_path / "model.onnx", [gbuffer]) <= 1e-5


def test_an_empty_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no checkpoint"):
        load_shader(Run(tmp_path))


def test_evaluation_equals_the_metrics_by_hand(bundle: Bundle, data: Path) -> None:
    rows = list(evaluate(bundle, [data], limit=3))
    assert len(rows) == 3
    running = session(bundle.model)
    assert running.get_inputs()[0].shape[1] == 6
    for row in rows:
        assert row.figures["ssim"] == pytest.approx(metrics.ssim(row.image, row.reference))
        white = np.ones_like(row.reference)
        assert row.figures["trivial_dssim"] == pytest.approx(metrics.dssim(white, row.reference))
        assert row.contrast >= 0.12
    mean = summary(rows)
    assert mean["ratio"] == pytest.approx(mean["dssim"] / mean["trivial_dssim"])
    assert contact_sheet(EFFECTS["ao"], rows, columns=1).shape == (
        3 * 64 + 2 * 4,
        4 * 64 + 3 * 4,
        3,
    )
    assert json.loads(json.dumps(document(bundle, rows, Variant())))["mean"]["views"] == 3


def test_evaluation_on_every_backend(bundle: Bundle, data: Path) -> None:
    exact = summary(list(evaluate(bundle, [data], limit=3)))
    for backend in available():
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
