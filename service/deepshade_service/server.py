"""uvicorn, but it doesn't wait for networks that are still being loaded when it is to stop."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import sys
from types import FrameType

import uvicorn

from deepshade import tracing
from deepshade_service.app import Service


class Server(uvicorn.Server):
    """At a signal requests are finished; at Ctrl-C those that wait for a network are refused.

    A second Ctrl-C ends the process at once.
    """

    def __init__(self, config: uvicorn.Config, service: Service) -> None:
        super().__init__(config)
        self._service = service
        self._loop: asyncio.AbstractEventLoop | None = None

    async def serve(self, sockets: list[socket.socket] | None = None) -> None:
        """Serve until a signal comes; then the process ends."""
        self._loop = asyncio.get_running_loop()
        await super().serve(sockets)
        # A library that compiles a network can't be interrupted, and Python would wait for it.
        _end(0 if self.started else 1)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """As uvicorn's, and at Ctrl-C nobody waits for what loads."""
        super().handle_exit(sig, frame)
        if self.force_exit:
            _end(128 + signal.SIGINT)
        if sig == signal.SIGINT and self._loop is not None:
            self._loop.call_soon_threadsafe(self._service.stopping.set)


def _end(status: int) -> None:
    tracing.end()
    logging.shutdown()
    sys.stdout.flush()
    os._exit(status)
