"""Targets follow from the data alone."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from deepshade_report import derived
from deepshade_report.sections import default_backend
from deepshade_report.targets import GIB, targets

from .sections import NETWORKS, made_up


def verdicts(sections: dict[str, Any]) -> dict[str, bool | None]:
    return {row["target"]: row["met"] for row in targets(sections)}


def verdict(sections: dict[str, Any], words: str) -> bool | None:
    (found,) = [met for text, met in verdicts(sections).items() if words in text]
    return found


def rows(sections: dict[str, Any], section: str, **wanted: Any) -> list[dict[str, Any]]:
    found = sections[section]["data"]["rows"]
    return [row for row in found if all(row[key] == value for key, value in wanted.items())]


def test_without_data_every_target_is_open() -> None:
    found = targets({})
    assert len(found) > 15
    assert all(row["met"] is None and row["measured"] == "not measured" for row in found)
    skipped = {"error": {"status": "skipped", "reason": "no shards"}}
    assert [row["met"] for row in targets(skipped)] == [None] * len(found)


def test_made_up_figures_are_judged_as_by_hand() -> None:
    sections = made_up()
    # 80 ms / (16 ms x 0.3) = 16.7; 80 / (70 x 0.3) = 3.8
    assert verdict(sections, "fast: at least 15 x") is True
    assert verdict(sections, "best: at least 4 x") is False
    assert verdict(sections, "fast: lower DSSIM") is True
    assert verdict(sections, "best: DSSIM at least 15 %") is True  # .034 / .056 = .61
    assert verdict(sections, "of HBAO") is True
    assert verdict(sections, "GPU: fast") is None  # measured on a CPU


@pytest.mark.parametrize(
    ("words", "section", "wanted", "change"),
    [
        ("fast: lower DSSIM", "error", {"name": "fast"}, {"dssim": 0.0561}),
        ("best: DSSIM at least 15 %", "error", {"name": "best"}, {"dssim": 0.048}),
        ("strictly better", "error", {"name": "best"}, {"dssim": 0.05}),
        ("of HBAO", "error", {"name": "balanced"}, {"dssim": 0.08}),
        ("of GTAO", "error", {"name": "GTAO"}, {"dssim": 0.03}),
        (
            "adds at most 2",
            "error",
            {"id": "balanced openvino/bf16"},
            {"dssim": 1.03 * NETWORKS["balanced"][1]},
        ),
        ("at most 3 x the bare", "service", {"bundle": "fast"}, {"ratio": {"median": 3.01}}),
        ("under 30 ms", "service", {"bundle": "fast"}, {"total_ms": {"median": 30.0}}),
        ("1.6 x one client", "clients", {"clients": 4}, {"speedup": {"median": 1.59}}),
        ("slower than 4 x", "clients", {"clients": 4}, {"most_of_median": 4.01}),
        ("inside 1 GiB", "sizes", {"width": 3840}, {"peak_above_idle": GIB + 1}),
        ("within 25 %", "sizes", {"width": 3840}, {"ms_per_megapixel": 99.0}),
        ("8192x8192", "sizes", {"width": 8192}, {"peak_above_idle": 9 * GIB}),
        ("half background", "background", {"share": 0.5}, {"of_full": {"median": 0.61}}),
        ("at most 5 %", "service", {"bundle": "best"}, {"stages_ms": {"plan": {"median": 2.0}}}),
        ("more than 1e-3", "savings", {"view": 1}, {"most_changed": 2e-3}),
    ],
)
def test_one_figure_beyond_its_bound_is_not_met(
    words: str, section: str, wanted: dict[str, Any], change: dict[str, Any]
) -> None:
    sections = made_up()
    assert verdict(sections, words) is True
    changed = copy.deepcopy(sections)
    found = rows(changed, section, **wanted)
    assert found
    for row in found:
        merge(row, change)
    assert verdict(changed, words) is False
    others = {text: met for text, met in verdicts(sections).items() if words not in text}
    assert sum(verdicts(changed)[text] != met for text, met in others.items()) <= 2


def merge(row: dict[str, Any], change: dict[str, Any]) -> None:
    for key, value in change.items():
        if isinstance(value, dict):
            merge(row[key], value)
        else:
            row[key] = value


def test_a_gpu_s_figures_count() -> None:
    sections = made_up()
    gpu = sections["gpu"]["data"]
    gpu["gpu"] = "some card"
    for row, ms in zip(gpu["rows"], (1.5, 1.2), strict=True):
        row["ms"]["median"] = ms
    assert verdict(sections, "GPU: paper under 2 ms") is True
    assert verdict(sections, "GPU: fast under 1 ms") is False


def test_the_default_backend_is_the_service_s_else_the_fastest_that_is_exact_enough() -> None:
    sections = made_up()
    assert default_backend(sections, "fast") == "openvino/bf16"
    sections["service"] = {"status": "skipped", "reason": "-"}
    assert default_backend(sections, "fast") == "openvino/fp16"
    for row in rows(sections, "error", id="fast openvino/fp16"):
        row["dssim"] *= 1.03
    assert default_backend(sections, "fast") == "openvino/bf16"


def test_same_time_is_the_least_error_that_fits() -> None:
    sections = made_up()
    points = derived.points(sections)
    for row in derived.same_time(sections):
        for name, reached in row["reached"].items():
            fit = [p.error for p in points if p.name == name and p.milliseconds <= row["ms"] * 1.01]
            assert (reached["dssim"] if reached else None) == min(fit, default=None)


def test_published_figures_are_the_paper_s() -> None:
    assert derived.PUBLISHED.milliseconds == pytest.approx(17)
    assert 1 - 2 * derived.PUBLISHED.error == pytest.approx(0.729)
