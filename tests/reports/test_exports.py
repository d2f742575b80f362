"""`python -m deepshade_report.exports`: what it measures, and goes on with."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from deepshade import exr
from deepshade.errors import EngineError
from deepshade_report import exports

ROOT = Path(__file__).resolve().parents[2]
HEADER = {"deepshade:fov": 50.0, "deepshade:focus": 3.0, "deepshade:aperture": 0.1}


@pytest.mark.slow
def test_each_export_is_measured_once(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(exports, "_RUNNERS", {})  # ONNX alone; test_programs has the others
    monkeypatch.setattr(exports, "COLUMNS", ("ONNX", "ONNX, one size", "ONNX, fp16"))
    image = exr.read(ROOT / "samples" / "room.exr")
    channels = {name: plane[150:182, 200:224].copy() for name, plane in image.pixels.items()}
    with (tmp_path / "room.exr").open("wb") as file:
        exr.write(file, channels, attributes=HEADER)
    for effect in ("aa", "dof"):
        (tmp_path / "models" / effect).mkdir(parents=True)
        bundle = ROOT / "models" / effect / "balanced"
        (tmp_path / "models" / effect / "balanced").symlink_to(bundle)
    out = tmp_path / "out"
    with pytest.raises(EngineError, match="not all bundles"):
        exports.main(tmp_path / "room.exr", out, tmp_path / "models", limit=1)
    found = json.loads((out / "aa-balanced.json").read_text("utf-8"))
    assert found["ONNX"]["largest"] <= 1e-6
    assert 0 < found["ONNX, fp16"]["mean"] < found["ONNX, fp16"]["largest"] < 0.01
    capsys.readouterr()
    exports.main(tmp_path / "room.exr", out, tmp_path / "models", limit=1)
    said = capsys.readouterr().out
    assert said.startswith("dof/balanced: ONNX ")  # aa is known
    assert [line.split(" | ")[0] for line in said.splitlines()[3:]] == [
        "| aa/balanced",
        "| dof/balanced",
    ]
    assert (out / "sheet.png").read_bytes().startswith(b"\x89PNG")
    assert exports.sheet(["aa/balanced"], out).shape == (32, 4 * 24, 3)
