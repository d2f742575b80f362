"""What is measured of each backend, how it is kept, and what follows from it."""

from __future__ import annotations

import json
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from deepshade import metrics
from deepshade.bundles import Bundle, write_config
from deepshade.engines import REFERENCE, Backend, EngineError, usable
from deepshade.machine import cpu_kind
from deepshade.probe import write_probe
from deepshade_service import measurement
from deepshade_service.calibration import Calibration, chosen_path
from deepshade_service.candidate import fastest
from deepshade_service.measurement import Measurement, published, published_added
from deepshade_service.models import Models

BF16, INT8 = Backend("openvino", "bf16"), Backend("openvino", "int8")


@pytest.fixture
def bundle(tmp_path, make_bundle) -> Bundle:
    """The tests' small network with a probe, and errors in its metrics."""
    folder = tmp_path / "models" / "ao" / "probed"
    rng = np.random.default_rng(0)
    windows = [
        (rng.normal(size=(6, 16, 16)).astype(np.float32), rng.uniform(size=(1, 16, 16)))
        for _ in range(2)
    ]
    error = {"test-real": {"exact": {"dssim": 0.04}}, "other": {"exact": {"dssim": 0.5}}}
    make_bundle(folder)
    write_probe(folder / "probe.exr", "ao", windows)
    config = json.loads((folder / "config.json").read_text())
    keys = ("effect", "name", "inputs", "outputs", "radius", "fov", "size_multiple", "halo")
    return write_config(folder, **{key: config[key] for key in keys}, metrics={"error": error})


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(measurement, "_SIZES", ((16, 16), (32, 32)))


def test_what_the_bundles_own_tests_found_counts_if_it_is_more(bundle):
    """Beside itself the probe finds nothing added."""
    for added, expected in ((0.05, 0.05), (-0.05, 0.0), (float("nan"), 0.0)):
        tests = {"a": {str(REFERENCE): {"added": added}}, "b": {str(REFERENCE): {}}, "c": None}
        metrics = {**bundle.metrics, "backends": {cpu_kind(): {"tests": tests}, "b": None}}
        known = replace(bundle, metrics=metrics)
        (found,) = Calibration(None, threads=1).measure(known, [REFERENCE])
        assert found.added == pytest.approx(expected)
        assert found.dssim == pytest.approx(0.04 * (1 + expected))


def test_tests_on_another_kind_of_cpu_count_where_there_are_none_on_this(bundle):
    def added(**kinds):
        found = {kind: {"tests": {"t": {str(INT8): {"added": a}}}} for kind, a in kinds.items()}
        return published_added(replace(bundle, metrics={"backends": found}), INT8)

    here = cpu_kind()
    assert added(**{here: 0.01, "other": 0.3}) == 0.01
    assert added(other=0.3, third=0.2) == 0.3
    assert added(**{here: float("nan"), "other": 0.3}) == 0.3
    assert added() is None


def test_a_measurement_is_kept_and_found_again(bundle, tmp_path):
    path = tmp_path / "cache" / "c.json"
    first = Calibration(path, threads=1)
    assert first.missing(bundle)[0] == REFERENCE
    (found,) = first.measure(bundle, [REFERENCE])
    assert found.ms(0) >= 0 and found.ms(10**6) > 0
    assert (found.dssim, found.added) == (0.04, 0.0)
    again = Calibration(path, threads=1)
    assert again.get(bundle, REFERENCE) == found
    assert REFERENCE not in again.missing(bundle)
    # another machine's share, another graph or another engine is another measurement
    assert Calibration(path, threads=2).get(bundle, REFERENCE) is None
    other = replace(bundle, hashes={**bundle.hashes, "model.onnx": "1" * 64})
    assert again.get(other, REFERENCE) is None


def test_what_a_precision_adds_is_measured_on_the_probe(bundle, tmp_path, monkeypatch):
    """An engine that answers too dark by a third: its error by hand, relative to fp32's."""
    exact = measurement.load_engine(bundle, REFERENCE, threads=1)
    windows = measurement.probe.read_probe(bundle)

    class Dark:
        backend, channels = BF16, 6

        def __init__(self):
            self.bundle = bundle

        def warm(self):
            pass

        def prepare(self, height, width):
            pass

        def shrink(self):
            pass

        def predict(self, gbuffer):
            return exact.predict(gbuffer) * np.float32(2 / 3)

    monkeypatch.setattr(
        measurement,
        "load_engine",
        lambda b, backend, threads: exact if backend == REFERENCE else Dark(),
    )
    (found,) = Calibration(None, threads=1).measure(bundle, [BF16])
    errors = [
        [metrics.dssim(np.clip(exact.predict(g[None])[0] * factor, 0, 1), r) for g, r in windows]
        for factor in (1, 2 / 3)
    ]
    plain, dark = (np.mean(column) for column in errors)
    assert found.added == pytest.approx(dark / plain - 1, rel=1e-5)
    assert found.dssim == pytest.approx(0.04 * dark / plain, rel=1e-5)


def test_a_burst_of_other_work_decides_nothing(bundle, monkeypatch):
    """On a clock of its own, with one slow pass of each backend: the true costs are found."""
    now = [0.0]
    exact = measurement.load_engine(bundle, REFERENCE, threads=1)

    class Clocked:
        """Its memory is given back before the first pass and after each."""

        channels = 6

        def __init__(self, backend, seconds, slow):
            self.backend, self.bundle = backend, bundle
            self.seconds, self.slow, self.turn = seconds, slow, -1

        def warm(self):
            pass

        def prepare(self, height, width):
            pass

        def predict(self, gbuffer):
            pixels = gbuffer.shape[2] * gbuffer.shape[3]
            now[0] += self.seconds * pixels * (10 if self.turn == self.slow else 1)
            return exact.predict(gbuffer)

        def shrink(self):
            self.turn += 1

    costs = {REFERENCE: (5e-6, 2), BF16: (2e-6, 0), INT8: (3e-6, 1)}
    monkeypatch.setattr(
        measurement,
        "load_engine",
        lambda b, backend, threads: Clocked(backend, *costs[backend]),
    )
    monkeypatch.setattr(measurement.time, "perf_counter", lambda: now[0])
    found = Calibration(None, threads=1).measure(bundle, costs)
    assert {one.backend: one.ms(10**6) for one in found} == pytest.approx(
        {backend: 1e9 * seconds for backend, (seconds, _) in costs.items()}
    )
    assert fastest(found) == BF16


@pytest.mark.parametrize("text", ["", "[]", "{", '{"x": 3}', "\ufeff{}"])
def test_a_damaged_file_is_made_anew(bundle, tmp_path, text):
    path = tmp_path / "c.json"
    path.write_text(text)
    found = Calibration(path, threads=1)
    assert REFERENCE in found.missing(bundle)
    found.measure(bundle, [REFERENCE])
    assert Calibration(path, threads=1).get(bundle, REFERENCE) is not None


def test_damaged_entries_are_measured_again(bundle, tmp_path):
    path = tmp_path / "c.json"
    Calibration(path, threads=1).measure(bundle, [REFERENCE])
    (key,) = json.loads(path.read_text())
    for entry in ({}, {"fixed_ms": "x"}, 3, {"fixed_ms": True, "ms_per_megapixel": 1}):
        path.write_text(json.dumps({key: entry}))
        assert Calibration(path, threads=1).get(bundle, REFERENCE) is None


def test_a_file_that_cannot_be_written_is_no_failure(bundle, tmp_path):
    (tmp_path / "file").write_text("")
    found = Calibration(tmp_path / "file" / "c.json", threads=1)
    found.measure(bundle, [REFERENCE])
    assert found.get(bundle, REFERENCE) is not None


def test_a_backend_that_fails_is_left_out(bundle, tmp_path, monkeypatch):
    load = measurement.load_engine

    def refusing(bundle, backend, *, threads):
        if backend != REFERENCE:
            raise EngineError("this one is broken")
        return load(bundle, backend, threads=threads)

    monkeypatch.setattr(measurement, "load_engine", refusing)
    models = Models(tmp_path / "models", threads=1, calibration=tmp_path / "c.json")
    models.load()
    assert models.calibrating
    models.calibrate(threading.Event())
    assert not models.calibrating
    (only,) = models.candidates("ao")
    assert only.backend == REFERENCE
    assert only.default and only.calibrated


def test_cancelling_ends_it(bundle, tmp_path):
    cancelled = threading.Event()
    cancelled.set()
    found = Calibration(tmp_path / "c.json", threads=1)
    assert found.measure(bundle, usable(bundle), cancelled) == []
    models = Models(tmp_path / "models", threads=1, calibration=tmp_path / "c.json")
    models.load()
    models.calibrate(cancelled)
    assert not models.calibrating
    assert not (tmp_path / "c.json").exists()


def test_the_fastest_that_adds_little_is_chosen():
    def measured(backend, ms, added):
        return Measurement(backend, 0.0, ms, None, added)

    exact = measured(REFERENCE, 10, 0.0)
    assert fastest([exact, measured(BF16, 4, 0.02), measured(INT8, 2, 0.021)]) == BF16
    assert fastest([exact, measured(BF16, 4, -0.1)]) == BF16
    assert fastest([exact, measured(BF16, 4, None)]) == REFERENCE  # nobody knows its error
    assert fastest([measured(REFERENCE, 10, None)]) == REFERENCE
    assert fastest([]) is None


def test_the_published_error(bundle):
    assert published(bundle) == 0.04
    other = {"error": {"other": {"exact": {"dssim": 0.5}}}}
    assert published(replace(bundle, metrics=other)) == 0.5
    for broken in ({}, {"error": 3}, {"error": {"a": None}}, {"error": {"a": {"exact": {}}}}):
        assert published(replace(bundle, metrics=broken)) is None


def test_where_it_is_kept(monkeypatch, tmp_path):
    assert chosen_path("off") is None
    assert str(chosen_path("x/y.json")) == "x/y.json"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert chosen_path("") == tmp_path / "deepshade" / "calibration.json"


@pytest.mark.slow
def test_a_service_calibrates_itself_in_the_background(bundle, start, make_exr, monkeypatch):
    """Answers come at once, in fp32; later from what was measured to be best, and say so."""
    gate, measure = threading.Event(), Calibration.measure
    monkeypatch.setattr(
        Calibration, "measure", lambda *arguments: gate.wait(30) and measure(*arguments)
    )
    local = start(models=bundle.path.parents[1], calibration=bundle.path.parent / "c.json")
    models = local.service.models

    def shade(query=""):
        return local.client.post(
            f"/shade/ao{query}",
            content=make_exr(32, 32),
            headers={"Content-Type": "image/x-exr"},
        ).headers

    first = shade()
    assert models.calibrating
    assert (first["Deepshade-Engine"], first["Deepshade-Precision"]) == ("onnxruntime", "fp32")
    gate.set()
    deadline = time.monotonic() + 60
    while models.calibrating:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    chosen = models.candidate("ao")
    assert chosen.calibrated
    later = shade()
    found = Backend(later["Deepshade-Engine"], later["Deepshade-Precision"])
    assert found == chosen.backend
    for backend in usable(bundle):
        pinned = shade(f"?engine={backend.engine}&precision={backend.precision}")
        assert (pinned["Deepshade-Engine"], pinned["Deepshade-Precision"]) == (
            backend.engine,
            backend.precision,
        )
