"""Output for people: colour on terminals only, wide lines elsewhere."""

from __future__ import annotations

import sys
import time

from rich.console import Console


def stdout() -> Console:
    """A console on standard output."""
    # in a pipe nobody sees the window's width: don't fold lines that a tool may want to read
    width = None if sys.stdout.isatty() else 200
    return Console(width=width, highlight=False)


def duration(seconds: float) -> str:
    """A time for people: "40 s", "12 min", "3.5 h"."""
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    return f"{seconds / 60:.0f} min" if seconds < 90 * 60 else f"{seconds / 3600:.1f} h"


class Watch:
    """Progress of a long job on standard error: a bar on a terminal, elsewhere a line now and then.

    Once `SETTLED` of its `units` are done after the first, which includes what is done but once, it
    says how long the whole takes. Use it as a context.
    """

    SETTLED = 3
    EVERY = 5.0  # seconds between lines

    def __init__(self, doing: str, units: str, *, hidden: bool = False) -> None:
        from rich import progress

        self.doing, self.units, self.hidden = doing, units, hidden
        self._console = Console(stderr=True, highlight=False)
        self._plain = not self._console.is_terminal
        columns = (
            doing,
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            "{task.fields[note]}",
        )
        times = (progress.TimeElapsedColumn(), "{task.fields[left]}")
        self._bar = progress.Progress(
            *columns, *times, console=self._console, disable=self._plain or hidden
        )
        self._task = self._bar.add_task("", total=None, note="", left="")
        self._began: int | None = None  # done before
        self._first: tuple[float, int] | None = None  # when the first was done, and how many
        self._spoke, self._estimated = time.monotonic(), False

    def __enter__(self) -> Watch:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def update(self, done: int, total: int, note: str = "") -> None:
        """So many of so many units are done; `note` stands beside."""
        now = time.monotonic()
        if self._began is None:
            self._began = done
        if self._first is None and done > self._began:
            self._first = now, done
        each = self._each(now, done)
        left = f"{duration(each * (total - done))} left" if each and done < total else ""
        self._bar.update(self._task, completed=done, total=total, note=note, left=left)
        if each and not self._estimated:
            self._estimated = True
            whole = f"{total - self._began} {self.units} take about"
            self.say(f"{whole} {duration(each * (total - self._began))}, {each:.2g} s each")
        elif self._plain and now - self._spoke > self.EVERY:
            self.say(
                "  ".join(part for part in (f"{self.doing} {done}/{total}", note, left) if part)
            )

    def say(self, text: str, style: str = "") -> None:
        """A line of its own."""
        if not self.hidden:
            self._spoke = time.monotonic()
            self._console.print(text, style=style, soft_wrap=True)

    def _each(self, now: float, done: int) -> float | None:
        """Seconds a unit, without the first; None before enough are done."""
        if self._first is None or done - self._first[1] < self.SETTLED:
            return None
        return (now - self._first[0]) / (done - self._first[1])
