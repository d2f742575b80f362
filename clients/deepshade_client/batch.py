"""Many pictures: which files, where each answer goes, and several requests in flight."""

from __future__ import annotations

import asyncio
import glob
import os
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from deepshade import exr
from deepshade.errors import ImageError, LimitError
from deepshade_client import sequences
from deepshade_client.answer import PNG, Saved, plan_in
from deepshade_client.client import AsyncClient
from deepshade_client.exceptions import ClientError, ConnectionFailed
from deepshade_client.request import Options
from deepshade_client.sequences import View, sequence_of

SUFFIXES = (".exr", ".png")


class UsageError(ClientError):
    """The inputs and the output don't go together; nothing was sent."""


@dataclass(frozen=True, slots=True)
class Task:
    """One view (one file, or several that belong together) and where its answer goes.

    It isn't sent where it `lacks` files that the other frames of its `sequence` have.
    """

    sources: tuple[Path, ...]
    target: Path
    lacks: tuple[str, ...] = ()
    sequence: Path | None = None


@dataclass(frozen=True, slots=True)
class Result:
    """What came of a task: facts or an error, and the seconds it took with all retries.

    With neither it was skipped: its answer is there. Neither the picture's bytes nor the answer's
    are in it: a batch may be long.
    """

    task: Task
    seconds: float
    saved: Saved | None = None
    error: Exception | None = None


def views(inputs: Sequence[str], *, together: bool | None = None) -> list[View]:
    """The views that `inputs` name, as in `plan`. Raises UsageError."""
    return sequences.views(_find(inputs, None), together=together)


def picture_of(sources: tuple[Path, ...]) -> Path | tuple[Path, ...]:
    """A view's files as the client's picture argument: the only one, or the tuple of all."""
    return sources if len(sources) > 1 else sources[0]


def plan(
    inputs: Sequence[str], out: str, *, effect: str, suffix: str, together: bool | None = None
) -> list[Task]:
    """Pairs every view with its output path.

    `inputs` are files, folders (every .exr below them), glob patterns and patterns of frames
    (`room.####.exr`, `room.%04d.exr`). `out` is a file (for one picture), a folder (same names
    and subfolders), or a pattern with {name} and {effect}, or with #### or %04d for the frame.
    With `together` all inputs are one view (True) or each its own (False), else what
    `sequences` says. Raises UsageError: nothing found, one file for many pictures, two answers
    for one path, an answer that would replace an input, a picture without a frame's number.
    """
    is_folder = _is_folder(out)
    files = _find(inputs, Path(out).resolve() if is_folder else None)
    found = sequences.views(files, together=together)
    if "{" in out or (not is_folder and sequences.is_pattern(out)):
        targets = [_fill(out, view, effect) for view in found]
    elif is_folder or len(found) > 1:
        if Path(out).suffix.lower() in SUFFIXES and not is_folder:
            raise UsageError(
                f"{len(found)} pictures can't all go to the file {out}",
                fix="name a folder (with a / at its end), or a pattern such as 'ao.####.exr' "
                "or 'out/{name}_ao.exr'; files of one view: --together",
            )
        targets = [Path(out, view.folder, view.name + suffix) for view in found]
    else:
        targets = [Path(out)]
    tasks = [
        Task(v.files, target, v.lacks, sequence_of(v.files) if v.frame is not None else None)
        for v, target in zip(found, targets, strict=True)
    ]
    _check_targets(tasks, set(files))
    return tasks


def suffix_of(out: str | None, *, png: bool) -> str:
    """The suffix of the answers, which says what they are: that of `out`, else .png if asked for.

    Raises UsageError for one that says something else.
    """
    found = "" if out is None or _is_folder(out) else Path(out).suffix.lower()
    if found in SUFFIXES:
        if png and found != ".png":
            raise UsageError(
                f"--png makes PNGs, but {out} ends in {found}",
                fix="leave out --png, or name a .png file, or a folder",
            )
        return found
    if re.fullmatch(r"\.[a-z]{2,5}", found):
        raise UsageError(
            f"answers are no {found} files, as {out} says",
            fix="write .exr or .png; for a folder of that name put a / at its end",
        )
    return ".png" if png else ".exr"


def is_done(task: Task) -> bool:
    """Whether its answer is there: a whole file, newer than every file that it is made of."""
    try:
        made = task.target.stat().st_mtime_ns
        if any(source.stat().st_mtime_ns >= made for source in task.sources):
            return False
        content = task.target.read_bytes()
        if task.target.suffix.lower() == ".png":
            return content.startswith(PNG) and content.endswith(b"IEND\xaeB`\x82")
        exr.read_header(content)
    except (OSError, ImageError, LimitError):
        return False
    return True


async def run(
    client: AsyncClient,
    effect: str,
    tasks: Sequence[Task],
    options: Options,
    *,
    jobs: int,
    done: Callable[[Result], None],
    skip: bool = False,
) -> list[Result]:
    """Shade all tasks, `jobs` at a time, and save their answers; `done` hears of each.

    Errors become results. When nothing answers at the server's address, what hasn't started
    isn't tried. With `skip` what `is_done` is left as it is. A radius that follows from depth is
    that of a sequence's first frame that has an answer in all of them: from frame to frame it
    would flicker.
    """
    queue = iter(tasks)
    results: list[Result] = []
    unreachable = False
    follows = options.radius is None or str(options.radius).strip().endswith("%")
    radii: dict[Path, asyncio.Future[str | None]] = {}

    async def agreed(sequence: Path) -> str | None:
        """The radius of its first frame, "" for its own in each; None: the asker is the first."""
        while known := radii.get(sequence):
            if (radius := await known) is not None:
                return radius
            if radii.get(sequence) is known:  # it failed, and the next one takes its place
                del radii[sequence]
        return None

    async def work() -> None:
        nonlocal unreachable
        for task in queue:
            if unreachable:
                return
            settings, first = options, None
            if task.sequence and follows:
                radius = await agreed(task.sequence)
                if unreachable:
                    return
                if radius is None:
                    first = radii[task.sequence] = asyncio.get_running_loop().create_future()
                settings = replace(options, radius=radius or options.radius)
            start = time.perf_counter()
            saved: Saved | None = None
            failure: Exception | None = None
            radius = None
            try:
                if task.lacks:
                    raise _lacking(task)
                if skip and await asyncio.to_thread(is_done, task):
                    radius = await asyncio.to_thread(_radius_of, task.target) if first else None
                else:
                    picture = picture_of(task.sources)
                    saved = await client.shade_to(task.target, effect, picture, settings)
                    radius = _radius_among(saved.facts, ".")
            except (ClientError, OSError) as error:
                # its traceback and its cause hold the request, with the picture in it
                failure = error.with_traceback(None)
                failure.__cause__ = failure.__context__ = None
                unreachable |= isinstance(error, ConnectionFailed)
            finally:
                if first:
                    first.set_result(radius)
            result = Result(task, time.perf_counter() - start, saved, failure)
            results.append(result)
            done(result)

    async with asyncio.TaskGroup() as group:
        for _ in range(min(jobs, len(tasks))):
            group.create_task(work())
    return results


def _radius_of(answer: Path) -> str | None:
    """As `_radius_among`, of a saved answer; None where that doesn't tell."""
    content = answer.read_bytes()
    if content.startswith(PNG):  # which holds one effect
        try:
            plan = plan_in(content)
        except ValueError:
            plan = {}
        return _radius_among(plan, ".") if plan else None
    return _radius_among(exr.read_header(content).parts[0].attributes, ":")


def _radius_among(facts: Mapping[str, object], between: str) -> str:
    """That of one effect, or of the first of several; "" if its header or the bundle gave it."""
    names = (name for name in facts if name.split(between)[-1] == "radius")
    known = (k for k in names if facts.get(f"{k}_source") in ("depth", "request"))
    return next((str(facts[k]) for k in known), "")


def _lacking(task: Task) -> UsageError:
    return UsageError(
        f"there is no file of its {' and '.join(task.lacks)}, as most frames have",
        fix="render it, or take each file for a picture of its own: --apart",
    )


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
            matches = sequences.matches(text) if sequences.is_pattern(text) else []
            # Path.glob takes no absolute patterns.
            matches = matches or sorted(Path(match) for match in glob.glob(text, recursive=True))  # noqa: PTH207
            if not matches:
                raise UsageError(f"there is no file, folder or match for {text}")
            for match in matches:
                if match.is_file():
                    found.setdefault(match, Path(match.name))
    if not found:
        raise UsageError(f"no .exr files in {', '.join(inputs)}")
    return found


def _is_folder(out: str) -> bool:
    return out.endswith(("/", os.sep)) or Path(out).is_dir()


def _fill(pattern: str, view: View, effect: str) -> Path:
    filled = pattern
    if sequences.is_pattern(pattern):
        if view.frame is None:
            raise UsageError(
                f"{view.files[0]} has no frame number to put into {pattern}",
                fix="number the files, as in room.0001.exr, or use {name}",
            )
        filled = sequences.numbered(pattern, view.frame)
    try:
        return Path(filled.format(name=view.name, effect=effect))
    except (KeyError, IndexError, ValueError) as error:
        raise UsageError(
            f"the output pattern '{pattern}' can't be filled in: {error!r}",
            fix="it may hold {name} and {effect}, and #### or %04d for the frame",
        ) from error


def _check_targets(tasks: Sequence[Task], inputs: set[Path]) -> None:
    originals = {path.resolve() for path in inputs}
    seen: dict[Path, Task] = {}
    for task in tasks:
        target = task.target.resolve()
        if target in originals:
            raise UsageError(
                f"{task.target} is an input; it would be overwritten",
                fix="choose another output, for example a pattern such as '{name}_ao.exr'",
            )
        if target in seen:
            raise UsageError(
                f"{task.sources[0]} and {seen[target].sources[0]} would both go to {task.target}",
                fix="use a folder as the input, which keeps subfolders apart, or other names",
            )
        if target.is_dir():
            raise UsageError(f"the output {task.target} is a folder")
        seen[target] = task
