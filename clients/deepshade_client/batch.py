"""Many pictures: which files, where each answer goes, and several requests in flight."""

from __future__ import annotations

import asyncio
import glob
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from deepshade_client.answer import Saved
from deepshade_client.client import AsyncClient
from deepshade_client.exceptions import ClientError, ConnectionFailed
from deepshade_client.request import Options


class UsageError(ClientError):
    """The inputs and the output don't go together; nothing was sent."""

    def __init__(self, detail: str, fix: str = "") -> None:
        super().__init__(detail)
        self.fix = fix


@dataclass(frozen=True, slots=True)
class Task:
    """One view (one file, or several that belong together) and where its answer goes."""

    sources: tuple[Path, ...]
    target: Path


@dataclass(frozen=True, slots=True)
class Result:
    """What came of a task: facts or an error, and the seconds it took with all retries.

    Neither the picture's bytes nor the answer's are in it: a batch may be long.
    """

    task: Task
    seconds: float
    saved: Saved | None = None
    error: Exception | None = None


def views(inputs: Sequence[str], *, together: bool = False) -> list[tuple[Path, ...]]:
    """The files of every view that `inputs` name, as in `plan`. Raises UsageError."""
    found = list(_find(inputs, None))
    return [tuple(found)] if together else [(path,) for path in found]


def together_or_one(sources: tuple[Path, ...]) -> Path | tuple[Path, ...]:
    """A view as the client's picture argument: its only file, or the tuple of all."""
    return sources if len(sources) > 1 else sources[0]


def plan(
    inputs: Sequence[str], out: str, *, effect: str, suffix: str, together: bool = False
) -> list[Task]:
    """Pairs every input picture with its output path.

    `inputs` are files, folders (every .exr below them) and glob patterns. `out` is a file (for
    one picture), a folder (same names and subfolders), or a pattern with {name} and {effect}.
    With `together` all inputs are one view. Raises UsageError: nothing found, one file for many
    pictures, two answers for one path, an answer that would replace an input.
    """
    is_folder = out.endswith(("/", os.sep)) or Path(out).is_dir()
    everything = found = _find(inputs, Path(out).resolve() if is_folder else None)
    if together:
        found = dict(list(everything.items())[:1])
    if "{" in out:
        targets = [_fill(out, path, effect) for path in found]
    elif is_folder or len(found) > 1:
        if Path(out).suffix.lower() in (".exr", ".png") and not is_folder:
            raise UsageError(
                f"{len(found)} pictures can't all go to the file {out}",
                "name a folder (with a / at its end), or a pattern such as 'out/{name}_ao.exr'",
            )
        targets = [Path(out, relative).with_suffix(suffix) for relative in found.values()]
    else:
        targets = [Path(out)]
    groups = [tuple(everything)] if together else [(path,) for path in found]
    tasks = [Task(group, target) for group, target in zip(groups, targets, strict=True)]
    _check_targets(tasks, set(everything))
    return tasks


async def run(
    client: AsyncClient,
    effect: str,
    tasks: Sequence[Task],
    options: Options,
    *,
    jobs: int,
    done: Callable[[Result], None],
) -> list[Result]:
    """Shade all tasks, `jobs` at a time, and save their answers; `done` hears of each.

    Errors become results. When nothing answers at the server's address, what hasn't started
    isn't tried.
    """
    queue = iter(tasks)
    results: list[Result] = []
    unreachable = False

    async def work() -> None:
        nonlocal unreachable
        for task in queue:
            if unreachable:
                return
            start = time.perf_counter()
            saved: Saved | None = None
            failure: Exception | None = None
            try:
                picture = together_or_one(task.sources)
                saved = await client.shade_to(task.target, effect, picture, options)
            except (ClientError, OSError) as error:
                # its traceback and its cause hold the request, with the picture in it
                failure = error.with_traceback(None)
                failure.__cause__ = failure.__context__ = None
                unreachable |= isinstance(error, ConnectionFailed)
            result = Result(task, time.perf_counter() - start, saved, failure)
            results.append(result)
            done(result)

    async with asyncio.TaskGroup() as group:
        for _ in range(min(jobs, len(tasks))):
            group.create_task(work())
    return results


def _find(inputs: Sequence[str], out: Path | None) -> dict[Path, Path]:
    """Every input picture, in order, once -> its path relative to the input that named it.

    An output folder inside an input folder is left out: there are earlier answers in it.
    """
    found: dict[Path, Path] = {}
    for text in inputs:
        path = Path(text)
        if path.is_dir():
            files = sorted(p for p in path.rglob("*") if p.suffix.lower() == ".exr" and p.is_file())
            inside = out is not None and path.resolve() in out.parents
            for file in files:
                if not (inside and out in file.resolve().parents):
                    found.setdefault(file, file.relative_to(path))
        elif path.exists():
            found.setdefault(path, Path(path.name))
        else:
            # Path.glob takes no absolute patterns.
            matches = sorted(Path(match) for match in glob.glob(text, recursive=True))  # noqa: PTH207
            if not matches:
                raise UsageError(f"there is no file, folder or match for {text}")
            for match in matches:
                if match.is_file():
                    found.setdefault(match, Path(match.name))
    if not found:
        raise UsageError(f"no .exr files in {', '.join(inputs)}")
    return found


def _fill(pattern: str, source: Path, effect: str) -> Path:
    try:
        return Path(pattern.format(name=source.stem, effect=effect))
    except (KeyError, IndexError, ValueError) as error:
        raise UsageError(
            f"the output pattern '{pattern}' can't be filled in: {error!r}",
            "it may hold {name} and {effect}",
        ) from error


def _check_targets(tasks: Sequence[Task], inputs: set[Path]) -> None:
    originals = {path.resolve() for path in inputs}
    seen: dict[Path, Task] = {}
    for task in tasks:
        target = task.target.resolve()
        if target in originals:
            raise UsageError(
                f"{task.target} is an input; it would be overwritten",
                "choose another output, for example a pattern such as '{name}_ao.exr'",
            )
        if target in seen:
            raise UsageError(
                f"{task.sources[0]} and {seen[target].sources[0]} would both go to {task.target}",
                "use a folder as the input, which keeps subfolders apart, or other names",
            )
        if target.is_dir():
            raise UsageError(f"the output {task.target} is a folder")
        seen[target] = task
