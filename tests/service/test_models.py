"""Which bundles there are, which one a request gets, and which engines are in memory."""

from __future__ import annotations

import asyncio
import logging
import threading

import pytest

from deepshade.bundles import Bundle
from deepshade.engines import REFERENCE, available, choose
from deepshade_service import models as models_module
from deepshade_service.models import Models, key_of
from deepshade_service.parameters import ShadeParameters
from deepshade_service.problems import Problem
from deepshade_service.selection import allowed, select

EXR = {"Content-Type": "image/x-exr"}
BUNDLES = 27


@pytest.fixture
def root(tmp_path, make_bundle):
    """Three bundles, by error not as by name."""
    for name, error in (("fast", 0.3), ("balanced", 0.2), ("best", 0.1)):
        make_bundle(tmp_path / "ao" / name, dssim=error)
    return tmp_path


@pytest.fixture
def many(tmp_path, make_bundle):
    """As many bundles as nine effects have."""
    for n in range(BUNDLES):
        make_bundle(tmp_path / "ao" / f"b{n}")
    return tmp_path


@pytest.fixture
def three(root):
    models = Models(root, threads=1, pinned=("onnxruntime", None))
    asyncio.run(models.load())
    return models


@pytest.fixture
def loads(monkeypatch):
    """The bundles of which an engine was loaded, in turn."""
    made: list[str] = []
    load = models_module.load_engine

    def counted(bundle, backend, *, threads):
        made.append(bundle.name)
        return load(bundle, backend, threads=threads)

    monkeypatch.setattr(models_module, "load_engine", counted)
    return made


def test_ready_with_many_bundles_and_no_engine_until_it_is_asked_for(start, many, loads, make_exr):
    local = start(models=many)
    assert len(local.client.get("/readyz").json()["bundles"]) == BUNDLES
    assert len(local.client.get("/effects/ao").json()["bundles"]) == BUNDLES
    explained = local.client.post("/shade/ao?explain=1", content=make_exr(8, 8), headers=EXR)
    assert explained.json()["bundle"] == "b0"
    assert loads == []
    for _ in range(2):
        answer = local.client.post("/shade/ao?bundle=b7", content=make_exr(8, 8), headers=EXR)
        assert answer.status_code == 200
    assert loads == ["b7"]


def test_effects_are_stable_while_bundles_are_verified(start, root, monkeypatch):
    gate, load = threading.Event(), Bundle.load
    monkeypatch.setattr(Bundle, "load", classmethod(lambda cls, path: gate.wait(20) and load(path)))
    local = start(ready=False, models=root)
    for _ in range(3):
        answer = local.client.get("/effects")
        assert answer.status_code == 200
        assert all(effect["bundles"] == [] for effect in answer.json())
    assert local.client.get("/readyz").status_code == 503
    gate.set()
    local.wait()
    assert len(local.client.get("/effects/ao").json()["bundles"]) == 3


def test_loading_stops_when_the_service_does(start, many, monkeypatch, wait_until):
    gate, begun, load = threading.Event(), [], Bundle.load

    def slow(cls, path):
        begun.append(path)
        assert gate.wait(20)
        return load(path)

    monkeypatch.setattr(Bundle, "load", classmethod(slow))
    local = start(ready=False, models=many)
    wait_until(lambda: begun)
    stopping = threading.Thread(target=local.stop)
    stopping.start()
    wait_until(lambda: local._server.lifespan.shutdown_event.is_set())
    gate.set()
    stopping.join(20)
    assert len(begun) == 1


def test_one_engine_is_loaded_once_and_others_are_not_held_up(start, root, monkeypatch, make_exr):
    gate, load, made = threading.Event(), models_module.load_engine, []

    def slow(bundle, backend, *, threads):
        made.append(bundle.name)
        assert bundle.name != "best" or gate.wait(20)
        return load(bundle, backend, threads=threads)

    monkeypatch.setattr(models_module, "load_engine", slow)
    local = start(models=root, workers=1)
    statuses = []

    def shade(name):
        body = make_exr(8, 8)
        answer = local.client.post(f"/shade/ao?bundle={name}", content=body, headers=EXR)
        statuses.append(answer.status_code)

    waiting = [threading.Thread(target=shade, args=("best",)) for _ in range(3)]
    for thread in waiting:
        thread.start()
    shade("fast")  # with one worker, and while 'best' is being loaded
    assert statuses == [200]
    gate.set()
    for thread in waiting:
        thread.join(20)
    assert statuses == [200] * 4
    assert sorted(made) == ["best", "fast"]


def test_a_bundle_that_can_not_be_loaded_spoils_only_its_own_requests(
    start, root, monkeypatch, make_exr, caplog
):
    load = models_module.load_engine

    def broken(bundle, backend, *, threads):
        if bundle.name == "best":
            raise RuntimeError("secret: no such operator")
        return load(bundle, backend, threads=threads)

    monkeypatch.setattr(models_module, "load_engine", broken)
    local = start(models=root)
    for _ in range(2):
        answer = local.client.post("/shade/ao?bundle=best", content=make_exr(8, 8), headers=EXR)
        assert answer.status_code == 500
        assert answer.json()["type"].endswith("bad-bundle")
        assert "ao/best" in answer.json()["detail"]
        assert "secret" not in answer.text
    assert "no such operator" in caplog.text
    assert local.client.post("/shade/ao", content=make_exr(8, 8), headers=EXR).status_code == 200


def test_engines_in_memory_are_bounded(three, loads, monkeypatch):
    monkeypatch.setattr(models_module, "MAX_ENGINES", 2)

    async def use():
        backend = REFERENCE
        bundles = {bundle.name: bundle for bundle in three.find("ao")}
        speed = await three.ms_per_megapixel(bundles["fast"], backend)
        for name in ("best", "fast", "balanced", "fast", "best"):
            engine = await three.engine(bundles[name], backend)
            assert engine.bundle.name == name
        assert len(three.engines()) == 2
        # a time once taken stays, so that the same request gets the same bundle
        assert await three.ms_per_megapixel(bundles["fast"], backend) == speed

    asyncio.run(use())
    assert loads == ["fast", "best", "balanced", "best"]  # what was used longest ago goes


def test_what_can_not_be_had(three, root):
    for arguments, status, kind in (
        (("oa",), 404, "unknown-effect"),
        (("gi",), 404, "no-bundle"),
        (("ao", "bst"), 404, "no-bundle"),
    ):
        with pytest.raises(Problem) as caught:
            three.find(*arguments)
        assert (caught.value.status, caught.value.kind) == (status, kind)
    with pytest.raises(Problem) as caught:
        Models(root, threads=1).find("ao")
    assert caught.value.status == 503


def test_backends_are_by_rule_unless_pinned(three, root):
    def backend(models, **pins):
        return allowed(models, "ao", ShadeParameters(**pins))[0][1]

    assert backend(three) == REFERENCE  # as this service was started
    plain = Models(root, threads=1)
    asyncio.run(plain.load())
    assert backend(plain) == choose(plain.find("ao")[0])
    for one in available():
        if one.precision != "int8":  # for which these bundles hold no ranges
            assert backend(plain, engine=one.engine, precision=one.precision) == one
            assert backend(three, engine=one.engine).engine == one.engine
    for pins in ({"engine": "abacus"}, {"engine": "onnxruntime", "precision": "bf16"}):
        with pytest.raises(Problem) as caught:
            backend(plain, **pins)
        assert (caught.value.status, caught.value.kind) == (422, "no-backend")
        assert caught.value.more["available"] == [str(one) for one in available()]


def chosen(models, megapixels=1.0, **asked):
    """The bundle that a picture gets of which so much has to be computed."""
    parameters = ShadeParameters(**asked)
    candidates = allowed(models, "ao", parameters)
    sizes = {bundle.name: megapixels for bundle, _ in candidates}
    return asyncio.run(select(models, candidates, parameters, sizes)).bundle.name


def test_a_name_chooses(three):
    assert chosen(three) == "balanced"
    assert chosen(three, quality="fast") == "fast"
    assert chosen(three, bundle="best") == "best"
    with pytest.raises(Problem, match="different bundles"):
        chosen(three, quality="best", bundle="fast")


def test_without_a_default_the_least_error_is_chosen(tmp_path, make_bundle):
    for name, error in (("a", 0.05), ("z", 0.03)):
        make_bundle(tmp_path / "ao" / name, dssim=error)
    models = Models(tmp_path, threads=1, pinned=("onnxruntime", None))
    asyncio.run(models.load())
    assert chosen(models) == "z"


def test_an_error_chooses_what_is_just_good_enough(three, loads):
    assert chosen(three, max_error=0.25) == "balanced"
    assert chosen(three, max_error=0.2) == "balanced"
    assert chosen(three, max_error=1) == "fast"
    with pytest.raises(Problem) as caught:
        chosen(three, max_error=0.06)
    more = caught.value.more
    assert (more["asked"], more["best"]) == (0.06, 0.1)
    assert more["short_by"] == pytest.approx(0.04)
    assert "max_error=0.1" in more["fix"]
    assert loads == []


def test_a_time_chooses_the_most_accurate_that_keeps_it(three):
    speeds = {"fast": 10.0, "balanced": 100.0, "best": 1000.0}
    for bundle in three.find("ao"):
        three._speeds[*key_of(bundle), REFERENCE] = speeds[bundle.name]
    assert chosen(three, megapixels=0.5, budget_ms=500) == "best"
    assert chosen(three, megapixels=0.5, budget_ms=499) == "balanced"
    assert chosen(three, megapixels=0.5, budget_ms=5) == "fast"
    assert chosen(three, megapixels=0.5, budget_ms=60, max_error=0.2) == "balanced"
    assert chosen(three, megapixels=0.5, budget_ms=60, bundle="fast") == "fast"
    with pytest.raises(Problem) as caught:
        chosen(three, megapixels=0.5, budget_ms=4)
    more = caught.value.more
    assert (caught.value.kind, more["asked"], more["best"]) == ("budget-too-small", 4, 5.0)
    assert more["short_by"] == pytest.approx(1)
    with pytest.raises(Problem) as caught:
        chosen(three, megapixels=0.5, budget_ms=60, max_error=0.15)
    assert caught.value.kind == "error-too-small"


def test_a_time_is_taken_while_warming_up(start, root, loads, make_exr):
    local = start(models=root)
    answer = local.client.post("/shade/ao?budget_ms=1e6", content=make_exr(8, 8), headers=EXR)
    assert answer.headers["deepshade-bundle"] == "best"
    assert sorted(loads) == ["balanced", "best", "fast"]


def test_the_log_says_what_came_from_where_and_what_is_hidden(tmp_path, make_bundle, caplog):
    for place in ("mine/ao/fast", "others/ao/fast", "others/ao/best"):
        make_bundle(tmp_path / place)
    models = Models((tmp_path / "mine", tmp_path / "others"), threads=1)
    with caplog.at_level(logging.INFO, "deepshade.service"):
        asyncio.run(models.load())
    assert {bundle.path.parts[-3:] for bundle in models.bundles("ao")} == {
        ("mine", "ao", "fast"),
        ("others", "ao", "best"),
    }
    lines = [record.getMessage() for record in caplog.records]
    assert f"{tmp_path / 'others' / 'ao' / 'fast'} isn't served" in lines[0]
    assert [line.rpartition(" from ")[2] for line in lines[1:]] == [
        str(tmp_path / "others"),
        str(tmp_path / "mine"),
    ]
