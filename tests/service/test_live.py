"""Live sessions over real sockets: the same pixels as a request's, and who is late is skipped."""

from __future__ import annotations

import contextlib
import io
import json
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from PIL import Image
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from deepshade import exr, live
from deepshade_service.live import answer as answers
from deepshade_service.live import viewer as viewers
from deepshade_service.live.tokens import Tokens

TOKEN = "a-secret-of-some-length"
SIZE = (48, 64)


class Socket:
    """One side of a live session: what it says, and what it is told."""

    def __init__(self, connection: ClientConnection) -> None:
        self.connection = connection
        self.told: list[dict[str, Any]] = []

    def say(self, **message: Any) -> None:
        self.connection.send(json.dumps(message))

    def frame(
        self, planes: dict[str, np.ndarray], id: int = 1, flags: int = 0, **about: Any
    ) -> None:
        message = live.pack(
            *(live.GBUFFER, id, planes, {"header": {"deepshade:fov": 50.0}, **about}),
            codec="raw",
            time=time.time(),
            sent=time.time(),
            flags=flags,
        )
        self.connection.send(message)

    def hear(self, wanted: Callable[[Any], bool], seconds: float = 20) -> Any:
        """The first message that is `wanted`; texts before it are kept in `told`."""
        deadline = time.monotonic() + seconds
        while True:
            message = self.connection.recv(max(0.01, deadline - time.monotonic()))
            if isinstance(message, bytes):
                found: Any = live.parse(message, exr.Limits())
            else:
                found = json.loads(message)
                self.told.append(found)
            if wanted(found):
                return found

    def answer(self, id: int | None = None, rest: bool | None = None) -> live.Frame:
        return self.hear(
            lambda m: (
                isinstance(m, live.Frame)
                and id in (None, m.id)
                and rest in (None, bool(m.flags & live.REST))
            )
        )

    def text(self, kind: str) -> dict[str, Any]:
        return self.hear(lambda m: isinstance(m, dict) and m["type"] == kind)

    def closed(self) -> int:
        """The code with which the service closes it."""
        with pytest.raises(ConnectionClosed) as caught:
            self.hear(lambda m: False)
        assert caught.value.rcvd
        return caught.value.rcvd.code


@contextlib.contextmanager
def joined(local: Any, path: str, token: str = "", **headers: str) -> Iterator[Socket]:
    url = f"ws://127.0.0.1:{local.address[1]}{path}"
    protocols = ["deepshade.live.1", *([f"token.{token}"] if token else [])]
    with connect(
        url, subprotocols=protocols, additional_headers=headers, compression=None, proxy=None
    ) as connection:
        yield Socket(connection)


@contextlib.contextmanager
def publishing(local: Any, name: str, **hello: Any) -> Iterator[Socket]:
    with joined(local, f"/live/{name}/publish") as socket:
        said = {"type": "hello", "protocol": 1, "effects": "ao", "settings": {}} | hello
        with contextlib.suppress(ConnectionClosed):  # refused already
            socket.say(**said)
        yield socket


@pytest.fixture
def planes(make_picture) -> dict[str, np.ndarray]:
    return {
        name: plane.astype("<f4") if name == "position.Z" else plane.astype("<f2")
        for name, plane in make_picture(*SIZE).items()
    }


def test_a_frame_is_shaded_as_its_file_is(service, planes, make_exr):
    half = [name for name, plane in planes.items() if plane.itemsize == 2]
    file = make_exr(planes, half=half, attributes={"deepshade:fov": 50.0})
    query = "/shade/ao?radius=0.5&half=false"
    asked = service.client.post(query, content=file, headers={"Content-Type": "image/x-exr"})
    with publishing(service, "same", half=False, answers="raw") as socket:
        welcome = socket.text("welcome")
        assert welcome["inputs"] == {"ao": ["normal", "position"]}
        socket.text("next")
        socket.frame(planes, settings={"radius": 0.5})
        found = socket.answer()
    assert found.kind == live.ANSWER
    assert found.about["effects"] == ["ao"]
    np.testing.assert_array_equal(
        found.planes()["ao.Y"], exr.read(asked.content).pixels["Y"].astype("<f4")
    )


def test_settings_stay_until_others_are_said(service, planes):
    with publishing(service, "stay", settings={"radius": 0.5}, answers="raw") as socket:
        socket.frame(planes, 1)
        first = socket.answer(1).planes()["ao.Y"]
        socket.frame(planes, 2, settings={"radius": 3.0})
        second = socket.answer(2).planes()["ao.Y"]
        socket.frame(planes, 3)
        np.testing.assert_array_equal(socket.answer(3).planes()["ao.Y"], second)
    assert not np.array_equal(first, second)


def test_the_radius_of_the_first_frame_stays(service, planes):
    """Else what AO reaches would follow each frame's depths, and flicker."""
    nearer = {n: p if n.startswith("normal") else p / 2 for n, p in planes.items()}
    with publishing(service, "steady", answers="none") as socket:
        radii = []
        for id, flags in ((1, 0), (2, 0), (3, live.CUT)):
            socket.frame(nearer if id > 1 else planes, id, flags)
            socket.text("about") if id == 1 else socket.hear(
                lambda m, id=id: isinstance(m, dict) and m.get("shaded") == id
            )
            (session,) = [s for s in service.service.sessions.all() if s.name == "steady"]
            radii.append(session.plans["ao"]["radius"])
    assert radii[1] == radii[0]
    assert radii[2] == pytest.approx(radii[0] / 2, rel=0.01)


def test_the_newest_frame_wins(service, planes):
    """Who doesn't wait to be asked loses frames, never time; the last one is always shaded."""
    with publishing(service, "newest", answers="deflate") as socket:
        socket.text("next")
        for id in range(1, 41):
            socket.frame(planes, id)
        seen = [socket.answer()]
        while seen[-1].id < 40:
            seen.append(socket.answer())
        status = socket.hear(lambda m: isinstance(m, dict) and m.get("shaded") == len(seen))
    ids = [frame.id for frame in seen]
    assert ids == sorted(set(ids))
    assert status["dropped"] > 0
    # overwritten before they were shaded, or their answers before they were sent
    assert status["dropped"] + status["shaded"] == 40


def test_what_cannot_be_shaded_is_said_and_the_session_goes_on(service, planes):
    with publishing(service, "faults") as socket:
        socket.frame({name: p for name, p in planes.items() if "normal" in name}, 1)
        told = socket.text("problem")
        assert told["id"] == 1
        assert told["problem"]["status"] == 422
        assert told["problem"]["missing"] == ["position"]
        socket.frame(planes, 2, effects="aoo")
        assert socket.text("problem")["problem"]["fix"] == "did you mean 'ao'?"
        socket.frame(planes, 3, settings={"radios": 1})
        assert "radius" in socket.text("problem")["problem"]["fix"]
        socket.frame(planes, 4, settings={"compression": "zip"})
        assert "live frames have no such" in socket.text("problem")["problem"]["detail"]
        socket.frame(planes, 5)
        assert socket.answer().id == 5


@pytest.mark.parametrize(
    ("say", "code"),
    [
        (b"no frame at all, but long enough to be looked at", 4400),
        ("no JSON", 4422),
        ("[1, 2]", 4422),
        ("[" * 5000, 4422),
        ('{"no": "type"}', 4422),
    ],
)
def test_nonsense_ends_the_connection_with_a_reason(service, say, code):
    with publishing(service, "nonsense") as socket:
        socket.text("welcome")
        socket.connection.send(say)
        assert socket.closed() == code
    assert [m["problem"]["status"] for m in socket.told if m["type"] == "problem"] == [code - 4000]


@pytest.mark.parametrize(
    ("path", "hello", "code"),
    [
        ("/live/-odd-/publish", {}, 4422),
        ("/live/x/publish", {"protocol": 2}, 4422),
        ("/live/x/publish", {"effects": "nothing"}, 4404),
        ("/live/x/publish", {"answers": "zip"}, 4422),
        ("/live/nobody/view", None, 4404),
    ],
)
def test_refusals_say_why_before_they_close(service, path, hello, code):
    with joined(service, path) as socket:
        if hello is not None:
            socket.say(**({"type": "hello", "protocol": 1, "effects": "ao"} | hello))
        assert socket.closed() == code
    assert socket.told[-1]["problem"]["detail"]


def test_a_viewer_sees_a_jpeg_that_moves_and_the_exact_picture_at_rest(service, planes):
    with publishing(service, "seen", answers="raw") as socket:
        socket.frame(planes, 1)
        exact = socket.answer().planes()["ao.Y"]
        with joined(service, "/live/seen/view") as viewer:
            viewer.text("welcome")
            moving = viewer.answer(1, rest=False)
            assert moving.codec == "jpeg"
            eyes = np.asarray(Image.open(io.BytesIO(moving.blocks[0])), np.float32) / 255
            assert eyes.shape == SIZE
            assert np.abs(eyes - exact.astype(np.float32)).mean() < 0.02
            socket.frame(planes, 2)
            still = viewer.answer(2, rest=True)
            assert still.codec == "deflate"
            np.testing.assert_array_equal(still.planes()["ao.Y"], exact)
            assert still.time <= time.time()
            viewer.say(type="ping", t=12.5)
            assert viewer.text("pong")["t"] == 12.5
            viewer.say(type="want", moving="lz5")
            assert viewer.closed() == 4422


def test_many_viewers_cost_one_encoding(service, planes, monkeypatch):
    made = []
    encode = answers.Answer._encode
    monkeypatch.setattr(
        answers.Answer, "_encode", lambda self, want: made.append(want) or encode(self, want)
    )
    with contextlib.ExitStack() as stack:
        socket = stack.enter_context(publishing(service, "crowd", answers="none"))
        socket.text("welcome")
        crowd = [stack.enter_context(joined(service, "/live/crowd/view")) for _ in range(5)]
        for viewer in crowd:
            viewer.text("welcome")
            viewer.say(type="want", rest="none")
        socket.text("next")
        socket.frame(planes, 1)
        messages = [viewer.answer(1) for viewer in crowd]
    assert len({bytes(message.blocks[0]) for message in messages}) == 1
    assert len([want for want in made if not want.rest]) == 1


def test_a_viewer_that_acknowledges_nothing_gets_few_frames_and_holds_nobody_up(
    service, planes, monkeypatch
):
    monkeypatch.setattr(viewers, "_PATIENCE", 1e6)  # however slow the machine is
    with publishing(service, "stalled", answers="raw") as socket:
        socket.text("welcome")
        with joined(service, "/live/stalled/view") as viewer:
            viewer.text("welcome")
            viewer.say(type="want", rest="none")
            for id in (1, 2):
                socket.frame(planes, id)
                viewer.answer(id)
            for id in range(3, 13):
                socket.frame(planes, id)
                socket.answer(id)
            viewer.say(type="ack", id=2)
            assert viewer.answer().id == 12  # nothing between waits for it


def test_a_broken_publisher_comes_back_to_its_viewers_and_an_ended_one_leaves_nothing(
    service, planes, wait_until
):
    with publishing(service, "back", answers="raw") as socket:
        resume = socket.text("welcome")["resume"]
        socket.frame(planes, 1)
        socket.answer()
        with joined(service, "/live/back/view") as viewer:
            viewer.text("welcome")
            with publishing(service, "back") as thief:
                assert thief.closed() == 4409
            socket.connection.socket.close()
            assert viewer.hear(lambda m: isinstance(m, dict) and m.get("publisher") == "gone")
            with publishing(service, "back", resume=resume) as again:
                again.text("welcome")
                again.frame(planes, 2)
                assert viewer.answer(2)
                names = [each["session"] for each in service.client.get("/live").json()]
                assert "back" in names
                again.say(type="end")
                assert viewer.closed() == 4404
                assert viewer.told[-1]["publisher"] == "ended"
    wait_until(lambda: "back" not in service.client.get("/live").text)


def test_who_knows_the_secret_takes_over_a_connection_that_is_not_known_to_be_broken(
    service, planes
):
    with publishing(service, "zombie") as old:
        resume = old.text("welcome")["resume"]
        with publishing(service, "zombie", resume=resume) as new:
            new.text("welcome")
            new.frame(planes, 5)
            assert new.answer().id == 5
            with pytest.raises(ConnectionClosed):
                old.hear(lambda m: False)


def test_limits_on_sessions_viewers_sizes_and_rates(start, planes):
    local = start(live_sessions=1, live_viewers=1, live_frame=50_000, live_rate=5)
    with publishing(local, "one", answers="raw") as socket:
        assert socket.text("welcome")["limits"]["rate"] == 5
        with publishing(local, "two") as second:
            assert second.closed() == 4429
        with joined(local, "/live/one/view") as viewer, joined(local, "/live/one/view") as late:
            viewer.text("welcome")
            assert late.closed() == 4429
        socket.text("next")
        for id in range(1, 21):
            socket.frame(planes, id)
        status = socket.hear(lambda m: isinstance(m, dict) and m.get("dropped", 0) >= 10)
        assert status["shaded"] <= 10
        big = {name: np.zeros((200, 200), "<f2") for name in planes}
        socket.frame(big, 30)
        assert socket.closed() == 4413


def test_beyond_loopback_a_token_is_needed(start, planes):
    closed = start(beyond=True)
    with publishing(closed, "x") as socket:
        assert socket.closed() == 4403
    assert closed.client.get("/live").status_code == 403

    local = start(beyond=True, token=TOKEN)
    bearer = {"Authorization": f"Bearer {TOKEN}"}
    assert local.client.get("/live").status_code == 401
    assert local.client.get("/live", headers={"Authorization": "Bearer no"}).status_code == 401
    for token, headers in (("", {}), ("wrong", {}), ("", {"Authorization": f"Basic {TOKEN}"})):
        with joined(local, "/live/x/publish", token, **headers) as socket:
            assert socket.closed() == 4401
    with joined(local, "/live/x/publish", **bearer) as socket:
        socket.say(type="hello", protocol=1, effects="ao", answers="raw")
        socket.text("welcome")
        link = local.client.post("/live/x/link", headers=bearer).json()
        assert link["path"] == f"/live/x#token={link['token']}"
        with joined(local, "/live/x/view", link["token"]) as viewer:
            viewer.text("welcome")
        with joined(local, "/live/x/view", TOKEN) as viewer:
            viewer.text("welcome")
        for path in ("/live/y/view", "/live/x/publish"):  # it is for viewers of x alone
            with joined(local, path, link["token"]) as other:
                assert other.closed() == 4401
        with joined(local, "/live/x/view") as other:
            assert other.closed() == 4401


def test_links_expire_and_cannot_be_made_up():
    tokens = Tokens(TOKEN)
    old, _ = tokens.link("x", now=time.time() - 3601)
    token, expires = tokens.link("x")
    assert tokens._valid(token, "x")
    assert not tokens._valid(old, "x")
    assert not tokens._valid(token, "y")
    assert not tokens._valid(token, None)
    for made_up in (
        f"{expires + 9}.{token.partition('.')[2]}",
        token[:-1],
        "9" * 400 + ".x",
        "ä.ö",
    ):
        assert not tokens._valid(made_up, "x")
    assert not Tokens(TOKEN + "2")._valid(token, "x")
