"""Every error is a problem document with the right status that says what to do."""

from __future__ import annotations

import asyncio
import gc
import json
import socket
import threading
import time

import numpy as np
import pytest

from deepshade.exr import Limits
from deepshade_service.uploads import Upload

EXR = {"Content-Type": "image/x-exr"}


def problem(response, status, kind=None):
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    document = response.json()
    assert document["status"] == status
    assert document["type"].startswith("urn:deepshade:problem:")
    assert document["title"]
    assert document["detail"]
    if kind:
        assert document["type"].endswith(f":{kind}")
    return document


def shade(client, body, query="", effect="ao", **options):
    return client.post(f"/shade/{effect}{query}", content=body, headers=EXR, **options)


def test_routes(client):
    problem(client.get("/nothing"), 404)
    assert "GET" not in problem(client.get("/shade/ao"), 405)["title"]
    assert client.get("/shade/ao").headers["allow"] == "POST"


def test_unknown_effect_names_the_nearest(client, make_exr):
    document = problem(shade(client, make_exr(4, 4), effect="aoo"), 404, "unknown-effect")
    assert "'ao'" in document["fix"]
    problem(client.get("/effects/aoo"), 404, "unknown-effect")


def test_an_effect_without_a_bundle_says_so(client, make_exr):
    document = problem(shade(client, make_exr(4, 4), effect="gi"), 404, "no-bundle")
    assert "no bundle for the effect 'gi' is installed" in document["detail"]
    assert document["installed"] == ["ao"]


def test_unknown_bundle_names_the_nearest(client, make_exr):
    document = problem(shade(client, make_exr(4, 4), "?bundle=tinny"), 404, "no-bundle")
    assert "'tiny'" in document["fix"]
    assert shade(client, make_exr(4, 4), "?bundle=tiny").status_code == 200


@pytest.mark.parametrize("body", [b"", b"hello", b"\x89PNG\r\n\x1a\n" + bytes(100)])
def test_no_exr(client, body):
    problem(shade(client, body), 400, "not-an-image")


def test_truncated(client, make_exr):
    body = make_exr(32, 32)
    problem(shade(client, body[: len(body) * 2 // 3]), 400, "damaged-image")


@pytest.mark.parametrize("kind", ["text/plain", "", "image/png", "application/json"])
def test_content_type(client, make_exr, kind):
    response = client.post(
        "/shade/ao", content=make_exr(4, 4), headers={"Content-Type": kind} if kind else {}
    )
    document = problem(response, 415, "unsupported-type")
    assert "image/x-exr" in document["supported"]


def test_missing_attribute_names_found_missing_and_near(client, make_exr, make_picture):
    channels = {
        name.replace("position", "positon"): plane for name, plane in make_picture(8, 8).items()
    }
    document = problem(shade(client, make_exr(channels)), 422, "missing-attribute")
    assert document["missing"] == ["position"]
    assert "normal.X" in document["found"]
    assert document["near"]["position"] == ["positon"]
    assert "positon" in document["fix"]


@pytest.mark.parametrize(
    "query",
    [
        *(f"radius={value}" for value in ("0", "-1", "nan", "inf", "-inf", "x", "", "1e99")),
        *(f"fov={value}" for value in ("0", "180", "-5", "nan", "x")),
        "compression=zap",
        "format=gif",
        "half=perhaps",
        "profile=maya",
        "map=normal",
        "map==x",
        "radiu=1",
        "map=nromal=x",
    ],
)
def test_bad_parameters(client, make_exr, query):
    name = query.partition("=")[0]
    document = problem(shade(client, make_exr(4, 4), f"?{query}"), 422)
    assert name in document["detail"] or document["fix"] == "did you mean 'normal'?"


@pytest.mark.parametrize(
    ("query", "said"),
    [
        ("raduis=1", "did you mean ?radius=?"),
        ("quality=bset", "did you mean ?quality=best?"),
        ("profile=blendr", "did you mean ?profile=blender?"),
        ("radius=-1", "must be at least 1e-30, not -1"),
    ],
)
def test_near_misses_and_readable_bounds(client, make_exr, query, said):
    document = problem(shade(client, make_exr(4, 4), f"?{query}"), 422, "bad-parameter")
    assert said in f"{document['detail']}; {document['fix']}"


def test_fixes_name_query_parameters_and_following_them_works(client, make_exr):
    plane = np.full((8, 8), 3, "f")
    body = make_exr({"Z": plane})
    document = problem(shade(client, body), 422, "no-camera")
    assert "(?fov=)" in document["fix"]
    assert shade(client, body, "?fov=50").status_code == 200
    document = problem(shade(client, make_exr({"A": plane})), 422, "missing-attribute")
    assert "depth with the field of view (?fov=)" in document["fix"]
    body = make_exr(
        {f"{a}.normal.{c}": plane * (c == "Z") for a in "AB" for c in "XYZ"} | {"Z": plane}
    )
    document = problem(shade(client, body, "?fov=50"), 422, "ambiguous-channel")
    query = document["fix"].partition(": ")[2]
    assert shade(client, body, f"{query}&fov=50").status_code == 200


def test_what_still_loads_when_the_service_stops_is_refused(start, make_exr):
    local = start()

    async def stop():
        local.service.stopping.set()

    local.run(stop())
    document = problem(shade(local.client, make_exr(4, 4)), 503, "stopping")
    assert "loaded" in document["detail"]


def test_a_bad_radius_in_the_header(client, make_exr):
    body = make_exr(4, 4, attributes={"deepshade:radius": -2.0})
    problem(shade(client, body), 422, "bad-header")
    assert shade(client, body, "?radius=1").status_code == 200


@pytest.mark.parametrize(
    ("limit", "value"),
    [("body_bytes", 900), ("decoded_bytes", 1000), ("pixels", 200), ("channels", 5), ("parts", 0)],
)
def test_limits(start, make_exr, limit, value):
    local = start(limits=Limits(**{limit: value}))
    document = problem(shade(local.client, make_exr(16, 16)), 413, "over-limit")
    assert document["limit"] == limit
    assert f"--max-{limit.removesuffix('_bytes')}" in document["fix"]
    assert document["maximum"] == value
    assert document["value"] > value


def test_body_limit_without_content_length(start, make_exr):
    local = start(limits=Limits(body_bytes=100_000))
    sent = 0

    def endless():
        nonlocal sent
        for _ in range(1000):
            sent += 10_000
            yield bytes(10_000)

    document = problem(shade(local.client, endless()), 413, "over-limit")
    assert document["value"] <= 400_000
    assert shade(local.client, make_exr(8, 8)).status_code == 200
    assert local.service.uploads.held == 0


def test_declared_length_over_the_limit_is_refused_before_the_body(start):
    local = start(limits=Limits(body_bytes=1000))
    with socket.create_connection(local.address, timeout=5) as connection:
        connection.sendall(
            b"POST /shade/ao HTTP/1.1\r\nHost: x\r\nContent-Type: image/x-exr\r\n"
            b"Content-Length: 99999999999\r\n\r\n"
        )
        assert b"413" in connection.recv(100)


def test_a_refusal_reaches_a_client_that_is_still_sending(start, make_exr):
    local = start(limits=Limits(body_bytes=2**20), queue=0, workers=1)
    big = bytes(16 * 2**20)
    for _ in range(3):
        response = shade(local.client, big)
        problem(response, 413, "over-limit")
        assert response.headers["connection"] == "close"
    problem(shade(local.client, big, effect="aoo"), 404, "unknown-effect")
    response = local.client.post("/shade/ao", content=big, headers={"Content-Type": "text/plain"})
    problem(response, 415, "unsupported-type")
    response = shade(local.client, make_exr(8, 8))
    assert response.status_code == 200
    assert "connection" not in response.headers
    # the body has arrived: nothing is in the way, the connection stays
    assert "connection" not in shade(local.client, b"hello").headers


def test_sum_of_uploads_is_limited(start, make_exr, wait_until):
    body = make_exr(64, 64)
    room = 2 * len(body) + 100  # a body is held twice while its pieces are joined
    local = start(uploads=room, limits=Limits(body_bytes=len(body)))
    with socket.create_connection(local.address, timeout=5) as connection:
        connection.sendall(
            b"POST /shade/ao HTTP/1.1\r\nHost: x\r\nContent-Type: image/x-exr\r\n"
            b"Content-Length: 1000\r\n\r\n" + bytes(500)
        )
        wait_until(lambda: local.service.uploads.held)
        response = shade(local.client, body)
    problem(response, 429, "uploads-full")
    assert int(response.headers["retry-after"]) > 0
    wait_until(lambda: not local.service.uploads.held)
    assert shade(local.client, body).status_code == 200


def test_too_large_for_the_memory(start, make_exr):
    local = start(memory=900_000)
    document = problem(shade(local.client, make_exr(256, 256)), 413, "over-limit")
    assert document["limit"] == "memory_bytes"
    assert "--memory" in document["fix"]
    assert shade(local.client, make_exr(8, 8)).status_code == 200


def test_slow_body_times_out_and_holds_no_worker(start, make_exr):
    local = start(body_timeout=0.3, workers=1, queue=0)
    with socket.create_connection(local.address, timeout=5) as connection:
        connection.sendall(
            b"POST /shade/ao HTTP/1.1\r\nHost: x\r\nContent-Type: image/x-exr\r\n"
            b"Content-Length: 1000\r\n\r\nabc"
        )
        time.sleep(0.05)
        assert shade(local.client, make_exr(8, 8)).status_code == 200
        answer = b""
        while chunk := connection.recv(4096):
            answer += chunk
    head, _, body = answer.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 408")
    assert json.loads(body)["status"] == 408
    assert local.service.uploads.held == 0


def block(local):
    """Make every prediction wait for the returned event."""
    gate, started = threading.Event(), threading.Event()
    engine = local.engine()
    predict = engine.predict

    def waiting(gbuffer):
        started.set()
        assert gate.wait(20)
        return predict(gbuffer)

    engine.predict = waiting
    return gate, started


def in_thread(work):
    results = []
    thread = threading.Thread(target=lambda: results.append(work()))
    thread.start()
    return thread, results


def test_full_queue_is_429_and_the_loop_stays_free(start, make_exr, wait_until):
    local = start(workers=1, queue=1)
    gate, started = block(local)
    body = make_exr(8, 8)
    waiting = [in_thread(lambda: shade(local.client, body)) for _ in range(2)]
    assert started.wait(10)
    wait_until(lambda: local.service.workers.taken == 2)
    response = shade(local.client, body)
    assert local.client.get("/healthz").status_code == 200
    gate.set()
    problem(response, 429, "queue-full")
    assert int(response.headers["retry-after"]) >= 1
    for thread, results in waiting:
        thread.join(10)
        assert results[0].status_code == 200


def alive(local):
    """Bytes of the uploads that the process still has."""
    gc.collect()
    return sum(len(each.data) for each in gc.get_objects() if type(each) is Upload)


def send(local, body):
    """A connection that has sent a request, and may leave before the answer."""
    connection = socket.create_connection(local.address)
    head = b"POST /shade/ao HTTP/1.1\r\nHost: x\r\nContent-Type: image/x-exr\r\n"
    connection.sendall(head + b"Content-Length: %d\r\n\r\n" % len(body) + body)
    return connection


def test_a_client_that_leaves_while_its_job_waits_leaves_nothing_behind(
    start, make_exr, wait_until
):
    local = start(workers=1, queue=4)
    gate, started = block(local)
    body = make_exr(8, 8)
    before = alive(local)
    first, results = in_thread(lambda: shade(local.client, body))
    assert started.wait(10)
    for _ in range(3):
        with send(local, body):
            wait_until(lambda: local.service.workers.taken == 2)
        wait_until(lambda: local.service.workers.taken == 1)
    wait_until(lambda: local.service.uploads.held == len(body))
    assert alive(local) - before == len(body)
    gate.set()
    first.join(10)
    assert results[0].status_code == 200
    wait_until(lambda: not local.service.workers.taken)
    assert local.service.uploads.held == 0


def test_what_a_left_job_holds_counts_until_its_thread_ends(start, make_exr, wait_until):
    local = start(workers=1, queue=4)
    gate, started = block(local)
    body = make_exr(8, 8)
    with send(local, body):
        assert started.wait(10)
    assert shade(local.client, b"", effect="aoo").status_code == 404  # the loop has gone on
    time.sleep(0.05)
    assert (local.service.uploads.held, local.service.workers.taken) == (len(body), 1)
    gate.set()
    wait_until(lambda: not local.service.workers.taken)
    assert local.service.uploads.held == 0
    assert shade(local.client, body).status_code == 200


def test_who_waits_for_memory_waits_in_turn_and_takes_no_worker(start, make_exr, wait_until):
    local = start(workers=1, queue=4)
    memory, workers = local.service.memory, local.service.workers
    gate, holding = threading.Event(), threading.Event()

    async def hold():
        async with memory.hold(memory.total):
            holding.set()
            await asyncio.to_thread(gate.wait, 20)

    holder, _ = in_thread(lambda: local.run(hold()))
    assert holding.wait(10)
    waiting = [in_thread(lambda: shade(local.client, make_exr(8, 8))) for _ in range(2)]
    wait_until(lambda: len(memory._waiting) == 2)
    assert local.run(workers.run(lambda _: 7)) == 7  # the only worker is idle
    gate.set()
    holder.join()
    for thread, results in waiting:
        thread.join(10)
        assert results[0].status_code == 200


def test_not_ready(start, tmp_path, make_exr):
    local = start(ready=False, models=tmp_path)
    assert local.client.get("/healthz").status_code == 200
    for response in (local.client.get("/readyz"), shade(local.client, make_exr(4, 4))):
        problem(response, 503, "not-ready")
        assert int(response.headers["retry-after"]) > 0
    assert local.client.get("/effects/ao").json()["bundles"] == []


def test_a_damaged_bundle_is_refused_and_the_others_serve(start, tmp_path, models, make_exr):
    import shutil

    shutil.copytree(models, tmp_path, dirs_exist_ok=True)
    shutil.copytree(models / "ao" / "tiny", tmp_path / "ao" / "broken")
    with (tmp_path / "ao" / "broken" / "model.onnx").open("ab") as file:
        file.write(b"x")
    local = start(models=tmp_path)
    assert local.client.get("/readyz").json()["refused"] == ["ao/broken"]
    assert shade(local.client, make_exr(4, 4)).headers["deepshade-bundle"] == "tiny"


def test_a_failure_inside_shows_no_traceback(start, make_exr):
    local = start()

    def fail(gbuffer):
        raise RuntimeError("secret detail")

    local.engine().predict = fail
    response = shade(local.client, make_exr(4, 4))
    problem(response, 500, "internal")
    assert "secret" not in response.text
    assert "Traceback" not in response.text


def test_a_network_that_answers_nan_is_an_error(start, make_exr):
    local = start()
    engine = local.engine()
    engine.predict = lambda g: np.full((1, 1, *g.shape[2:]), np.nan, np.float32)
    problem(shade(local.client, make_exr(64, 64)), 500, "bad-answer")


class TestForm:
    def post(self, client, body, kind="multipart/form-data; boundary=X"):
        return client.post("/shade/ao", content=body, headers={"Content-Type": kind})

    def part(self, data=b"x", head=b'name="image"; filename="a.exr"'):
        return b"--X\r\nContent-Disposition: form-data; " + head + b"\r\n\r\n" + data + b"\r\n"

    def test_no_boundary(self, client):
        problem(self.post(client, b"", "multipart/form-data"), 400, "damaged-form")

    def test_no_file(self, client):
        problem(self.post(client, b"--X--\r\n"), 400, "damaged-form")

    @pytest.mark.parametrize("body", [b"", b"garbage", b"--Y\r\n\r\n--Y--"])
    def test_garbage(self, client, body):
        problem(self.post(client, body), 400, "damaged-form")

    def test_unfinished(self, client):
        problem(self.post(client, self.part()), 400, "damaged-form")

    def test_a_field_that_is_no_file(self, client):
        body = self.part(head=b'name="radius"') + b"--X--\r\n"
        assert "radius" in problem(self.post(client, body), 422, "not-a-file")["detail"]

    def test_too_many_files(self, start):
        local = start(files=3)
        document = problem(self.post(local.client, self.part() * 4 + b"--X--\r\n"), 413)
        assert document["limit"] == "files"

    def test_sizes_that_differ(self, client, make_exr, make_picture):
        files = [
            (
                name,
                (
                    f"{name}.exr",
                    make_exr({k: v for k, v in make_picture(*size).items() if name in k}),
                ),
            )
            for name, size in (("normal", (8, 8)), ("position", (8, 9)))
        ]
        problem(client.post("/shade/ao", files=files), 400)
