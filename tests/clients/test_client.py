"""The Python API against a real service, a mock one, and transports that misbehave."""

from __future__ import annotations

import asyncio
import inspect
import tracemalloc
from dataclasses import replace

import httpx
import numpy as np
import pytest

import deepshade_client
from deepshade import exr
from deepshade_client import (
    NO_RETRY,
    AsyncClient,
    BadAnswer,
    BadRequest,
    Busy,
    Client,
    ClientError,
    ConnectionBroken,
    ConnectionFailed,
    MissingAttribute,
    MockTransport,
    NotReady,
    Options,
    Retry,
    ServerFailed,
    TimedOut,
    Timeout,
    TooLarge,
    batch,
    mock_answer,
)

FAST = Retry(attempts=4, first=0.001, longest=0.01)


@pytest.fixture(scope="module")
def server(service):
    return str(service.client.base_url)


@pytest.fixture(autouse=True)
def _no_proxies(monkeypatch):
    for name in ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.lower(), raising=False)


def test_public_names():
    """What users may import: exactly this, each documented."""
    names = {
        "AsyncClient Client Answer Options MockTransport Retry NO_RETRY Timeout ClientError",
        "TransportError ConnectionBroken ConnectionFailed TimedOut ServerProblem BadRequest",
        "MissingAttribute TooLarge Busy NotReady ServerFailed BadAnswer Saved Trainer mock_answer",
    }
    expected = {name for line in names for name in line.split()}
    assert set(deepshade_client.__all__) == expected
    assert deepshade_client.__all__ == sorted(
        deepshade_client.__all__, key=lambda name: (not name.isupper(), name)
    )
    for name in expected:
        thing = getattr(deepshade_client, name)
        if inspect.isclass(thing):
            assert thing.__doc__, name
            assert issubclass(thing, ClientError) == issubclass(thing, Exception)


def test_the_client_and_the_async_client_offer_the_same():
    def public(cls):
        return {name for name in vars(cls) if not name.startswith("_")}

    assert public(Client) == public(AsyncClient)
    for name in public(Client):
        sync, asynchronous = (inspect.signature(getattr(c, name)) for c in (Client, AsyncClient))
        if name == "stream":  # the one gives and takes iterators, the other such that are awaited
            sync, asynchronous = (
                s.replace(
                    parameters=[p.replace(annotation="") for p in s.parameters.values()],
                    return_annotation="",
                )
                for s in (sync, asynchronous)
            )
        assert sync == asynchronous, name


def test_shade(server, make_exr, tmp_path):
    path = tmp_path / "view.exr"
    path.write_bytes(make_exr(24, 32))
    with Client(server) as client:
        answers = [
            client.shade("ao", path, Options(radius=0.25, half=False)),
            client.shade("ao", str(path), Options(radius=0.25, half=False)),
            client.shade("ao", path.read_bytes(), Options(radius=0.25, half=False)),
        ]
    assert len({answer.content for answer in answers}) == 1
    answer = answers[0]
    assert answer.media_type == "image/x-exr"
    assert answer.facts["radius"] == "0.25"
    assert answer.facts["radius_source"] == "request"
    assert list(answer.timing) == ["decode", "plan", "infer", "encode"]
    (y,) = answer.channels().values()
    assert y.shape == (24, 32)
    saved = answer.save(tmp_path / "out.exr")
    assert saved.read_bytes() == answer.content
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.exr", "view.exr"]


def test_an_answer_in_words_is_short(server, make_exr):
    with Client(server) as client:
        answer = client.shade("ao", make_exr(64, 64), Options(radius=0.25))
        layered = client.shade("ao", make_exr(8, 8), Options(append=True))
    words = repr(answer)
    assert len(words) < 120
    for word in ("ao", "image/x-exr", f"{len(answer.content):,} bytes", "tiny", "0.25"):
        assert word in words
    np.testing.assert_array_equal(layered.arrays()["ao"], [layered.channels()["ao.Y"]])


def test_explain_is_the_plan_of_the_answer(server, make_exr):
    options = Options(radius=0.25, bundle="tiny", engine="onnxruntime", precision="fp32")
    with Client(server) as client:
        plan = client.explain("ao", make_exr(24, 32), options)
        answer = client.shade("ao", make_exr(24, 32), options)
        png = client.shade("ao", make_exr(24, 32), replace(options, format="png"))
    assert plan["asked"] == {"bundle": "tiny", "engine": "onnxruntime", "precision": "fp32"}
    assert plan["radius"] == 0.25
    assert answer.plan() == plan
    assert png.plan() == plan

    async def work():
        async with AsyncClient(server) as client:
            return await client.explain("ao", make_exr(24, 32), options)

    assert asyncio.run(work()) == plan


def test_what_cannot_be_met_says_by_how_much(server, make_exr):
    with Client(server) as client, pytest.raises(BadRequest) as caught:
        client.shade("ao", make_exr(8, 8), Options(quality="best"))
    assert caught.value.kind == "no-bundle"


def test_every_option_reaches_the_service(server, make_exr, make_picture):
    channels = {
        name.replace("normal", "thing"): plane for name, plane in make_picture(8, 8).items()
    }
    options = Options(
        radius=2,
        fov=40.5,
        profile="deepshade",
        mapping={"normal": "thing"},
        bundle="tiny",
        max_error=0.5,
        engine="onnxruntime",
        precision="fp32",
        compression="piz",
        half=True,
    )
    with Client(server) as client:
        answer = client.shade("ao", make_exr(channels), options)
        png = client.shade("ao", make_exr(8, 8), Options(format="png"))
    assert answer.facts["radius"] == "2"
    assert "thing.X" in answer.facts["mapped"]
    assert png.media_type == "image/png"
    with pytest.raises(BadAnswer, match="can't be decoded"):
        png.channels()


def test_several_files_of_one_view(server, make_exr, make_picture, tmp_path):
    channels = make_picture(8, 8)
    paths = {}
    for name in ("normal", "position"):
        paths[name] = tmp_path / f"{name}.exr"
        paths[name].write_bytes(make_exr({k: v for k, v in channels.items() if name in k}))
    with Client(server) as client:
        whole = client.shade("ao", make_exr(channels)).channels()["Y"]
        listed = client.shade("ao", list(paths.values())).channels()["Y"]
        named = client.shade("ao", paths).channels()["Y"]
    np.testing.assert_array_equal(whole, listed)
    np.testing.assert_array_equal(whole, named)


def test_problems_become_exceptions(server, make_exr, make_picture):
    with Client(server, retry=NO_RETRY) as client:
        with pytest.raises(BadRequest, match="not an OpenEXR image") as caught:
            client.shade("ao", b"hello")
        assert (caught.value.status, caught.value.kind) == (400, "not-an-image")
        assert caught.value.fix
        with pytest.raises(BadRequest, match="no effect 'aoo'"):
            client.shade("aoo", b"")
        positions = {k: v for k, v in make_picture(4, 4).items() if "normal" in k}
        with pytest.raises(MissingAttribute) as missing:
            client.shade("ao", make_exr(positions))
        assert missing.value.missing == ["position"]
        assert "normal.X" in missing.value.found
        with pytest.raises(BadRequest, match="radius"):
            client.shade("ao", make_exr(4, 4), Options(radius=-1))


def test_several_effects_in_one_request(make_exr):
    """As a string or a list; arrays and facts are by effect, and both clients send the same."""
    rng = np.random.default_rng(3)
    names = ("ao.Y", "gi.R", "gi.G", "gi.B")
    channels = {name: rng.random((4, 6), np.float32) for name in names}
    transport = MockTransport(
        lambda request: mock_answer(
            channels, ao={"bundle": "best", "derived": "a: b; c"}, gi={"bundle": "fast"}
        )
    )
    with Client(transport=transport) as client:
        answers = [client.shade(each, make_exr(4, 6)) for each in ("ao,gi", ["ao", "gi"])]

    async def work():
        async with AsyncClient(transport=transport) as client:
            return await client.shade(("ao", "gi"), make_exr(4, 6))

    answers.append(asyncio.run(work()))
    assert {request.url.raw_path for request in transport.requests} == {b"/shade/ao,gi"}
    for answer in answers:
        assert answer.effects == ["ao", "gi"]
        assert answer.facts["ao.bundle"] == "best"
        assert answer.facts["gi.bundle"] == "fast"
        arrays = answer.arrays()
        assert list(arrays) == ["ao", "gi"]
        np.testing.assert_array_equal(arrays["ao"], channels["ao.Y"][None])
        np.testing.assert_array_equal(arrays["gi"], [channels[f"gi.{band}"] for band in "RGB"])


def test_one_effect_gives_its_array_too(server, make_exr):
    with Client(server) as client:
        answer = client.shade(["ao"], make_exr(4, 6))
    assert answer.effects == ["ao"]
    np.testing.assert_array_equal(answer.arrays()["ao"], [answer.channels()["Y"]])


@pytest.mark.parametrize("header", ["", "[1]", "{"])
def test_facts_that_cannot_be_read_are_a_bad_answer(header):
    def handler(request):
        response = mock_answer({"ao.Y": np.ones((2, 2))}, effects="ao,gi", ao={"radius": 2})
        response.headers["Deepshade-Gi"] = header
        return response

    with Client(transport=MockTransport(handler)) as client, pytest.raises(BadAnswer, match="gi"):
        client.shade("ao,gi", b"")


def test_effects(server):
    with Client(server) as client:
        assert client.wait_until_ready()["status"] == "ready"
        names = [effect["name"] for effect in client.effects()]
        assert "ao" in names
        assert client.effect("ao")["bundles"][0]["name"] == "tiny"


def test_async(server, make_exr):
    async def work():
        async with AsyncClient(server) as client:
            bodies = [make_exr(8, 8 + n) for n in range(4)]
            answers = await asyncio.gather(*(client.shade("ao", body) for body in bodies))
            effects = await client.effects()
            one = await client.effect("ao")
            await client.wait_until_ready()
            return answers, effects, one

    answers, effects, one = asyncio.run(work())
    assert [a.channels()["Y"].shape[1] for a in answers] == [8, 9, 10, 11]
    assert one in effects


def test_mock_transport(make_exr):
    shade = np.linspace(0, 1, 24, dtype=np.float32).reshape(4, 6)

    def handler(request):
        if request.url.path == "/shade/ao":
            return mock_answer({"Y": shade}, radius=2, radius_source="request")
        return httpx.Response(422, json={"type": "urn:x:missing-attribute", "missing": ["depth"]})

    mock = MockTransport(handler)
    with Client(transport=mock) as client:
        answer = client.shade("ao", make_exr(4, 6), Options(quality="fast", budget_ms=3))
        with pytest.raises(MissingAttribute) as caught:
            client.shade("dof", b"hello")
    assert caught.value.missing == ["depth"]
    assert answer.facts == {"radius": "2", "radius_source": "request"}
    np.testing.assert_array_equal(answer.channels()["Y"], shade)
    assert [request.url.path for request in mock.requests] == ["/shade/ao", "/shade/dof"]
    assert dict(mock.requests[0].url.params) == {"quality": "fast", "budget_ms": "3"}
    assert mock.requests[1].content == b"hello"

    async def work():
        async with AsyncClient(transport=mock) as client:
            return await client.shade("ao", make_exr(4, 6))

    assert asyncio.run(work()).content == answer.content


def test_shade_to(server, make_exr, tmp_path):
    target = tmp_path / "new" / "out.exr"
    with Client(server, retry=NO_RETRY) as client:
        answer = client.shade("ao", make_exr(8, 8), Options(radius=0.5))
        saved = client.shade_to(target, "ao", make_exr(8, 8), Options(radius=0.5))
        with pytest.raises(BadRequest, match="not an OpenEXR image"):
            client.shade_to(target, "ao", b"hello")
    assert (saved.path, saved.media_type, saved.facts) == (target, "image/x-exr", answer.facts)
    assert list(saved.timing) == list(answer.timing)
    np.testing.assert_array_equal(exr.read(target).pixels["Y"], answer.channels()["Y"])
    assert [path.name for path in target.parent.iterdir()] == ["out.exr"]

    async def work():
        async with AsyncClient(server) as client:
            return await client.shade_to(str(target), "ao", make_exr(8, 9))

    assert asyncio.run(work()).path == target
    assert exr.read_header(target).parts[0].shape == (8, 9)


class Pieces(httpx.SyncByteStream, httpx.AsyncByteStream):
    """A body of 64 KiB pieces that are made when they are asked for; it may break at the end."""

    def __init__(self, count, error=None):
        self.count, self.error = count, error

    def __iter__(self):
        yield from (bytes(2**16) for _ in range(self.count))
        if self.error:
            raise self.error

    async def __aiter__(self):
        for piece in self:
            yield piece


def large(count, error=None):
    headers = {"Content-Type": "image/x-exr"}
    return httpx.Response(200, headers=headers, stream=Pieces(count, error))


def test_an_answer_goes_to_disk_as_it_arrives(tmp_path):
    """However large it is: 32 MiB here, of which memory never holds one."""

    async def work():
        async with AsyncClient(transport=MockTransport(lambda request: large(512))) as client:
            return await client.shade_to(tmp_path / "a.exr", "ao", b"")

    with Client(transport=MockTransport(lambda request: large(512))) as client:
        for save in (
            lambda: client.shade_to(tmp_path / "a.exr", "ao", b""),
            lambda: asyncio.run(work()),
        ):
            tracemalloc.start()
            save()
            _, peak = tracemalloc.get_traced_memory()
            tracemalloc.stop()
            assert peak < 2**20 < (tmp_path / "a.exr").stat().st_size == 2**25


def test_an_answer_that_breaks_off_leaves_nothing_and_is_asked_for_again(tmp_path):
    answers = [large(3, httpx.ReadError("reset")), large(2)]
    (tmp_path / "a.exr").write_bytes(b"before")

    def handler(request):
        assert (tmp_path / "a.exr").read_bytes() == b"before"
        return answers.pop(0)

    with Client(transport=MockTransport(handler), retry=FAST) as client:
        client.shade_to(tmp_path / "a.exr", "ao", b"")
    assert (tmp_path / "a.exr").stat().st_size == 2**17
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


@pytest.mark.parametrize("status", [200, 422, 0])
def test_a_batch_keeps_no_bytes_of_what_is_done(status, tmp_path):
    """Sixteen pictures of 1 MiB and their answers, of which one at a time is in memory."""
    size, count = 2**20, 16
    (tmp_path / "a.exr").write_bytes(bytes(size))
    tasks = [batch.Task((tmp_path / "a.exr",), tmp_path / f"out/{n}.exr") for n in range(count)]

    def handler(request):
        if status == 0:
            raise httpx.ReadError("reset", request=request)
        return large(16) if status == 200 else failing(status)

    async def work():
        # what was sent isn't kept either, so no MockTransport
        transport = httpx.MockTransport(handler)
        async with AsyncClient(transport=transport, retry=NO_RETRY) as client:
            return await batch.run(client, "ao", tasks, Options(), jobs=1, done=lambda result: None)

    tracemalloc.start()
    results = asyncio.run(work())
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert [result.error is None for result in results] == [status == 200] * count
    assert peak < 4 * size


@pytest.mark.parametrize("server", ["http://a:b", "127.0.0.1:8000", "ftp://x", "", "http://"])
def test_what_is_no_address(server, monkeypatch):
    monkeypatch.setenv("DEEPSHADE_SERVER", "http://")
    with pytest.raises(ClientError, match="no address") as caught:
        Client(server)
    assert "http://127.0.0.1:8000" in caught.value.fix


class Script(httpx.BaseTransport, httpx.AsyncBaseTransport):
    """Plays back responses and exceptions, and counts the requests."""

    def __init__(self, *steps):
        self.steps = list(steps)
        self.asked = 0

    def handle_request(self, request):
        self.asked += 1
        step = self.steps.pop(0)
        if isinstance(step, Exception):
            raise step
        # A response can be read once, so hand out a fresh one.
        return httpx.Response(step.status_code, headers=step.headers, content=step.content)

    async def handle_async_request(self, request):
        return self.handle_request(request)


def ok():
    return httpx.Response(200, json=[])


def failing(status, retry_after=None):
    headers = {"Retry-After": retry_after} if retry_after else {}
    return httpx.Response(status, json={"detail": f"it is {status}"}, headers=headers)


@pytest.mark.parametrize(
    "failure",
    [
        failing(429),
        failing(503),
        failing(429, "0"),
        httpx.ConnectError("refused"),
        httpx.ConnectTimeout("slow"),
        httpx.ReadError("broken"),
        httpx.RemoteProtocolError("closed"),
        # not the service's own, which are problem documents: a balancer's that lost a replica
        httpx.Response(500, text="Internal Server Error"),
        httpx.Response(502, text="<html>"),
    ],
)
def test_tries_again_what_may_succeed(failure):
    script = Script(failure, failure, ok())
    with Client(transport=script, retry=FAST) as client:
        assert client.effects() == []
    assert script.asked == 3

    async def work():
        async with AsyncClient(transport=Script(failure, ok()), retry=FAST) as client:
            return await client.effects()

    assert asyncio.run(work()) == []


def test_a_timeout_may_be_a_number():
    seen = []

    def answer(request):
        seen.append(request.extensions["timeout"])
        return ok()

    for timeout in (7, Timeout(answer=7)):
        with Client(transport=httpx.MockTransport(answer), timeout=timeout) as client:
            client.effects()
    assert seen == [Timeout(answer=7).as_httpx().as_dict()] * 2
    for wrong in (0, -1.5, float("nan"), float("inf"), "7"):
        with pytest.raises(ClientError, match="seconds above 0"):
            Client(timeout=wrong)


@pytest.mark.parametrize(
    ("failure", "error"),
    [
        (failing(400), BadRequest),
        (failing(404), BadRequest),
        (failing(413), TooLarge),
        (failing(422), BadRequest),
        (failing(500), ServerFailed),
        (failing(502), ServerFailed),
        (httpx.ReadTimeout("slow"), TimedOut),
        (httpx.Response(200, text="hello"), BadAnswer),
    ],
)
def test_does_not_try_again_what_cannot(failure, error):
    script = Script(failure, ok())
    with Client(transport=script, retry=FAST) as client, pytest.raises(error):
        client.effects()
    assert script.asked == 1


@pytest.mark.parametrize(
    ("failure", "error"),
    [(failing(429), Busy), (failing(503), NotReady), (httpx.ConnectError("x"), ConnectionFailed)],
)
def test_gives_up_in_the_end(failure, error):
    script = Script(*[failure] * 10)
    with Client(transport=script, retry=FAST) as client, pytest.raises(error):
        client.effects()
    assert script.asked == FAST.attempts


def test_pauses_grow_honour_retry_after_and_are_capped():
    retry = Retry(attempts=10, first=1, longest=20)
    pauses = [retry.pause(Busy(429, {}), attempt) for attempt in range(1, 10)]
    for attempt, pause in enumerate(pauses[:4]):
        assert 2**attempt <= pause <= 1.25 * 2**attempt
    assert pauses[-1] == 20
    assert retry.pause(Busy(429, {}, retry_after=60), 1) == 60  # not cut to our own longest
    assert retry.pause(Busy(429, {}), 10) is None
    assert retry.pause(Busy(429, {}, retry_after=7), 1) == 7
    assert retry.pause(Busy(429, {}, retry_after=10_000), 1) == 300
    assert retry.pause(BadRequest(400, {}), 1) is None


def test_retry_after_as_a_date():
    from email.utils import formatdate
    from time import time

    script = Script(failing(429, formatdate(time() + 30, usegmt=True)))
    with Client(transport=script, retry=NO_RETRY) as client, pytest.raises(Busy) as caught:
        client.effects()
    assert 25 < caught.value.retry_after <= 31


def test_a_broken_connection_stops_no_batch(make_exr, tmp_path):
    (tmp_path / "a.exr").write_bytes(make_exr(4, 4))
    tasks = [batch.Task((tmp_path / "a.exr",), tmp_path / f"{n}.exr") for n in range(3)]
    found = httpx.Response(200, content=b"x", headers={"Content-Type": "image/x-exr"})

    async def work(failure):
        script = Script(failure, found, found)
        async with AsyncClient(transport=script, retry=NO_RETRY) as client:
            return await batch.run(client, "ao", tasks, Options(), jobs=1, done=lambda result: None)

    results = asyncio.run(work(httpx.ReadError("reset")))
    assert [type(result.error) for result in results] == [ConnectionBroken, type(None), type(None)]
    assert len(asyncio.run(work(httpx.ConnectError("refused")))) == 1


def test_nobody_listens():
    with (
        Client("http://127.0.0.1:9", retry=NO_RETRY, timeout=Timeout(connect=1)) as client,
        pytest.raises(ConnectionFailed, match=r"127\.0\.0\.1:9") as caught,
    ):
        client.effects()
    assert "deepshade serve" in caught.value.fix


def test_the_server_comes_from_the_environment(monkeypatch):
    monkeypatch.setenv("DEEPSHADE_SERVER", "http://render.example:1234/shaders/")
    with Client() as client:
        assert client.server == "http://render.example:1234/shaders"
    script = Script(ok())
    with Client("http://x/y/", transport=script) as client:
        client.effects()


def test_a_path_in_front_of_the_service_is_kept():
    paths = []

    class Proxy(Script):
        def handle_request(self, request):
            paths.append(request.url.path)
            return ok()

    with Client("http://x/shaders/", transport=Proxy()) as client:
        client.effects()
    assert paths == ["/shaders/effects"]
