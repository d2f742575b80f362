"""The optional parts of deepshade: which packages each needs, by the installed metadata."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import sys
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution, requires
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

# the first of these that brings a package is the one to install for it; the report borrows
_ORDER = (
    *("client", "service", "live", "workers", "trainer", "report"),
    *("postgres", "cluster", "tracing"),
)
# where a package isn't imported by its own name, with _ for -
_MODULES = {
    "openexr": "OpenEXR",
    "pillow": "PIL",
    "scikit-learn": "sklearn",
    "opentelemetry-sdk": "opentelemetry.sdk",
    "opentelemetry-exporter-otlp-proto-http": "opentelemetry.exporter.otlp.proto.http",
}
# imported by a package of ours rather than by us
_INDIRECT = {"drjit": "workers", "starlette": "service", "pydantic": "service"}


@cache
def packages() -> dict[str, tuple[str, ...]]:
    """Extra -> the packages it needs, by their names for pip; "" are those of every installation.

    From the distribution's requirements (its pyproject.toml), without versions.
    """
    return {extra: tuple(each) for extra, each in _requirements().items()}


@cache
def _requirements() -> dict[str, dict[str, str]]:
    """Extra -> its packages' names -> what pip is told, as "torch>=2.6"."""
    found: dict[str, dict[str, str]] = {extra: {} for extra in ("", *_ORDER)}
    for requirement in requires("deepshade") or ():
        specifier, _, marker = requirement.partition(";")
        extra = re.search(r"extra == ['\"]([\w-]+)", marker)
        name = extra[1] if extra else ""
        if name in found and (package := re.match(r"[\w.-]+", specifier)):
            found[name][package[0].lower()] = specifier.strip()
    return found


def module_of(package: str) -> str:
    """The name under which a package is imported."""
    return _MODULES.get(package, package.replace("-", "_"))


def installed(module: str) -> bool:
    """Whether a top-level module could be imported; it isn't."""
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):
        return False


def missing_packages(extra: str) -> list[str]:
    """The packages of an extra ("" for the core) that aren't installed, by their names for pip."""
    return [package for package in packages()[extra] if not installed(module_of(package))]


def extra_of(module: str) -> str | None:
    """The first extra that brings a module, or None if it is nobody's."""
    top = module.partition(".")[0]
    for extra in _ORDER:
        if any(top == module_of(package) for package in packages()[extra]):
            return extra
    return _INDIRECT.get(top)


def install_command(extra: str) -> str:
    """The line that installs an extra ("" for the core), from where this deepshade came.

    That is the clone, or the wheel if it is where it was (PEP 610 keeps that). Else it names the
    packages that are missing by their own names: an index may not have deepshade.
    """
    beside = Path(sys.executable).with_name("pip")
    found = shutil.which("pip")
    same = found is not None and Path(found).absolute() == beside.absolute()
    return f"{'pip' if same else f'{sys.executable} -m pip'} install {_what(extra)}"


def _what(extra: str) -> str:
    suffix = f"[{extra}]" if extra else ""
    clone = Path(__file__).resolve().parents[2]
    if (clone / "pyproject.toml").is_file():
        return f"-e '{'.' if clone == Path.cwd() else clone}{suffix}'"
    url = _origin()
    place = Path(url2pathname(urlsplit(url).path))
    if url.startswith("file:") and place.exists():
        return f"'{place}{suffix}'"
    wanted = _requirements()[extra]
    return " ".join(f"'{wanted[name]}'" for name in missing_packages(extra) or wanted)


def _origin() -> str:
    """The URL that this deepshade was installed from; "" from an index."""
    try:
        recorded = distribution("deepshade").read_text("direct_url.json")
    except PackageNotFoundError:
        return ""
    return str(json.loads(recorded)["url"]) if recorded else ""
