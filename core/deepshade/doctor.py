"""`deepshade doctor`: checks of this machine, each with the line that puts it right."""

from __future__ import annotations

import os
import shutil
import socket
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from deepshade.errors import BundleError, ConfigError
from deepshade.extras import install_command, installed, missing_packages, packages
from deepshade.llvm import FIX as LLVM_FIX
from deepshade.llvm import OLDEST, find_libllvm, libllvm_version
from deepshade.machine import cpu_count, cpu_quota, memory_bytes

_GIB = 1024**3


@dataclass(frozen=True, slots=True)
class Check:
    """One finding. A failed `required` check makes `deepshade doctor` exit with 1.

    `fix` says what to do if it failed; `value` is what was counted or measured, in bytes or CPUs.
    """

    name: str
    ok: bool
    required: bool
    detail: str
    fix: str = ""
    value: float | None = None


def doctor(
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Check this machine for everything deepshade needs, and print how to fix what is missing.

    Exits with 1 if something is missing that deepshade can't do without.

    Examples:

      deepshade doctor

      deepshade doctor --json
    """
    checks = run_checks()
    if json:
        import json as json_module

        typer.echo(json_module.dumps([asdict(check) for check in checks], indent=2))
    else:
        _show(checks)
    if any(check.required and not check.ok for check in checks):
        raise typer.Exit(1)


def run_checks(checks: Sequence[Callable[[], list[Check]]] | None = None) -> list[Check]:
    """Every check's findings."""
    found = [check for function in (checks or _CHECKS) for check in function()]
    return [replace(check, fix="") if check.ok else check for check in found]


def check_python() -> list[Check]:
    """Whether Python is new enough."""
    version = ".".join(map(str, sys.version_info[:3]))
    return [Check("python", sys.version_info >= (3, 11), True, version, "install 3.11 or newer")]


def check_packages() -> list[Check]:
    """Whether the core's packages are installed (required) and each extra's (not required)."""
    checks = []
    for extra in packages():
        lacking = missing_packages(extra)
        name = f"extra '{extra}'" if extra else "core packages"
        detail = f"missing: {', '.join(lacking)}" if lacking else "all installed"
        checks.append(Check(name, not lacking, not extra, detail, install_command(extra)))
    return checks


def check_llvm() -> list[Check]:
    """Whether libLLVM is found, which Mitsuba renders with; required if Mitsuba is installed."""
    needed = installed("mitsuba")
    path = find_libllvm()
    version = libllvm_version(path) if path else None
    too_old = version is not None and version < OLDEST  # named by the environment
    if path is None:
        wrong = os.environ.get("DRJIT_LIBLLVM_PATH")
        detail = f"DRJIT_LIBLLVM_PATH names no file: {wrong}" if wrong else "none from 17 on found"
    elif too_old:
        detail = f"{path} is version {version}; Mitsuba needs {OLDEST} or newer"
    else:
        detail = f"{path} ({version})" if version else str(path)
    return [Check("libLLVM", path is not None and not too_old, needed, detail, LLVM_FIX)]


def check_shared_memory(path: Path = Path("/dev/shm")) -> list[Check]:
    """How large /dev/shm is, where Ray's workers exchange arrays."""
    if not path.is_dir():
        return [Check("shared memory", True, False, "no /dev/shm on this system")]
    total = shutil.disk_usage(path).total
    fix = "docker run --shm-size=2g … (compose: shm_size: 2g)"
    detail = f"{total / _GIB:.1f} GiB in {path}"
    return [Check("shared memory", total >= _GIB, False, detail, fix, total)]


def check_machine() -> list[Check]:
    """How many CPUs and how much memory this process may use."""
    quota = cpu_quota()
    cpus = f"{cpu_count()} usable of {os.cpu_count()}" + (f", quota {quota:g}" if quota else "")
    memory = memory_bytes()
    enough = memory == 0 or memory >= 2 * _GIB
    detail = f"{memory / _GIB:.1f} GiB" if memory else "unknown"
    fix = "give the machine or container at least 2 GiB"
    return [
        Check("CPUs", True, False, cpus, value=cpu_count()),
        Check("memory", enough, False, detail, fix, memory or None),
    ]


def check_engines() -> list[Check]:
    """What networks can run on here; at least one engine is needed once the service is installed.

    Loads the engines' libraries, which takes a moment.
    """
    from deepshade.engines import available

    found = available()
    listed: dict[str, list[str]] = {}
    for backend in found:
        listed.setdefault(backend.engine, []).append(backend.precision)
    detail = "; ".join(f"{engine} ({', '.join(kinds)})" for engine, kinds in listed.items())
    fix = install_command("service")
    return [Check("engines", bool(found), installed("fastapi"), detail or "none", fix)]


def check_bundles(*roots: Path) -> list[Check]:
    """Whether each model that is served by default, or lies in `roots`, matches its hashes."""
    from deepshade.bundles import Bundle, bundle_folders, bundle_roots

    try:
        roots = roots or bundle_roots()
    except ConfigError as error:
        fix = "name one that is there, or unset it to use the shipped ones"
        return [Check("models", False, True, str(error), fix)]
    checks = [Check("models", True, False, ", ".join(map(str, roots)))]
    for folder in bundle_folders(*roots):
        name = f"model {folder.parent.name}/{folder.name}"
        try:
            detail = f"sha256 {Bundle.load(folder).short_hash}…"
            checks.append(Check(name, True, True, detail))
        except BundleError as error:
            checks.append(Check(name, False, True, str(error), error.fix))
    if len(checks) == 1:
        fix = "install deepshade again, or name a folder of bundles: DEEPSHADE_MODELS"
        checks = [replace(checks[0], ok=False, detail=f"none in {checks[0].detail}", fix=fix)]
    return checks


def check_port(port: int = 8000) -> list[Check]:
    """Whether the service's usual port is free."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            detail = error.strerror or str(error)
            fix = f"stop what listens there (ss -ltnp 'sport = :{port}'), or serve --port elsewhere"
            return [Check(f"port {port}", False, False, detail, fix)]
    return [Check(f"port {port}", True, False, "free")]


_CHECKS: tuple[Callable[[], list[Check]], ...] = (
    check_python,
    check_packages,
    check_llvm,
    check_shared_memory,
    check_machine,
    check_engines,
    check_bundles,
    check_port,
)


def _show(checks: Sequence[Check]) -> None:
    from rich.markup import escape

    from deepshade.console import stdout

    console = stdout()
    for check in checks:
        mark = "[green]ok     [/green]"
        if not check.ok:
            mark = "[red]MISSING[/red]" if check.required else "[yellow]warning[/yellow]"
        console.print(f"{mark}  {escape(check.name)}: {escape(check.detail)}", soft_wrap=True)
        if check.fix:
            console.print(f"         fix: {escape(check.fix)}", soft_wrap=True)
