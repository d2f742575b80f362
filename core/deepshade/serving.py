"""What our services start with: a listening socket, and lines for their log."""

from __future__ import annotations

import logging
import socket
from typing import Any

from deepshade.errors import DeepshadeError
from deepshade.logs import JsonFormatter, as_json

_POLLS = ("/healthz", "/readyz", "/metrics")


def listen(host: str, port: int) -> socket.socket:
    """A listening socket; its port is known before the server starts, also when it was 0.

    Its protocol is stated, because asyncio sets TCP_NODELAY only on sockets that say TCP, and
    without it every small answer takes 40 ms (Nagle's algorithm against delayed acknowledgement).
    """
    listener = None
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        listener = socket.socket(family, kind, protocol)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen(2048)
    except OSError as error:
        if listener is not None:
            listener.close()
        raise DeepshadeError(
            f"can't listen at {host}, port {port}: {error.strerror or error}",
            fix="choose another --port (0 takes a free one) or --host",
        ) from error
    return listener


def _no_poll(record: logging.LogRecord) -> bool:
    """Whether a line of uvicorn's access log is about anything else than a health poll."""
    _, _, path, *_ = record.args if isinstance(record.args, tuple) else ("", "", "")
    return str(path).partition("?")[0] not in _POLLS


def logging_config(level: str) -> dict[str, Any]:
    """uvicorn's own set-up, and ours beside it; lines of JSON if $DEEPSHADE_LOG_FORMAT says so."""
    from copy import deepcopy

    from uvicorn.config import LOGGING_CONFIG

    config = deepcopy(LOGGING_CONFIG)
    for formatter in config["formatters"].values():
        formatter["fmt"] = f"%(asctime)s {formatter['fmt']}"
    if as_json():
        config["formatters"] = {name: {"()": JsonFormatter} for name in config["formatters"]}
    config["filters"] = {"polls": {"()": lambda: _no_poll}}
    config["handlers"]["access"]["filters"] = ["polls"]
    for name in ("uvicorn", "uvicorn.error", "uvicorn.access", "deepshade"):
        config["loggers"].setdefault(name, {"handlers": ["default"], "propagate": False})
        config["loggers"][name]["level"] = level.upper()
    return config
