"""Studies of tiny bundles over tiny data: rows, resuming, and what their plots are made from."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import typer
from PIL import Image
from typer.testing import CliRunner

from deepshade.environments import read_environment
from deepshade.errors import ConfigError, DataError
from deepshade_report import studies
from deepshade_report.studies import artefacts, diversity, loss, regressors, time
from deepshade_report.studies.common.bench import Bench
from deepshade_report.studies.common.cli import study as command
from deepshade_report.studies.common.learning import recipe, trained
from deepshade_report.studies.common.rows import Rows, by
from deepshade_report.studies.common.scale import SMALL, Scale
from deepshade_report.studies.common.sets import counts, diverse, order, specs
from deepshade_report.view import load_views

from .small import SIZE, write_bundle, write_data

TINY = replace(SMALL, val_views=1, test_views=2, steps=4, batch=2, curve=2, pixels=20, trees=2)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("study")
    write_bundle(folder / "models" / "ao" / "balanced", 4, 0)
    write_data(folder / "data" / "learn", "ao", 4)
    write_data(folder / "data" / "held", "ao", 3)
    return folder


class Small(Bench):
    """A bench whose data sets are there."""

    def set(self, name: str) -> Path:
        return (self.data / name).resolve()


def bench(root: Path, out: Path, name: str = "a", *, resume: bool = False, **more: Any) -> Small:
    scale: Scale = more.pop("scale", TINY)
    return Small(name, out, root / "data", [root / "models"], scale, resume=resume, **more)


def counting(values: Sequence[int], fails: int | None = None) -> tuple[Any, list[int]]:
    """A study of squares that stops at one of them, and what it has measured."""
    measured: list[int] = []

    def measure(bench: Bench, point: dict[str, Any]) -> dict[str, Any]:
        if point["n"] == fails:
            raise KeyboardInterrupt
        measured.append(point["n"])
        return {"square": point["n"] ** 2, "nothing": float("nan")}

    found = SimpleNamespace(
        TITLE="squares",
        FIGURE="0",
        points=lambda bench: [{"n": value} for value in values],
        measure=measure,
        draw=lambda bench, rows: bytes(len(rows)),
    )
    return found, measured


def test_every_study_is_found_and_says_what_it_repeats() -> None:
    names = studies.names()
    assert {"radius", "fov", "structure", "effects", "loss", "diversity", "regressors"} < set(names)
    modules = [studies.study(name) for name in names]
    figures = [module.FIGURE for module in modules]
    assert sorted(figures) == sorted(["6", "7", "8", "9", "10 a, b", "10 c, d", "11", "12", "13"])
    assert all(callable(getattr(m, f)) for m in modules for f in ("points", "measure", "draw"))
    with pytest.raises(ConfigError, match="no study is called 'fog'") as caught:
        studies.study("fog")
    assert "fov" in caught.value.fix


def test_a_stopped_study_goes_on_where_it_was(root: Path, tmp_path: Path) -> None:
    stopped, first = counting([1, 2, 3], fails=3)
    with pytest.raises(KeyboardInterrupt):
        bench(root, tmp_path).run(stopped)
    assert first == [1, 2]
    whole, second = counting([1, 2, 3])
    rows, picture = bench(root, tmp_path, resume=True).run(whole)
    assert second == [3]
    assert [row["square"] for row in rows] == [1, 4, 9]
    assert picture.read_bytes() == bytes(3)
    document = json.loads((tmp_path / "a.json").read_text())
    assert document["rows"] == rows
    assert rows[0]["nothing"] is None  # JSON has no NaN
    assert not list(tmp_path.glob("*.tmp"))

    again, third = counting([1, 2, 3])
    bench(root, tmp_path).run(again)
    assert third == [1, 2, 3]  # without --resume all is measured anew
    other, fourth = counting([1, 2, 3])
    bench(root, tmp_path, resume=True, scale=replace(TINY, steps=5)).run(other)
    assert fourth == [1, 2, 3]  # other settings


def test_means_over_seeds(tmp_path: Path) -> None:
    rows = Rows(tmp_path / "rows.json", "key", {}, resume=False)
    for kind, seed, value in (("a", 0, 1.0), ("a", 1, 3.0), ("b", 0, 5.0)):
        rows.add({"point": {"kind": kind, "seed": seed}, "value": value})
    assert by(rows.rows, "kind", lambda row: row["value"]) == {"a": 2.0, "b": 5.0}


def test_a_training_has_a_curve_and_goes_on(root: Path, tmp_path: Path) -> None:
    network = {"u0": 2, "levels": 2}
    whole = bench(root, tmp_path / "whole")
    made = recipe(whole, network=network)
    found = trained(whole, made, "run")
    assert [entry["step"] for entry in found["curve"]] == [2, 4]
    assert found["views"] == {"train": 4, "validation": 1, "test": 2}
    assert found["test"] == found["curve"][-1]["test"]
    # 6 -> 2, 2 -> 4 in 2 groups, 4 + 2 -> 1, all 3 x 3 with biases
    assert found["parameters"] == 2 * 55 + 4 * 10 + 55
    assert trained(whole, made, "run") == found  # a run that is done stays

    stopping = bench(root, tmp_path / "parts")

    def stop(done: int, total: int, doing: str) -> None:
        if "step 3 of" in doing:
            raise KeyboardInterrupt

    stopping.advance = stop
    with pytest.raises(KeyboardInterrupt):
        trained(stopping, made, "run")
    parts = bench(root, tmp_path / "parts")
    assert trained(parts, made, "run")["curve"] == found["curve"]


@pytest.mark.parametrize("module", [loss, regressors])
def test_studies_that_train(root: Path, tmp_path: Path, module: ModuleType) -> None:
    name = module.__name__.rpartition(".")[2]
    rows, picture = bench(root, tmp_path, name).run(module)
    assert len(rows) == len({json.dumps(row["point"]) for row in rows}) >= 4
    for row in rows:
        assert 0 < row["test"]["dssim"] < 1
        assert 0 < row["test"]["mae"] < 1
    check_plot(picture)


def test_patches_hold_what_is_around_a_pixel() -> None:
    planes = np.zeros((6, 5, 5), np.float32)
    planes[2], planes[5] = 1, -3
    planes[3] = np.arange(5)[None, :] * 0.5
    planes[:, 0] = 0  # background
    (patch,) = regressors.patches(planes, 3, np.array([1]), np.array([2])).reshape(1, 6, 3, 3)
    assert (patch[3, 1] == [-0.25, 0, 0.25]).all()  # in units of the reach, two radii
    assert (patch[:3, 1:] == planes[:3, 1:3, 1:4]).all()
    assert (patch[3:, 0].T == (0, 0, -1)).all()
    assert patch[5, 1, 1] == 0


def test_families_share_a_pool_of_views() -> None:
    families = tuple(f"procedural:{letter}" for letter in "abcdefghijklm")
    pool = diverse(26, families)
    for several in (1, 2, 5, 10, 13):
        table = counts(26, families, several)
        assert sum(table.values()) == 26
        assert list(table) == order(families)[:several]
        assert max(table.values()) - min(table.values()) <= 1
        entries = [SimpleNamespace(record={"scene": f"{name}:7"}) for name in pool]
        data: Any = SimpleNamespace(entries=entries)
        assert len(diversity.taken(data, range(len(pool)), table)) == 26


def test_no_seed_of_a_data_set_is_in_another(tmp_path: Path) -> None:
    sets = specs(SMALL, tmp_path)
    assert len({spec.seed for spec in sets.values()}) == len(sets)
    assert {spec.radius for spec in sets.values()} == {None}
    assert len(sets["effects"].effects) == 9
    found = read_environment(tmp_path / "even-sky" / "even.exr")
    turned = np.roll(found.radiance, 17, axis=2)
    assert np.array_equal(turned, found.radiance)
    assert found.radiance.std(1).max() > 0.01


def test_errors_are_sorted_by_what_is_around(root: Path) -> None:
    view = load_views(root / "data" / "held", "ao")[0]
    depth = np.full((SIZE, SIZE), 4.0, np.float32)
    depth[:, : SIZE // 2] = 2.0  # nearer by four radii
    position = np.stack([depth * 0, depth * 0, -depth])
    truth = np.full((1, SIZE, SIZE), 0.5, np.float32)
    edge = replace(
        view,
        attributes={**view.attributes, "position": position},
        reference=truth,
        background=np.zeros((SIZE, SIZE), np.bool_),
    )
    names = list(artefacts.KINDS)

    def kind(shift: float, column: int, row: int = SIZE // 2) -> str:
        error, kinds = artefacts.sorted_errors(edge, truth + np.float32(shift))
        assert np.allclose(error, abs(shift))
        return names[kinds[row, column]]

    assert kind(-0.2, SIZE // 2 + 3) == "halo"
    assert kind(0.2, SIZE // 2 + 3) == "hidden"
    assert kind(0.2, 2) == "border"
    assert kind(-0.2, 12) == "shade"
    waves = truth + np.float32(0.2) * np.sin(np.arange(SIZE, dtype=np.float32))
    _, kinds = artefacts.sorted_errors(edge, waves)
    assert (kinds[SIZE // 2, 18:24] == names.index("invented")).mean() > 0.4
    _, kinds = artefacts.sorted_errors(replace(edge, reference=waves), truth)
    assert (kinds[SIZE // 2, 18:24] == names.index("lost")).mean() > 0.4


def test_the_setting_that_fits_into_a_time() -> None:
    rows: list[dict[str, Any]] = [
        {"point": {"error": name}, "name": name[0], "dssim": error}
        for name, error in (("a1", 0.3), ("a2", 0.2), ("a3", 0.1), ("b1", 0.05))
    ]
    ms = {"a1": 1, "a2": 2, "a3": 9, "b1": 1}
    rows.append({"point": {"speed": "all"}, "ms": {k: {"median": v} for k, v in ms.items()}})
    best = time.within(rows, 5, "a")
    assert best is not None
    assert (best["point"], best["ms"]) == ({"error": "a2"}, 2)
    assert time.within(rows, 0.5, "a") is None


@pytest.mark.slow
def test_artefacts_of_shipped_bundles(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = bench(root, tmp_path, "artefacts", views_from=root / "data" / "held")
    rows, picture = here.run(artefacts)
    assert [row["point"] for row in rows] == [{"view": k} for k in range(3)]
    assert list(rows[0]["methods"]) == ["balanced", "GTAO", "HBAO"]
    assert list(rows[0]["methods"]["GTAO"]) == list(artefacts.KINDS)
    check_plot(picture)


def test_without_bundles_or_views_a_study_fails(root: Path, tmp_path: Path) -> None:
    views = root / "data" / "held"
    empty = Small("artefacts", tmp_path, root, [tmp_path], TINY, views_from=views)
    with pytest.raises(ConfigError, match="no bundle for 'ao'"):
        empty.run(artefacts)
    app = typer.Typer()
    app.command()(command)
    options = ["artefacts", f"--views={tmp_path / 'nowhere'}", f"--out={tmp_path}"]
    result = CliRunner().invoke(app, options)
    assert isinstance(result.exception, DataError)
    assert isinstance(CliRunner().invoke(app, ["fog"]).exception, ConfigError)


def check_plot(picture: Path) -> None:
    content = picture.read_bytes()
    assert len(content) < 150_000
    with Image.open(io.BytesIO(content)) as image:
        assert image.width > 400
        assert len(np.unique(np.asarray(image.convert("L")))) > 8
