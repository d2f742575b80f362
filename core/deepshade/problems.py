"""Errors as problem documents (RFC 9457): which HTTP status and kind, and the facts they carry."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from deepshade.errors import (
    AmbiguousChannelError,
    BundleError,
    CameraError,
    ConfigError,
    ContradictionError,
    DamagedImageError,
    DeepshadeError,
    ImageError,
    LimitError,
    MissingAttributeError,
)

MEDIA_TYPE = "application/problem+json"

# The first match counts, so subclasses come before their parents.
_KINDS: tuple[tuple[type[DeepshadeError], int, str], ...] = (
    (DamagedImageError, 400, "damaged-image"),
    (ImageError, 400, "not-an-image"),
    (LimitError, 413, "over-limit"),
    (MissingAttributeError, 422, "missing-attribute"),
    (AmbiguousChannelError, 422, "ambiguous-channel"),
    (CameraError, 422, "no-camera"),
    (ContradictionError, 422, "contradiction"),
    (ConfigError, 422, "bad-parameter"),
    (BundleError, 500, "bad-bundle"),
    (DeepshadeError, 422, "unusable-input"),
)
_FACTS = (
    *("missing", "found", "near", "attribute", "candidates", "seen", "fits"),
    *("limit", "value", "maximum"),
)
MAX_ENTRIES = 200  # entries of a list; a file may have thousands of channels


def kind_of(error: DeepshadeError) -> tuple[int, str]:
    """The HTTP status of an error, and the kind that ends its document's type URI."""
    return next((status, kind) for cls, status, kind in _KINDS if isinstance(error, cls))


def facts_of(error: DeepshadeError) -> dict[str, Any]:
    """What an error carries for machines, as plain JSON values of bounded length."""
    return {name: _short(getattr(error, name)) for name in _FACTS if hasattr(error, name)}


def type_uri(kind: str) -> str:
    """The document's `type`."""
    return f"urn:deepshade:problem:{kind}"


def _short(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _short(entry) for name, entry in list(value.items())[:MAX_ENTRIES]}
    if isinstance(value, tuple | list | set):
        return [str(entry)[:200] for entry in list(value)[:MAX_ENTRIES]]
    return value
