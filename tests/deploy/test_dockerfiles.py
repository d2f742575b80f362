"""Dockerfiles: what they copy is there, what they install is ours, what they start starts."""

from __future__ import annotations

import importlib.metadata
import re
import shlex
import subprocess
import sys
import zipfile
from pathlib import Path
from types import ModuleType

import pytest

FILES = ("service", "trainer", "ray")


@pytest.fixture(params=FILES)
def dockerfile(request: pytest.FixtureRequest, root: Path) -> Path:
    return root / f"deploy/{request.param}.Dockerfile"


@pytest.fixture(scope="module")
def wheel(
    root: Path, images: ModuleType, tmp_path_factory: pytest.TempPathFactory
) -> zipfile.ZipFile:
    """What the images' `pip install .` builds, from nothing but what COPY gives them."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    images.copy(". ./", source, "/", root, {})
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out)]
    subprocess.run(build, cwd=source, check=True, capture_output=True)
    (path,) = out.glob("*.whl")
    return zipfile.ZipFile(path)


def value(images: ModuleType, dockerfile: Path, name: str) -> str:
    (*_, last) = images.read(dockerfile, {})
    return next(text for kind, text in last.instructions if kind == name)


def test_the_context_is_the_sources_and_no_more(root: Path, images: ModuleType) -> None:
    files = images.context(root)
    tops = {file.parts[0] for file in files}
    packages = {"core", "service", "workers", "trainer", "clients", "reports"}
    assert tops == packages | {"pyproject.toml", "constraints.txt", "README.md", "LICENSE"} | {
        "models",
        "samples",
    }
    tracked = subprocess.run(["git", "ls-files"], cwd=root, capture_output=True, text=True)
    if tracked.returncode == 0:  # in a clone
        known = {Path(line) for line in tracked.stdout.splitlines()}
        assert {file for file in known if file.parts[0] in tops} <= set(files)


@pytest.mark.parametrize("name", ["trainer", "ray"])
def test_images_that_render_have_what_mitsuba_loads(root: Path, name: str) -> None:
    """A slim Debian has the C and C++ libraries and zlib; each other one is installed by name."""
    drjit = importlib.metadata.distribution("drjit").locate_file("drjit")
    told = subprocess.run(["ldd", *Path(str(drjit)).glob("libdrjit-*.so")], capture_output=True)
    needed = set(re.findall(r"^\s(lib\S+) => /(?:usr/)?lib/", told.stdout.decode(), re.MULTILINE))
    assert needed, told.stderr
    usual = {"libc.so.6", "libm.so.6", "libdl.so.2", "libpthread.so.0", "librt.so.1"}
    usual |= {"libstdc++.so.6", "libgcc_s.so.1", "libz.so.1"}
    text = (root / f"deploy/{name}.Dockerfile").read_text()
    for library in needed - usual:
        stem, _, version = library.partition(".so.")
        assert f" {stem}{version} " in text, f"{library} is in no package that is installed"


def test_images_hold_the_whole_wheel(wheel: zipfile.ZipFile) -> None:
    names = wheel.namelist()
    for each in ("deepshade/health.py", "deepshade_trainer/cli.py", "deepshade_workers/cli.py"):
        assert each in names
    assert any(name.startswith("deepshade/shipped/models/ao/balanced/") for name in names)


def test_they_ask_for_extras_that_there_are(
    dockerfile: Path, images: ModuleType, wheel: zipfile.ZipFile
) -> None:
    """pip only warns of an extra that it doesn't know."""
    (name,) = (each for each in wheel.namelist() if each.endswith("METADATA"))
    offered = re.findall(r"Provides-Extra: (\S+)", wheel.read(name).decode())
    stages = images.read(dockerfile, {})
    runs = " ".join(text for kind, text in stages[0].instructions if kind == "RUN")
    (asked,) = re.findall(r"'\.\[([\w,]+)\]'", runs)
    assert set(asked.split(",")) <= set(offered)


def test_they_are_pinned_and_nobody_s_root(dockerfile: Path, images: ModuleType) -> None:
    for stage in images.read(dockerfile, {}):
        assert re.fullmatch(r"python:3\.\d+\.\d+-slim-bookworm", stage.base), stage.base
        for kind, text in stage.instructions:
            if kind == "RUN" and "pip install" in text:
                assert all("-c constraints.txt" in each for each in text.split("pip install")[1:])
    assert value(images, dockerfile, "USER") == "10001:10001"
    given = images.read(dockerfile, {"BASE": "python@sha256:1"})
    assert {stage.base for stage in given} == {"python@sha256:1"}


def test_their_commands_take_their_options(dockerfile: Path, images: ModuleType) -> None:
    """Of CMD: by the command's own help, as the installed entry point has it."""
    command, *rest = images.words(value(images, dockerfile, "CMD"))
    if command == "ray":
        help_ = subprocess.run(
            [sys.executable, "-m", "ray.scripts.scripts", "start", "--help"],
            capture_output=True,
            text=True,
            check=True,
        ).stdout
    else:
        points = importlib.metadata.entry_points(group="console_scripts", name=command)
        if not points:
            pytest.skip(f"{command} isn't installed here")
        (point,) = points
        code = f"import sys; from {point.module} import {point.attr} as f; sys.exit(f())"
        help_ = subprocess.run(
            [sys.executable, "-c", code, "serve", "--help"],
            capture_output=True,
            text=True,
            check=True,
            env={"COLUMNS": "200", "PATH": "/usr/bin:/bin", "PYTHONPATH": ":".join(sys.path)},
        ).stdout
    for option in (word.partition("=")[0] for word in rest if word.startswith("--")):
        assert option in help_, option


def test_an_instruction_that_is_not_known_is_refused(images: ModuleType, tmp_path: Path) -> None:
    (path := tmp_path / "Dockerfile").write_text("FROM a\nRUN true\nVOLUME /x\n")
    with pytest.raises(ValueError, match="line 3: VOLUME"):
        images.read(path, {})


def test_files_are_copied_as_the_file_says(images: ModuleType, tmp_path: Path) -> None:
    text = "ARG B=x:1\nFROM ${B} AS one\nCOPY . ./\nFROM ${B}\nCOPY --from=one /a /b\nCMD echo 1\n"
    (path := tmp_path / "Dockerfile").write_text(text)
    first, last = images.read(path, {})
    assert (first.base, first.name, last.name) == ("x:1", "one", "")
    assert shlex.join(images.words(last.instructions[-1][1])) == "sh -c 'echo 1'"
    one, two = tmp_path / "one", tmp_path / "two"
    (one / "a").mkdir(parents=True)
    (one / "a/file").write_text("here")
    two.mkdir()
    images.copy(last.instructions[0][1], two, "/", tmp_path, {"one": one})
    assert (two / "b/file").read_text() == "here"
    (context := tmp_path / "context").mkdir()
    (context / ".dockerignore").write_text("*\n!/kept\n**/__pycache__\n")
    for each in ("kept/x", "kept/__pycache__/y", "other/z", ".env"):
        (context / each).parent.mkdir(parents=True, exist_ok=True)
        (context / each).write_text(each)
    images.copy(". ./", two, "/src", context, {})
    assert [str(p.relative_to(two)) for p in (two / "src").rglob("*") if p.is_file()] == [
        "src/kept/x"
    ]
