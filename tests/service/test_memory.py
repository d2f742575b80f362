"""Sharing memory between requests, and giving it back."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import numpy as np
import pytest

from deepshade import exr
from deepshade.errors import ConfigError
from deepshade.machine import resident, trim
from deepshade_service.memory import MemoryBudget, need_of, parse_size


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


def test_the_budget_serves_who_comes_first():
    """Were small amounts let past, a large one would starve while there are always small ones."""
    order = []

    async def use(budget, name, amount, gate):
        async with budget.hold(amount):
            order.append(name)
            await gate.wait()

    async def scenario():
        budget, gates = MemoryBudget(100), {name: asyncio.Event() for name in "abcde"}
        users = []
        for name, amount in (("a", 60), ("b", 40), ("c", 90), ("d", 10), ("e", 10**9)):
            users.append(asyncio.create_task(use(budget, name, amount, gates[name])))
            await asyncio.sleep(0)
        gates["b"].set()
        for _ in range(5):
            await asyncio.sleep(0)
        assert order == ["a", "b"]  # 'd' would fit, but 'c' was there before
        for gate in gates.values():
            gate.set()
        await asyncio.gather(*users)
        assert order == ["a", "b", "c", "d", "e"]
        assert budget._free == budget.total

    asyncio.run(scenario())


@pytest.mark.parametrize("granted", [False, True])
def test_waiting_for_memory_can_be_given_up(granted):
    async def use(budget):
        async with budget.hold(50):
            await asyncio.sleep(10)

    async def scenario():
        budget = MemoryBudget(100)
        async with budget.hold(100):
            waiting = asyncio.create_task(use(budget))
            await asyncio.sleep(0)
            if not granted:
                waiting.cancel()
                await asyncio.sleep(0)
        waiting.cancel()  # when it has been granted, but before it could go on
        with pytest.raises(asyncio.CancelledError):
            await waiting
        assert budget._free == 100
        async with budget.hold(100):
            pass

    asyncio.run(scenario())


def test_an_engine_gives_its_memory_back(service):
    engine = service.engine()
    engine.shrink()
    trim()
    before = resident()
    engine.predict(np.zeros((1, 6, 1024, 1024), np.float32))
    grown = resident() - before
    assert grown > 50 * 2**20
    engine.shrink()
    trim()
    assert resident() - before < 0.2 * grown


def test_an_idle_service_gives_its_memory_back(start, make_exr, wait_until):
    local = start(idle_trim=0.1)
    calls = []
    engine = local.engine()
    shrink = engine.shrink
    engine.shrink = lambda: (calls.append(1), shrink())
    for count in (1, 2):
        local.client.post(
            "/shade/ao", content=make_exr(16, 16), headers={"Content-Type": "image/x-exr"}
        )
        wait_until(lambda count=count: len(calls) == count)
        local.run(asyncio.sleep(0.3))
        assert len(calls) == count  # once, not again and again


def test_the_part_with_the_most_pixels_counts(service, make_exr):
    """Not the widest one: either may turn out to be the one that is shaded."""
    bundle = service.engine().bundle
    wide, large = (exr.read_header(make_exr(*size)) for size in ((1, 501), (300, 300)))
    alone = need_of([large], bundle, 2**30)
    together = need_of([wide, large], bundle, 2**30)
    assert together.total > alone.total
    assert together.max_pixels == alone.max_pixels == 320 * 320


def test_4k_stays_within_a_gibibyte_however_much_there_is(service, make_exr):
    part = exr.read_header(make_exr(2, 2, half=True)).parts[0]
    part = replace(part, data_window=(0, 0, 3839, 2159), decoded_bytes=2160 * 3840 * 12)
    header = exr.Header((part,), body_bytes=60 * 2**20)
    bundle = replace(service.engine().bundle, bytes_per_pixel=150)
    for total in (2**30, 2**33):
        need = need_of([header], bundle, total)
        assert need.total <= 2**30
        assert need.max_pixels > 2**20


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


def test_what_a_derivation_takes_is_counted(service, make_exr, make_picture):
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
    bundle = replace(service.engine().bundle, bytes_per_pixel=1)  # as if it took nothing
    needed = need_of([header], bundle, 2**30).total
    tracemalloc.start()
    load_gbuffer(body, ("normal", "position"), headers=[header])
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak <= needed - len(body)


def test_what_several_effects_decode_is_counted(service, make_exr, make_picture):
    """Together, and one by one where a NaN parts them: what was decoded before is gone by then."""
    import tracemalloc

    from deepshade.effects import EFFECTS
    from deepshade.gbuffer import load_gbuffers

    tiny = replace(service.engine().bundle, bytes_per_pixel=1)
    rows = [EFFECTS[name] for name in ("ao", "sss")]
    bundles = [replace(tiny, effect=row.name, inputs=row.inputs) for row in rows]
    rng = np.random.default_rng(0)
    channels = make_picture(512, 512)
    for layer in ("light", "scatter"):
        channels |= {f"{layer}.{c}": rng.random((512, 512), np.float32) for c in "RGB"}
    for nan in (False, True):
        channels["light.R"][0, 0] = np.nan if nan else 1
        body = make_exr(channels, half=True, compression="none")
        header = exr.read_header(body)
        needed = max(need_of([header], bundle, 2**30, bundles).total for bundle in bundles)
        tracemalloc.start()
        for gbuffer in load_gbuffers(body, [row.inputs for row in rows], headers=[header]):
            assert gbuffer.nonfinite == (nan and "light" in gbuffer.attributes)
            del gbuffer
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak <= needed - len(body)
