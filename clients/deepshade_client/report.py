"""What the command shows: progress and tables for people, documents for programs."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn
from rich.table import Table

from deepshade_client.batch import Result, Task
from deepshade_client.exceptions import ClientError, ServerProblem
from deepshade_client.sequences import summary


@contextmanager
def progress(total: int, *, quiet: bool) -> Iterator[Progress]:
    """A progress bar on stderr; none if `quiet`, for one picture, or without a terminal."""
    console = Console(stderr=True)
    columns = ("shading", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    show = not quiet and total > 1 and console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=not show) as bar:
        bar.add_task("", total=total)
        yield bar


@dataclass
class Batch:
    """What becomes of the tasks, on stderr: a line for each picture, only errors if `quiet`."""

    tasks: Sequence[Task]
    bar: Progress
    quiet: bool
    results: list[Result] = field(default_factory=list)
    told: set[type] = field(default_factory=set)

    def open(self) -> None:
        """The first lines: which files are taken for one frame."""
        for line in () if self.quiet else summary(task.sources for task in self.tasks):
            self.bar.console.print(line, highlight=False, soft_wrap=True)

    def done(self, result: Result) -> None:
        """Says what came of one, and keeps it."""
        self.results.append(result)
        for task in self.bar.task_ids:
            self.bar.advance(task)
        if result.error:
            _print_error(self.bar.console, result)
        elif result.saved and not self.quiet:
            self.bar.console.print(_line(result), highlight=False, soft_wrap=True)

    def waiting(self, error: ClientError, seconds: float) -> None:
        """Says, once for each kind of error, that there will be further attempts."""
        if type(error) in self.told:
            return
        self.told.add(type(error))
        _print_failure(self.bar.console, "[yellow]…[/yellow]", f"{error}; trying again", error)

    def counts(self) -> dict[str, int]:
        """How many were saved, failed, were skipped, and weren't tried."""
        saved = sum(result.saved is not None for result in self.results)
        failed = sum(result.error is not None for result in self.results)
        done = len(self.results)
        return {
            "saved": saved,
            "failed": failed,
            "skipped": done - saved - failed,
            "not_tried": len(self.tasks) - done,
        }

    def close(self, *, interrupted: bool = False) -> None:
        """The last line: how many were saved and how many weren't, where there are several."""
        counts = self.counts()
        said = [f"{n} {kind.replace('_', ' ')}" for kind, n in counts.items() if n]
        if interrupted:
            said = ["interrupted", *said]
        if not self.quiet and (len(self.tasks) > 1 or counts["skipped"]):
            self.bar.console.print(", ".join(said), highlight=False)
            if counts["not_tried"]:
                self.bar.console.print("    the rest: the same command with --skip-existing")

    def as_json(self) -> dict[str, Any]:
        """All results as one document, in the order of the tasks."""
        by_task = {result.task: result for result in self.results}
        pictures = [_entry(task, by_task.get(task)) for task in self.tasks]
        return {"pictures": pictures} | self.counts()


def print_effects(effects: Sequence[dict[str, Any]]) -> None:
    """What each effect reads, its settings, and its bundles with their error and time."""
    console = Console()
    for effect in effects:
        console.print(f"[bold]{escape(effect['name'])}[/bold]  {escape(effect['title'])}")
        table = Table.grid("", "", "", padding=(0, 2))
        table.add_row("  reads", "", ", ".join(entry["attribute"] for entry in effect["inputs"]))
        for setting in effect["settings"]:
            table.add_row(f"  --{setting['name']}", escape(_range(setting)), _meaning(setting))
        for bundle in effect["bundles"]:
            on = f"{bundle['engine']}/{bundle['precision']}"
            error = f"DSSIM {bundle['dssim']:.4f}" if bundle["dssim"] is not None else ""
            table.add_row(f"  {escape(bundle['name'])}", error, escape(_times(bundle, on)))
        if not effect["bundles"]:
            table.add_row("  [dim]no bundle[/dim]")
        console.print(table)


def _range(setting: dict[str, Any]) -> str:
    if setting["lowest"] is None:
        return str(setting["unit"])
    return f"{setting['unit']}, {setting['lowest']:g} to {setting['highest']:g}"


def _meaning(setting: dict[str, Any]) -> str:
    """What it is, and what holds without it."""
    default = setting["default"]
    shown = f"{default:g}" if isinstance(default, int | float) else default
    without = ", else ".join(str(each) for each in (setting["header"], shown) if each is not None)
    return escape(f"{setting['meaning']}; without it {without}")


def _times(bundle: dict[str, Any], on: str) -> str:
    times = [
        f"{each['ms']:.3g} ms at {each['size'][0]} x {each['size'][1]} ({each['machine']})"
        for each in bundle.get("times", ())
    ]
    return f"{on}: {'; '.join(times)}" if times else on


def print_environments(environments: Sequence[dict[str, Any]]) -> None:
    """A table of environment maps."""
    table = Table("environment", "source", "size", "sha256")
    for each in environments:
        size = f"{each['width']} x {each['height']}" if each.get("width") else ""
        cells = each["name"], each["source"], size, _cell(each.get("sha256"))
        table.add_row(*map(escape, cells))
    Console().print(table)


def print_models(models: Sequence[dict[str, Any]]) -> None:
    """A table of bundles."""
    table = Table("effect", "bundle", "radius", "engine", "precision", "dssim", "sha256")
    for model in models:
        cells = ("effect", "name", "radius", "engine", "precision", "dssim", "sha256")
        table.add_row(*(escape(_cell(model.get(cell))) for cell in cells))
    Console().print(table)


def _cell(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)[:16]


def _line(result: Result) -> str:
    assert result.saved is not None
    facts, timing = result.saved.facts, result.saved.timing
    parts = [f"[green]✓[/green] {escape(str(result.task.target))}  {result.seconds:.2f} s"]
    if timing:
        # of several effects the sums: "infer-ao" and such are in the JSON
        sums = (f"{name} {ms:.0f}" for name, ms in timing.items() if "-" not in name)
        parts.append(f"{' '.join(sums)} ms")
    derived = {value: None for name, value in facts.items() if name.endswith("derived") and value}
    if derived:
        parts.append(f"derived {escape('; '.join(derived))}")
    if left := facts.get("left_out"):
        parts.append(f"[yellow]not appended: {escape(left)}[/yellow]")
    if multiplied := facts.get("multiplied"):
        parts.append(f"multiplied onto {escape(multiplied)}")
    broken = {n for name, n in facts.items() if name.endswith("nonfinite_pixels")} - {"0"}
    if broken:
        parts.append(f"[yellow]{', '.join(sorted(broken))} non-finite pixels[/yellow]")
    warnings = {value: None for name, value in facts.items() if name.endswith("warnings")}
    lines = [f"\n    [yellow]{escape(as_options(text))}[/yellow]" for text in warnings]
    return "".join(("  ·  ".join(parts), *lines))


def as_options(text: str) -> str:
    """The service's text with "--fov 50" for "?fov=50"."""

    def option(parameter: re.Match[str]) -> str:
        blank = " " if parameter[0].startswith("&") else ""
        return f"{blank}--{parameter[1].replace('_', '-')}{' ' if parameter[2] else ''}"

    text = re.sub(r"\?(strict|trust)=1", r"--\1", text)  # which take no value there
    return re.sub(r"[?&]([a-z_]+)=(?=([\w<.])?)", option, text)


def _print_error(console: Console, result: Result) -> None:
    assert result.error is not None
    text = f"{result.task.sources[0]}: {result.error}"
    _print_failure(console, "[red]✗[/red]", text, result.error)


def _print_failure(console: Console, mark: str, text: str, error: Exception) -> None:
    console.print(f"{mark} {escape(as_options(text))}", highlight=False, soft_wrap=True)
    if fix := getattr(error, "fix", ""):
        console.print(f"    {escape(as_options(fix))}", highlight=False, soft_wrap=True)


def _entry(task: Task, result: Result | None) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "input": [str(path) for path in task.sources],
        "output": str(task.target),
        "ok": False,
    }
    if result is None:
        return entry | {"error": {"detail": "not tried: the batch ended early"}}
    entry["seconds"] = round(result.seconds, 4)
    if saved := result.saved:
        facts = {name: number(name, fact) for name, fact in saved.facts.items()}
        return entry | {"ok": True, "facts": facts, "milliseconds": dict(saved.timing)}
    if result.error is None:
        return entry | {"ok": True, "skipped": True}
    error = result.error
    document = error.document if isinstance(error, ServerProblem) else {"detail": str(error)}
    return entry | {"error": document}


def number(name: str, fact: str) -> str | int | float:
    """A header's number as one; names and hashes stay text, whatever they look like."""
    if name.endswith(("bundle", "environment", "sha256", "layer")):
        return fact
    for kind in (int, float):
        with suppress(ValueError):
            if math.isfinite(number := kind(fact)):
                return number
    return fact
