"""Sharing memory between requests, and giving it back."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from deepshade import exr
from deepshade.errors import ConfigError
from deepshade.machine import resident, trim
from deepshade_service.memory import MemoryBudget, parse_size
from deepshade_service.room import room_for


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
    engine = service.service.models.engine(service.service.models.candidate("ao"))
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
    engine = local.service.models.engine(local.service.models.candidate("ao"))
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


def test_the_part_with_the_most_pixels_counts(service, make_exr):
    """Not the widest one: either may turn out to be the one that is shaded."""
    engine = service.service.models.engine(service.service.models.candidate("ao"))
    wide, large = (exr.read_header(make_exr(*size)) for size in ((1, 101), (100, 100)))
    alone = room_for([large], engine, 2**30)
    together = room_for([wide, large], engine, 2**30)
    assert together.needed > alone.needed
    assert together.tile_bytes >= engine.bytes_per_pixel * 100 * 100
    assert together.max_pixels(engine) >= 100 * 100


def test_4k_stays_within_a_gibibyte_however_much_there_is(service, make_exr):
    from types import SimpleNamespace

    part = exr.read_header(make_exr(2, 2, half=True)).parts[0]
    part = replace(part, data_window=(0, 0, 3839, 2159), decoded_bytes=2160 * 3840 * 12)
    header = exr.Header((part,), body_bytes=60 * 2**20)
    bundle = service.service.models.engine(service.service.models.candidate("ao")).bundle
    engine = SimpleNamespace(bundle=bundle, channels=6, bytes_per_pixel=150)
    for total in (2**30, 2**33):
        room = room_for([header], engine, total)
        assert room.needed <= 2**30
        assert room.max_pixels(engine) > 2**20


def test_uploads_fit_the_machine(monkeypatch):
    from deepshade.errors import ConfigError
    from deepshade.exr import Limits
    from deepshade_service import config

    monkeypatch.setattr(config, "memory_bytes", lambda: 2 * config.GIB)
    small = config.Settings()
    assert small.uploads == config.GIB // 2
    assert small.limits.body_bytes == config.GIB // 4
    assert config.Settings(limits=Limits(body_bytes=5 * config.GIB)).uploads == 10 * config.GIB
    with pytest.raises(ConfigError, match="--max-uploads"):
        config.Settings(uploads=1000, limits=Limits(body_bytes=501))


def test_what_a_derivation_takes_is_counted(service, make_exr, make_picture, monkeypatch):
    """World-space attributes as half floats: read, converted, and beside them what they give."""
    import tracemalloc

    from deepshade.gbuffer import load_gbuffer

    channels = {
        name.replace(".", "_world."): plane for name, plane in make_picture(512, 512).items()
    }
    body = make_exr(
        channels, half=True, compression="none", attributes={"worldToCamera": np.eye(4)}
    )
    header = exr.read_header(body)
    engine = service.service.models.engine(service.service.models.candidate("ao"))
    monkeypatch.setattr(engine, "bytes_per_pixel", 1)  # as if the network took nothing
    needed = room_for([header], engine, 2**30).needed
    tracemalloc.start()
    load_gbuffer(body, ("normal", "position"), headers=[header])
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak <= needed - len(body)
