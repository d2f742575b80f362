"""The plan of real requests: what it says, that it is kept, and that it changes no pixel."""

from __future__ import annotations

import json
import threading
from dataclasses import replace

import numpy as np
import pytest

from deepshade import exr
from deepshade.effects import EFFECTS
from deepshade.gbuffer import load_gbuffer
from deepshade_service import shading
from deepshade_service.parameters import ShadeParameters
from deepshade_service.planner import Plan, Scene
from deepshade_service.tiles import plan_tiles

EXR = {"Content-Type": "image/x-exr"}
NEVER = threading.Event()


def shade(client, body, query=""):
    return client.post(f"/shade/ao{query}", content=body, headers=EXR)


@pytest.fixture(scope="module")
def half(make_picture, make_exr):
    """A picture whose left 60 % are background, with channels that no shader reads."""
    channels = make_picture(256, 480)
    for plane in channels.values():
        plane[:, :288] = 0
    for name in "RGB":
        channels[name] = np.ones((256, 480), np.float32)
    return make_exr(channels, half=True, attributes={"deepshade:fov": 50.0})


def test_explain_is_the_plan_that_the_answers_header_holds(client, half):
    explained = shade(client, half, "?explain=1&bundle=tiny&radius=0.25")
    assert explained.headers["content-type"] == "application/json"
    plan = explained.json()
    answer = shade(client, half, "?bundle=tiny&radius=0.25")
    assert json.loads(exr.read_header(answer.content).parts[0].attributes["deepshade:plan"]) == plan

    assert plan["effect"] == "ao"
    assert plan["asked"] == {"bundle": "tiny"}
    assert "tiny" in plan["reason"]
    assert (plan["engine"], plan["precision"]) == ("onnxruntime", "fp32")
    assert (plan["radius"], plan["radius_source"]) == (0.25, "request")
    pixels = plan["pixels"]
    assert pixels["all"] == 256 * 480
    assert pixels["background"] == 256 * 288
    assert pixels["known"] == 0
    assert 256 * 192 < pixels["computed"] <= 256 * (192 + 48 + 40)
    assert pixels["share"] == pytest.approx(pixels["computed"] / pixels["all"], rel=1e-3)
    assert pixels["tiles"] == 1
    for fact in ("computed_pixels", "background_pixels"):
        header = answer.headers["deepshade-" + fact.replace("_", "-")]
        assert int(header) == pixels[fact.removesuffix("_pixels")]


def test_channels_that_are_not_read_are_not_decoded(client, half):
    channels = shade(client, half, "?explain=1").json()["channels"]
    assert channels["in_file"] == 9
    wanted = {f"{layer}.{axis}" for layer in ("normal", "position") for axis in "XYZ"}
    assert set(channels["decoded"]) == wanted
    assert channels["bytes_in_file"] == 9 * 2 * 256 * 480
    assert channels["bytes_saved"] == 3 * 2 * 256 * 480


def test_explaining_runs_no_network(start, half, monkeypatch):
    local = start()
    engine = local.service.models.engine(local.service.models.candidate("ao"))
    monkeypatch.setattr(engine, "predict", lambda gbuffer: 1 / 0)
    response = shade(local.client, half, "?explain=true")
    assert response.status_code == 200
    assert "infer" not in response.headers["server-timing"]


def test_what_is_computed_is_fast_to_plan_and_equals_the_whole(service, half):
    engine = service.service.models.engine(service.service.models.candidate("ao"))
    gbuffer = load_gbuffer(half, engine.bundle.inputs)
    scene = Scene(gbuffer, EFFECTS["ao"])
    plan = scene.plan(engine.bundle, ShadeParameters(radius=0.5), 10**9)
    assert plan.computed < 0.6 * gbuffer.background.size
    whole = plan_tiles(256, 480, multiple=4, halo=48, max_pixels=10**9)
    answers = [
        shading.infer(gbuffer, Plan(0.5, "request", tiling), engine, NEVER)
        for tiling in (plan.tiling, whole)
    ]
    np.testing.assert_allclose(*answers, atol=1e-5)
    assert answers[0].std() > 0.01


def test_far_pixels_are_open_whether_or_not_they_are_computed(client, make_picture, make_exr):
    channels = make_picture(200, 300)
    scale = np.ones((200, 300), np.float32)
    scale[:, 200:] = 1e5  # a backdrop, along the same rays
    for axis in "XYZ":
        channels[f"position.{axis}"] *= scale
    body = make_exr(channels)
    response = shade(client, body, "?half=false&radius=0.5")
    plan = shade(client, body, "?explain=1&radius=0.5").json()["pixels"]
    assert plan["known"] == 200 * 100
    assert "less than a pixel" in plan["known_why"]
    assert int(response.headers["deepshade-known-pixels"]) == 200 * 100
    y = exr.read(response.content).pixels["Y"]
    assert (y[:, 200:] == 1).all()
    assert (y[:, :200] < 1).any()
    # a radius of many pixels everywhere: the network answers all
    assert shade(client, body, "?explain=1&radius=1e9").json()["pixels"]["known"] == 0


@pytest.fixture
def calibrated(start, models, tmp_path, monkeypatch):
    """A service with three bundles whose figures are made up; `computed` pixels decide."""
    import shutil

    for name, error in (("fast", 0.3), ("balanced", 0.2), ("best", 0.1)):
        folder = tmp_path / "ao" / name
        shutil.copytree(models / "ao" / "tiny", folder)
        config = json.loads((folder / "config.json").read_text())
        (folder / "config.json").write_text(json.dumps(config | {"name": name}))
        metrics = {"error": {"test-real": {"exact": {"dssim": error}}}}
        (folder / "metrics.json").write_text(json.dumps(metrics))
    local = start(models=tmp_path)
    models_ = local.service.models
    speeds = {"fast": 10.0, "balanced": 100.0, "best": 1000.0}
    candidates = models_.candidates

    def timed(effect):
        return [
            replace(
                c, added=0.0, fixed_ms=0.0, ms_per_megapixel=speeds[c.bundle.name], calibrated=True
            )
            for c in candidates(effect)
        ]

    monkeypatch.setattr(models_, "candidates", timed)
    return local.client


def test_quality_names_a_bundle(calibrated, half):
    for query, name in (("", "balanced"), ("?quality=fast", "fast"), ("?quality=best", "best")):
        assert shade(calibrated, half, query).headers["deepshade-bundle"] == name
    refused = shade(calibrated, half, "?quality=best&bundle=fast")
    assert refused.status_code == 422
    assert shade(calibrated, half, "?quality=good").status_code == 422


def test_an_error_or_a_time_chooses(calibrated, half):
    error = shade(calibrated, half, "?max_error=0.25")
    assert error.headers["deepshade-bundle"] == "balanced"
    assert float(error.headers["deepshade-dssim"]) == pytest.approx(0.2)
    # the whole picture has 0.12 megapixels; only 0.06 have to be computed
    plan = shade(calibrated, half, "?budget_ms=70&explain=1").json()
    assert plan["bundle"] == "best"
    assert plan["predicted_ms"] == pytest.approx(1e-3 * plan["pixels"]["computed"], rel=1e-3)
    assert "within 70 ms" in plan["reason"]
    assert plan["asked"] == {"budget_ms": 70.0}
    assert {entry["bundle"] for entry in plan["considered"]} == {"fast", "balanced", "best"}
    assert shade(calibrated, half, "?budget_ms=7").headers["deepshade-bundle"] == "balanced"


def test_what_cannot_be_met_says_by_how_much(calibrated, half):
    response = shade(calibrated, half, "?budget_ms=0.1")
    problem = response.json()
    assert response.status_code == 422
    assert problem["type"].endswith("budget-too-small")
    assert problem["short_by"] == pytest.approx(problem["best"] - 0.1, abs=1e-3)
    assert 0.5 < problem["best"] < 0.7  # of what is computed, not of the whole picture
    problem = shade(calibrated, half, "?max_error=0.01").json()
    assert problem["type"].endswith("error-too-small")
    assert problem["best"] == pytest.approx(0.1)


@pytest.mark.parametrize(
    "query", ["?max_error=0", "?max_error=nan", "?budget_ms=-1", "?precision=fp8"]
)
def test_impossible_wishes(client, half, query):
    response = shade(client, half, query)
    assert response.status_code == 422
    assert response.json()["type"].endswith("bad-parameter")


def test_an_engine_that_is_not_here(client, half):
    response = shade(client, half, "?engine=abacus")
    assert response.status_code == 422
    assert "abacus" in response.json()["detail"]


@pytest.mark.parametrize("size", [(64, 96), (61, 90)])
def test_a_consumed_gbuffer_gives_the_same_without_a_copy(service, make_exr, size):
    engine = service.service.models.engine(service.service.models.candidate("ao"))
    seen = []

    class Spy:
        bundle = engine.bundle

        def predict(self, gbuffer):
            seen.append(gbuffer)
            return engine.predict(gbuffer)

    answers = []
    for consume in (False, True):
        gbuffer = load_gbuffer(make_exr(*size), engine.bundle.inputs)
        plan = Scene(gbuffer, EFFECTS["ao"]).plan(engine.bundle, ShadeParameters(radius=0.3), 10**9)
        answers.append(shading.infer(gbuffer, plan, Spy(), NEVER, consume=consume))
    np.testing.assert_array_equal(*answers)
    np.testing.assert_array_equal(*seen)
    exact = size == (64, 96)  # else it has to be padded
    assert np.shares_memory(seen[1], gbuffer.attributes["normal"]) == exact
