"""The page of effects on light, made from tiny bundles over a tiny data set, and its pictures."""

from __future__ import annotations

import io
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepshade import metrics, pictures
from deepshade_report import baselines, effects
from deepshade_report.context import Context
from deepshade_report.strip import chosen, strip, webp
from deepshade_report.view import View, load_views

from .plates import noise, plates
from .small import SIZE, write_bundle, write_data

DOCUMENT = """# Title
<!-- made: overview -->
to be replaced
<!-- end -->
Prose, <!-- kept -->.
<!-- made: gi -->
to be replaced
<!-- end -->
<!-- made: dof -->
<!-- end -->
The end.
"""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("effects")
    write_bundle(folder / "models" / "gi" / "balanced", 4, 0)
    write_bundle(folder / "rest" / "gi" / "paper", 8, 1)
    write_data(folder / "data", "gi")
    (folder / "docs").mkdir()
    (folder / "docs" / "effects.md").write_text(DOCUMENT)
    (folder / "README.md").write_text("<!-- made: nine -->\nto be replaced\n<!-- end -->\n")
    return folder


def made(root: Path, paper: bool) -> tuple[str, dict[str, str]]:
    def context(effect: str) -> Context:
        folder = root / "rest" / "gi" / "paper" if paper else None
        out = root / "out" / str(paper) / effect
        return Context([root / "models"], root / "data", out, folder, effect, threads=1, quick=True)

    wrong = effects.write([root / "docs" / "effects.md", root / "README.md"], context)
    return (root / "docs" / "effects.md").read_text(), wrong


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_the_page_says_what_was_measured_and_what_was_not(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text, wrong = made(root, paper=True)
    assert "to be replaced" not in text
    assert "Prose, <!-- kept -->." in text
    assert list(wrong) == ["dof"]
    assert "Not measured" in text.split("<!-- made: dof -->")[1]
    nine = (root / "README.md").read_text()
    assert "to be replaced" not in nine
    section = text.split("<!-- made: gi -->")[1].split("<!-- end -->")[0]
    found = json.loads((root / "out" / "True" / "gi" / "report.json").read_text())["sections"]
    views = load_views(root / "data", "gi", 2)
    trivial = [v.dssim(np.zeros_like(v.reference)) for v in views]
    assert f"| doing nothing | | {np.mean(trivial):.4f} ±".replace("0.", ".") in section
    for row in found["error"]["data"]["rows"]:
        error = np.std(row["each"], ddof=1) / np.sqrt(2)
        assert row["dssim"] == pytest.approx(np.mean(row["each"]), rel=1e-5)
        assert row["standard_error"] == pytest.approx(error, rel=1e-4, abs=1e-8)
    assert "**`balanced`**" in section
    ours = found["error"]["data"]["rows"][0]["dssim"]
    line = next(
        line for line in nine.splitlines() if line.startswith("| Indirect light | .798 | 60 |")
    )
    assert f"| {1 - 2 * ours:.3f} |".replace(" 0.", " .") in line
    assert "the paper's network" in section
    assert "2 views of 64 x 64" in section
    assert "fewer than the 32" in section
    assert text.count("[Indirect light](#gi)") == 1
    for name in re.findall(r"!\[[^]]*]\(([^)]*)\)", section):
        with Image.open(root / "docs" / name) as picture:
            assert picture.format == "WEBP"
            assert picture.height == 2 * SIZE + pictures.GAP

    monkeypatch.setattr(baselines, "folder", lambda effect: None)  # they were measured above
    text, _ = made(root, paper=False)
    assert "Left out: the paper's network (no bundle of it" in text


def test_an_effect_s_views_lie_in_the_first_set_that_has_them(root: Path) -> None:
    write_data(root / "occlusion", "ao")
    folders = [root / "data", root / "occlusion"]
    assert [effects.data_of(effect, folders).name for effect in ("gi", "ao", "do")] == [
        "data",
        "occlusion",
        "data",
    ]


def view_of(seed: int) -> View:
    light = noise(40, 60, seed=seed)
    view = plates("aa", light=light, depth=np.ones((40, 60)))
    return replace(view, scene=f"noise:{seed % 2}", reference=np.roll(light, seed, 2))


def test_a_strip_shows_all_by_one_exposure() -> None:
    view = view_of(3)
    whole = strip(view, view.reference, view.reference / 2)
    assert whole.shape == (2 * 40 + pictures.GAP, 5 * 60 + 4 * pictures.GAP, 3)
    panels = [whole[:40, k * (60 + pictures.GAP) :][:, :60] for k in range(5)]
    factor = metrics.exposure(view.reference)
    for panel, image in zip(
        panels,
        (view.attributes["light"], view.reference, view.reference, view.reference / 2),
        strict=False,
    ):
        assert (panel == pictures.srgb(np.clip(image * factor, 0, 1))).all()
    assert (panels[4] == 255).all()  # no difference
    low = strip(view, view.reference * 0.5)[:40, -60:]
    assert (low[..., 2] == 255).all()  # blue
    assert low[..., 0].min() < 255
    large = strip(
        plates("aa", light=noise(600, 1030), depth=np.ones((600, 1030))), noise(600, 1030)
    )
    assert large.shape[0] == 2 * 120 + pictures.GAP  # a fifth


def test_a_strip_enlarges_where_the_effect_changes_most() -> None:
    light = np.zeros((40, 60))
    view = plates("aa", light=light, depth=np.ones((40, 60)))
    reference = view.reference.copy()
    reference[:, 31, 47] = 1
    view = replace(view, reference=reference)
    part = strip(view, reference)[-40:, 60 + pictures.GAP :][:, :60]
    assert (part == 255).all(-1).sum() == 4


def test_views_are_chosen_from_the_middle_of_different_scenes() -> None:
    views = [view_of(seed) for seed in (1, 2, 3, 4, 5)]
    first, second = chosen(views)
    assert sorted(v.contrast() for v in views)[2] == first.contrast()
    assert first.scene != second.scene
    assert len(chosen(views[:1])) == 1


def test_a_webp_file_is_near_its_picture() -> None:
    picture = pictures.srgb(np.broadcast_to(np.linspace(0, 1, 64), (3, 64, 64)))
    again = np.asarray(Image.open(io.BytesIO(webp(picture))))
    assert np.abs(again.astype(int) - picture).mean() < 3
