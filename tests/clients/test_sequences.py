"""Which files are one frame, by their names: as the service reads names too."""

from __future__ import annotations

from pathlib import Path

import pytest

from deepshade.gbuffer import channels
from deepshade.gbuffer.naming import FileName, parse_stem
from deepshade_client import sequences


@pytest.mark.parametrize(
    ("stem", "shot", "attribute", "frame"),
    [
        ("shot_normal.0007", "shot", "normal", "0007"),
        ("shot.normal_world.7", "shot", "normal_world", "7"),
        ("my_shot_v2-Depth_1001", "my_shot_v2", "Depth", "1001"),
        ("Normal0001", "", "Normal", "0001"),
        ("shot_N.0001", "shot", "N", "0001"),
        ("shot.0001.depth", "shot.0001", "depth", ""),
        ("shot.0001", "shot", "", "0001"),
        ("abnormal.0001", "abnormal", "", "0001"),
        ("shot_crypto.0001", "shot_crypto", "", "0001"),
        ("0001", "", "", "0001"),
        ("", "", "", ""),
    ],
)
def test_parse_stem(stem, shot, attribute, frame):
    assert parse_stem(stem) == FileName(shot, attribute, frame)


@pytest.mark.parametrize("stem", ["a_normal.0001", "a.N.01", "a b-depth 3", "a_tangent.1", "P"])
def test_an_attribute_is_what_the_service_takes_for_one(stem):
    readings = channels._read_as(channels.Layer(0, stem, from_stem=True), None)[1]
    assert bool(readings) == bool(parse_stem(stem).attribute)


def views(*names, together=None):
    files = {Path("in", name): Path(name) for name in names}
    return sequences.views(files, together=together)


def test_files_that_differ_in_the_attribute_alone_are_one_frame():
    names = [f"s{w}.{n:04d}.exr" for w in ("", "_normal", "_depth") for n in (1, 2)]
    found = views(*names)
    assert [view.name for view in found] == ["s.0001", "s.0002"]
    assert [path.name for path in found[0].files] == [
        "s.0001.exr",
        "s_normal.0001.exr",
        "s_depth.0001.exr",
    ]
    assert [view.frame for view in found] == [1, 2]
    assert sequences.summary(view.files for view in found) == [
        "s: 2 frames, 3 files a frame: beauty, normal, depth"
    ]
    assert [len(view.files) for view in views(*names, together=False)] == [1] * 6
    assert [len(view.files) for view in views(*names, together=True)] == [6]


@pytest.mark.parametrize(
    "names",
    [
        ("room.exr", "boat.exr"),
        ("room.0001.exr", "room.0002.exr"),
        ("room_normal.1.exr", "boat_depth.1.exr"),
        ("room_normal.1.exr", "room_depth.2.exr"),
        ("a/room_normal.1.exr", "b/room_depth.1.exr"),
        ("room_old.1.exr", "room_new.1.exr"),
        ("room.1.exr", "room_1.exr"),
    ],
)
def test_others_are_pictures_of_their_own(names):
    found = views(*names)
    assert [view.files for view in found if not view.lacks] == [(Path("in", n),) for n in names]
    assert [view.name for view in found] == [Path(name).stem for name in names]


def test_a_frame_without_what_most_have():
    names = [f"s_{w}.{n}.exr" for w in ("normal", "depth") for n in (1, 2, 3)]
    names.remove("s_normal.2.exr")
    names.append("s_light.3.exr")  # of one frame alone: nobody misses it
    lacking = {view.name: view.lacks for view in views(*names)}
    assert lacking == {"s.1": (), "s_depth.2": ("normal",), "s.3": ()}


def test_patterns(tmp_path):
    for name in ("r.0002.exr", "r.0001.exr", "r.10001.exr", "r.1.exr", "r.0001.txt", "r.0001b.exr"):
        (tmp_path / name).write_bytes(b"")

    def found(pattern):
        return [path.name for path in sequences.matches(str(tmp_path / pattern))]

    four = ["r.0001.exr", "r.0002.exr", "r.10001.exr"]
    assert found("r.####.exr") == found("r.%04d.exr") == four
    assert found("r.%d.exr") == found("r.#.exr")
    assert sorted(found("r.%d.exr")) == sorted([*four, "r.1.exr"])
    assert found("none/r.%d.exr") == []
    assert sequences.numbered("a.####.exr", 7) == sequences.numbered("a.%04d.exr", 7)
    assert sequences.numbered("a.%d.##.exr", 7) == "a.7.07.exr"
    assert not sequences.is_pattern("a.0001.exr")
