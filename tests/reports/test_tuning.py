"""The sweep finds better parameters, and what is shipped came out of it."""

from __future__ import annotations

import json
import math
import random
from dataclasses import fields, replace
from importlib.resources import files

import numpy as np
import pytest

from deepshade_report.baselines.ao import gtao, hbao, tuned, tuning
from deepshade_report.baselines.ao.horizons import open_field

from .walls import rubble

DEFAULTS = {"hbao": hbao.Parameters(), "gtao": gtao.Parameters()}


@pytest.mark.parametrize("subject", tuning.SUBJECTS, ids=lambda s: s.name)
def test_any_change_stays_within_its_range(subject: tuning.Subject) -> None:
    rng = random.Random(1)
    base = subject.published
    for reach in (math.inf, 0.5, 0.03):
        for _ in range(50):
            base = tuning._changed(base, subject.ranges, list(subject.ranges), reach, rng)
            for name, (low, high, _) in subject.ranges.items():
                assert low * 0.999 <= getattr(base, name) <= high * 1.001
    assert isinstance(base.blur, int)


@pytest.mark.slow
def test_a_sweep_comes_near_what_the_reference_was_made_with() -> None:
    at = (4, 4)
    view = rubble()
    subject = replace(tuning.SUBJECTS[0], at=at, settings=[at])
    hidden = hbao.Parameters(intensity=2.0, power=2.0, bias=0.3)
    view = replace(view, reference=subject.shade(open_field(view), *at, hidden))
    found = tuning.tune(subject, [view], seconds=4.0, seed=3, windows=1)
    assert found["trials"] > 3
    assert found["windows"]["ssim"] > found["windows"]["published"] + 0.01
    assert found["table"][0]["ssim"] == pytest.approx(found["windows"]["ssim"], abs=1e-4)


@pytest.mark.parametrize("name", DEFAULTS)
def test_what_is_shipped_is_the_outcome_of_a_sweep(name: str) -> None:
    shipped = json.loads((files("deepshade_report") / "baselines/ao/tuned.json").read_text("utf-8"))
    outcome = shipped[name]
    assert {field.name for field in fields(DEFAULTS[name])} == set(tuned.parameters(name))
    assert outcome["windows"]["ssim"] > outcome["windows"]["published"]
    subject = next(s for s in tuning.SUBJECTS if s.name == name)
    assert [tuple(row["setting"]) for row in outcome["table"]] == list(subject.settings)
    assert all(np.isfinite(row["ssim"]) for row in outcome["table"])
    assert all("deepshade_report.baselines.ao.tuning" in command for command in outcome["commands"])
