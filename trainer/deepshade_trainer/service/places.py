"""Which paths a request may name: those that really lie in one of the configured roots."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from deepshade.errors import ConfigError, nearest


def confined(name: str, roots: Sequence[Path]) -> Path:
    """The real path that a request names, absolute or below one of the roots.

    Links are followed first, so that one out of the roots is refused, as `..` is. Raises
    ConfigError for that, and for what isn't there, alike: what lies outside is nobody's business.
    """
    if "\0" in name or not name:
        raise ConfigError("data", detail="a path can't be empty or hold a NUL")
    for root in (each.resolve() for each in roots):
        path = (root / name).resolve()
        if path.is_relative_to(root) and path.exists():
            _check_inside(path if path.is_dir() else path.parent, root)
            return path
    listed = ", ".join(map(str, roots)) or "none: --data names one"
    names = [entry.name for root in roots for entry in root.iterdir()]
    close = nearest(Path(name).name, names)
    hint = f"; did you mean {close!r}?" if close else ""
    raise ConfigError(
        "data", detail=f"{name[:200]!r} isn't in the trainer's data folders ({listed}){hint}"
    )


def _check_inside(path: Path, root: Path) -> None:
    """Nothing in a folder may lead out of the root either."""
    for entry in path.rglob("*"):
        if entry.is_symlink() and not entry.resolve().is_relative_to(root):
            raise ConfigError("data", detail=f"{entry.name!r} in {path} is a link out of {root}")
