"""Sharing memory between requests, and giving it back."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from deepshade.errors import ConfigError
from deepshade_service.memory import MemoryBudget, parse_size, resident, trim


@pytest.mark.parametrize(
    ("text", "size"),
    [("512M", 2**29), ("2g", 2**31), ("1.5 GiB", 3 * 2**29), ("100", 100), ("64kb", 2**16)],
)
def test_sizes(text, size):
    assert parse_size(text) == size


@pytest.mark.parametrize("text", ["", "-1", "two", "1x", "1e9"])
def test_bad_sizes(text):
    with pytest.raises(ConfigError, match="is no size"):
        parse_size(text)


def test_the_budget_makes_requests_wait():
    budget = MemoryBudget(100)
    order = []

    def second():
        with budget.hold(60):
            order.append("second")

    with budget.hold(60):
        thread = threading.Thread(target=second)
        thread.start()
        with budget.hold(40):
            order.append("beside")
        order.append("first")
    thread.join(5)
    assert order == ["beside", "first", "second"]
    with budget.hold(10**9):  # never more than there is
        pass


def test_waiting_for_memory_can_be_given_up():
    budget = MemoryBudget(100)
    cancelled = threading.Event()
    cancelled.set()
    with budget.hold(100), budget.hold(50, cancelled):
        pass
    with budget.hold(100):
        pass


def test_an_engine_gives_its_memory_back(service):
    engine = service.service.models.pick("ao")
    engine.shrink()
    trim()
    before = resident()
    engine.predict(np.zeros((1, 6, 1024, 1024), np.float32))
    grown = resident() - before
    assert grown > 50 * 2**20
    engine.shrink()
    trim()
    assert resident() - before < 0.2 * grown


def test_an_idle_service_gives_its_memory_back(start, make_exr):
    local = start(idle_trim=0.1)
    calls = []
    engine = local.service.models.pick("ao")
    shrink = engine.shrink
    engine.shrink = lambda: (calls.append(time.monotonic()), shrink())
    local.client.post(
        "/shade/ao", content=make_exr(16, 16), headers={"Content-Type": "image/x-exr"}
    )
    deadline = time.monotonic() + 5
    while not calls:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    time.sleep(0.3)
    assert len(calls) == 1  # once, not again and again
