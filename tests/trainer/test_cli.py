"""The trainer's commands, one after the other as a user runs them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepshade.bundles import Bundle, bundle_folders
from deepshade.cli import main
from deepshade.machine import cpu_kind, describe
from deepshade_trainer import training
from deepshade_trainer.evaluation import short_names
from deepshade_trainer.recipe import Recipe
from deepshade_trainer.training import Progress

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
    assert main(["export", str(run), *out[:4]]) == 0
    assert "Not measured" in (bundle / "README.md").read_text()
    assert "--test" in capsys.readouterr().out
    assert main(["export", str(run), *out]) == 0
    assert [b.name for b in bundle_folders(tmp_path / "models")] == ["mine"]
    card = (bundle / "README.md").read_text()
    assert "Not measured" not in card
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
    assert [view["view"] for view in document["views"]] == sorted({0, 1, 2})
    assert "x the trivial answer's" in capsys.readouterr().out

    other = ["--set", "lr=0.5", *settings]
    assert main(["train", "ao", "--data", str(data), "--out", str(run), *other]) == 2
    assert "another recipe" in capsys.readouterr().err


def test_a_stopped_run_ends_with_130(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(recipe: Recipe, *_: object, **__: object) -> Iterator[Progress]:
        yield Progress(3, recipe.steps, 0.5)

    monkeypatch.setattr(training, "train", stopped)
    assert main(["train", "ao", "--data", "x", "--out", "run", "--set", "steps=9"]) == 130
    assert "step 3 of 9; the same command goes on" in capsys.readouterr().err


def test_names_of_scenes_leave_out_the_folders_they_share() -> None:
    assert short_names(["/a/b/c.obj", "/a/b/c.obj"]) == ["c.obj", "c.obj"]
    assert short_names(["a/b/c.obj", "a/d/c.obj"]) == ["b/c.obj", "d/c.obj"]
    assert short_names(["/a/b.obj", "procedural:room:7"]) == ["b.obj", "procedural:room:7"]
    assert short_names(["/a/b.obj", "a/c.obj"]) == ["/a/b.obj", "a/c.obj"]
    assert short_names(["compose:x/a+y/b:3", "c.obj"]) == ["compose:x/a+y/b:3", "c.obj"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "ao", "--data", "nowhere", "--out", "run"], "holds no manifest.json"),
        (["train", "ao", "--data", "x", "--out", "run", "--preset", "papr"], "no preset"),
        (["train", "ao", "--data", "x", "--out", "run", "--set", "steps"], "key=value"),
        (["train", "ao", "--data", "x", "--out", "run", "--set", "stps=3"], "'steps'"),
        (["train", "aoo", "--data", "x", "--out", "run"], "aoo"),
        (["train", "dof", "--data", "x", "--out", "run"], "train dof --preset paper"),
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
