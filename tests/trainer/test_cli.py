"""The trainer's commands, one after the other as a user runs them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepshade.bundles import Bundle, bundle_folders
from deepshade.cli import main
from deepshade.machine import cpu_kind, describe

SETTINGS = [
    "steps=4",
    "batch=4",
    "network.widths=[8,12]",
    "network.steps=[2]",
    "network.down=[1,1]",
    "network.up=[1]",
    "network.rings=[1]",
    "network.fine_rings=[1,2]",
    "network.detail=[]",
]


@pytest.mark.slow
def test_train_export_evaluate(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, bundle, sheet = tmp_path / "run", tmp_path / "models/ao/mine", tmp_path / "sheet.png"
    settings = [x for s in [*SETTINGS, "precision=fp32"] for x in ("--set", s)]
    train = ["train", "ao", "--data", str(data), "--out", str(run), *settings]
    assert main(train) == 0
    assert main(train) == 0  # complete: nothing left to do
    note = tmp_path / "note.md"
    note.write_text("Made by a test.")
    out = ["--out", str(bundle), "--data", str(data), "--test", str(data), "--note", str(note)]
    assert main(["export", str(run), *out]) == 0
    assert [b.name for b in bundle_folders(tmp_path / "models")] == ["mine"]
    card = (bundle / "README.md").read_text()
    assert "Made by a test." in card
    assert "16-bit positions" in card
    errors = Bundle.load(bundle).metrics["error"]["waves"]
    capsys.readouterr()

    evaluate = ["evaluate", str(bundle), "--data", str(data), "--limit", "3"]
    assert main([*evaluate, "--sheet", str(sheet), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert len(document["views"]) == document["mean"]["views"] == 3
    assert set(document["views"][0]) >= {"scene", "ssim", "psnr", "mae", "flip", "trivial_ssim"}
    assert np.asarray(Image.open(sheet)).shape[2] == 3
    assert errors["exact"]["views"] >= 3
    assert f"| {describe()} | onnxruntime | fp32 | 768 x 512 |" in card
    kinds, found = Bundle.load(bundle).int8_kinds, errors.get("exact, openvino/int8")
    small = found is not None and found["dssim"] <= 1.01 * errors["exact"]["dssim"]
    assert kinds == ((cpu_kind(),) if small else ())
    assert (document["engine"], document["precision"]) == ("onnxruntime", "fp32")
    assert main([*evaluate, "--engine", "openvino", "--json"]) == 0
    other_engine = json.loads(capsys.readouterr().out)
    assert other_engine["engine"] == "openvino"
    assert other_engine["mean"]["ssim"] == pytest.approx(document["mean"]["ssim"], abs=1e-3)
    assert main([*evaluate, "--precision", "fp64"]) == 2
    assert "no precision 'fp64'" in capsys.readouterr().err
    assert main(evaluate) == 0
    assert "x the trivial answer's" in capsys.readouterr().out

    other = ["--set", "lr=0.5", *settings]
    assert main(["train", "ao", "--data", str(data), "--out", str(run), *other]) == 2
    assert "another recipe" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "ao", "--data", "nowhere", "--out", "run"], "holds no manifest.json"),
        (["train", "ao", "--data", "x", "--out", "run", "--preset", "papr"], "no preset"),
        (["train", "ao", "--data", "x", "--out", "run", "--set", "steps"], "key=value"),
        (["train", "ao", "--data", "x", "--out", "run", "--set", "stps=3"], "'steps'"),
        (["train", "aoo", "--data", "x", "--out", "run"], "aoo"),
        (["evaluate", "nowhere", "--data", "x"], "missing"),
        (["export", "nowhere", "--out", "b", "--data", "x"], "no checkpoint"),
    ],
)
def test_what_is_wrong_is_said(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error
