"""Every figure that the dashboard and the alerts ask for is one that our services give."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from deepshade_service.telemetry import Telemetry as Service
from deepshade_trainer.service.store import QUEUED, RUNNING, Job, Store
from deepshade_trainer.service.telemetry import Telemetry as Trainer

_METRIC = re.compile(r"\bdeepshade_\w+")
_LABELS = re.compile(r"by \(([^)]*)\)|\{(\w+)=")


def store(folder: Path) -> Store:
    store = Store(f"sqlite:///{folder / 'jobs.db'}")
    store.prepare()
    for number, state in enumerate((QUEUED, RUNNING)):
        name = f"job{number}"
        facts = {"effect": "ao", "name": "balanced", "asked": {}, "sentence": "", "fix": ""}
        store.add(Job(id=name, key=name, state=state, place=1.0, created=1.0, begun=0, **facts))
    return store


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """Metric -> labels, of services of which each has done something."""
    service = Service(queued=lambda: 0, held=lambda: 0)
    service.answered("/shade/{effect}", 200)
    service.shaded("ao", {"infer": 1.0}, 1, 1, 1)
    event = {"phase": "training", "step": 1, "steps": 2, "loss": 0.1, "validation": {"dssim": 0.2}}
    event |= {"rate": 3.0, "left": 4.0}
    jobs = store(tmp_path_factory.mktemp("store"))
    folders = (tmp_path_factory.getbasetemp(), Path("/is/not/there"))
    text = service.render().decode() + Trainer(jobs, lambda _: event, folders).render().decode()
    jobs.close()
    assert text.count("disk_free_ratio{") == 1
    found: dict[str, set[str]] = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            found.setdefault(sample.name, set()).update(sample.labels)
    return found


def queries(root: Path) -> list[str]:
    dashboard = json.loads((root / "deploy/grafana/deepshade.json").read_text())
    rules = yaml.safe_load((root / "deploy/alerts.yml").read_text())["groups"][0]["rules"]
    shown = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    return [*shown, *(rule["expr"] for rule in rules)]


def test_each_query_s_metrics_and_labels_exist(root: Path, given: dict[str, set[str]]) -> None:
    asked = queries(root)
    assert len(asked) > 15
    for query in asked:
        names = _METRIC.findall(query)
        assert names or query.startswith("up{"), query
        assert set(names) <= set(given), query
        for grouped, filtered in _LABELS.findall(query):
            for label in filter(None, (*grouped.split(", "), filtered)):
                assert label == "job" or all(label in given[name] for name in names), query


def test_what_we_count_is_shown(root: Path, given: dict[str, set[str]]) -> None:
    shown = set(_METRIC.findall(" ".join(queries(root))))
    plain = {name for name in given if not name.endswith(("_created", "_bucket", "_count"))}
    # for other questions than those of a dashboard
    rest = {"deepshade_computed_pixels_total", "deepshade_trainer_job_left_seconds"}
    assert plain - shown <= rest


def test_the_file_is_what_the_script_writes(root: Path) -> None:
    from tests.deploy.conftest import script

    made: dict[str, Any] = script("scripts/dashboard.py").dashboard()
    assert json.loads((root / "deploy/grafana/deepshade.json").read_text()) == made


def test_without_its_database_the_trainer_says_so(tmp_path: Path) -> None:
    jobs = Store(f"sqlite:///{tmp_path / 'none' / 'jobs.db'}")
    text = Trainer(jobs, lambda _: None).render().decode()
    jobs.close()
    assert "deepshade_trainer_database_up 0.0" in text
    assert "deepshade_trainer_jobs" not in text
