"""Streams from the client's side: sources, sinks, choices, and a service that is killed."""

from __future__ import annotations

import asyncio
import io
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from deepshade import exr, live
from deepshade.live.codecs import encode
from deepshade_client import Client, ClientError, Options
from deepshade_client.cli import main
from deepshade_client.exceptions import BadRequest, ConnectionFailed
from deepshade_client.live import LiveAnswer, Picture, Publisher, sources, tev
from deepshade_client.live.files import Folder
from deepshade_client.live.link import Link
from deepshade_client.live.pace import MAX_STEP, Pace
from deepshade_client.live.pictures import read_picture

FOV = {"deepshade:fov": 50.0}


@pytest.fixture
def server(service) -> str:
    return f"http://127.0.0.1:{service.address[1]}"


@pytest.fixture
def frames(tmp_path, make_exr) -> list[Path]:
    paths = []
    for number in range(1, 4):
        path = tmp_path / "in" / f"room.{number:04d}.exr"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(make_exr(40, 56, number, half=True, attributes=FOV))
        paths.append(path)
    return paths


def test_a_stream_gives_what_requests_give(server, frames):
    options = Options(radius=0.5)
    with Client(server) as client:
        found = list(client.stream("ao", frames, options, half=False))
        for path, answer in zip(frames, found, strict=True):
            asked = client.shade("ao", path, Options(radius=0.5, half=False))
            np.testing.assert_array_equal(answer.arrays()["ao"], asked.arrays()["ao"])
            assert answer.picture.name == path.stem
            assert answer.age > 0


def test_arrays_need_no_files(server, make_picture):
    pictures = [Picture(make_picture(24, 32, seed), FOV) for seed in range(3)]
    with Client(server) as client:
        found = [answer.arrays()["ao"].mean() for answer in client.stream("ao", pictures)]
    assert len(set(found)) == 3


def test_a_loop_that_ends_early_ends_the_stream(server, make_picture, service, wait_until):
    def endless():
        while True:
            yield Picture(make_picture(24, 32), FOV)

    with Client(server) as client:
        for answer in client.stream("ao", endless(), session="early"):
            assert answer.arrays()
            break
    wait_until(
        lambda: all(
            each["publisher"] == "gone"
            for each in service.client.get("/live").json()
            if each["session"] == "early"
        )
    )


def test_a_picture_that_cannot_be_shaded_is_an_answer_with_an_error(server, make_picture):
    good = Picture(make_picture(24, 32), FOV)
    bad = Picture({n: p for n, p in good.planes.items() if "normal" in n}, {})
    with Client(server) as client:
        first, second, third = client.stream("ao", [good, bad, good])
    assert first.error is third.error is None
    with pytest.raises(BadRequest, match="position"):
        second.arrays()


def test_what_asks_wrongly_raises(server, make_picture):
    with Client(server) as client, pytest.raises(BadRequest, match="no effect 'aoo'"):
        list(client.stream("aoo", [Picture(make_picture(24, 32), FOV)]))


def test_nobody_there_is_said_after_some_patience():
    with Client("http://127.0.0.1:1") as client, pytest.raises(ConnectionFailed, match="0 s"):
        list(client.stream("ao", [], patience=0))


@pytest.mark.slow
def test_a_killed_service_is_found_again_and_no_picture_is_lost(start_server, make_picture):
    """kill -9 in the middle: each picture is answered once, and what happened is told."""
    server = start_server()
    port = server.url.rpartition(":")[2]
    told = []
    pictures = [Picture(make_picture(24, 32, n), FOV, f"p{n}") for n in range(12)]
    names = []
    with Client(server.url) as client:
        stream = client.stream("ao", pictures, heard=lambda event: told.append(event.kind))
        for answer in stream:
            names.append(answer.picture.name)
            if len(names) == 4:
                server.stop(signal.SIGKILL)
                start_server("--port", port)
    assert names == [picture.name for picture in pictures]
    assert [kind for kind in told if kind != "status"] == ["open", "lost", "back"]


async def first(source, count: int = 1):
    found = []
    async for picture in source:
        found.append(picture)
        if len(found) == count:
            break
    return found


def test_a_half_written_file_waits(tmp_path, make_exr):
    body = make_exr(16, 24, half=True, attributes=FOV)
    path = tmp_path / "late.exr"
    path.write_bytes(body[: len(body) // 2])
    read = sources.Reading(["normal", "position"])

    async def run() -> tuple[float, list[Picture]]:
        begun = time.monotonic()
        asyncio.get_running_loop().call_later(0.6, path.write_bytes, body)
        source = sources.watched(tmp_path, read, lambda text: None, there=True)
        found = await first(source)
        return time.monotonic() - begun, found

    waited, (picture,) = asyncio.run(run())
    assert waited > 0.6
    assert picture.name == "late"
    assert len(picture.planes) == 6


def test_a_sequence_reads_only_what_is_needed(tmp_path, make_picture, make_exr):
    channels = make_picture(16, 24) | {"extra.R": np.zeros((16, 24), np.float32)}
    path = tmp_path / "a.exr"
    path.write_bytes(make_exr(channels, half=["normal.X"], attributes=FOV))
    picture = read_picture([path], ["normal", "position"])
    assert sorted(picture.planes) == sorted(make_picture(16, 24))
    assert picture.planes["normal.X"].dtype == np.float16
    assert picture.planes["normal.Y"].dtype == np.float32
    assert picture.header["deepshade:fov"] == 50.0
    assert len(read_picture([path], ["scatter"]).planes) == 7  # the service shall say it


def test_what_isnt_whole_in_a_pipe_is_said():
    with pytest.raises(ClientError, match=r"frame 1 .* length"):
        asyncio.run(first(sources.piped(io.BytesIO(b"P6"), print)))
    with pytest.raises(ClientError, match=r"frame 1.* begins with"):
        stream = io.BytesIO(struct.pack("<I", 44) + b"x" * 44)
        asyncio.run(first(sources.piped(stream, print)))
    told: list[str] = []
    assert not asyncio.run(first(sources.piped(io.BytesIO(struct.pack("<I", 9)), told.append)))
    assert told == ["the renderer stopped within frame 1"]


def test_the_example_renderer_streams_into_files(server, tmp_path, capsys):
    example = Path(__file__).parents[2] / "examples" / "renderer.py"
    assert len(example.read_text().split("\n\n", 1)[1].strip().splitlines()) < 40
    written = subprocess.run([sys.executable, example, "2"], capture_output=True, check=True)

    class Stdin:
        buffer = io.BytesIO(written.stdout)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdin", Stdin)
        out = tmp_path / "ao.####.exr"
        assert main(["stream", "ao", "-", "-o", str(out), "--server", server, "--json"]) == 0
    picture = exr.read(tmp_path / "ao.0002.exr")
    assert picture.pixels["Y"].shape == (256, 384)
    assert picture.header.parts[0].attributes["deepshade:bundle"] == "tiny"
    assert picture.header.parts[0].attributes["deepshade:fov"] == 50.0
    assert not list(tmp_path.glob(".*.tmp"))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["-o", "a/", "--fps", "30"], "files want every picture"),
        (["-o", "a/", "--loop"], "--loop never ends"),
        (["-o", "a.exr"], "one file for many pictures"),
    ],
)
def test_what_does_not_go_together_is_said(arguments, said, capsys):
    assert main(["stream", "ao", "in.####.exr", *arguments]) == 2
    assert said in capsys.readouterr().err


def test_smaller_pictures_keep_what_they_show():
    """A ramp's every third pixel, from the middle of its block; pixels become third of a pixel."""
    ramp = np.tile(np.arange(9, dtype=np.float32), (7, 1))
    picture = Picture({"Z": ramp, "motion.U": ramp}).smaller(3)
    np.testing.assert_array_equal(picture.planes["Z"], np.tile([1, 4, 7], (2, 1)))
    np.testing.assert_array_equal(picture.planes["motion.U"] * 3, picture.planes["Z"])
    assert Picture({"Z": ramp[:1, :1]}).smaller(4).size == (1, 1)


def test_the_codec_follows_the_link():
    """The slower the link, the smaller what is sent; on the fastest it isn't compressed at all."""
    names = live.available()
    smooth = np.sin(np.indices((64, 256)).sum(0) / 40).astype("<f4")
    chosen, sizes = [], []
    for megabits in (5, 100, 1000, 100_000):
        link = Link(names)
        link.learn([smooth, smooth.astype("<f2")])
        for _ in range(8):
            link.sent(1_000_000, 8 / megabits)
        chosen.append(link.choose(4_000_000))
        sizes.append(len(encode(smooth, chosen[-1])))
    assert chosen[-1] == "raw"
    assert sizes == sorted(sizes)
    assert len(set(chosen)) >= 3
    assert Link(names, "deflate").choose(10**6) == "deflate"


def test_the_pace_finds_the_largest_picture_that_holds_the_rate():
    """Of a machine that takes 0.1 µs a pixel: 30 a second allow 333,000 pixels, less some room."""
    pace, pixels = Pace(30), 1_000_000
    steps = []
    for _ in range(40):
        step = pace.choose(pixels)
        steps.append(step)
        shaded = pixels / step**2
        pace.took(int(shaded), {"infer": 1e3 * 1e-7 * shaded}, 0.0)
    assert steps[0] == 1
    assert set(steps[-20:]) == {2}  # 250,000: it settles
    for _ in range(40):
        pace.choose(pixels)
        pace.took(1000, {"infer": 1e3}, 0.0)
    assert pace.step == MAX_STEP


def test_a_still_picture_is_sharpened(service, server, make_picture):
    """With --fps a picture that rests comes once more, whole."""

    async def run() -> list[LiveAnswer]:
        publisher = Publisher(server, "sharp", "ao", {"radius": 0.5}, fps=200, half=False)
        publisher._pace.step = 2
        collected = asyncio.ensure_future(first(publisher.answers(), 2))
        await publisher.offer(Picture(make_picture(48, 64), FOV))
        return await collected

    small, whole = asyncio.run(run())
    assert small.planes["ao.Y"].shape == (24, 32)
    assert not small.sharp
    assert whole.sharp
    assert whole.planes["ao.Y"].shape == (48, 64)
    with Client(server) as client:
        picture = Picture(make_picture(48, 64), FOV)
        (exact,) = client.stream("ao", [picture], Options(radius=0.5), half=False)
    np.testing.assert_allclose(whole.arrays()["ao"], exact.arrays()["ao"], atol=1e-5)


def test_tev_gets_whole_frames():
    """Read back by the layout in tev's own source, field by field."""
    received = bytearray()
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def listen() -> None:
            with listener.accept()[0] as connection:
                while part := connection.recv(65536):
                    received.extend(part)

        thread = threading.Thread(target=listen)
        thread.start()
        viewer = tev.Viewer(f"127.0.0.1:{listener.getsockname()[1]}", "shot")
        planes = {"ao.Y": np.arange(6, dtype=np.float16).reshape(2, 3), "b": np.ones((2, 3), "f4")}
        viewer.show(planes)
        viewer.show(planes)
        viewer.close()
        thread.join(10)
    packets = []
    while received:
        (size,) = struct.unpack_from("<I", received)
        packets.append(bytes(received[4:size]))
        del received[:size]
    assert [packet[0] for packet in packets] == [4, 6, 6]
    head = b"\x01shot\0"
    assert packets[0][1:] == head + struct.pack("<3i", 3, 2, 2) + b"ao.Y\0b\0"
    start = head + struct.pack("<i", 2) + b"ao.Y\0b\0"
    start += struct.pack("<4i4q", 0, 0, 3, 2, 0, 6, 1, 1)
    assert packets[1][1:].startswith(start)
    values = np.frombuffer(packets[1][1 + len(start) :], "<f4")
    np.testing.assert_array_equal(values, [0, 1, 2, 3, 4, 5, 1, 1, 1, 1, 1, 1])


def test_no_viewer_is_said():
    with pytest.raises(ClientError, match=r"no viewer listens at 127\.0\.0\.1:1"):
        tev.Viewer("127.0.0.1:1", "x").show({"Y": np.zeros((1, 1))})


def test_files_are_named_as_their_frames(tmp_path):
    planes = {"ao.Y": np.zeros((2, 2), "f2"), "gi.R": np.ones((2, 2), "f2")}
    picture = Picture({"Z": planes["ao.Y"]}, FOV, "room.0007", 7)
    answer = LiveAnswer(1, picture, planes, 0.0)
    assert Folder(str(tmp_path / "a")).save(answer) == tmp_path / "a" / "room.0007.exr"
    path = Folder(str(tmp_path / "b.%03d.exr")).save(answer)
    assert path.name == "b.007.exr"
    assert set(exr.read(path).pixels) == {"ao.Y", "gi.R"}
