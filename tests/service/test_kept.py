"""Kept uploads: sent once and shaded again and again, bounded, gone in time, and said to be so."""

from __future__ import annotations

import time

import numpy as np
import pytest

from deepshade import exr
from deepshade.errors import LimitError
from deepshade_service.kept import Kept
from deepshade_service.problems import Problem
from deepshade_service.uploads import Upload

EXR = {"Content-Type": "image/x-exr"}


def kept(tmp_path, room=1000, seconds=60.0):
    return Kept(room, seconds, tmp_path)


def files(*sizes, field="", filename="a.exr"):
    return [Upload(field, filename, bytes([n % 256]) * size) for n, size in enumerate(sizes)]


def hold(store, held):
    name = store.name(held)
    store.add(name, held)
    return name


def gone(store, name):
    try:
        with store.use(name):
            return False
    except Problem as problem:
        assert problem.status == 410
        return True


def test_the_same_files_have_the_same_name_in_one_process_only(tmp_path):
    store = kept(tmp_path)
    same, other = files(5, 6), files(5, 6, filename="b.exr")
    assert store.name(same) == store.name(files(5, 6))
    # where one part ends and the next begins is part of what is hashed
    assert store.name([Upload("", "ab", b"c")]) != store.name([Upload("", "a", b"bc")])
    assert len({store.name(same), store.name(other), kept(tmp_path).name(same)}) == 3


def test_those_used_longest_ago_make_room(tmp_path):
    store = kept(tmp_path)
    first, second = hold(store, files(400)), hold(store, files(401))
    with store.use(first) as got:
        assert got == files(400)
    third = hold(store, files(402))
    assert store.bytes == 802
    assert gone(store, second)
    assert not gone(store, first) and not gone(store, third)


def test_what_is_in_use_stays_though_others_need_the_room(tmp_path):
    store = kept(tmp_path)
    first = hold(store, files(900))
    with store.use(first), pytest.raises(Problem, match="in use") as refused:
        hold(store, files(901))
    assert refused.value.status == 429
    hold(store, files(901))
    assert gone(store, first)


def test_an_upload_larger_than_the_room_is_refused_and_costs_no_other(tmp_path):
    store = kept(tmp_path)
    first = hold(store, files(900))
    with pytest.raises(LimitError):
        hold(store, files(600, 600))
    assert not gone(store, first)


def test_uploads_go_after_a_while_but_not_under_those_who_use_them(tmp_path, monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    store = kept(tmp_path, seconds=60)
    name = hold(store, files(10))
    clock[0] += 59
    assert not gone(store, name)
    with store.use(name) as got:
        clock[0] += 100
        store.tidy()
        assert got == files(10) and store.bytes == 10
    clock[0] += 59
    assert not gone(store, name)
    clock[0] += 61
    assert gone(store, name) and store.bytes == 0


def test_a_picture_is_sent_once_and_shaded_as_if_it_were_sent_each_time(client, make_exr):
    body = make_exr(48, 64)
    sent = client.post("/uploads", files={"file": ("shot.exr", body)})
    assert sent.status_code == 201
    found = sent.json()
    assert found["display_window"] == [0, 0, 63, 47]
    assert found["effects"]["ao"]["lacks"] == ""
    assert found["files"] == [{"name": "shot.exr", "bytes": len(body)}]
    for radius in ("0.3", "12%"):
        asked = {"radius": radius, "upload": found["name"]}
        kept = client.post("/shade/ao", params=asked)
        direct = client.post("/shade/ao", params={"radius": radius}, content=body, headers=EXR)
        assert kept.status_code == 200
        assert kept.content == direct.content
    assert client.get(f"/uploads/{found['name']}").json() == found


def test_layers_come_as_they_are_in_the_file(client, make_exr, make_picture):
    channels = make_picture(40, 56)
    wide = {
        f"light.{c}": np.full((40, 56), v, np.float32)
        for c, v in zip("RGB", (1, 2, 3e6), strict=True)
    }
    grey = {"mask": np.eye(40, 56, dtype=np.float32)}
    body = make_exr(channels | wide | grey, half={"mask", *channels}, data_window=(8, 4, 63, 43))
    found = client.post("/uploads", content=body, headers=EXR).json()
    shown = {layer["name"]: index for index, layer in enumerate(found["layers"])}
    assert set(shown) == {"normal", "position", "light", "mask"}
    described = {name: found["layers"][index] for name, index in shown.items()}
    assert described["normal"]["unit"].startswith("direction")
    assert described["position"]["attribute"] == "position"
    assert (described["light"]["type"], described["mask"]["type"]) == ("float", "half")
    for name, index in shown.items():
        got = client.get(f"/uploads/{found['name']}/layers/{index}")
        assert got.status_code == 200
        image = exr.read(got.content)
        (part,) = image.header.parts
        assert part.compression == "none"
        assert part.data_window == (8, 4, 63, 43)
        wanted = exr.read(body, described[name]["channels"])
        for ours, theirs in zip(
            "Y" if name == "mask" else "RGB", described[name]["channels"], strict=True
        ):
            np.testing.assert_array_equal(image.pixels[ours], wanted.pixels[theirs])
    assert client.get(f"/uploads/{found['name']}/layers/9").status_code == 404


def test_who_names_what_is_not_kept_learns_what_to_do(client, make_exr):
    unknown = client.post("/shade/ao", params={"upload": "0" * 32})
    assert unknown.status_code == 410
    assert unknown.json()["type"].endswith("upload-gone")
    assert "POST /uploads" in unknown.json()["fix"]
    assert client.get("/uploads/" + "0" * 32).status_code == 410
    near = client.post("/shade/ao", params={"upload": "rom"})
    assert near.status_code == 404
    assert "room" in near.json()["fix"]
    assert client.post("/shade/ao", params={"upload": "../x"}).status_code == 404
    both = client.post("/shade/ao?upload=room", content=make_exr(16, 16), headers=EXR)
    assert both.status_code == 422 and "body" in both.json()["detail"]


def test_what_an_effect_lacks_is_said_in_the_words_of_a_query(client, make_exr):
    body = make_exr({"Z": np.full((16, 16), 3, np.float32)})
    lacks = client.post("/uploads", content=body, headers=EXR).json()["effects"]["ao"]["lacks"]
    assert "?fov=" in lacks and "--fov" not in lacks


def test_samples_need_no_upload(client):
    names = client.get("/samples").json()
    assert names
    found = client.get(f"/uploads/{names[0]}").json()
    assert found["name"] == names[0]
    assert client.post("/shade/ao", params={"upload": names[0]}).status_code == 200


def test_what_is_no_picture_is_not_kept(client, service):
    before = service.service.kept.bytes
    refused = client.post("/uploads", content=b"not an EXR", headers=EXR)
    assert refused.status_code == 400
    assert service.service.kept.bytes == before


def test_a_full_store_answers_with_its_option_and_old_uploads_with_gone(start, make_exr):
    body = make_exr(48, 64)
    small = start(keep=int(1.5 * len(body)))
    first = small.client.post("/uploads", content=body, headers=EXR).json()["name"]
    other = make_exr(48, 64, attributes={"comments": "another"})
    assert small.client.post("/uploads", content=other, headers=EXR).status_code == 201
    again = small.client.post("/shade/ao", params={"upload": first})
    assert again.status_code == 410
    large = small.client.post("/uploads", content=make_exr(96, 128), headers=EXR)
    assert large.status_code == 413
    assert "--keep" in large.json()["fix"]


def test_header_values_that_json_cannot_hold_are_left_out(client, make_exr):
    said = {"deepshade:radius": float("nan"), "deepshade:scene": "x" * 5000, "deepshade:spp": 4}
    found = client.post("/uploads", content=make_exr(16, 16, attributes=said), headers=EXR)
    assert found.status_code == 201
    assert found.json()["settings"] == {"spp": 4}
