"""The trainer service: its queue, its store on both databases, its paths, and what it publishes."""

from __future__ import annotations

import json
import os
import pwd
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any, ClassVar

import httpx
import pytest
import uvicorn

from deepshade.bundles import bundle_root
from deepshade.errors import BundleError, ConfigError
from deepshade.serving import listen
from deepshade.versions import Alias
from deepshade_trainer.service.app import create_app
from deepshade_trainer.service.config import Settings
from deepshade_trainer.service.places import confined
from deepshade_trainer.service.publishing import Publisher
from deepshade_trainer.service.store import CANCELLED, DONE, QUEUED, RUNNING, Job, Store

TOKEN = "a-token-of-some-length"
POSTGRES = shutil.which("postgres"), shutil.which("initdb")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Postgres:
    """A real PostgreSQL server of our own, at a free port."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.port = folder, free_port()
        self.user = "postgres" if os.geteuid() == 0 else pwd.getpwuid(os.geteuid()).pw_name
        self.url = f"postgresql+psycopg://deepshade@127.0.0.1:{self.port}/postgres"
        if os.geteuid() == 0:
            shutil.chown(folder, self.user)
        setup = ["-A", "trust", "-U", "deepshade", "--no-sync", "-D", str(folder / "db")]
        subprocess.run([str(POSTGRES[1]), *setup], check=True, stdout=-3, **self._as())
        self.start()

    def _as(self) -> dict[str, Any]:
        """It refuses to run as root."""
        return {"user": self.user, "cwd": self.folder} if os.geteuid() == 0 else {}

    def start(self) -> None:
        command = [str(POSTGRES[0]), "-D", str(self.folder / "db"), "-p", str(self.port)]
        command += ["-k", str(self.folder), "-c", "listen_addresses=127.0.0.1"]
        self.process = subprocess.Popen(command, stdout=-3, stderr=-3, **self._as())
        until = time.monotonic() + 60
        while time.monotonic() < until:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            time.sleep(0.05)
        raise AssertionError("PostgreSQL doesn't start")

    def kill(self) -> None:
        """As `kill -9` of the server and all its processes."""
        for child in subprocess.run(
            ["pgrep", "-P", str(self.process.pid)], capture_output=True, text=True
        ).stdout.split():
            with suppress(ProcessLookupError):  # one ended by itself, or with another
                os.kill(int(child), signal.SIGKILL)
        self.process.kill()
        self.process.wait()


@pytest.fixture(scope="module")
def postgres() -> Iterator[Postgres]:
    if None in POSTGRES:
        pytest.skip("PostgreSQL isn't installed here: apt-get install postgresql")
    if os.geteuid() == 0 and "postgres" not in {each.pw_name for each in pwd.getpwall()}:
        pytest.skip("PostgreSQL doesn't run as root, and there is no user 'postgres'")
    folder = Path(tempfile.mkdtemp(prefix="deepshade-postgres-"))  # which its user can reach
    server = Postgres(folder)
    yield server
    server.process.send_signal(signal.SIGINT)
    server.process.wait(30)
    shutil.rmtree(folder)


@pytest.fixture(params=["sqlite", "postgresql"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Store]:
    """An empty store, on either database."""
    if request.param == "sqlite":
        store = Store(f"sqlite:///{tmp_path / 'jobs.db'}")
    else:
        store = Store(request.getfixturevalue("postgres").url)
    store.prepare()
    yield store
    from sqlalchemy import delete

    with store._session() as session:
        session.execute(delete(Job))
    store.close()


def job(key: str, place: float = 0.0) -> Job:
    return Job(
        id=key,
        key=key * 4,
        effect="ao",
        name="balanced",
        asked={"minutes": 10.0, "seed": 0},
        state=QUEUED,
        place=place,
        created=time.time(),
        begun=0,
        sentence="",
        fix="",
    )


def test_a_store_keeps_each_job_once_and_in_turn(store: Store) -> None:
    for place, key in enumerate("abc"):
        found, fresh = store.add(job(key, place))
        assert fresh
        assert store.before(found) == place
    again, fresh = store.add(job("b", 9))
    assert (again.place, fresh) == (1, False)
    first = store.claim()
    assert first is not None
    assert (first.id, first.state, first.begun) == ("a", RUNNING, 1)
    assert [each.id for each in store.jobs()] == ["c", "b", "a"]
    assert store.move("a", DONE, of=(RUNNING,), published=3, sentence="better")
    assert not store.move("a", CANCELLED, of=(QUEUED,))
    done = store.get("a")
    assert done is not None
    assert done.asked == {"minutes": 10.0, "seed": 0}
    assert (done.published, done.state) == (3, DONE)
    assert not store.add(job("a"))[1]  # done is done
    store.move("b", CANCELLED, of=(QUEUED,))
    assert store.add(job("b"))[1]  # asked for again, it waits again, behind the others
    assert [store.claim().id for _ in range(2)] == ["c", "b"]  # type: ignore[union-attr]
    assert store.claim() is None


def test_what_ran_when_all_was_killed_waits_again(store: Store) -> None:
    store.add(job("a", 1))
    store.add(job("b", 2))
    assert store.claim().id == "a"  # type: ignore[union-attr]
    store.prepare()
    again = store.claim()
    assert again is not None
    assert (again.id, again.begun) == ("a", 2)


def test_a_job_is_claimed_once_however_many_ask(store: Store) -> None:
    for number in range(12):
        store.add(job(f"j{number}", number))
    claimed: list[str] = []

    def claim() -> None:
        while store.waiting():
            if (found := store.claim()) is not None:
                claimed.append(found.id)

    threads = [threading.Thread(target=claim) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(claimed) == sorted(f"j{number}" for number in range(12))


def test_a_killed_database_is_waited_for(postgres: Postgres) -> None:
    store = Store(postgres.url)
    store.prepare()
    store.add(job("k", 1))
    postgres.kill()
    from sqlalchemy.exc import SQLAlchemyError

    with pytest.raises(SQLAlchemyError):
        store.get("k")
    postgres.start()
    until = time.monotonic() + 60
    while True:  # it recovers from its log first
        try:
            assert store.get("k") is not None
            break
        except SQLAlchemyError:
            assert time.monotonic() < until
            time.sleep(0.1)
    store.close()


def test_a_url_that_is_none_is_said() -> None:
    with pytest.raises(ConfigError, match="postgresql\\+psycopg"):
        Store("nonsense")


def test_paths_stay_in_their_roots(tmp_path: Path) -> None:
    root, secret = tmp_path / "root", tmp_path / "secret"
    (root / "a").mkdir(parents=True)
    secret.mkdir()
    (root / "out").symlink_to(secret)
    (root / "in").symlink_to(root / "a")
    assert confined("a", [root]) == (root / "a").resolve()
    assert confined(str(root / "a"), [root]) == (root / "a").resolve()
    assert confined("in", [root]) == (root / "a").resolve()
    for name in ("out", "../secret", str(secret), "/etc/passwd", "a/../../secret", "", "x\0", "no"):
        with pytest.raises(ConfigError):
            confined(name, [root])
    with pytest.raises(ConfigError):
        confined("a", [])
    (root / "a/shard-00000.safetensors").symlink_to(secret)
    with pytest.raises(ConfigError, match="link out of"):
        confined("a", [root])


@pytest.fixture
def settings(
    base: Path, data: Path, judges: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> Settings:
    library = tmp_path / "library"
    (library / "ao").mkdir(parents=True)
    shutil.copytree(judges, library / "ao/test")
    return Settings(
        folder=tmp_path / "trainer",
        published=tmp_path / "models",
        bases=(base.parents[1], bundle_root()),
        data=(data.parent,),
        library=library,
        token=TOKEN,
        threads=1,
        **getattr(request, "param", {}),
    )


@pytest.fixture
def client(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> Iterator[httpx.Client]:
    """A client of a service, in a thread, whose queue stands still."""

    async def still(self: Any) -> None:
        self._store.prepare()

    monkeypatch.setattr("deepshade_trainer.service.queue.Queue.run", still)
    config = uvicorn.Config(create_app(settings), log_config=None, timeout_graceful_shutdown=1)
    server, listener = uvicorn.Server(config), listen("127.0.0.1", 0)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    url = f"http://127.0.0.1:{listener.getsockname()[1]}"
    headers = {"Authorization": f"Bearer {TOKEN}"}
    with httpx.Client(base_url=url, headers=headers, trust_env=False, timeout=60) as client:
        until = time.monotonic() + 30
        while client.get("/readyz").status_code != 200:
            assert time.monotonic() < until
            time.sleep(0.01)
        yield client
    server.should_exit = True
    thread.join(30)
    listener.close()


ASKED = {"data": "waves", "steps": 4, "batch": 4}


def test_the_same_request_finds_the_same_job(client: httpx.Client) -> None:
    first = client.post("/train/ao", json=ASKED)
    assert first.status_code == 202
    assert (first.json()["state"], first.json()["before"]) == ("queued", 0)
    again = client.post("/train/ao", json=ASKED)
    assert (again.status_code, again.json()["id"]) == (200, first.json()["id"])
    other = client.post("/train/ao", json=ASKED | {"seed": 1}).json()
    assert other["before"] == 1
    assert [each["id"] for each in client.get("/jobs").json()] == [
        other["id"],
        first.json()["id"],
    ]
    assert client.delete(f"/jobs/{other['id']}").json()["cancelled"]
    assert client.get(f"/jobs/{other['id']}").json()["state"] == "cancelled"
    assert client.post("/train/ao", json=ASKED | {"seed": 1}).status_code == 202


@pytest.mark.parametrize(
    ("effect", "asked", "said"),
    [
        ("aoo", ASKED, "no effect"),
        ("full", ASKED, "it has nothing to learn"),
        ("ao", {"steps": 4}, "one of data, upload and scene"),
        ("ao", ASKED | {"scene": "procedural:room:1"}, "not data and scene"),
        ("ao", ASKED | {"minutes": -1}, "minutes"),
        ("ao", ASKED | {"stepz": 1}, "stepz"),
        ("ao", ASKED | {"base": "balancd"}, "no bundle ao/balancd"),
        ("ao", ASKED | {"name": "../x"}, "can't be a bundle's name"),
        ("ao", {"data": "../../etc"}, "isn't in the trainer's data folders"),
        ("ao", {"scene": "/etc/passwd"}, "isn't in the trainer's data folders"),
        ("ao", {"scene": "compose:/etc+/usr"}, "isn't in the trainer's data folders"),
        ("ao", {"upload": "none"}, "no complete upload"),
    ],
)
def test_what_cant_be_is_said_at_once(
    client: httpx.Client, effect: str, asked: dict[str, Any], said: str
) -> None:
    answer = client.post(f"/train/{effect}", json=asked)
    assert answer.status_code == 422, answer.text
    assert said in answer.json()["detail"]
    assert client.get("/jobs").json() == []


def test_a_token_is_needed_for_everything_but_health(client: httpx.Client) -> None:
    bare = {"Authorization": ""}
    assert client.get("/healthz", headers=bare).status_code == 200
    for path in ("/jobs", "/bundles", "/docs", "/readyz", "/jobs/x/events"):
        assert client.get(path, headers=bare).status_code == 401
    assert client.post("/train/ao", json=ASKED, headers=bare).status_code == 401


def test_uploads_are_data_sets_and_nothing_else(client: httpx.Client, data: Path) -> None:
    for path in sorted(data.iterdir(), reverse=True):  # the manifest last
        answer = client.put(f"/data/mine/{path.name}", content=path.read_bytes())
        assert answer.status_code == 200, answer.text
    there = client.get("/data/mine").json()["files"]
    assert {each["file"] for each in there} == {path.name for path in data.iterdir()}
    job = client.post("/train/ao", json={"upload": "mine", "steps": 4, "batch": 4}).json()
    assert job["id"] == client.post("/train/ao", json=ASKED).json()["id"]  # the same views
    for name in ("%2e%2e/x", "x.py", "shard-1.safetensors", "environments/%2e%2e/x", "a/b.json"):
        assert client.put(f"/data/mine/{name}", content=b"x").status_code in (404, 422)
    assert client.delete("/data/mine").json()["deleted"]
    assert client.get("/data/mine").json()["files"] == []


@pytest.mark.parametrize("settings", [{"upload_bytes": 1000}], indirect=True)
def test_uploads_have_a_limit(client: httpx.Client) -> None:
    assert client.put("/data/a/manifest.json", content=bytes(600)).status_code == 200
    assert client.put("/data/b/manifest.json", content=bytes(600)).status_code == 413
    assert client.get("/data/b").json()["files"] == []


def test_one_service_has_a_folder(client: httpx.Client, settings: Settings) -> None:
    with pytest.raises(ConfigError, match="another trainer service uses"):
        create_app(settings)


class Shading(BaseHTTPRequestHandler):
    """A shading service that hears of changes, and refuses some."""

    refused: ClassVar[list[str]] = []
    heard: ClassVar[list[tuple[str, str | None]]] = []

    def do_POST(self) -> None:
        self.heard.append((self.path, self.headers["Authorization"]))
        self.send_response(409 if self.refused else 200)
        self.end_headers()
        self.wfile.write(json.dumps({"refused": self.refused, "detail": "NaN"}).encode())

    def log_message(self, *_: object) -> None:
        return


@pytest.fixture
def shading() -> Iterator[str]:
    Shading.refused, Shading.heard = [], []
    server = HTTPServer(("127.0.0.1", 0), Shading)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join()
    server.server_close()


def other(base: Path, folder: Path) -> Path:
    """The base bundle with another card."""
    shutil.copytree(base, folder)
    (folder / "README.md").write_text("another")
    return folder


def test_published_moves_the_alias_and_tells_the_services(
    settings: Settings, base: Path, tmp_path: Path, shading: str
) -> None:
    from dataclasses import replace

    publisher = Publisher(replace(settings, services=(shading,)))
    alias = Alias(settings.published, "ao", "balanced")
    version, said = publisher.publish(other(base, tmp_path / "new"), "ao", "balanced")
    assert (alias.numbers(), alias.current, said) == ([1, 2], 2, "")  # what shipped is the first
    assert Shading.heard == [("/bundles/reload", f"Bearer {TOKEN}")]
    publisher.roll_back("ao", "balanced")
    assert alias.current == 1
    publisher.pin("ao", "balanced", 1)
    third = other(base, tmp_path / "third")
    (third / "README.md").write_text("a third")
    version, said = publisher.publish(third, "ao", "balanced")
    assert (version.number, alias.current) == (3, 1)
    assert "pinned" in said
    publisher.unpin("ao", "balanced")
    Shading.refused = ["ao/balanced"]
    with pytest.raises(BundleError, match="refused it: NaN"):
        publisher.publish(third, "ao", "balanced")
    assert alias.current == 1
    Shading.refused = ["gi/balanced"]  # which is nothing of ours
    publisher.pin("ao", "balanced", 3)
    assert alias.current == 3


def test_a_service_that_is_away_holds_nothing_up(
    settings: Settings, base: Path, tmp_path: Path
) -> None:
    from dataclasses import replace

    publisher = Publisher(replace(settings, services=(f"http://127.0.0.1:{free_port()}",)))
    _, said = publisher.publish(other(base, tmp_path / "new"), "ao", "balanced")
    assert "wasn't told" in said
    assert publisher.listed()[0]["number"] == 2


@pytest.mark.slow
def test_a_job_from_request_to_version_through_a_killed_service(
    settings: Settings, data: Path, tmp_path: Path
) -> None:
    """`kill -9` of the service while a job trains: the next one ends it, and publishes once."""
    from deepshade_client import Trainer

    port = free_port()
    command = [sys.executable, "-m", "deepshade_trainer.service.cli", "serve"]
    command += ["--port", str(port), "--folder", str(settings.folder), "--threads", "1"]
    command += ["--models", str(settings.bases[0]), "--published", str(settings.published)]
    command += ["--data", str(data.parent), "--library", str(settings.library)]
    environment = os.environ | {"DEEPSHADE_TOKEN": TOKEN}

    def start() -> subprocess.Popen[bytes]:
        process = subprocess.Popen(command, env=environment, stdout=-3, stderr=-3)
        until = time.monotonic() + 60
        while time.monotonic() < until:
            try:
                if httpx.get(f"http://127.0.0.1:{port}/healthz").is_success:
                    return process
            except httpx.TransportError:
                time.sleep(0.1)
        raise AssertionError("the trainer doesn't start")

    service = start()
    try:
        with Trainer(f"http://127.0.0.1:{port}", token=TOKEN) as trainer:
            asked = {"data": "waves", "steps": 10, "batch": 4, "lr": 4e-3, "slower": 10.0}
            number = trainer.train("ao", **asked)["id"]
            second = trainer.train("ao", **asked | {"seed": 1})["id"]
            killed = False
            for event in trainer.events(number):
                if event.data.get("step", 0) >= 4 and not killed:
                    killed = True
                    service.kill()
                    service.wait()
                    service = start()  # the client goes on where it was
                if event.kind == "end":
                    break
            assert killed
            job = trainer.job(number)
            assert job["begun"] == 2
            assert job["published"] == 2, job["sentence"]
            assert job["sentence"].startswith("published as ao/balanced 2: better.")
            assert trainer.preview(number, tmp_path / "preview.png")
            (listed,) = trainer.bundles()
            assert (listed["number"], listed["versions"]) == (2, [1, 2])
            assert trainer.cancel(second)["cancelled"]
            for event in trainer.events(second):
                last = event
            assert last.data["state"] == "cancelled"
            assert not (settings.folder / "jobs" / second).exists()
            assert trainer.roll_back("ao", "balanced")["number"] == 1
    finally:
        service.send_signal(signal.SIGTERM)
        assert service.wait(60) == 0


def test_a_rendered_scene_is_known_by_its_contents(
    client: httpx.Client, settings: Settings
) -> None:
    asked = {"scene": "procedural:room:1", "views": 8, "steps": 4}
    first = client.post("/train/ao", json=asked).json()
    assert first["id"] == client.post("/train/ao", json=asked).json()["id"]
    assert first["id"] != client.post("/train/ao", json=asked | {"views": 9}).json()["id"]
    (rendering,) = [
        json.loads(path.read_text())
        for path in (settings.folder / "jobs" / first["id"]).glob("rendering.json")
    ]
    assert rendering["scene"] == "procedural:room:1"
    assert not Path(rendering["out"]).exists()
