"""Bundles change under a running service: no request fails, and what is bad never answers."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import onnx
import pytest
from onnx import numpy_helper

from deepshade.files import sha256
from deepshade.versions import Alias

from .conftest import LEVELS, unet, write_bundle

EXR = {"Content-Type": "image/x-exr"}
SWITCHES = 100


@pytest.fixture
def alias(tmp_path: Path) -> Alias:
    """Two small versions of ao/balanced that answer differently, the alias at the second."""
    alias = Alias(tmp_path / "models", "ao", "balanced")
    for seed in (1, 2):
        folder = tmp_path / f"made{seed}" / "balanced"
        write_bundle(folder, unet(4, LEVELS, seed), levels=LEVELS)
        alias.point(alias.publish(folder).number)
    return alias


@pytest.fixture
def local(alias, start):
    return start(models=alias.link.parents[1])


def shaded(local, body):
    """The hash of the bundle that answered."""
    answer = local.client.post("/shade/ao", content=body, headers=EXR)
    assert answer.status_code == 200, answer.text
    return answer.headers["Deepshade-Bundle-Sha256"], answer.content


def number(local):
    (bundle,) = local.client.get("/bundles").json()
    return bundle["number"]


def test_no_request_fails_during_many_switches_under_load(local, make_exr):
    body = make_exr(24, 32)
    expected = {}
    for version in (1, 2):
        local.client.post("/bundles/ao/balanced/pin", params={"version": version})
        sha256, picture = shaded(local, body)
        expected[sha256] = picture
    stop, seen, failed = threading.Event(), [], []

    def load():
        while not stop.is_set():
            try:
                seen.append(shaded(local, body))
            except AssertionError as error:
                failed.append(error)

    clients = [threading.Thread(target=load) for _ in range(3)]
    for client in clients:
        client.start()
    for switch in range(SWITCHES):
        version = 1 + switch % 2
        answer = local.client.post("/bundles/ao/balanced/pin", params={"version": version})
        assert answer.json()["number"] == version
    stop.set()
    for client in clients:
        client.join()
    assert not failed
    assert {sha256 for sha256, _ in seen} == set(expected)
    assert all(picture == expected[sha256] for sha256, picture in seen)


def test_a_service_that_is_told_takes_what_the_alias_leads_to(local, alias, make_exr):
    before, _ = shaded(local, make_exr(8, 8))
    alias.point(1)
    assert shaded(local, make_exr(8, 8))[0] == before  # nobody has told it yet
    told = local.client.post("/bundles/reload")
    assert told.json() == {"changed": ["ao/balanced"]}
    assert number(local) == 1
    assert shaded(local, make_exr(8, 8))[0] != before
    assert local.client.post("/bundles/reload").json() == {"changed": []}


def broken(folder: Path, kind: str) -> Path:
    """A bundle with right hashes that can't be loaded, or answers with what isn't finite."""
    write_bundle(folder, unet(4, LEVELS, 3), levels=LEVELS)
    model = onnx.load(folder / "model.onnx")
    weight = model.graph.initializer[0]
    value = numpy_helper.to_array(weight).copy()
    value[...] = float("nan")
    weight.CopyFrom(numpy_helper.from_array(value, weight.name))
    content = model.SerializeToString() if kind == "nan" else b"no graph"
    (folder / "model.onnx").write_bytes(content)
    config = json.loads((folder / "config.json").read_text())
    config["hashes"] = {"model.onnx": sha256(folder / "model.onnx")}
    (folder / "config.json").write_text(json.dumps(config))
    return folder


@pytest.mark.parametrize("kind", ["nan", "no graph"])
def test_what_cant_be_loaded_never_answers(local, alias, tmp_path, make_exr, kind):
    before = shaded(local, make_exr(8, 8))
    version = alias.publish(broken(tmp_path / "bad" / "balanced", kind))
    refused = local.client.post("/bundles/ao/balanced/pin", params={"version": version.number})
    assert refused.status_code == 500
    assert alias.current == 2  # a start anew wouldn't find it either
    assert alias.pinned is None
    alias.point(version.number)
    told = local.client.post("/bundles/reload")
    assert told.status_code == 409
    assert told.json()["refused"] == ["ao/balanced"]
    assert shaded(local, make_exr(8, 8)) == before
    assert local.client.post("/bundles/ao/balanced/rollback").status_code == 200
    assert shaded(local, make_exr(8, 8)) == before


def test_pin_and_roll_back_by_one_call_each(local, alias):
    pinned = local.client.post("/bundles/ao/balanced/pin", params={"version": 1}).json()
    assert (pinned["number"], pinned["pinned"], pinned["versions"]) == (1, 1, [1, 2])
    assert alias.current == 1
    assert local.client.delete("/bundles/ao/balanced/pin").json()["pinned"] is None
    local.client.post("/bundles/ao/balanced/pin", params={"version": 2})
    back = local.client.post("/bundles/ao/balanced/rollback").json()
    assert (back["number"], back["pinned"]) == (1, None)
    none = local.client.post("/bundles/ao/balanced/rollback")
    assert none.status_code == 422
    assert "no version before" in none.json()["detail"]


def test_only_the_tokens_bearer_changes_bundles(alias, start, make_exr):
    token = "a-token-of-some-length"
    local = start(models=alias.link.parents[1], token=token)
    url = "/bundles/ao/balanced/rollback"
    assert local.client.post(url).status_code == 401
    assert local.client.post(url, headers={"Authorization": "Bearer wrong"}).status_code == 401
    assert number(local) == 2
    assert local.client.post(url, headers={"Authorization": f"Bearer {token}"}).status_code == 200
    shaded(local, make_exr(8, 8))  # which anybody may


def test_no_page_of_another_origin_changes_bundles(local):
    evil = {"Origin": "http://evil.example"}
    assert local.client.post("/bundles/reload", headers=evil).status_code == 403
    assert local.client.post("/bundles/reload", headers={"Host": "evil.example"}).status_code == 403
