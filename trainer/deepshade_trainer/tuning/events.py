"""A job's events: lines of JSON in a file, which survives whoever writes and whoever reads it."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

FILE = "events.jsonl"

Event = dict[str, Any]


class EventLog:
    """The file of events in a job's folder, to be appended to by one process."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / FILE
        self._mend()

    def add(self, event: Mapping[str, Any]) -> None:
        """Append one, with the time."""
        line = json.dumps({"at": round(time.time(), 3), **event}, allow_nan=False)
        with self._path.open("a", encoding="utf-8") as file:
            file.write(line + "\n")

    def _mend(self) -> None:
        """Cut off half a line, which a killed writer left."""
        if not self._path.exists():
            return
        whole = self._path.read_bytes()
        end = whole.rfind(b"\n") + 1
        if end < len(whole):
            os.truncate(self._path, end)


def read_events(folder: Path, start: int = 0, offset: int = 0) -> tuple[list[Event], int]:
    """The complete events after byte `offset`, without the first `start`, and where they end."""
    try:
        with (folder / FILE).open("rb") as file:
            file.seek(offset)
            whole = file.read()
    except FileNotFoundError:
        return [], offset
    end = whole.rfind(b"\n") + 1
    lines = whole[:end].splitlines()[start:]
    return [json.loads(line) for line in lines], offset + end


def last_event(folder: Path) -> Event | None:
    """The latest event of all; None where there is none yet."""
    path = folder / FILE
    try:
        size = path.stat().st_size
        events, _ = read_events(folder, 1, size - _TAIL) if size > _TAIL else read_events(folder)
    except FileNotFoundError:
        return None
    return events[-1] if events else None


_TAIL = 1 << 16  # bytes that hold the last event surely, and begin within one before
