"""Output for people: colour on terminals only, wide lines elsewhere."""

from __future__ import annotations

import sys

from rich.console import Console


def stdout() -> Console:
    """A console on standard output."""
    return _console(stderr=False)


def stderr() -> Console:
    """A console on standard error."""
    return _console(stderr=True)


def _console(*, stderr: bool) -> Console:
    stream = sys.stderr if stderr else sys.stdout
    # in a pipe nobody sees the window's width: don't fold lines that a tool may want to read
    width = None if stream.isatty() else 200
    return Console(stderr=stderr, width=width, highlight=False)
