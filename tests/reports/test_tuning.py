"""The search finds better parameters, within their ranges."""

from __future__ import annotations

import math
import random
from dataclasses import fields, replace
from functools import partial
from importlib import import_module

import pytest

from deepshade.effects import EFFECTS
from deepshade.errors import DeepshadeError

from .walls import rubble

try:
    from deepshade_report import baselines, tuning
    from deepshade_report.baselines.ao import gtao, hbao
except (ModuleNotFoundError, DeepshadeError) as error:  # no Dr.Jit or no libLLVM
    pytest.skip(f"no compiled kernels here: {error}", allow_module_level=True)

SUBJECTS = {"hbao": hbao.TUNABLE, "gtao": gtao.TUNABLE}


@pytest.mark.parametrize("name", SUBJECTS)
def test_any_change_stays_within_its_range(name: str) -> None:
    rng, subject = random.Random(1), SUBJECTS[name]
    base = subject.published
    for reach in (math.inf, 0.5, 0.03):
        for _ in range(50):
            base = tuning.changed(base, subject.ranges, list(subject.ranges), reach, rng)
            for entry, (low, high) in subject.ranges.items():
                assert low * 0.999 <= getattr(base, entry) <= high * 1.001
    assert isinstance(base.blur, int)


def test_a_range_that_may_be_too_narrow_is_named() -> None:
    subject = SUBJECTS["gtao"]
    inner = {name: sum(ends) / 2 for name, ends in subject.ranges.items()}
    base = replace(subject.published, **inner)
    assert tuning.at_ends(base, subject.ranges) == []
    low, high = (replace(base, spread=end) for end in subject.ranges["spread"])
    assert tuning.at_ends(low, subject.ranges) == ["spread 1.0"]
    assert tuning.at_ends(high, subject.ranges) == ["spread 2.5"]


@pytest.mark.slow
def test_a_search_comes_near_what_the_reference_was_made_with() -> None:
    view, subject = rubble(), replace(hbao.TUNABLE, make=partial(hbao.hbao, 4, 4))
    hidden = hbao.hbao(4, 4, replace(hbao.PUBLISHED, intensity=2.0, power=2.0, bias=0.3))
    hidden.prepare(view)
    view = replace(view, reference=hidden.shade(view)[None])
    found = tuning.tune(subject, [view], seconds=4.0, seed=3)
    assert found["trials"] > 3
    assert found["dssim"]["tuned"] < found["dssim"]["published"] - 0.005


@pytest.mark.parametrize("effect", EFFECTS)
def test_what_is_shipped_names_every_parameter_within_its_range(effect: str) -> None:
    for name in getattr(baselines.folder(effect), "METHODS", {}).values():
        package = f"{baselines.__name__}.{effect}"
        if subject := getattr(import_module(f"{package}.{name}"), "TUNABLE", None):
            shipped = tuning.tuned(package, name)
            assert {field.name for field in fields(subject.published)} == set(shipped)
            for entry, (low, high) in subject.ranges.items():
                assert low <= shipped[entry] <= high
