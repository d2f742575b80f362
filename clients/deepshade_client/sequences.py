"""Frames of a sequence: patterns of file names, and which files are one frame.

`room.####.exr` and `room.%04d.exr` stand for all frames of `room`. Files in one folder whose names
differ only in an attribute at the end (`shot_normal.0007.exr`, `shot_depth.0007.exr`) are one
frame, with the file that names none (`shot.0007.exr`, the beauty). What counts as an attribute's
name is what the service takes for one.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from deepshade.gbuffer.naming import parse_stem

PLAIN = "beauty"  # what a file is whose name has no attribute, beside files whose names have one
_NUMBER = re.compile(r"(#+)|%(?:0(\d+))?d")


@dataclass(frozen=True, slots=True)
class View:
    """The files of one picture, and where its answer belongs.

    `name` is the answer's name without suffix, `folder` lies below an output folder. `lacks` are
    attributes that this frame has no file of, but most frames of its sequence have.
    """

    files: tuple[Path, ...]
    folder: Path
    name: str
    frame: int | None = None
    lacks: tuple[str, ...] = ()


def is_pattern(text: str) -> bool:
    """Whether it stands for numbered files: the last part of the path holds a number's place."""
    return _NUMBER.search(Path(text).name) is not None


def matches(pattern: str) -> list[Path]:
    """The files that a pattern such as `room.####.exr` stands for, by their numbers.

    `####` and `%04d` are numbers of at least four digits, `%d` those of any. Only the last part
    of the path may hold one.
    """
    path = Path(pattern)
    pieces, end = [], 0
    for found in _NUMBER.finditer(path.name):
        digits = len(found[1] or "") or int(found[2] or 1)
        pieces += [re.escape(path.name[end : found.start()]), rf"(\d{{{digits},}})"]
        end = found.end()
    named = re.compile("".join((*pieces, re.escape(path.name[end:]))))
    if not path.parent.is_dir():
        return []
    numbered = [
        ([int(number) for number in match.groups()], file)
        for file in path.parent.iterdir()
        if (match := named.fullmatch(file.name)) and file.is_file()
    ]
    return [file for _, file in sorted(numbered)]


def numbered(pattern: str, frame: int) -> str:
    """The pattern with the frame's number in place of `####` or `%04d`."""
    path = Path(pattern)
    name = _NUMBER.sub(lambda m: f"{frame:0{len(m[1] or '') or int(m[2] or 1)}d}", path.name)
    return str(path.with_name(name))


def views(files: Mapping[Path, Path], *, together: bool | None = None) -> list[View]:
    """The views that files are: `files` maps each to its path below an output folder.

    By default files are one view as the module's text says; `together` makes all of them one
    view (True), or each its own (False).
    """
    if together:
        return [_view(list(files), files)]
    groups: dict[object, list[Path]] = {}
    for file in files:
        name = parse_stem(file.stem)
        frame = int(name.frame) if name.frame else None
        key = file if together is False else (file.parent, name.shot, frame)
        groups.setdefault(key, []).append(file)
    found = []
    for group in groups.values():
        named = any(parse_stem(file.stem).attribute for file in group)
        found += [_view(each, files) for each in ([group] if named else [[f] for f in group])]
    return found if together is False else _with_gaps(found)


def summary(frames: Iterable[Sequence[Path]]) -> list[str]:
    """A line for each sequence whose frames are several files: how many, and of what."""
    kinds = Counter((sequence_of(files), _attributes(files)) for files in frames if len(files) > 1)
    return [
        f"{sequence.name}: {count} frame{'s' * (count > 1)}, {len(attributes)} files a frame: "
        + ", ".join(attributes)
        for (sequence, attributes), count in kinds.items()
    ]


def _view(group: Sequence[Path], files: Mapping[Path, Path]) -> View:
    below, name = files[group[0]], parse_stem(group[0].stem)
    frame = int(name.frame) if name.frame else None
    label = below.stem
    if len(group) > 1:
        label = ".".join(filter(None, (name.shot, name.frame))) or name.attribute
    return View(tuple(group), below.parent, label, frame)


def sequence_of(files: Sequence[Path]) -> Path:
    """What the frames of a sequence have in common: their folder, and the name of the shot."""
    return files[0].parent / (parse_stem(files[0].stem).shot or "frames")


def _attributes(files: Sequence[Path]) -> tuple[str, ...]:
    return tuple(parse_stem(file.stem).attribute or PLAIN for file in files)


def _with_gaps(found: list[View]) -> list[View]:
    """The views; one that lacks an attribute that most frames of its sequence have says so."""
    sequences: dict[Path, list[View]] = {}
    for view in found:
        sequences.setdefault(sequence_of(view.files), []).append(view)
    usual: dict[Path, list[str]] = {}
    for sequence, frames in sequences.items():
        counts = Counter(word for view in frames for word in set(_attributes(view.files)))
        several = any(len(view.files) > 1 for view in frames)
        usual[sequence] = [word for word, n in counts.items() if several and 2 * n > len(frames)]

    def lacking(view: View) -> tuple[str, ...]:
        there = _attributes(view.files)
        return tuple(word for word in usual[sequence_of(view.files)] if word not in there)

    return [replace(view, lacks=lacking(view)) for view in found]
