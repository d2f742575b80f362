"""Streams skip checks only where these change nothing."""

from __future__ import annotations

import dataclasses

import numpy as np

from deepshade.gbuffer import GBuffer
from deepshade_service.live import trust
from deepshade_service.parameters import ShadeParameters

ASKED = ShadeParameters()


def one(**changed: object) -> GBuffer:
    attributes = {"normal": np.ones((3, 4, 4), np.float32)}
    plain = GBuffer(attributes, np.zeros((4, 4), np.bool_))
    return dataclasses.replace(plain, **changed)


def loads(
    checked: GBuffer, monkeypatch, seconds: list[float], kind: str = "float", **asked: bool
) -> list[bool]:
    """Which of the loads at these times were with checks."""
    kept, found = trust.Trust(), []

    def load(how: ShadeParameters) -> list[GBuffer]:
        found.append(not how.trust)
        return [dataclasses.replace(checked, derived={}) if how.trust else checked]

    for second in seconds:
        monkeypatch.setattr(trust.time, "monotonic", lambda second=second: second)
        kept.load(([["Z", kind]], 0), ASKED.model_copy(update=asked), load)
    return found


def test_checks_that_change_nothing_are_made_once_a_second(monkeypatch):
    found = loads(one(), monkeypatch, [10, 10.1, 10.9, 11.1, 11.2])
    assert found == [True, False, False, False, True, False, False]


def test_checks_that_find_something_are_made_of_every_frame(monkeypatch):
    changed = one(derived={"normal": "stored as n / 2 + 1 / 2; decoded"})
    assert loads(changed, monkeypatch, [10, 10.1, 12]) == [True, False, True, True]
    assert loads(one(), monkeypatch, [10, 10.1], strict=True) == [True, True]
    assert loads(one(), monkeypatch, [10, 10.1], trust=True) == [False, False]


def test_places_in_16_bits_are_checked_in_every_frame(monkeypatch):
    """Whether they are repaired depends on each frame's values."""
    deep = one(mapped={"depth": "Z"})
    assert loads(deep, monkeypatch, [10, 10.1], kind="half") == [True, True]
    assert loads(deep, monkeypatch, [10, 10.1], kind="float") == [True, False, False]


def test_what_is_the_same_is_so_in_every_number():
    other = np.ones((3, 4, 4), np.float32)
    assert trust._same([one()], [one()])
    other[2, 3, 3] = 2
    assert not trust._same([one()], [one(attributes={"normal": other})])
    assert not trust._same([one()], [one(warnings=("odd",))])
