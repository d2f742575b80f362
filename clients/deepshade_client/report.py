"""What the command shows: progress and tables for people, documents for programs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn
from rich.table import Table

from deepshade_client.batch import Result, Task
from deepshade_client.exceptions import ServerProblem


@contextmanager
def progress(total: int, *, quiet: bool) -> Iterator[Callable[[Result], None]]:
    """A progress bar on stderr and a line for each picture; only errors if `quiet`."""
    console = Console(stderr=True)
    columns = ("shading", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    show = not quiet and total > 1 and console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=not show) as bar:
        task = bar.add_task("", total=total)

        def done(result: Result) -> None:
            bar.advance(task)
            if result.error:
                _print_error(console, result)
            elif not quiet:
                console.print(_line(result), highlight=False, soft_wrap=True)

        yield done


def as_json(tasks: Sequence[Task], results: Sequence[Result]) -> dict[str, Any]:
    """All results as one document, in the order of the tasks."""
    by_task = {result.task: result for result in results}
    pictures = [_entry(task, by_task.get(task)) for task in tasks]
    saved = sum(picture["ok"] for picture in pictures)
    return {"pictures": pictures, "saved": saved, "failed": len(tasks) - saved}


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
    broken = {n for name, n in facts.items() if name.endswith("nonfinite_pixels")} - {"0"}
    if broken:
        parts.append(f"[yellow]{', '.join(sorted(broken))} non-finite pixels[/yellow]")
    return "  ·  ".join(parts)


def _print_error(console: Console, result: Result) -> None:
    source = escape(str(result.task.sources[0]))
    console.print(
        f"[red]✗[/red] {source}: {escape(str(result.error))}", highlight=False, soft_wrap=True
    )
    if fix := getattr(result.error, "fix", ""):
        console.print(f"    {escape(fix)}", highlight=False, soft_wrap=True)


def _entry(task: Task, result: Result | None) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "input": [str(path) for path in task.sources],
        "output": str(task.target),
        "ok": False,
    }
    if result is None:
        return entry | {"error": {"detail": "not tried: the service can't be reached"}}
    entry["seconds"] = round(result.seconds, 4)
    if saved := result.saved:
        facts = {name: number(name, fact) for name, fact in saved.facts.items()}
        return entry | {"ok": True, "facts": facts, "milliseconds": dict(saved.timing)}
    error = result.error
    document = error.document if isinstance(error, ServerProblem) else {"detail": str(error)}
    return entry | {"error": document}


def number(name: str, fact: str) -> str | int | float:
    """A header's number as one; names and hashes stay text, whatever they look like."""
    if name.endswith(("bundle", "environment", "sha256")):
        return fact
    for kind in (int, float):
        with suppress(ValueError):
            if math.isfinite(number := kind(fact)):
                return number
    return fact
