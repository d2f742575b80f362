"""Made-up sections of a report, such as a machine could measure them; for tests only."""

from __future__ import annotations

from typing import Any

import numpy as np

from deepshade_report.frames import MEGAPIXELS
from deepshade_report.statistics import ratio, spread

BACKENDS = {
    ("onnxruntime", "fp32"): (1.0, 1.0),
    ("onnxruntime", "int8"): (0.7, 1.05),
    ("openvino", "fp32"): (0.55, 1.0),
    ("openvino", "bf16"): (0.3, 1.004),
    ("openvino", "fp16"): (0.28, 1.001),
}
QUALITIES = ("fast", "balanced", "best")
NETWORKS = {  # name -> (milliseconds in fp32 on ONNX Runtime, DSSIM)
    "fast": (16.0, 0.052),
    "balanced": (30.0, 0.043),
    "best": (70.0, 0.034),
    "paper": (80.0, 0.056),
}


def rounds(median: float, seed: int, count: int = 9) -> list[float]:
    return list(median * np.random.default_rng(seed).normal(1, 0.02, count))


def made_up() -> dict[str, Any]:
    """All sections, done."""
    errors, speeds = [], []
    for name, (ms, dssim) in NETWORKS.items():
        for (engine, precision), (faster, worse) in BACKENDS.items():
            about = {
                "id": f"{name} {engine}/{precision}",
                "name": name,
                "family": "paper's network" if name == "paper" else "network",
                "settings": {"engine": engine, "precision": precision},
            }
            errors.append(about | error_row(dssim * worse))
            speeds.append(about | speed_row(ms * faster, len(speeds)))
    for name, family, count, start, best in (
        ("HBAO", "screen-space", 4, 20.0, 0.071),
        ("GTAO", "screen-space", 4, 28.0, 0.066),
        ("Mitsuba + OIDN", "ray tracing", 4, 60.0, 0.05),
    ):
        for step in range(count):
            settings = {"samples": 2**step}
            about = {
                "id": f"{name} samples={2**step}",
                "name": name,
                "family": family,
                "settings": settings,
            }
            errors.append(about | error_row(best * (1 + 0.2 * (count - 1 - step))))
            speeds.append(about | speed_row(start * 1.7**step, len(speeds)))
    sections: dict[str, Any] = {
        "error": {
            "views": 3,
            "scenes": ["room", "cat"],
            "size": [512, 512],
            "trivial_dssim": 0.087,
            "rows": errors,
            "missing": {"Blender": "<not> here"},
        },
        "speed": {"frame": [768, 512], "background": 0.0, "rows": speeds, "missing": {}},
        "service": {
            "frame": [768, 512],
            "chosen": True,
            "rows": [service_row(n) for n in list(NETWORKS)[:3]],
        },
        "clients": {"rows": [row for name in ("fast", "best") for row in client_rows(name)]},
        "sizes": {"bundle": "fast", "backend": "openvino/bf16", "left_out": "", "rows": sizes()},
        "background": {
            "rows": [
                {
                    "bundle": name,
                    "backend": "openvino/bf16",
                    "shape": shape,
                    "share": share,
                    "total_ms": spread(rounds(12 * (1.1 - share), 3)),
                    "infer_ms": spread(rounds(8 * (1.1 - share), 3)),
                    "of_full": ratio(rounds(1.1 - share, 4), rounds(1.1, 5)),
                }
                for name in ("fast", "best")
                for shape in ("sky", "object")
                for share in (0.0, 0.25, 0.5, 0.75, 1.0)
            ]
        },
        "savings": savings(),
        "gpu": {
            "gpu": None,
            "available": ["onnxruntime/fp32"],
            "rows": [
                {"what": f"{name}, CPU, the same code: device", "ms": spread(rounds(ms, 1))}
                for name, ms in (("paper", 80.0), ("fast", 16.0))
            ],
            "end_to_end": [],
            "failed": {},
        },
        "comparison": {"view": 0, "scene": "room", "picture": "comparison.png", "panels": []},
    }
    return {
        name: {"status": "done", "seconds": 1.0, "key": "test", "data": found}
        for name, found in sections.items()
    }


def error_row(dssim: float) -> dict[str, Any]:
    each = [dssim * 0.8, dssim, dssim * 1.2]
    return {"dssim": dssim, "ssim": 1 - 2 * dssim, "of_trivial": dssim / 0.087, "each": each}


def speed_row(ms: float, seed: int) -> dict[str, Any]:
    values = rounds(ms, seed)
    middle = spread(values)
    return {
        "ms": middle,
        "ms_per_megapixel": middle["median"] / MEGAPIXELS,
        "scaled_from_megapixels": None,
        "rounds": values,
    }


def service_row(name: str) -> dict[str, Any]:
    bare = rounds(NETWORKS[name][0] * 0.3, 7)
    parts = {"decode": 6.0, "plan": 0.3, "infer": bare[0] * 1.05, "encode": 2.0, "transport": 1.0}
    total = [value + 8.3 for value in bare]
    return {
        "bundle": name,
        "sha256": "0" * 64,
        "request": f"/shade/ao?quality={name}",
        "backend": "openvino/bf16",
        "bare_ms": spread(bare),
        "total_ms": spread(total),
        "stages_ms": {stage: spread(rounds(ms, 8)) for stage, ms in parts.items()},
        "ratio": ratio(total, bare),
        "slowest": "decode",
    }


def client_rows(name: str) -> list[dict[str, Any]]:
    one = rounds(60.0, 11, 3)
    found = []
    for count, gain in ((1, 1.0), (2, 1.55), (4, 1.7), (8, 1.7)):
        many = [value * gain for value in one]
        middle = 1e3 * count / many[0]
        found.append(
            {
                "bundle": name,
                "backend": "openvino/bf16",
                "clients": count,
                "requests": 500,
                "refused": 0,
                "per_second": spread(many),
                "speedup": ratio(many, one),
                "median_ms": middle,
                "p95_ms": 1.4 * middle,
                "most_ms": 2.5 * middle,
                "most_of_median": 2.5,
            }
        )
    return found


def sizes() -> list[dict[str, Any]]:
    shapes = [(64, 64), (256, 256), (768, 512), (1024, 1024), (3840, 2160), (8192, 8192)]
    found = []
    for memory, few in ((8 * 2**30, shapes), (2**30, [(768, 512), (3840, 2160)])):
        for width, height in few:
            pixels = width * height
            found.append(
                {
                    "width": width,
                    "height": height,
                    "megapixels": pixels / 1e6,
                    "memory_setting": memory,
                    "body_bytes": 6 * pixels,
                    "server_ms": spread(rounds(1 + 30e-6 * pixels, 2)),
                    "client_ms": spread(rounds(2 + 31e-6 * pixels, 2)),
                    "ms_per_megapixel": 30 + 1e6 / pixels,
                    "stages_ms": {"decode": 1.0},
                    "tiles": "1",
                    "peak_above_idle": min(memory, 200 * pixels),
                    "idle": 2**28,
                    "idle_after": 2**28,
                }
            )
    return found


def savings() -> dict[str, Any]:
    shares = [1.0, 0.7, 0.4]
    rows = [
        {
            "bundle": "fast",
            "view": view,
            "scene": "room",
            "background": 1 - share,
            "known": 0,
            "tiles": 1,
            "computed_share": share,
            "whole_ms": 5.0,
            "infer_ms": 5 * share,
            "total_ms": 12.0,
            "plan_ms": 0.3,
            "of_full_ms": share,
            "saved_ms": 5 * (1 - share),
            "most_changed": 1e-6,
            "added_dssim": 1e-9,
        }
        for view, share in enumerate(shares)
    ]
    summary = {
        "bundle": "fast",
        "views": 3,
        "skipped_share": 0.3,
        "background": 0.3,
        "of_full_ms": spread(shares),
        "saved_ms": spread([5 * (1 - share) for share in shares]),
        "most_added_dssim": 1e-9,
        "most_changed": 1e-6,
    }
    channels = {"in_file": 24, "read": 6, "body_bytes": 10**7, "all_ms": spread([30.0])}
    return {
        "views": 3,
        "rows": rows,
        "summary": [summary],
        "channels": channels | {"read_ms": spread([8.0])},
    }
