"""Does what a Dockerfile says, without a container engine: to prove it where there is none.

    mmdebstrap --variant=minbase --include=python3,python3-venv,ca-certificates bookworm out/base
    sudo python scripts/images.py deploy/service.Dockerfile --base out/base --out out/service

Each stage is a copy of the base's root. RUN runs in it by chroot, with its own mounts and process
ids; COPY heeds .dockerignore. The image's settings are written beside the root, from where
`scripts/topology.py --images out` takes both. Of Dockerfiles it knows what ours use, and refuses
the rest.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from string import Template

from dockerfile_parse import DockerfileParser
from pathspec import PathSpec

ROOT = Path(__file__).resolve().parents[1]
SETTINGS = "image.json"
KNOWN = {"FROM", "ARG", "RUN", "COPY", "ENV", "WORKDIR", "USER", "EXPOSE", "HEALTHCHECK", "CMD"}


@dataclass
class Image:
    """What a container begins with, beside its files."""

    env: dict[str, str] = field(default_factory=dict)
    workdir: str = "/"
    user: str = "0:0"
    command: list[str] = field(default_factory=list)
    health: list[str] = field(default_factory=list)


@dataclass
class Stage:
    """One FROM and what follows it; the instructions are pairs of name and value."""

    base: str
    name: str
    instructions: list[tuple[str, str]] = field(default_factory=list)


def read(path: Path, arguments: Mapping[str, str]) -> list[Stage]:
    """A Dockerfile's stages. Raises ValueError for an instruction that isn't known here."""
    known, stages = dict(arguments), list[Stage]()
    for found in DockerfileParser(fileobj=io.BytesIO(path.read_bytes())).structure:
        name, value = found["instruction"].upper(), found["value"]
        if name == "COMMENT":
            continue
        if name not in KNOWN:
            raise ValueError(f"{path}, line {found['startline'] + 1}: {name} isn't known here")
        if name == "ARG":
            key, _, default = value.partition("=")
            value = f"{key}={known.setdefault(key, default)}"
        if name == "FROM":
            base, *alias = Template(value).substitute(known).split()
            stages.append(Stage(base, alias[1] if alias else ""))
        elif stages:
            stages[-1].instructions.append((name, value))
    return stages


def context(folder: Path) -> list[Path]:
    """The files that a build sees, relative, by .dockerignore (whose rules git's are like)."""
    ignored = PathSpec.from_lines("gitignore", (folder / ".dockerignore").read_text().splitlines())
    files = []
    for place, names, found in os.walk(folder):
        here = Path(place).relative_to(folder)
        names[:] = [n for n in names if not ignored.match_file(f"{here / n}/")]
        files += [here / n for n in found if not ignored.match_file(here / n)]
    return sorted(files)


def words(value: str) -> list[str]:
    """Exec form is JSON, shell form is for sh."""
    return json.loads(value) if value.startswith("[") else ["sh", "-c", value]


def copy(value: str, root: Path, workdir: str, folder: Path, stages: Mapping[str, Path]) -> None:
    """COPY of a context's folder, or of a path from another stage."""
    options = [word for word in value.split() if word.startswith("--")]
    source, target = (word for word in value.split() if word not in options)
    to = root / Path(workdir, target).relative_to("/")
    if options:
        (name,) = (each.removeprefix("--from=") for each in options)
        to.parent.mkdir(parents=True, exist_ok=True)
        subprocess.run(["cp", "-a", str(stages[name] / source.lstrip("/")), str(to)], check=True)
        return
    for file in context(folder):
        if file.is_relative_to(source):
            (to / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(folder / file, to / file)


def chroot(root: Path, image: Image, binds: list[str], command: list[str]) -> None:
    """Run a command in a root as a build does: as root, with the machine's network."""
    lines = ["set -e", "mount --make-rprivate /", f"cd {shlex.quote(str(root))}"]
    lines += ["mount -t proc proc proc", "mount --rbind /dev dev"]
    for bind in binds:
        at = root / bind.lstrip("/")
        if Path(bind).is_dir():
            at.mkdir(parents=True, exist_ok=True)
        else:
            at.parent.mkdir(parents=True, exist_ok=True)
            at.touch()
        lines.append(f"mount --rbind {shlex.quote(bind)} {shlex.quote(str(at))}")
    inner = f"cd {shlex.quote(image.workdir)} && exec {shlex.join(command)}"
    env = shlex.join(f"{k}={v}" for k, v in image.env.items())
    lines.append(f"exec chroot . /usr/bin/env -i {env} sh -c {shlex.quote(inner)}")
    space = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "sh", "-c", "\n".join(lines)]
    subprocess.run(space, check=True)


def build(
    dockerfile: Path, base: Path, out: Path, arguments: Mapping[str, str], binds: list[str]
) -> Image:
    """The last stage's root as `out`/root and its settings as `out`/image.json."""
    roots: dict[str, Path] = {}
    for number, stage in enumerate(stages := read(dockerfile, arguments)):
        root = out / ("root" if stage is stages[-1] else f"stage{number}")
        shutil.rmtree(root, ignore_errors=True)
        out.mkdir(parents=True, exist_ok=True)
        subprocess.run(["cp", "-a", "--reflink=auto", str(base), str(root)], check=True)
        image = Image({"PATH": "/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin", "HOME": "/root"})
        known = {k: v for k, v in os.environ.items() if k.startswith("PIP_")}
        for name, value in stage.instructions:
            print(f"{dockerfile.name}: {name} {value[:100]}", flush=True)
            if name == "ARG":
                key, _, default = value.partition("=")
                known[key] = default
            elif name == "ENV":
                given = (pair.partition("=") for pair in shlex.split(value))
                image.env |= {key: text for key, _, text in given}
            elif name == "WORKDIR":
                image.workdir = value
                (root / value.lstrip("/")).mkdir(parents=True, exist_ok=True)
            elif name == "USER":
                image.user = value
            elif name == "COPY":
                copy(value, root, image.workdir, ROOT, roots)
            elif name == "RUN":
                seen = Image(known | image.env, image.workdir)
                chroot(root, seen, ["/etc/resolv.conf", *binds], words(value))
            elif name == "HEALTHCHECK":
                image.health = words(value.partition("CMD ")[2])
            elif name == "CMD":
                image.command = words(value)
        roots[stage.name] = root
    for name, root in roots.items():
        if name:
            shutil.rmtree(root)
    (out / SETTINGS).write_text(json.dumps(asdict(image), indent=1))
    return image


def size(root: Path) -> int:
    """Bytes that the files of a root take, each once."""
    seen = {}
    for place, _, names in os.walk(root):
        for name in names:
            status = (Path(place) / name).lstat()
            seen[status.st_ino] = status.st_size
    return sum(seen.values())


def main() -> int:
    """Build one image."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dockerfile", type=Path)
    parser.add_argument("--base", type=Path, required=True, help="the root that FROM stands for")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--build-arg", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument(
        "--bind", action="append", default=[], help="of this machine, seen by RUN: a package mirror"
    )
    asked = parser.parse_args()
    arguments = dict(pair.split("=", 1) for pair in asked.build_arg)
    build(asked.dockerfile, asked.base, asked.out.resolve(), arguments, asked.bind)
    base, whole = size(asked.base), size(asked.out / "root")
    print(f"{asked.out / 'root'}: {whole / 1e6:.0f} MB, of which the base {base / 1e6:.0f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
