"""Hard cases in their small form, and that the table can fail."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade.engines import REFERENCE
from deepshade.errors import ConfigError
from deepshade.files import shipped
from deepshade_report.hardcases import cli, made, session, table
from deepshade_report.hardcases.cases import CASES, Case
from deepshade_report.hardcases.measure import Bench, deviation, mean_error, structural

app = typer.Typer()
app.command()(cli.hardcases)


def run(*options: str) -> tuple[int, str]:
    found = CliRunner().invoke(app, options)
    assert found.exception is None or isinstance(found.exception, SystemExit), found.exception
    return found.exit_code, found.stdout


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Bench(Bundle.load(shipped("models") / "aa" / "balanced"), [REFERENCE], (48, 64), 1)


def test_the_corner_is_what_rays_find():
    """Its closed form beside the rays that a Monte Carlo method would trace."""
    picture = made.corner(EFFECTS["ao"], 8, 40, radius=0.5)
    position, normal = picture.planes["position"], picture.planes["normal"]
    rng = np.random.default_rng(0)
    disc, turn = np.sqrt(rng.random(400_000)), rng.random(400_000) * 2 * math.pi
    local = np.stack([disc * np.cos(turn), disc * np.sin(turn), np.sqrt(1 - disc * disc)])
    for column in (2, 15, 18, 27, 39):
        p, n = position[:, 4, column].astype(float), normal[:, 4, column].astype(float)
        across = np.cross([0, 1, 0], n)
        ray = local[0] * across[:, None] + local[1:2] * np.array([[0], [1], [0]])
        ray = ray + local[2] * n[:, None]
        # the other wall: points with z = |x| - 2 on the far side
        facing = np.array([-n[0], 0, n[2]])
        far = facing @ np.array([0, 0, -2.0])
        with np.errstate(divide="ignore"):
            distance = (far - facing @ p) / (facing @ ray)
        open_ = 1 - np.mean((distance > 0) & (distance < 0.5))
        assert picture.truth[0, 4, column] == pytest.approx(open_, abs=4e-3)


def test_errors_count_what_is_compared():
    effect, truth = EFFECTS["ao"], np.full((1, 20, 20), 0.5, np.float32)
    off = truth.copy()
    off[:, :4] = np.nan
    off[:, 10] += 0.25
    compared = np.ones((20, 20), bool)
    compared[:4] = False
    picture = replace(made.wall(effect, 20, 20), truth=truth, compared=compared)
    assert mean_error(effect, off, truth, compared) == pytest.approx(0.25 / 16)
    assert deviation(effect, picture, off, truth) == pytest.approx(math.sqrt(0.25**2 / 16))
    assert (
        structural(effect, truth, truth, compared) == 0 < structural(effect, off, truth, compared)
    )


def test_float64_is_the_network_and_its_engine_is_near(bench):
    exact, engine = bench.exact, bench.engines[0]
    easy = bench.shade(exact, bench.easy), bench.shade(engine, bench.easy)
    assert 0 < deviation(bench.effect, bench.easy, *easy) < 1e-6


def test_a_row_over_its_line_fails_and_is_drawn(bench, tmp_path):
    made_ = session.Session(shipped("models"), tmp_path, CASES, quick=True, threads=1)
    (easy,) = session.chosen_cases(["easy"])
    rows = made_._rows(bench, replace(easy, line=0.5))
    assert not rows[0].passed and rows[0].severity == pytest.approx(2)
    assert [path.suffix for path in (tmp_path / "failed").iterdir()] == [".png"]
    refused = Case("refused", lambda effect, easy: iter([("", easy.ask(focus=-1.0))]))
    (row,) = made_._rows(bench, refused)
    assert not row.passed and "bad-parameter" in row.refused
    assert table.worst_first([*rows, row])[0] is row


# One effect of each kind: of surfaces, of a lens, of motion, of edges.
@pytest.mark.parametrize("effect", ["aa", "ao", "dof", "mb"])
def test_small_form(effect, tmp_path):
    texts = "easy", "scene x 1e6", "block", "surfaces", "1e5 beside", "lens", "motion", "sizes"
    options = [option for text in texts for option in ("--case", text)]
    options += ["--quick", "--effect", effect, "--out", str(tmp_path), "--threads", "1"]
    code, text = run(*options, "--json")
    rows = [json.loads(line) for line in text.splitlines()]
    assert len(rows) > 10 and {row["backend"] for row in rows} == {str(REFERENCE)}
    over = [row for row in rows if not row["passed"]]
    if effect == "ao":  # known, and in docs/numerics.md: a block is a quarter of so small a picture
        assert len(over) == 11 and all(row["case"].endswith("in a block") for row in over)
        assert max(row["error"] / row["line"] for row in over) < 1.11
        assert max(row["float64"] for row in over) < 1e-5
    else:
        assert over == []
    assert code == (1 if over else 0)


def test_a_run_goes_on_where_it_was_stopped(tmp_path, monkeypatch):
    options = ["--quick", "--effect", "aa", "--case", "light x", "--out", str(tmp_path)]
    options += ["--threads", "1"]
    document = tmp_path / "numerics.md"
    document.write_text("before\n<!-- made: hardcases -->\nold\n<!-- end -->\nafter\n")
    first = run(*options)
    with (tmp_path / "rows.jsonl").open("a") as file:
        file.write('{"stamp": ')  # it was killed while it wrote
    monkeypatch.setattr(session, "Bench", None)  # nothing is measured again
    assert run(*options, "--resume", "--document", str(document)) == first
    text = document.read_text()
    assert "| light x 1e5 |" in text and "old" not in text
    assert text.startswith("before") and text.endswith("after\n")
    with pytest.raises(ConfigError, match="no case is called 'scne x'"):
        session.chosen_cases(["scne x"])
