"""Transfer functions: the curve that a network sees light through, and its inverse.

Radiance spans from a sky of 1e-3 to a firefly of 1e5. `log(1 + x)` is the curve that denoisers
settled on for such light: near 0 it is the identity, and its slope nowhere explodes. Both
directions work on any array type with `numpy`'s or `torch`'s functions, which the caller passes.
"""

from __future__ import annotations

from typing import Any


def forward(x: Any, curve: str, library: Any) -> Any:
    """Light >= 0 through `curve`, "linear" or "log"; negative light counts as 0 in "log"."""
    return x if curve == "linear" else library.log1p(x.clip(0))


def inverse(y: Any, curve: str, library: Any) -> Any:
    """The light that `forward` made `y` of. exp overflows float32 beyond 88, light of 1e38."""
    return y if curve == "linear" else library.expm1(y.clip(-1.0, 80.0))
