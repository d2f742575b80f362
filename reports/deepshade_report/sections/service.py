"""The service from outside: the sections `service` (where the time goes) and `clients`."""

from __future__ import annotations

import http.client
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from deepshade.bundles import Bundle
from deepshade.engines import Backend, load_engine
from deepshade.errors import EngineError
from deepshade_report import frames
from deepshade_report.context import Context
from deepshade_report.server import STAGES, Connection, Reply, Server, request_path
from deepshade_report.statistics import percentile, ratio, significant, spread
from deepshade_report.store import Skipped
from deepshade_report.subjects import Network
from deepshade_report.timing import visits

_SERVICE_SECONDS = 45.0
_CLIENT_SECONDS = 3.0  # of each number of clients in each round
_CLIENT_ROUNDS = 3
_COUNTS, _QUICK_COUNTS = (1, 2, 4, 8), (1, 4)
_RUNS = 3  # of each thing at each visit, of which the middle one counts
# Seconds that a service may take to choose its engines.
_CALIBRATION, _QUICK_CALIBRATION = 300.0, 30.0


def service(context: Context) -> dict[str, Any]:
    """Requests at 768 x 512, half ZIP in and out, against the bare network in the same rounds.

    The bare network runs here, on the backend that the service's answers name.
    """
    view = frames.extended(frames.fullest(context.held_out), frames.HEIGHT, frames.WIDTH)
    body = frames.body(view)
    with serving(context) as server:
        connection = server.connect()
        rows = {b.name: _Row(context, b, connection, body, view) for b in context.served}
        pace = context.pace(_SERVICE_SECONDS, fewest=6, most=40)
        for share, name in visits(list(rows), pace):
            context.advance(share, name)
            rows[name].visit()
        connection.close()
    return {
        "frame": [frames.WIDTH, frames.HEIGHT],
        "body_bytes": len(body),
        "threads": context.threads,
        "chosen": server.chosen,
        "rows": [row.result() for row in rows.values()],
    }


class _Row:
    """One bundle's requests and bare runs."""

    def __init__(
        self, context: Context, bundle: Bundle, connection: Connection, body: bytes, view: Any
    ) -> None:
        self.bundle = bundle
        self.path = request_path(connection, context.effect, bundle.name, body)
        self._ask: Callable[[], Reply] = lambda: connection.shade(self.path, body)
        self.backend = self._ask().backend
        backend = Backend(*self.backend.split("/", 1))
        try:
            engine = load_engine(bundle, backend, threads=context.threads)
        except EngineError as error:
            raise Skipped(
                f"the service answers with {backend}, which fails here: {error}"
            ) from None
        engine.warm()
        network = Network(bundle, engine, bundle.name)
        network.prepare(view)
        self._bare: Callable[[], object] = lambda: network.shade(view)
        self._times: dict[str, list[float]] = {
            name: [] for name in ("bare", "total", "transport", *STAGES)
        }

    def visit(self) -> None:
        """A few bare runs, then a few requests; the middle one of each counts."""
        self._bare()
        runs = []
        for _ in range(_RUNS):
            start = time.perf_counter()
            self._bare()
            runs.append(1e3 * (time.perf_counter() - start))
        self._ask()
        replies = sorted((self._ask() for _ in range(_RUNS)), key=lambda reply: reply.server)
        reply = replies[_RUNS // 2]
        self._times["bare"].append(sorted(runs)[_RUNS // 2])
        self._times["total"].append(reply.server)
        self._times["transport"].append(reply.milliseconds - reply.server)
        for stage in STAGES:
            self._times[stage].append(reply.stages.get(stage, 0.0))

    def result(self) -> dict[str, Any]:
        """Milliseconds by stage, and the ratio to the bare network."""
        times = self._times
        stages = {name: spread(times[name]) for name in (*STAGES, "transport")}
        return {
            "bundle": self.bundle.name,
            "sha256": self.bundle.sha256,
            "request": self.path,
            "backend": self.backend,
            "bare_ms": spread(times["bare"]),
            "total_ms": spread(times["total"]),
            "stages_ms": stages,
            "ratio": ratio(times["total"], times["bare"]),
            "slowest": max(
                (name for name in stages if name != "infer"), key=lambda n: stages[n]["median"]
            ),
        }


@contextmanager
def serving(context: Context, options: Sequence[str] = ()) -> Iterator[Server]:
    """A service that has chosen its engines, in a process of its own."""
    with Server(context.models, options) as server:
        context.advance(0.0, "the service measures this machine")
        server.wait_until_chosen(_QUICK_CALIBRATION if context.quick else _CALIBRATION)
        yield server


def clients(context: Context) -> dict[str, Any]:
    """Throughput and response times with 1, 2, 4 and 8 clients that ask without a pause."""
    view = frames.extended(frames.fullest(context.held_out), frames.HEIGHT, frames.WIDTH)
    body = frames.body(view)
    chosen = [context.served[0], *context.served[-1:]] if not context.quick else context.served[:1]
    seconds = 0.5 if context.quick else _CLIENT_SECONDS
    rounds = 2 if context.quick else _CLIENT_ROUNDS
    counts = _QUICK_COUNTS if context.quick else _COUNTS
    rows = []
    with serving(context) as server:
        connection = server.connect()
        names = list(dict.fromkeys(bundle.name for bundle in chosen))
        for index, name in enumerate(names):
            path = request_path(connection, context.effect, name, body)
            backend = connection.shade(path, body).backend
            crowds = {count: _Crowd(server, path, body, count) for count in counts}
            for turn in range(rounds):
                for count in counts if turn % 2 == 0 else reversed(counts):
                    share = (index + turn / rounds) / len(names)
                    context.advance(share, f"{name}: {count} clients")
                    crowds[count].run(seconds)
            rows += [
                {"bundle": name, "backend": backend, **crowd.result(crowds[1])}
                for crowd in crowds.values()
            ]
        connection.close()
    return {
        "frame": [frames.WIDTH, frames.HEIGHT],
        "body_bytes": len(body),
        "chosen": server.chosen,
        "rows": rows,
    }


class _Crowd:
    """A number of clients, each of which asks again as soon as it is answered."""

    def __init__(self, server: Server, path: str, body: bytes, count: int) -> None:
        self.count = count
        self.throughputs: list[float] = []
        self.times: list[float] = []
        self.refused = 0
        self._server, self._path, self._body = server, path, body

    def run(self, seconds: float) -> None:
        """All clients together for so long; the first request of each doesn't count."""
        start = threading.Barrier(self.count + 1)
        taken: list[list[float]] = [[] for _ in range(self.count)]
        refused = [0] * self.count

        def client(number: int) -> None:
            connection = self._server.connect()
            self._ask(connection)
            start.wait()
            end = time.perf_counter() + seconds
            while time.perf_counter() < end:
                took = self._ask(connection)
                if took is None:
                    refused[number] += 1
                else:
                    taken[number].append(took)
            connection.close()

        threads = [threading.Thread(target=client, args=(n,)) for n in range(self.count)]
        for thread in threads:
            thread.start()
        start.wait()
        began = time.perf_counter()
        for thread in threads:
            thread.join()
        elapsed = time.perf_counter() - began
        times = [value for own in taken for value in own]
        self.times += times
        self.throughputs.append(len(times) / elapsed)
        self.refused += sum(refused)

    def _ask(self, connection: Connection) -> float | None:
        """Milliseconds of one request, None if it was refused or cut off."""
        try:
            reply = connection.ask("POST", self._path, self._body)
        except (OSError, http.client.HTTPException):
            connection.close()  # the next request opens it again
            return None
        return reply.milliseconds if reply.status == 200 else None

    def result(self, one: _Crowd) -> dict[str, Any]:
        """Figures beside those of a single client in the same rounds."""
        if not self.times:
            raise Skipped(f"none of {self.refused} requests by {self.count} clients was answered")
        middle = percentile(self.times, 0.5)
        return {
            "clients": self.count,
            "requests": len(self.times),
            "refused": self.refused,
            "per_second": spread(self.throughputs),
            "speedup": ratio(self.throughputs, one.throughputs),
            "median_ms": significant(middle),
            "p95_ms": significant(percentile(self.times, 0.95)),
            "most_ms": significant(max(self.times)),
            "most_of_median": significant(max(self.times) / middle),
        }
