"""Which bundles and backends there are, and which engines stay in memory."""

from __future__ import annotations

import json
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from deepshade.cli import main
from deepshade.engines import REFERENCE, Backend, usable
from deepshade_service import calibration, measurement
from deepshade_service import models as models_module
from deepshade_service.measurement import Measurement
from deepshade_service.models import Models
from deepshade_service.problems import Problem


@pytest.fixture
def root(tmp_path, make_bundle):
    """Two bundles: 'worse', first by name, and 'zbest'."""
    for name, error in (("worse", 0.05), ("zbest", 0.03)):
        metrics = {"error": {"test-real": {"exact": {"dssim": error}}}}
        make_bundle(tmp_path / "ao" / name, metrics=metrics)
    return tmp_path


@pytest.fixture
def plain(root):
    models = Models(root, threads=1)
    models.load()
    return models


def test_the_least_error_comes_first(plain):
    assert [bundle.name for bundle in plain.bundles("ao")] == ["zbest", "worse"]
    candidates = plain.candidates("ao")
    assert [c.bundle.name for c in candidates if c.default] == ["zbest", "worse"]
    assert candidates[0].backend == REFERENCE
    assert candidates[0].dssim == 0.03
    assert candidates[0].ms(10**6) is None  # nothing was measured
    assert not candidates[0].calibrated
    assert {c.backend for c in candidates} == set(usable(candidates[0].bundle))
    assert plain.candidate("ao").bundle.name == "zbest"
    assert plain.candidate("ao", "worse").bundle.name == "worse"
    assert plain.engine(plain.candidate("ao", "worse")).backend == REFERENCE


def test_what_can_not_be_had(plain, root):
    for arguments, status, kind in (
        (("oa",), 404, "unknown-effect"),
        (("gi",), 404, "no-bundle"),
        (("ao", "zbst"), 404, "no-bundle"),
        (("ao", None, "abacus"), 422, "no-backend"),
        (("ao", None, "onnxruntime", "bf16"), 422, "no-backend"),
    ):
        with pytest.raises(Problem) as caught:
            plain.candidate(*arguments)
        assert (caught.value.status, caught.value.kind) == (status, kind)
    with pytest.raises(Problem) as caught:
        Models(root, threads=1).candidates("ao")
    assert caught.value.status == 503


def test_pins(plain):
    for backend in usable(plain.bundles("ao")[0]):
        found = plain.candidate("ao", None, backend.engine, backend.precision)
        assert found.backend == backend
        assert found.default == (backend == REFERENCE)
    assert plain.candidate("ao", precision="fp32").backend == REFERENCE


def test_after_calibration_the_fastest_is_the_default(root, tmp_path, monkeypatch):
    """With made-up measurements, in which fp32 on the last engine is the fastest."""
    backends = usable(_loaded(root).bundles("ao")[0])
    chosen = [backend for backend in backends if backend.precision == "fp32"][-1]

    def measured(bundle, backends, *, threads, cancelled):
        return {
            backend: Measurement(backend, 0.0, 1.0 if backend == chosen else 5.0, None, None)
            for backend in backends
        }

    monkeypatch.setattr(calibration, "measure", measured)
    path = tmp_path / "c.json"
    models = Models(root, threads=1, calibration=path)
    models.load()
    assert models.candidate("ao").backend == REFERENCE  # until it is done
    models.calibrate(threading.Event())
    found = models.candidate("ao")
    assert (found.backend, found.default, found.calibrated) == (chosen, True, True)
    assert found.ms(2 * 10**6) == 2.0
    again = Models(root, threads=1, calibration=path)
    again.load()
    assert again.candidate("ao").backend == chosen
    assert [engine.backend for engine in again] == [chosen, chosen]


def test_pinned_engines_are_loaded_once_and_bounded(plain, monkeypatch):
    monkeypatch.setattr(models_module, "_PINNED", 1)
    made = []
    load = models_module.load_engine
    monkeypatch.setattr(
        models_module,
        "load_engine",
        lambda bundle, backend, *, threads: (
            made.append(backend) or load(bundle, backend, threads=threads)
        ),
    )
    pins = [one for one in plain.candidates("ao") if not one.default]
    for candidate in pins:
        with ThreadPoolExecutor(3) as pool:
            engines = list(pool.map(plain.engine, [candidate] * 3))
        assert len({id(engine) for engine in engines}) == 1
    assert len(made) == len(pins)
    assert len(list(plain)) <= 3  # two defaults and one pinned


@pytest.mark.slow
def test_bench_as_json_and_as_a_table(root, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(measurement, "_SIZES", ((16, 16), (32, 32)))
    monkeypatch.setattr(measurement, "_RUNS", 2)
    path = tmp_path / "kept" / "c.json"
    command = ["bench", "ao", "--models", str(root), "--bundle", "worse", "--threads", "1"]
    command += ["--calibration", str(path)]
    assert main([*command, "--device", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    found = {Backend(row["engine"], row["precision"]) for row in document["backends"]}
    assert found == set(usable(_loaded(root).bundles("ao")[1]))
    assert sum(row["default"] for row in document["backends"]) == 1
    for row in document["backends"]:
        assert (row["device_ms"] is None) == (row["engine"] == "openvino")
    assert not path.exists()
    assert main([*command, "--calibrate"]) == 0
    assert "onnxruntime" in capsys.readouterr().out
    assert len(json.loads(path.read_text())) == len(found)
    assert main(["bench", "nothing", "--models", str(root)]) == 2
    assert main([*command, "--calibration", "off", "--calibrate"]) == 2


def _loaded(root):
    models = Models(root, threads=1)
    models.load()
    return models
