"""Everything deepshade raises on bad input: one tree, each error says what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence


class DeepshadeError(Exception):
    """Something about the input or the set-up is wrong. `str()` says what, `.fix` what to do.

    A command that it ends returns `exit_code`.
    """

    fix = ""
    exit_code = 2

    def __init__(self, detail: str, *, fix: str = "") -> None:
        super().__init__(detail)
        self.detail = detail
        self.fix = fix or type(self).fix


class ImageError(DeepshadeError):
    """The bytes are no OpenEXR image, or one of a kind that deepshade can't use."""


class DamagedImageError(ImageError):
    """An OpenEXR image, but truncated or corrupt."""


class LimitError(DeepshadeError):
    """A size exceeds its limit; known before any pixel is decoded."""

    def __init__(self, limit: str, value: int, maximum: int) -> None:
        what, verb = limit.replace("_", " "), "needs" if limit == "memory_bytes" else "has"
        super().__init__(
            f"the image {verb} {value:,} {what}, the limit is {maximum:,}",
            fix=f"use a smaller image, or allow more: Limits({limit}=...)",
        )
        self.limit = limit
        self.value = value
        self.maximum = maximum


class MissingAttributeError(DeepshadeError):
    """Attributes that an effect needs are neither in the image nor derivable from it.

    `enough` says from what less all of them could be derived, if that is so.
    """

    def __init__(
        self,
        missing: Sequence[str],
        found: Sequence[str],
        near: Mapping[str, Sequence[str]] | None = None,
        *,
        why: Mapping[str, str] | None = None,
        enough: str = "",
        fix: str = "",
    ) -> None:
        near = {name: tuple(close) for name, close in (near or {}).items() if close}
        reasons = {name: f" ({why[name]})" for name in missing if why and why.get(name)}
        lacking = ", ".join(f"'{name}'{reasons.get(name, '')}" for name in missing)
        super().__init__(
            f"missing {lacking}; channels found: {_shortened(found) or 'none'}",
            fix=fix or _mapping_hint(missing, near, enough),
        )
        self.enough = enough
        self.missing = tuple(missing)
        self.found = tuple(found)
        self.near = near


class AmbiguousChannelError(DeepshadeError):
    """Several channels could be the same attribute; deepshade never guesses."""

    def __init__(self, attribute: str, candidates: Sequence[str], *, fix: str = "") -> None:
        super().__init__(
            f"'{attribute}' could be any of: {_shortened(candidates)}",
            fix=fix or f"choose one: --map {attribute}={candidates[0]}",
        )
        self.attribute = attribute
        self.candidates = tuple(candidates)


class CameraError(DeepshadeError):
    """A derivation needs a field of view or camera matrix that is absent or unusable."""


class ContradictionError(DeepshadeError):
    """Attributes of a G-buffer can't all be true: `seen` says what, `fits` which reading would.

    `fix` names the options that ask for it.
    """

    def __init__(self, detail: str, *, seen: str = "", fits: Sequence[str] = (), fix: str) -> None:
        super().__init__(detail, fix=f"{fix}; or --trust, if it is meant so")
        self.seen = seen or detail
        self.fits = tuple(fits)


class BundleError(DeepshadeError):
    """A model bundle is incomplete, malformed, or its files don't match their hashes."""


class EngineError(DeepshadeError):
    """A network can't run on the engine or in the precision that was asked for."""


class DataError(DeepshadeError):
    """A data set (shards, manifest) is incomplete, damaged or of another schema."""


class EnvironmentMapError(DeepshadeError):
    """A picture is no environment: its shape or its values are those of no light."""


class SceneError(DeepshadeError):
    """A scene can't be read or makes no sense."""


class ConfigError(DeepshadeError):
    """A setting has an unknown name or an impossible value."""

    def __init__(
        self, key: str, known: Iterable[str] = (), *, detail: str = "", fix: str = ""
    ) -> None:
        self.key = key
        self.nearest = nearest(key, known)
        super().__init__(
            detail or f"unknown setting '{key}'",
            fix=fix or (f"did you mean '{self.nearest}'?" if self.nearest else ""),
        )


def nearest(name: str, known: Iterable[str]) -> str | None:
    """The known name closest to `name` (case-insensitive), or None if none is close."""
    by_lower = {candidate.lower(): candidate for candidate in known}
    match = difflib.get_close_matches(name.lower(), by_lower, n=1, cutoff=0.5)
    return by_lower[match[0]] if match else None


def _shortened(names: Sequence[str]) -> str:
    return ", ".join(names[:24]) + (", …" if len(names) > 24 else "")


def _mapping_hint(
    missing: Sequence[str], near: Mapping[str, Sequence[str]], enough: str = ""
) -> str:
    for name in missing:
        if near.get(name):
            return f"if '{near[name][0]}' is it: --map {name}={near[name][0]}"
    render = f"{enough}: render with that on" if enough else "render with that pass on"
    return f"{render}, or name its channel: --map {missing[0]}=<layer>"
