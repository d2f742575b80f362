"""The papers' analyses, a file each, found by its name: `deepshade study NAME`.

A study has a TITLE, the FIGURE of the paper that it repeats (Nalbach et al., "Deep Shading",
arXiv 1603.06078), and three functions:

- `points(bench)`: what is to be measured, as JSON-ready dicts;
- `measure(bench, point)`: the figures of one point, as a JSON-ready dict;
- `draw(bench, rows)`: the plot (PNG) of its rows, which are points with their figures.
"""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules
from types import ModuleType

from deepshade.errors import ConfigError


def names() -> list[str]:
    """All studies, in alphabetical order."""
    return sorted(found.name for found in iter_modules(__path__) if not found.ispkg)


def study(name: str) -> ModuleType:
    """The study of that name. Raises ConfigError where there is none."""
    if name not in names():
        detail = f"no study is called '{name}': {', '.join(names())}"
        raise ConfigError(name, names(), detail=detail)
    return import_module(f"{__name__}.{name}")
