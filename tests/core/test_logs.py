"""Logs as JSON: what collectors read, also of what strangers put into a request."""

from __future__ import annotations

import json
import logging
import logging.config
from datetime import datetime

import pytest

from deepshade.errors import ConfigError
from deepshade.logs import JsonFormatter
from deepshade.serving import logging_config


def record(*arguments: object, message: str = "%s", name: str = "deepshade") -> logging.LogRecord:
    return logging.LogRecord(name, logging.WARNING, "f.py", 1, message, arguments, None)


def test_a_record_is_one_line_of_json() -> None:
    nasty = 'two\nlines "quoted" \x1b[31m'
    line = JsonFormatter().format(record(nasty))
    assert "\n" not in line and "\x1b" not in line
    entry = json.loads(line)
    assert entry["message"] == nasty
    assert (entry["level"], entry["logger"]) == ("warning", "deepshade")
    offset = datetime.fromisoformat(entry["time"]).utcoffset()
    assert offset is not None and not offset.total_seconds()


def test_an_access_log_has_its_fields() -> None:
    arguments = ("10.0.0.1:5", "POST", "/shade/ao", "1.1", 200)
    entry = json.loads(
        JsonFormatter().format(
            record(*arguments, message='%s - "%s %s HTTP/%s" %d', name="uvicorn.access")
        )
    )
    assert (entry["method"], entry["path"], entry["status"]) == ("POST", "/shade/ao", 200)
    assert entry["message"] == '10.0.0.1:5 - "POST /shade/ao HTTP/1.1" 200'


def test_a_traceback_is_kept() -> None:
    try:
        raise ValueError("no")
    except ValueError as error:
        made = record("x")
        made.exc_info = (type(error), error, error.__traceback__)
    entry = json.loads(JsonFormatter().format(made))
    assert entry["exception"].endswith("ValueError: no")
    assert "trace_id" not in entry


def test_the_variable_chooses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEEPSHADE_LOG_FORMAT", "json")
    formatters = logging_config("info")["formatters"]
    assert {made["()"] for made in formatters.values()} == {JsonFormatter}
    monkeypatch.setenv("DEEPSHADE_LOG_FORMAT", "")
    assert "fmt" in logging_config("info")["formatters"]["access"]
    monkeypatch.setenv("DEEPSHADE_LOG_FORMAT", "jsn")
    with pytest.raises(ConfigError, match="'jsn'") as caught:
        logging_config("info")
    assert caught.value.fix == "did you mean 'json'?"
