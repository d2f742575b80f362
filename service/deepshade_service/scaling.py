"""The service as a deployment of Ray Serve: the same application, in replicas that come and go.

    serve run deepshade_service.scaling:application threads=2
    serve deploy deploy/serve.yaml

Each replica has its own share of the CPUs: Ray reserves `threads` of them for it, and its networks
run on as many. What chooses bundles and bounds memory is as in `deepshade serve`.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

from fastapi import FastAPI
from ray import serve

from deepshade.bundles import bundle_roots
from deepshade.machine import cpu_count
from deepshade.tokens import configured
from deepshade_service.app import create_app
from deepshade_service.config import Settings, default_limits, default_memory
from deepshade_service.memory import parse_size


@dataclass(frozen=True)
class Arguments:
    """Of a replica: `threads` of its networks, `memory` for pixels and networks as "2G" (by default
    half of the machine's), pictures shaded at a time, and how many more may wait."""

    threads: int = 2
    memory: str = ""
    workers: int = 2
    queue: int = 16

    @classmethod
    def of(cls, given: dict[str, str]) -> Arguments:
        """From `serve run`'s words and a config's `args`. Raises ValueError and TypeError."""
        numbers = {k: int(v) for k, v in given.items() if k != "memory"}
        return cls(**numbers, memory=given.get("memory", ""))

    def settings(self) -> Settings:
        """The service's."""
        return Settings(
            models=bundle_roots(),
            threads=min(self.threads, cpu_count()),
            memory=parse_size(self.memory) if self.memory else default_memory(),
            workers=self.workers,
            queue=self.queue,
            limits=default_limits(),
            token=configured(),
        )


def application(arguments: dict[str, str], replicas: int = 1) -> Any:
    """The application that `serve run` and `serve deploy` ask for; a config may say otherwise of
    how many replicas there are."""
    asked = Arguments.of(arguments)

    def build() -> FastAPI:
        os.environ["OMP_NUM_THREADS"] = str(asked.threads)  # Ray sets it to 1 for what it starts
        return create_app(asked.settings())

    replica = serve.deployment(
        name="shading",
        num_replicas=replicas,
        ray_actor_options={"num_cpus": asked.threads},
        # the service turns away what is too much, with a Retry-After
        max_ongoing_requests=asked.workers + asked.queue,
        graceful_shutdown_timeout_s=20,
        health_check_period_s=5,
        health_check_timeout_s=30,
    )
    return replica(serve.ingress(build)()).bind()
