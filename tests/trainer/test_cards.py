"""Of speed, cards say the figures of their bundles, and so do README and docs/effects.md."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

from deepshade.bundles import Bundle, bundle_folders
from deepshade_trainer.card import record_speed, speed_section

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text("utf-8")
EFFECTS = (ROOT / "docs" / "effects.md").read_text("utf-8")
FOLDERS = bundle_folders(ROOT / "models")


def speeds(folder: Path) -> dict[str, dict[str, float]]:
    """Milliseconds by machine and backend."""
    found = json.loads((folder / "metrics.json").read_text("utf-8")).get("speed", {})
    return {machine: each["ms"] for machine, each in found.items()}


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_the_card_is_of_the_figures(folder: Path) -> None:
    metrics = json.loads((folder / "metrics.json").read_text("utf-8"))
    assert "\n".join(speed_section(metrics)) in (folder / "README.md").read_text("utf-8")


@pytest.mark.parametrize(
    ("row", "machine"),
    [
        ("two Xeon cores with AMX", "Intel(R) Xeon(R) Processor (AMX), 2 CPUs"),
        ("two EPYC cores (Zen 4, 16-bit products)", "AMD EPYC (AVX-512), 2 CPUs"),
    ],
)
def test_readme_says_what_the_cards_of_ao_say(row: str, machine: str) -> None:
    said = re.search(rf"\| {re.escape(row)} \| bf16 \| ([-\d. /]+) \|", README)
    assert said is not None
    for name, text in zip(("fast", "balanced", "best"), said[1].split(" / "), strict=True):
        known, digits = speeds(ROOT / "models/ao" / name), len(text.partition(".")[2])
        timed = f"{known[machine]['openvino/bf16']:.{digits}f}" if machine in known else "-"
        assert text == timed


def test_the_page_of_effects_says_what_the_cards_say() -> None:
    made = re.compile(r"<!-- made: (\w+) -->\n(.*?)<!-- end -->", re.DOTALL)
    row = re.compile(r"\| (?:\*\*)?`(\w+)`(?:\*\*)?(?:, alike)? \| (\w+/\w+) \|.* ([\d.]+) \|")
    found = 0
    for effect, text in made.findall(EFFECTS):
        where = re.search(r"^(.*), \d+ threads?, whole frames", text, re.MULTILINE)
        for name, backend, ms in row.findall(text) if where else ():
            known = speeds(ROOT / "models" / effect / name)[where[1]][backend]
            assert float(ms) == pytest.approx(known, abs=0.5 if known >= 100 else 0.05), effect
            found += 1
    assert found >= 5


def test_recording_a_machine_changes_the_section_alone(tmp_path: Path) -> None:
    for name in ("aa/balanced", "ibl/best"):  # the second was never timed
        folder = tmp_path / name
        shutil.copytree(ROOT / "models" / name, folder)
        before = (folder / "README.md").read_text("utf-8")
        for ms in (5.0, 2.5):
            record_speed(Bundle.load(folder), "A machine", {"openvino/fp32": ms})
        after = (folder / "README.md").read_text("utf-8")
        assert after.count("## Speed") == 1
        assert "| A machine | openvino | fp32 | 768 x 512 | 2.5 |" in after
        for section in re.split(r"^(?=## )", before, flags=re.MULTILINE):
            assert section.startswith("## Speed") or section.strip() in after
        assert speeds(folder)["A machine"] == {"openvino/fp32": 2.5}
