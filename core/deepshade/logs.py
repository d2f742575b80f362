"""Log records as lines of JSON, for whoever collects logs: DEEPSHADE_LOG_FORMAT=json."""

from __future__ import annotations

import json
import logging
import os
from datetime import UTC, datetime
from typing import Any

from deepshade.errors import ConfigError
from deepshade.tracing import ids

VARIABLE = "DEEPSHADE_LOG_FORMAT"
FORMATS = ("text", "json")
_ACCESS = ("client", "method", "path", "http_version", "status")  # of uvicorn's access log


class JsonFormatter(logging.Formatter):
    """One JSON object a record: time (RFC 3339, UTC), level, logger, message, and what it has more.

    That is the request's facts in an access log, the traceback of an exception, and the ids of the
    trace and span that it was logged in, where there is one.
    """

    def format(self, record: logging.LogRecord) -> str:
        """The line, without its end."""
        entry: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        arguments = record.args
        if record.name == "uvicorn.access" and isinstance(arguments, tuple):
            entry |= dict(zip(_ACCESS, arguments, strict=False))
        entry |= ids()
        if record.exc_info:
            entry["exception"] = self.formatException(record.exc_info)
        return json.dumps(entry, default=str)


def as_json() -> bool:
    """Whether $DEEPSHADE_LOG_FORMAT asks for it. Raises ConfigError for a format there isn't."""
    asked = os.environ.get(VARIABLE) or FORMATS[0]
    if asked not in FORMATS:
        raise ConfigError(asked, FORMATS, detail=f"${VARIABLE} is {asked[:40]!r}")
    return asked == "json"
