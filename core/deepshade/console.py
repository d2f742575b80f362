"""Output for people: colour on terminals only, wide lines elsewhere."""

from __future__ import annotations

import sys

from rich.console import Console


def stdout() -> Console:
    """A console on standard output."""
    # in a pipe nobody sees the window's width: don't fold lines that a tool may want to read
    width = None if sys.stdout.isatty() else 200
    return Console(width=width, highlight=False)
