"""Writes deploy/grafana/deepshade.json, the dashboard: python scripts/dashboard.py."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

OUT = Path(__file__).parents[1] / "deploy/grafana/deepshade.json"
_RATE = "[$__rate_interval]"
SOURCE = {"type": "prometheus", "uid": "prometheus"}

# title, unit, and pairs of query and legend; two a row
PANELS: tuple[tuple[str, str, tuple[tuple[str, str], ...]], ...] = (
    (
        "Requests by status",
        "reqps",
        ((f"sum by (status) (rate(deepshade_requests_total{_RATE}))", "{{status}}"),),
    ),
    (
        "Time of a stage, 95th percentile",
        "s",
        (
            (
                "histogram_quantile(0.95, sum by (stage, le) "
                f"(rate(deepshade_stage_seconds_bucket{_RATE})))",
                "{{stage}}",
            ),
        ),
    ),
    (
        "Mean time of the network by effect",
        "s",
        (
            (
                f'sum by (effect) (rate(deepshade_stage_seconds_sum{{stage="infer"}}{_RATE})) / '
                f'sum by (effect) (rate(deepshade_stage_seconds_count{{stage="infer"}}{_RATE}))',
                "{{effect}}",
            ),
        ),
    ),
    (
        "Megapixels a second by effect",
        "none",
        ((f"sum by (effect) (rate(deepshade_pixels_total{_RATE})) / 1e6", "{{effect}}"),),
    ),
    (
        "Being shaded or waiting",
        "none",
        (("sum(deepshade_jobs)", "pictures"),),
    ),
    (
        "Memory",
        "bytes",
        (
            ("deepshade_resident_bytes", "service"),
            ("deepshade_upload_bytes", "bodies held"),
            ("deepshade_trainer_resident_bytes", "trainer"),
        ),
    ),
    (
        "Pixels that weren't finite, by effect",
        "none",
        ((f"sum by (effect) (rate(deepshade_nonfinite_pixels_total{_RATE}))", "{{effect}}"),),
    ),
    (
        "Fine-tuning jobs",
        "none",
        (("deepshade_trainer_jobs", "{{state}}"),),
    ),
    (
        "Loss of what is training, and DSSIM where it was validated",
        "none",
        (
            ("deepshade_trainer_job_loss", "{{job}} loss"),
            ("deepshade_trainer_job_dssim", "{{job}} DSSIM"),
        ),
    ),
    (
        "How far it is",
        "percentunit",
        (("deepshade_trainer_job_step / deepshade_trainer_job_steps", "{{job}} {{phase}}"),),
    ),
    (
        "Steps a second",
        "none",
        (("deepshade_trainer_job_steps_per_second", "{{job}}"),),
    ),
    (
        "Published, and the wait of the first in the queue",
        "none",
        (
            ("deepshade_trainer_published_total", "published"),
            ("deepshade_trainer_oldest_seconds", "seconds"),
        ),
    ),
    (
        "Free on the disks",
        "percentunit",
        (("deepshade_trainer_disk_free_ratio", "{{folder}}"),),
    ),
)


def dashboard() -> dict[str, Any]:
    """Grafana's model of it (schema 39)."""
    panels = [
        {
            "id": number + 1,
            "type": "timeseries",
            "title": title,
            "datasource": SOURCE,
            "gridPos": {"x": 12 * (number % 2), "y": 8 * (number // 2), "w": 12, "h": 8},
            "fieldConfig": {"defaults": {"unit": unit, "min": 0}, "overrides": []},
            "targets": [
                {"refId": chr(65 + k), "datasource": SOURCE, "expr": expr, "legendFormat": legend}
                for k, (expr, legend) in enumerate(queries)
            ],
        }
        for number, (title, unit, queries) in enumerate(PANELS)
    ]
    return {
        "uid": "deepshade",
        "title": "deepshade",
        "schemaVersion": 39,
        "editable": False,
        "refresh": "30s",
        "time": {"from": "now-3h", "to": "now"},
        "panels": panels,
    }


if __name__ == "__main__":
    OUT.write_text(json.dumps(dashboard(), indent=1) + "\n")
