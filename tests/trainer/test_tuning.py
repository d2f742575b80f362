"""Fine-tuning: what is learnt from, what judges, and what comes of it, whatever is killed."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats

from deepshade.bundles import Bundle
from deepshade.errors import ConfigError, DataError
from deepshade.files import sha256
from deepshade.manifest import Manifest
from deepshade_trainer.dataset import Dataset
from deepshade_trainer.run import Run
from deepshade_trainer.tuning import events, shipped
from deepshade_trainer.tuning import finetune as tuning
from deepshade_trainer.tuning.finetune import finetune
from deepshade_trainer.tuning.finished import candidate
from deepshade_trainer.tuning.parts import Parts
from deepshade_trainer.tuning.plan import Plan
from deepshade_trainer.tuning.steps import own_parts
from deepshade_trainer.tuning.verdict import FILE, Paired, Verdict

from .conftest import write_data


def test_the_interval_is_that_of_a_paired_t_test() -> None:
    rng = np.random.default_rng(3)
    base = rng.uniform(0.02, 0.06, 9)
    after = base * rng.uniform(0.7, 1.0, 9)
    found = Paired.of(base.tolist(), after.tolist())
    low, high = stats.ttest_rel(after, base).confidence_interval(0.95)
    assert (found.low, found.high) == pytest.approx((low, high))
    assert found.change == pytest.approx(after.mean() / base.mean() - 1)


def verdict(**changes: object) -> Verdict:
    better = Paired.of([0.05, 0.04, 0.06, 0.05], [0.04, 0.033, 0.049, 0.041])
    same = Paired.of([0.03, 0.04], [0.0302, 0.0401])
    return replace(Verdict(better, {"test": same}, 1.0, 0.03, 1.1), **changes)  # type: ignore[arg-type]


def test_better_has_to_be_sure_and_to_cost_little() -> None:
    assert verdict().better
    unsure = Paired.of([0.05, 0.04, 0.06, 0.05], [0.03, 0.05, 0.04, 0.052])
    assert unsure.difference < 0
    cases = {
        "surely": {"own": unsure},
        "worse": {"test": {"test": Paired.of([0.03, 0.04], [0.033, 0.041])}},
        "as long": {"speed": 1.2},
        "0 % are": {"worse": 0.0},
    }
    for said, change in cases.items():
        found = verdict(**change)
        assert not found.better
        assert said in found.sentence()
        json.dumps(found.document(), allow_nan=False)


@pytest.mark.parametrize(("slow", "timings", "ratio"), [(1, 2, 1.0), (9, 3, 1.5)])
def test_a_candidate_that_seems_slow_is_timed_again(
    monkeypatch: pytest.MonkeyPatch, slow: int, timings: int, ratio: float
) -> None:
    """Other work hits one timing; what is slow stays so."""
    made = []

    def alternate(tasks: Any, pace: Any) -> dict[str, dict[str, list[float]]]:
        made.append(1.5 if len(made) < slow else 1.0)
        return {"base": {"ms": [3.0, 2.0]}, "candidate": {"ms": [9.0, 2.0 * made[-1]]}}

    monkeypatch.setattr(tuning, "alternate", alternate)
    bundle = Bundle.load(Path(__file__).parents[2] / "models/ao/fast")
    assert tuning.speed(bundle, bundle, 1.1) == ratio
    assert len(made) == timings


def test_what_judges_is_never_learnt_and_stays_when_views_come(tmp_path: Path) -> None:
    few, many = (write_data(tmp_path / str(n), n) for n in (24, 40))
    plan = Plan(effect="ao", base="", name="balanced", data=(str(few),))
    parts = [Parts.of(Dataset([folder], "ao"), [str(folder)], plan.seed) for folder in (few, many)]
    for each, count in zip(parts, (24, 40), strict=True):
        assert sorted(each.learnt + each.judges) == list(range(count))
    assert len(parts[0].judges) == 6
    assert len(parts[1].judges) == 10
    other = Parts.of(Dataset([few], "ao"), [str(few)], 1)
    assert other.judges != parts[0].judges
    with pytest.raises(DataError, match="too few"):
        tiny = write_data(tmp_path / "tiny", 6)
        Parts.of(Dataset([tiny], "ao"), [str(tiny)], 0)


@pytest.mark.parametrize("share", [0.25, 0.5, 0.8])
def test_the_share_of_older_views_is_what_was_asked_for(tmp_path: Path, share: float) -> None:
    own, old = write_data(tmp_path / "own", 10), write_data(tmp_path / "old", 40)
    parts = Parts.of(Dataset([own, old], "ao"), [str(own)], 0)
    mixed = parts.mixed(share)
    rehearsed = sum(number >= 10 for number in mixed) / len(mixed)
    assert rehearsed == pytest.approx(share, abs=0.12)
    assert not set(mixed) & set(parts.judges + parts.reminders)


def test_a_stored_turn_is_not_turned_again(tmp_path: Path) -> None:
    folder = write_data(tmp_path / "data", 4)
    data = Dataset([folder], "ao")
    turns = {data.turn(0, np.random.default_rng(seed)) for seed in range(50)}
    assert turns == set(range(8))
    manifest = Manifest.read(folder)
    for shard in manifest.shards:
        for record in shard.samples:
            record["turn"] = 0
    manifest.write(folder)
    data = Dataset([folder], "ao")
    assert {data.turn(0, np.random.default_rng(seed)) for seed in range(50)} == {0}


def test_the_same_job_has_the_same_key_and_another_one_another(plan: Plan, tmp_path: Path) -> None:
    twin = write_data(tmp_path / "twin")  # the same views elsewhere
    assert replace(plan, data=(str(twin),)).key() == plan.key()
    other = write_data(tmp_path / "other", 26)
    changes = ({"seed": 1}, {"steps": 7}, {"data": (str(other),)}, {"rehearsal": (str(other),)})
    keys = {replace(plan, **change).key() for change in changes}  # type: ignore[arg-type]
    assert len(keys | {plan.key()}) == 5
    with pytest.raises(ConfigError, match="minutes must be from"):
        replace(plan, minutes=float("nan"))


@pytest.fixture(scope="module")
def finished(plan: Plan, tmp_path_factory: Any) -> tuple[Path, list[dict[str, Any]]]:
    """The folder of `plan`'s job, which nothing broke, and its events."""
    folder, threads = tmp_path_factory.mktemp("finished"), torch.get_num_threads()
    torch.set_num_threads(plan.threads)  # as the worker does: sums depend on it
    try:
        return folder, list(finetune(plan, folder))
    finally:
        torch.set_num_threads(threads)


@pytest.mark.slow
def test_a_job_ends_with_a_better_bundle_and_its_decision(
    plan: Plan, finished: tuple[Path, list[dict[str, Any]]]
) -> None:
    folder, found = finished
    steps = [each for each in found if each["phase"] == "training"]
    assert [each["step"] for each in steps] == list(range(plan.steps + 1))
    assert steps[-1]["left"] == 0
    assert Run(folder / "run").preview.read_bytes().startswith(b"\x89PNG")
    bundle = Bundle.load(candidate(folder, plan))
    decision = json.loads((bundle.path / FILE).read_text())
    assert decision == found[-1]["decision"]
    assert decision["better"]
    assert decision["own"]["high"] < 0
    assert decision["candidate"]["sha256"] == bundle.sha256
    assert "Fine-tuned" in (bundle.path / "README.md").read_text()
    # done is done: nothing is trained, or measured, again
    assert list(finetune(plan, folder)) == [{"phase": "judged", "decision": decision}]


@pytest.mark.slow
def test_what_cant_help_is_not_better(plan: Plan, tmp_path: Path) -> None:
    """Of noise nothing can be learnt."""
    rng = np.random.default_rng(0)
    folder = write_data(tmp_path / "noise", 10, reference=lambda shape: rng.random(shape))
    useless = replace(plan, data=(str(folder),), lr=1e-6, steps=2)
    decision = list(finetune(useless, tmp_path / "job"))[-1]["decision"]
    assert not decision["better"]
    assert decision["sentence"].startswith("not published: on views that neither saw it isn't")
    assert (candidate(tmp_path / "job", useless) / FILE).exists()


@pytest.mark.slow
def test_a_killed_job_ends_where_an_unbroken_one_does(
    plan: Plan, finished: tuple[Path, list[dict[str, Any]]], tmp_path: Path
) -> None:
    """`kill -9` in the middle of training, and again while the result is judged."""
    whole, parts = finished[0], tmp_path / "parts"
    plan.write(parts)

    def work() -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "deepshade_trainer.tuning.worker", str(parts)]
        return subprocess.Popen(command, stdin=subprocess.PIPE)

    for phase, step in (("training", 5), ("judging", -1)):
        with work() as process:
            until = time.monotonic() + 200
            while time.monotonic() < until and process.poll() is None:
                last = events.last_event(parts) or {"phase": ""}
                if last["phase"] == phase and last.get("step", -1) >= step:
                    break
                time.sleep(0.02)
            process.kill()
        assert not (candidate(parts, plan) / FILE).exists()
        with (parts / events.FILE).open("a") as file:
            file.write('{"half a li')  # as the kill may leave it
    with work() as process:
        assert process.wait(200) == 0
    models = [candidate(folder, plan) / "model.onnx" for folder in (whole, parts)]
    assert sha256(models[0]) == sha256(models[1])
    decisions = [json.loads((model.parent / FILE).read_text()) for model in models]
    for name in ("own", "test", "better", "steps", "blend"):
        assert decisions[0][name] == decisions[1][name]


def test_the_shipped_samples_are_test_sets(tmp_path: Path) -> None:
    """Both have a reference of ao, and what a network sees of them is what a request gives it."""
    folders = shipped.as_data(tmp_path, "ao")
    assert [folder.name for folder in folders] == ["foliage", "room"]
    data = Dataset(folders[:1], "ao")
    sample = data.load(0)
    assert sample["normal"].shape[1:] == sample["reference_ao"].shape[1:] == (384, 512)
    assert data.radius(0) == pytest.approx(0.5)
    again = shipped.as_data(tmp_path / "again", "ao")
    assert sha256(again[0] / "shard-00000.safetensors") == sha256(
        folders[0] / "shard-00000.safetensors"
    )


def test_parts_of_a_plan_are_of_its_own_views(plan: Plan) -> None:
    parts = own_parts(plan)
    assert parts.rehearsed == parts.reminders == []
    assert parts.mixed(0.5) == parts.learnt
