"""Sections are kept as they are done, and a report goes on from them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from deepshade.errors import DeepshadeError
from deepshade_report import plots, run
from deepshade_report.context import Context
from deepshade_report.store import Skipped, Store, finite, key_of

from .sections import made_up


@pytest.fixture
def context(tmp_path: Path) -> Context:
    return Context(tmp_path / "models", tmp_path / "data", tmp_path / "out", quick=True)


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Which sections were measured; what they measure is made up."""
    calls: list[str] = []
    everything = made_up()

    def measurer(name: str) -> Callable[[Context], dict[str, Any]]:
        def measure(context: Context) -> dict[str, Any]:
            calls.append(name)
            found: dict[str, Any] = everything[name]["data"]
            return found

        return measure

    monkeypatch.setattr(run, "_measurer", measurer)
    monkeypatch.setattr(plots, "PLOTS", {})  # to draw takes long
    monkeypatch.setattr(run, "busy_share", lambda seconds: 0.0)
    return calls


def test_only_and_resume_measure_what_is_missing(context: Context, measured: list[str]) -> None:
    run.measure(context, only=["speed", "gpu"])
    assert measured == ["speed", "gpu"]
    found = run.measure(context, resume=True)
    assert measured[2:] == ["error", "service", "clients", "sizes", "background", "savings"]
    assert list(found["sections"]) == list(run.SECTIONS)
    assert found["sections"]["comparison"]["status"] == "skipped"  # there are no views
    run.measure(context, only=["error"])
    assert measured[8:] == ["error"]
    assert len(run.measure(context, only=["error"])["sections"]) == len(run.SECTIONS)
    run.measure(context)
    assert len(measured) == 10 + len(run.SECTIONS) - 1


def test_other_settings_measure_anew(context: Context, measured: list[str]) -> None:
    run.measure(context, only=["speed"])
    context.quick = False
    found = run.measure(context, only=["gpu"], resume=True)
    assert list(found["sections"]) == ["gpu"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_what_breaks_in_keeps_what_is_done(
    context: Context,
    measured: list[str],
    monkeypatch: pytest.MonkeyPatch,
    error: type[BaseException],
) -> None:
    before = run._measurer

    def breaking(name: str) -> Callable[[Context], dict[str, Any]]:
        if name == "service":
            raise error
        return before(name)

    monkeypatch.setattr(run, "_measurer", breaking)
    with pytest.raises(error):
        run.measure(context)
    report = json.loads((context.out / "report.json").read_text())
    assert report["partial"] is True
    assert list(report["sections"]) == ["error", "speed"]
    assert "stopped before the end" in (context.out / "index.html").read_text()
    monkeypatch.setattr(run, "_measurer", before)
    assert run.measure(context, resume=True)["partial"] is False
    assert measured.count("error") == measured.count("speed") == 1


@pytest.mark.parametrize("error", [Skipped("no GPU"), DeepshadeError("no GPU"), OSError("no GPU")])
def test_what_can_t_be_measured_is_skipped_with_its_reason(
    context: Context, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def failing(name: str) -> Callable[[Context], dict[str, Any]]:
        def measure(context: Context) -> dict[str, Any]:
            raise error

        return measure

    monkeypatch.setattr(run, "_measurer", failing)
    found = run.measure(context, only=["gpu"])
    assert found["sections"]["gpu"] == {
        "status": "skipped",
        "reason": "no GPU",
        "key": context.key(),
    }


def test_progress_only_grows(context: Context, measured: list[str]) -> None:
    seen: list[tuple[str, float]] = []
    run.measure(context, progress=lambda name, share, _: seen.append((name, share)))
    names = list(dict.fromkeys(name for name, _ in seen))
    assert names == list(run.SECTIONS)
    assert [share for _, share in seen[-2:]] == [0.0, 1.0]


def test_a_damaged_section_is_measured_again(tmp_path: Path) -> None:
    store = Store(tmp_path, "key")
    store.done("speed", {"rows": [1.0, float("nan")]}, 1.23)
    found = store.load("speed")
    assert found and found["data"] == {"rows": [1.0, None]}
    assert Store(tmp_path, "other").load("speed") is None
    (tmp_path / "sections" / "speed.json").write_text('{"status": "do')
    assert store.load("speed") is None
    assert not list(tmp_path.rglob("*.tmp"))


def test_stamps_differ_by_every_fact() -> None:
    stamps = {key_of(*facts) for facts in ((1, 2), (1, 3), (2, 2), ([1], 2), ("1", 2))}
    assert len(stamps) == 5
    assert finite({1: (1, float("inf"))}) == {"1": [1, None]}
