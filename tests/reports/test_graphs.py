"""The tables of docs/onnx.md are what the bundles say."""

from pathlib import Path

from deepshade_report import graphs

ROOT = Path(__file__).resolve().parents[2]


def test_the_page_is_of_the_bundles_that_ship():
    text = (ROOT / graphs.PAGE).read_text("utf-8")
    for name in ("graphs", "inputs", "operators"):
        assert f"<!-- made: {name} -->" in text
    assert graphs.filled(text, ROOT / "models") == text, "run python -m deepshade_report.graphs"
