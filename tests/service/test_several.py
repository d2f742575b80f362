"""Several effects in one request: a layer each, and every value what it is alone."""

from __future__ import annotations

import json
import threading

import numpy as np
import pytest

from deepshade import exr
from deepshade.attributes import ATTRIBUTES
from deepshade.effects import EFFECTS
from deepshade_service.config import Settings
from deepshade_service.memory import need_of

from .conftest import ORDINARY, Local

EXR = {"Content-Type": "image/x-exr"}
SHADED = ("ao", "dof", "sss")


def network(path, effect):
    """A small one: each output is a sum over all inputs and their neighbours, times a number."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    channels = sum(len(ATTRIBUTES[name].channels) for name in EFFECTS[effect].inputs)
    outputs = len(EFFECTS[effect].outputs)
    kernel = np.random.default_rng(len(effect)).random((outputs, channels, 3, 3), np.float32)
    shapes = (["N", channels, "H", "W"], ["N", outputs, "H", "W"])
    graph = helper.make_graph(
        [helper.make_node("Conv", ["gbuffer", "kernel"], ["shade"], pads=[1, 1, 1, 1])],
        "sum",
        [helper.make_tensor_value_info("gbuffer", TensorProto.FLOAT, shapes[0])],
        [helper.make_tensor_value_info("shade", TensorProto.FLOAT, shapes[1])],
        [numpy_helper.from_array(kernel * 0.01, "kernel")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    path.mkdir(parents=True, exist_ok=True)
    onnx.save(model, path / "model.onnx")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A bundle for each of three effects."""
    from deepshade.bundles import write_config

    folder = tmp_path_factory.mktemp("several")
    for effect in SHADED:
        network(folder / effect / "tiny", effect)
        row = EFFECTS[effect]
        config = {"effect": effect, "name": "tiny", "inputs": row.inputs, "outputs": row.outputs}
        config |= {"radius": 0.5, "fov": 50.0, "size_multiple": 1, "halo": 1, "bytes_per_pixel": 64}
        write_config(folder / effect / "tiny", config, {})
    return folder


@pytest.fixture(scope="module")
def local(root):
    service = Local(Settings(**ORDINARY, models=root))
    service.wait()
    yield service
    service.stop()


@pytest.fixture
def view(make_picture):
    """A floor with light that scatters, a strip of sky, and a lens in the header."""
    channels = make_picture(40, 56)
    for plane in channels.values():
        plane[:6] = 0
    rng = np.random.default_rng(5)
    for layer in ("light", "scatter"):
        channels |= {f"{layer}.{c}": rng.random((40, 56), np.float32) for c in "RGB"}
    return channels


LENS = {"deepshade:focus": 3.2, "deepshade:aperture": 0.3, "deepshade:fov": 50.0}


def shade(local, effects, body, query="half=false"):
    return local.client.post(f"/shade/{effects}?{query}", content=body, headers=EXR)


def pixels(response):
    assert response.status_code == 200, response.text
    return exr.read(response.content).pixels


@pytest.mark.parametrize(
    ("broken", "decodes"), [("", 1), ("position.X", 1), ("light.R", 4), ("normal.Y", 4)]
)
def test_each_layer_is_the_answer_that_the_effect_gives_alone(
    local, view, make_exr, broken, decodes, monkeypatch
):
    """Also where one effect reads a NaN that makes no background of another's pixels.

    The position is read for all of them.
    """
    if broken:
        view[broken][20:24, 30:33] = np.nan
    body = make_exr(view, attributes=LENS)
    reads, read = [], exr.read
    with monkeypatch.context() as patch:
        patch.setattr(exr, "read", lambda *a, **k: reads.append(a[1]) or read(*a, **k))
        response = shade(local, ",".join(SHADED), body)
    found = pixels(response)
    assert sorted(found) == sorted(f"{e}.{c}" for e in SHADED for c in EFFECTS[e].outputs)
    header = exr.read_header(response.content).parts[0].attributes
    plans = json.loads(header["deepshade:plan"])
    assert header["deepshade:effects"] == response.headers["deepshade-effects"] == "ao,dof,sss"
    for effect in SHADED:
        alone = shade(local, effect, body)
        for name, plane in pixels(alone).items():
            np.testing.assert_array_equal(found[f"{effect}.{name}"], plane)
        single = exr.read_header(alone.content).parts[0].attributes
        facts = {k: v for k, v in single.items() if k.startswith("deepshade:") and "plan" not in k}
        for name, value in facts.items():
            if name != "deepshade:fov":  # the camera's
                assert header[name.replace("deepshade:", f"deepshade:{effect}:")] == value
        told = json.loads(response.headers[f"deepshade-{effect}"])
        assert told["bundle_sha256"] == alone.headers["deepshade-bundle-sha256"]
        assert told["nonfinite_pixels"] == alone.headers["deepshade-nonfinite-pixels"]
        plan = json.loads(single["deepshade:plan"])
        plans[effect].pop("memory_bytes"), plan.pop("memory_bytes")
        assert plans[effect] == plan
    assert len(reads[0]) == len(set(reads[0]))
    assert len(reads) == decodes


def test_times_and_counters_are_by_effect(start, root, view, make_exr):
    local = start(models=root)
    timing = shade(local, "sss,ao", make_exr(view)).headers["server-timing"]
    names = [entry.partition(";")[0] for entry in timing.split(", ")]
    assert names[:4] == ["decode", "plan", "infer", "encode"]
    assert set(names[4:]) == {"plan-sss", "infer-sss", "plan-ao", "infer-ao"}
    metrics = local.client.get("/metrics").text
    for effect in ("ao", "sss"):
        assert f'deepshade_pixels_total{{effect="{effect}"}} 2240.0' in metrics
        assert f'deepshade_stage_seconds_count{{effect="{effect}",stage="decode"}} 1.0' in metrics


def test_explain_answers_a_plan_for_each(local, view, make_exr):
    plans = shade(local, "sss,ao", make_exr(view), "explain=1&radius=2").json()
    assert list(plans) == ["sss", "ao"]
    assert plans["ao"]["radius"] == 2
    assert "radius" not in plans["sss"]
    assert set(plans["ao"]["channels"]["decoded"]) == {k for k in view if k[0] in "np"}


@pytest.mark.parametrize(
    ("effects", "query", "status", "said", "fix"),
    [
        ("ao,ssss", "", 404, "ssss", "'sss'"),
        ("ao,", "", 404, "''", "effects"),
        ("ao,sss,ao", "", 422, "'ao' is asked for 2 times", "once"),
        ("ao,sss", "format=png", 422, "PNG", "EXR"),
        ("ao,sss", "focus=2", 422, "'ao' and 'sss' have no setting 'focus'", "dof, full"),
        ("ao,sss", "rotate=2", 422, "rotate", "do, full, ibl"),
        ("ao", "raduis=2", 422, "raduis", "?radius="),
        ("ao", "radius=-1", 422, "radius", "?radius=1e-30"),
        ("dof", "aperture=1e31", 422, "aperture", "?aperture=1e+30"),
        ("ao,dof", "bundle=small", 404, "the effect 'ao' has no bundle 'small'", ""),
    ],
)
def test_what_is_refused_says_what_to_do(local, view, make_exr, effects, query, status, said, fix):
    response = shade(local, effects, make_exr(view, attributes=LENS), query)
    assert response.status_code == status, response.text
    assert said in response.json()["detail"]
    assert fix in response.json().get("fix", "")


def test_all_that_is_missing_is_said_at_once_and_for_what(local, make_exr, make_picture):
    response = shade(local, "ao,sss,dof", make_exr(make_picture(4, 4)))
    assert response.status_code == 422
    detail = response.json()["detail"]
    assert "'scatter' (for sss)" in detail
    assert "'light' (for sss, dof)" in detail
    assert response.json()["missing"] == ["scatter", "light"]


def test_a_setting_counts_for_the_effects_that_have_it(local, view, make_exr):
    body = make_exr(view, attributes=LENS)
    found = pixels(shade(local, "ao,dof,sss", body, "half=false&radius=3&focus=9&aperture=.1"))
    for effect, query in (("ao", "radius=3"), ("dof", "focus=9&aperture=.1"), ("sss", "")):
        alone = pixels(shade(local, effect, body, f"half=false&{query}"))
        for name, plane in alone.items():
            np.testing.assert_array_equal(found[f"{effect}.{name}"], plane)


def test_a_request_ends_between_effects(start, root, view, make_exr, wait_until):
    """It is given up while the first effect is computed: the second is not."""
    local = start(models=root)
    (bundle,) = local.service.models.find("sss")
    second = local.run(local.service.models.engine(bundle, local.service.models.backend(bundle)))
    first, entered, left = local.engine(), threading.Event(), threading.Event()
    predict, calls = first.predict, []
    first.predict = lambda x: (entered.set(), left.wait(10), predict(x))[2]
    second.predict = lambda x: calls.append(1)

    def give_up():
        entered.wait(10)
        next(iter(local.service.workers._running)).set()
        left.set()

    threading.Thread(target=give_up).start()
    assert shade(local, "ao,sss", make_exr(view)).status_code == 503
    wait_until(lambda: not local.service.workers.taken)
    assert not calls


def test_memory_is_for_the_largest_beside_all_answers(local, view, make_exr):
    """Attributes are shared, tiles come one after the other, and answers stay."""
    headers = [exr.read_header(make_exr(view))]
    models = local.service.models
    bundles = [bundle for effect in SHADED for bundle in models.find(effect)]
    alone = [need_of(headers, bundle, 2**30).total for bundle in bundles]
    together = [need_of(headers, bundle, 2**30, bundles).total for bundle in bundles]
    assert max(alone) < max(together) < sum(alone)
    for bundle in bundles:
        assert need_of(headers, bundle, 2**30) == need_of(headers, bundle, 2**30, [bundle])


def test_one_effect_keeps_its_names(local, view, make_exr):
    response = shade(local, "sss", make_exr(view))
    assert list(pixels(response)) == ["B", "G", "R"]
    assert response.headers["deepshade-effect"] == "sss"
    assert "deepshade-effects" not in response.headers
