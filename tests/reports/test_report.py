"""A quick report of tiny bundles over a tiny data set: of a factor, and of light by channel."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.reference
import pytest
import typer
from typer.testing import CliRunner

from deepshade import exr, metrics
from deepshade.bundles import Bundle
from deepshade.engines import REFERENCE, load_engine
from deepshade.errors import ConfigError, DataError
from deepshade_report import baselines, page, plots, report
from deepshade_report.cli import report as command
from deepshade_report.context import Context
from deepshade_report.effects import Figures
from deepshade_report.method import LIMIT, Network
from deepshade_report.sections import Point, Skipped, frontier, points, same_time, summary
from deepshade_report.view import body, load_views, resized

from .plates import plates
from .small import SIZE, write_bundle, write_data


@pytest.fixture(scope="module", params=["ao", "gi"])
def root(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp(request.param) / request.param
    write_bundle(folder / "models" / request.param / "fast", 4, 0)
    write_bundle(folder / "more" / request.param / "paper", 16, 1)
    # of two with one name that of the folder named first counts
    write_bundle(folder / "more" / request.param / "fast", 8, 2)
    write_data(folder / "data", request.param)
    return folder


def arguments(root: Path, *more: str, models: Sequence[Path] = ()) -> list[str]:
    found = [f"--models={path}" for path in models or (root / "models", root / "more")]
    found += [f"--{name}={root / name}" for name in ("data", "out")]
    return [*found, f"--effect={root.name}", *more]


def run(*options: str) -> tuple[int, str]:
    app = typer.Typer()
    app.command()(command)
    result = CliRunner().invoke(app, list(options), catch_exceptions=False)
    return result.exit_code, result.output


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.parametrize("root", ["gi"], indirect=True)
def test_a_quick_report_has_every_section(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(baselines, "folder", lambda effect: None)
    code, output = run(*arguments(root, "--quick"))
    assert code == 0, output
    found = json.loads((root / "out" / "report.json").read_text())
    sections = found["sections"]
    assert {name: s.get("reason") for name, s in sections.items() if s["status"] != "done"} == {}
    ids = {row["id"] for row in sections["speed"]["data"]["rows"]}
    assert {"fast onnxruntime/fp32", "paper onnxruntime/fp32"} <= ids
    (service,) = sections["service"]["data"]["rows"]
    assert service["total_ms"]["median"] > service["bare_ms"]["median"] > 0
    sizes = sections["sizes"]["data"]["rows"]
    assert sizes[-1]["width"] == 1024
    assert (root / "out" / "comparison.png").stat().st_size > 10_000
    assert (root / "out" / "speed-error.png").exists()
    assert "index.html" in output
    assert run(*arguments(root, "--quick", "--resume"))[0] == 0
    assert json.loads((root / "out" / "report.json").read_text())["sections"] == sections


def test_speed_against_error_of_any_effect(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(baselines, "folder", lambda effect: None)
    out = root / "short"
    options = arguments(root, "--quick", "--only=error", "--only=speed", f"--out={out}")
    assert run(*options)[0] == 0
    sections = json.loads((out / "report.json").read_text())["sections"]
    assert list(sections) == ["error", "speed"]
    views = load_views(root / "data", root.name, 2)
    error = sections["error"]["data"]
    row = next(row for row in error["rows"] if row["id"] == "fast onnxruntime/fp32")
    bundle = Bundle.load(root / "models" / root.name / "fast")
    graph = onnx.reference.ReferenceEvaluator(onnx.load(bundle.model))
    expected, trivial = [], []
    for view in views:
        a = view.attributes
        runs = [[a["normal"], a["position"] / 0.5]]
        if view.effect.per_channel:
            runs = [[*runs[0], a["light_diffuse"][k : k + 1]] for k in range(3)]
        tensor = np.stack([np.concatenate(planes) for planes in runs])
        answer = graph.run(None, {"gbuffer": tensor})[0][:, 0]
        factor = 1 / np.percentile(view.reference, 99) if view.effect.is_light else 1.0
        reference = np.clip(view.reference * factor, 0, 1)
        expected.append(metrics.dssim(np.clip(answer * factor, 0, 1), reference))
        trivial.append(metrics.dssim(np.full_like(reference, view.effect.trivial), reference))
    assert row["each"] == pytest.approx(expected, abs=1e-4)
    assert error["trivial_dssim"] == pytest.approx(np.mean(trivial), rel=1e-4)


def test_a_network_takes_any_size(root: Path) -> None:
    bundle = Bundle.load(root / "models" / root.name / "fast")
    whole = load_views(root / "data", root.name, 3)[2]
    engine = load_engine(bundle, REFERENCE, threads=1)
    answers = []
    for view in (whole, resized(whole, 37, 53)):
        method = Network(bundle, engine)
        method.prepare(view)
        answers.append(method.shade(view))
    assert answers[1].shape == (len(bundle.outputs), 37, 53)
    inner = np.s_[:, :35, :51]  # the convolutions see two pixels farther
    assert np.allclose(answers[0][inner], answers[1][inner], rtol=1e-5)


def test_nothing_to_measure_is_an_error(root: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no bundle for"):
        run(*arguments(root, models=[tmp_path]))
    with pytest.raises(ConfigError, match="there is no folder"):
        run(*arguments(root, models=[tmp_path / "nowhere"]))
    with pytest.raises(DataError, match="manifest"):
        run(*arguments(root, f"--data={tmp_path}"))
    with pytest.raises(ConfigError, match="no section is called 'sped'"):
        run(*arguments(root, "--only", "sped"))
    with pytest.raises(ConfigError, match="no effect is called 'oa'"):
        run(*arguments(root, "--effect", "oa"))
    assert not (tmp_path / "report.json").exists()


def test_bodies_hold_the_view_at_any_size_and_compress_like_real_ones(root: Path) -> None:
    view = load_views(root / "data", root.name, 3)[2]
    large = resized(view, 300, 400)
    position = large.attributes["position"]
    assert np.array_equal(position[:, :SIZE, :SIZE], view.attributes["position"])
    mirrored = view.attributes["position"][:, :, ::-1]
    assert np.array_equal(position[:, :SIZE, SIZE : 2 * SIZE], mirrored)
    grained = body(view, 300, 400, grain=True)
    image = exr.read(grained).pixels
    for axis, plane in zip("XYZ", position, strict=True):
        assert np.allclose(image[f"position.{axis}"], plane, rtol=4e-3, atol=1e-6)
    assert len(grained) > 2 * len(body(view, 300, 400))


def test_the_floor_is_what_noise_in_the_reference_leaves() -> None:
    truth, rng = np.full((3, 64, 64), 2.0, np.float32), np.random.default_rng(5)
    error = np.full_like(truth, 0.01)
    noisy = truth + error * rng.standard_normal(truth.shape, np.float32)
    view = plates("mb", depth=np.ones((64, 64)), motion=np.ones((2, 64, 64)), light=truth)
    assert view.floor() is None
    view = dataclasses.replace(view, reference=noisy, error=error)
    assert view.floor() == pytest.approx(view.dssim(truth), rel=0.1)


def test_a_body_keeps_what_is_infinitely_far() -> None:
    depth = np.full((9, 12), 3.0)
    depth[:4] = np.inf
    motion = np.full((2, 9, 12), 1e6)
    view = plates("mb", depth=depth, motion=motion, light=np.full((9, 12), 1e6))
    image = exr.read(body(view, 9, 12)).pixels
    assert (image["Z"] == depth).all()
    assert np.isfinite(image["motion.U"]).all()
    assert np.isfinite(image["light.R"]).all()


def made_up() -> dict[str, Any]:
    """Sections with the networks on two backends, and a method at two settings."""
    found = [
        ("fast", "network", {"engine": "openvino", "precision": "bf16"}, 5.0, 0.04),
        ("fast", "network", {"engine": "onnxruntime", "precision": "fp32"}, 10.0, 0.039),
        ("paper", "paper's network", {"engine": "openvino", "precision": "bf16"}, 40.0, 0.06),
        ("paper", "paper's network", {"engine": "onnxruntime", "precision": "fp32"}, 80.0, 0.06),
        ("<HBAO>", "screen-space", {"steps": 2}, 7.0, 0.09),
        ("<HBAO>", "screen-space", {"steps": 8}, 20.0, 0.07),
    ]
    rows = [
        {"id": f"{name} {list(s.values())}", "name": name, "family": f, "settings": s, "ms": ms}
        for name, f, s, ms, _ in found
    ]
    errors = [
        row | {"dssim": error, "of_trivial": error / 0.1, "each": [error]}
        for row, (*_, error) in zip(rows, found, strict=True)
    ]
    speeds = [
        row | {"ms": {"median": row["ms"], "quartiles": [1.0, 99.0]}, "ms_per_megapixel": row["ms"]}
        for row in rows
    ]
    facts = {"missing": {}, "views": 1, "size": [64, 64], "trivial_dssim": 0.1}
    return {
        "error": {"status": "done", "data": {"rows": errors, **facts}},
        "speed": {"status": "done", "data": {"rows": speeds}},
        "service": {"status": "skipped", "reason": "<no> port"},
    }


def test_like_is_compared_with_like() -> None:
    table = {row["name"]: row for row in summary(made_up())}
    assert table["fast"]["backend"] == "openvino/bf16"
    assert table["fast"]["like_for_like"] == pytest.approx(8)  # and not 16, of two engines
    assert table["fast"]["less_error"] == pytest.approx(1 / 3)
    assert table["the paper's network"]["backend"] == "onnxruntime/fp32"
    best = same_time(made_up())[-1]["reached"]
    assert best["<HBAO>"]["dssim"] == 0.07
    assert same_time(made_up())[0]["reached"]["<HBAO>"] is None


def test_what_is_a_limit_is_no_rival() -> None:
    sections = made_up()
    for name in ("error", "speed"):
        found = sections[name]["data"]
        found["missing"] = {}
        *_, first, second = (dict(row) for row in found["rows"])
        for row in (first, second):
            row |= {"name": "rays", "family": LIMIT, "id": f"rays {row['settings']}"}
            row |= {"dssim": 0.001, "each": [0.001]} if name == "error" else {}
            found["rows"].append(row)
    figures = Figures(sections)
    assert figures.rival is not None and figures.rival.name == "<HBAO>"
    assert figures.quick is None
    assert [(point.name, point.error) for point in figures.limits] == [("rays", 0.001)]


def test_the_frontier_is_what_nothing_beats() -> None:
    rng = np.random.default_rng(3)
    found = [Point(str(k), "", "", *rng.integers(1, 9, 2), {}) for k in range(60)]
    kept = frontier(found)
    for point in found:
        beaten = any(
            (o.cost <= point.cost and o.error < point.error)
            or (o.cost < point.cost and o.error <= point.error)
            for o in found
        )
        alike = [(p.cost, p.error) for p in kept].count((point.cost, point.error))
        assert alike == (0 if beaten else 1)


def test_the_page_stands_alone_and_escapes_what_was_measured(tmp_path: Path) -> None:
    context = Context([tmp_path], tmp_path, tmp_path, threads=2)
    document = report.document(context, made_up(), "key")
    drawn = plots.speed_error(document["sections"], "ao")
    assert drawn is not None
    text = page.render(document, {"speed-error": drawn})
    assert "&lt;HBAO&gt;" in text
    assert "<HBAO>" not in text
    assert "Skipped: &lt;no&gt; port" in text
    assert not re.findall(r"""(?:src|href)=["'](?!#|data:)""", text)
    assert text.count("data:image/png;base64,") == 1
    assert points(document["sections"])


@pytest.mark.parametrize("root", ["ao"], indirect=True)
@pytest.mark.parametrize("problem", [Skipped("no GPU"), DataError("no GPU"), OSError("no GPU")])
def test_sections_are_kept_and_what_breaks_keeps_what_is_done(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, problem: Exception
) -> None:
    calls: list[str] = []

    def measuring(name: str) -> Any:
        def measure(context: Context) -> dict[str, Any]:
            calls.append(name)
            if name == "sizes":
                raise problem
            if name == "comparison":
                raise KeyboardInterrupt
            return dict(made_up()[name]["data"]) if name != "service" else {"rows": []}

        return measure

    sections = {name: measuring(name) for name in report.SECTIONS}
    monkeypatch.setattr(report, "SECTIONS", sections)
    monkeypatch.setattr(plots, "speed_error", lambda *_: None)  # to draw takes long
    context = Context([root / "models"], root / "data", tmp_path, effect=root.name, quick=True)
    with pytest.raises(KeyboardInterrupt):
        report.measure(context)
    found = json.loads((tmp_path / "report.json").read_text())["sections"]
    assert list(found) == ["error", "speed", "service", "sizes"]
    assert found["sizes"] == {"status": "skipped", "reason": "no GPU"}
    calls.clear()
    seen: list[tuple[str, float]] = []
    with pytest.raises(KeyboardInterrupt):
        report.measure(
            context, resume=True, progress=lambda name, share, _: seen.append((name, share))
        )
    assert calls == ["sizes", "comparison"]
    assert seen[:2] == [("sizes", 0.0), ("sizes", 1.0)]
    assert list(report.measure(context, only=["speed"])["sections"]) == list(found)
    other = dataclasses.replace(context, threads=context.threads + 1)
    assert list(report.measure(other, only=["speed"])["sections"]) == ["speed"]
