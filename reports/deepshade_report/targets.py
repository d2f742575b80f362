"""What the project set out to reach, computed from what was measured."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

from deepshade_report.sections import (
    MOST_ADDED,
    Sections,
    backend_of,
    best_rival,
    data,
    network_row,
    rows,
)
from deepshade_report.statistics import ratio, significant
from deepshade_report.subjects import NETWORK, REFERENCE

GIB = 2**30


def targets(sections: Sections) -> list[dict[str, Any]]:
    """Each target with what was measured and whether it is met; None where nothing tells."""
    return [
        {"target": text, "measured": measured, "met": met}
        for compute in _ALL
        for text, measured, met in compute(sections)
    ]


Result = tuple[str, str, bool | None]
_UNKNOWN = "not measured"


def _faster(name: str, least: float) -> Callable[[Sections], list[Result]]:
    def compute(sections: Sections) -> list[Result]:
        text = f"{name}: at least {least:g} x faster than the paper's network on {REFERENCE}"
        ours, paper = (network_row(sections, "speed", n) for n in (name, "paper"))
        if not ours or not paper:
            return [(text, _UNKNOWN, None)]
        found = ratio(paper["rounds"], ours["rounds"])
        low, high = found["quartiles"]
        shown = (
            f"{found['median']:.1f} x ({low:.1f} to {high:.1f}): "
            f"{paper['ms']['median']:.1f} ms against {ours['ms']['median']:.2f} ms "
            f"({backend_of(ours)})"
        )
        return [(text, shown, found["median"] >= least)]

    return compute


def _better(name: str, most: float, text: str) -> Callable[[Sections], list[Result]]:
    def compute(sections: Sections) -> list[Result]:
        ours, paper = (network_row(sections, "error", n) for n in (name, "paper"))
        if not ours or not paper:
            return [(f"{name}: {text}", _UNKNOWN, None)]
        share = ours["dssim"] / paper["dssim"]
        shown = f"{ours['dssim']:.4f} against {paper['dssim']:.4f} ({share - 1:+.1%})"
        return [(f"{name}: {text}", shown, share < 1 if most == 1 else share <= most)]

    return compute


def _ordered(sections: Sections) -> list[Result]:
    text = "each bundle strictly better in error than the next faster one"
    found = []
    for name in _names(sections):
        error, speed = (network_row(sections, part, name) for part in ("error", "speed"))
        if error and speed:
            found.append((speed["ms"]["median"], error["dssim"], name))
    if len(found) < 2:
        return [(text, _UNKNOWN, None)]
    found.sort()
    met = all(b[1] < a[1] for a, b in pairwise(found))
    shown = ", ".join(f"{name} {error:.4f} in {ms:.2f} ms" for ms, error, name in found)
    return [(text, shown, met)]


def _below_rivals(sections: Sections) -> list[Result]:
    results: list[Result] = []
    for word in ("hbao", "gtao"):
        text = f"every bundle's DSSIM below that of {word.upper()} at its best settings"
        rival = best_rival(sections, word)
        ours = [(n, r) for n in _names(sections) if (r := network_row(sections, "error", n))]
        if not rival or not ours:
            results.append((text, _UNKNOWN, None))
            continue
        name, worst = max(ours, key=lambda item: float(item[1]["dssim"]))
        shown = f"{worst['dssim']:.4f} ({name}) against {rival['dssim']:.4f}"
        results.append((text, shown, worst["dssim"] < rival["dssim"]))
    return results


def _precision(sections: Sections) -> list[Result]:
    text = f"the precision chosen by default adds at most {MOST_ADDED:.0%} DSSIM"
    added = []
    for name in _names(sections):
        ours = network_row(sections, "error", name)
        exact = [
            row
            for row in rows(sections, "error", name=name, family=NETWORK)
            if backend_of(row) == str(REFERENCE)
        ]
        if ours and exact:
            added.append((ours["dssim"] / exact[0]["dssim"] - 1, name, backend_of(ours)))
    if not added:
        return [(text, _UNKNOWN, None)]
    shown = ", ".join(f"{name} {more:+.2%} ({backend})" for more, name, backend in added)
    return [(text, shown, max(added)[0] <= MOST_ADDED)]


def _service(sections: Sections) -> list[Result]:
    found = rows(sections, "service", bundle="fast")
    texts = (
        "POST ?quality=fast: total server time at most 3 x the bare network's",
        "POST ?quality=fast: under 30 ms",
    )
    if not found:
        return [(text, _UNKNOWN, None) for text in texts]
    row = found[0]
    times, total = row["ratio"], row["total_ms"]
    slowest = row["slowest"]
    return [
        (
            texts[0],
            f"{times['median']:.2f} x ({times['quartiles'][0]:.2f} to {times['quartiles'][1]:.2f}"
            f"); slowest stage besides the network: {slowest}, "
            f"{row['stages_ms'][slowest]['median']:.1f} ms",
            times["median"] <= 3,
        ),
        (
            texts[1],
            f"{total['median']:.1f} ms ({total['quartiles'][0]:.1f} to "
            f"{total['quartiles'][1]:.1f})",
            total["median"] < 30,
        ),
    ]


def _clients(sections: Sections) -> list[Result]:
    results: list[Result] = []
    four = rows(sections, "clients", clients=4)
    texts = (
        "four clients: at least 1.6 x one client's throughput",
        "four clients: no request slower than 4 x the median",
    )
    if not four:
        return [(text, _UNKNOWN, None) for text in texts]
    gains = ", ".join(f"{row['bundle']} {row['speedup']['median']:.2f} x" for row in four)
    most = ", ".join(f"{row['bundle']} {row['most_of_median']:.2f} x" for row in four)
    results.append((texts[0], gains, all(row["speedup"]["median"] >= 1.6 for row in four)))
    results.append((texts[1], most, all(row["most_of_median"] <= 4 for row in four)))
    return results


def _sizes(sections: Sections) -> list[Result]:
    texts = (
        "3840x2160 inside 1 GiB of service memory above idle",
        "3840x2160: time per megapixel within 25 % of 768x512's",
        "8192x8192 inside the configured limit",
    )
    found = rows(sections, "sizes", width=3840, height=2160)
    small = [row for row in found if row["memory_setting"] <= GIB]
    results: list[Result] = []
    if small and small[0]["peak_above_idle"] is not None:
        peak = small[0]["peak_above_idle"]
        results.append((texts[0], f"{peak / GIB:.2f} GiB, served with --memory 1G", peak <= GIB))
    else:
        results.append((texts[0], _UNKNOWN, None))
    shown, met = [], True
    for row in found:
        beside = rows(
            sections, "sizes", width=768, height=512, memory_setting=row["memory_setting"]
        )
        if beside:
            share = row["ms_per_megapixel"] / beside[0]["ms_per_megapixel"]
            met &= share <= 1.25
            shown.append(f"{share:.2f} x with {row['memory_setting'] / GIB:.3g} GiB")
    results.append((texts[1], ", ".join(shown), met) if shown else (texts[1], _UNKNOWN, None))
    huge = rows(sections, "sizes", width=8192, height=8192)
    if huge and huge[0]["peak_above_idle"] is not None:
        peak, limit = huge[0]["peak_above_idle"], huge[0]["memory_setting"]
        results.append((texts[2], f"{peak / GIB:.2f} of {limit / GIB:.3g} GiB", peak <= limit))
    else:
        results.append((texts[2], _UNKNOWN, None))
    return results


def _background(sections: Sections) -> list[Result]:
    text = "a frame that is half background costs at most 0.6 of a full one"
    half = rows(sections, "background", share=0.5)
    if not half:
        return [(text, _UNKNOWN, None)]
    shown = ", ".join(
        f"{row['bundle']} ({row['shape']}) {row['of_full']['median']:.2f}" for row in half
    )
    return [(text, shown, all(row["of_full"]["median"] <= 0.6 for row in half))]


def _planner(sections: Sections) -> list[Result]:
    text = "planning takes at most 5 % of the answer's time at 768x512"
    found = rows(sections, "service")
    if not found:
        return [(text, _UNKNOWN, None)]
    shares = {
        row["bundle"]: significant(row["stages_ms"]["plan"]["median"] / row["total_ms"]["median"])
        for row in found
    }
    shown = ", ".join(f"{name} {share:.1%}" for name, share in shares.items())
    return [(text, shown, max(shares.values()) <= 0.05)]


def _skipping(sections: Sections) -> list[Result]:
    text = "what the planner skips changes no pixel by more than 1e-3"
    found = rows(sections, "savings")
    if not found:
        return [(text, _UNKNOWN, None)]
    worst = max(found, key=lambda row: float(row["most_changed"]))
    shown = f"{worst['most_changed']:.2g} at most ({worst['bundle']})"
    return [(text, shown, worst["most_changed"] <= 1e-3)]


def _gpu(sections: Sections) -> list[Result]:
    found = data(sections, "gpu")
    results: list[Result] = []
    for name, most in (("paper", 2.0), ("fast", 1.0)):
        text = f"GPU: {name} under {most:g} ms of device time at 768x512"
        times = [
            (row["ms"]["median"], row["what"])
            for row in rows(sections, "gpu")
            if row["what"].startswith(f"{name},") and row["what"].endswith(": device")
        ]
        if not found or not times:
            results.append((text, _UNKNOWN, None))
        elif found["gpu"] is None:
            ms = min(times)[0]
            results.append((text, f"no GPU here; the same code on the CPU: {ms:.1f} ms", None))
        else:
            ms, what = min(times)
            results.append((text, f"{ms:.3f} ms ({what}, {found['gpu']})", ms < most))
    return results


def _names(sections: Sections) -> list[str]:
    found = [row["name"] for row in rows(sections, "error", family=NETWORK)]
    return list(dict.fromkeys(found))


_ALL: tuple[Callable[[Sections], list[Result]], ...] = (
    _faster("fast", 15),
    _better("fast", 1, "lower DSSIM than the paper's network"),
    _faster("best", 4),
    _better("best", 0.85, "DSSIM at least 15 % lower than the paper's network"),
    _ordered,
    _below_rivals,
    _precision,
    _service,
    _clients,
    _sizes,
    _background,
    _planner,
    _skipping,
    _gpu,
)
