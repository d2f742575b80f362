"""`deepshade export BUNDLE --to onnx`: the same answers by graphs that any runtime takes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnx
import pytest

from deepshade import tensors
from deepshade.bundles import Bundle
from deepshade.cli import main
from deepshade.effects import EFFECTS
from deepshade.gbuffer import load_gbuffer
from deepshade_trainer.graph import session
from deepshade_trainer.interchange import write_plain

ROOT = Path(__file__).resolve().parents[2]
MODELS = ROOT / "models"
HEIGHT, WIDTH = 128, 96
ON_SHAPES = {"If", "Shape", "ConstantOfShape", "Range", "Expand"}


def gbuffer(bundle: Bundle) -> np.ndarray:
    """A part of the shipped picture."""
    found = load_gbuffer(ROOT / "samples" / "room.exr", bundle.inputs).attributes
    part = {name: array[:, -HEIGHT:, 200 : 200 + WIDTH] for name, array in found.items()}
    return tensors.tensor(EFFECTS[bundle.effect], part, bundle.inputs, 0.4, per_channel=False)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "size"),
    [("ao/fast", (WIDTH, HEIGHT)), ("ao/fast", None), ("dof/balanced", (WIDTH, HEIGHT))],
)
def test_answers_are_the_bundles(name: str, size: tuple[int, int] | None, tmp_path: Path) -> None:
    bundle = Bundle.load(MODELS / name)
    made = write_plain(bundle, tmp_path, size, 13)
    model = onnx.load(str(made.path))
    onnx.checker.check_model(model, full_check=True)
    kinds = {node.op_type for node in model.graph.node}
    assert not kinds & (ON_SHAPES if size else {"If"})
    assert [entry.version for entry in model.opset_import] == [13]
    given = {"gbuffer": gbuffer(bundle)}
    ours, theirs = session(made.path), session(bundle.model)
    expected = theirs.run(None, given)[0]
    assert expected.std() > 0.01
    np.testing.assert_allclose(ours.run(None, given)[0], expected, atol=1e-5)
    assert ours.get_outputs()[0].shape[1:] == (
        [len(bundle.outputs), HEIGHT, WIDTH] if size else [len(bundle.outputs), "height", "width"]
    )
    facts = ours.get_modelmeta().custom_metadata_map
    assert len(json.loads(facts["deepshade:channels"])) == bundle.channels
    known = {out for node in model.graph.node for out in node.output}
    assert set(json.loads(facts["deepshade:float32"])) <= known


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["ao/fast", "--size", "100x64"], "multiples of 32; pad the picture to 128x64"),
        (["ao/fast", "--size", "big"], "give WxH"),
        (["ao/fast", "--opset", "12"], "from 13 to 18"),
        (["ibl/balanced", "--opset", "13"], "the lowest for this graph is 16"),
    ],
)
def test_what_can_not_be_is_said(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bundle, *options = words
    command = ["export", str(MODELS / bundle), "--to", "onnx", "-o", str(tmp_path), *options]
    assert main(command) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
