"""The optional parts of deepshade: which packages each needs, by the installed metadata."""

from __future__ import annotations

import importlib.util
import re
from functools import cache
from importlib.metadata import requires

# the first of these that brings a package is the one to install for it; the report borrows
_ORDER = ("client", "service", "workers", "trainer", "report")
# where a package isn't imported by its own name, with _ for -
_MODULES = {"openexr": "OpenEXR", "pillow": "PIL"}
# imported by a package of ours rather than by us
_INDIRECT = {"drjit": "workers", "starlette": "service", "pydantic": "service"}


@cache
def packages() -> dict[str, tuple[str, ...]]:
    """Extra -> the packages it needs, by their names for pip; "" are those of every installation.

    From the distribution's requirements (its pyproject.toml), without versions.
    """
    found: dict[str, tuple[str, ...]] = dict.fromkeys(("", *_ORDER), ())
    for requirement in requires("deepshade") or ():
        specifier, _, marker = requirement.partition(";")
        extra = re.search(r"extra == ['\"]([\w-]+)", marker)
        name = extra[1] if extra else ""
        if name in found and (package := re.match(r"[\w.-]+", specifier)):
            found[name] += (package[0].lower(),)
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
