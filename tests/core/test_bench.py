"""`deepshade bench`: every bundle on every backend, and which of them a request gets."""

import json
from pathlib import Path

import pytest

from deepshade import bench
from deepshade.bundles import Bundle
from deepshade.cli import main
from deepshade.engines import choose, usable

MODELS = Path(__file__).resolve().parents[2] / "models"


@pytest.mark.slow
def test_every_backend_is_timed_and_the_rules_choice_is_marked(tmp_path, monkeypatch, capsys):
    (tmp_path / "ao").mkdir()
    (tmp_path / "ao" / "fast").symlink_to(MODELS / "ao" / "fast")
    monkeypatch.setattr(bench, "WIDTH", 64)
    monkeypatch.setattr(bench, "HEIGHT", 64)
    assert main(["bench", "--models", str(tmp_path), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    bundle = Bundle.load(tmp_path / "ao" / "fast")
    assert [row["backend"] for row in rows] == [str(backend) for backend in usable(bundle)]
    assert [row["backend"] for row in rows if row["chosen"]] == [str(choose(bundle))]
    assert all(row["ms"] > 0 for row in rows)
