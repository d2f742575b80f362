"""What renderers store as depth, and our planar depth from each."""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from deepshade.errors import ConfigError

Kind = Literal["planar", "distance", "inverse", "normalised", "zbuffer", "reversed"]
KINDS: tuple[Kind, ...] = get_args(Kind)
MEANINGS: dict[Kind, str] = {
    "planar": "the distance from the camera's plane",
    "distance": "the distance along the ray",
    "inverse": "1 / depth",
    "normalised": "0 at the near plane, 1 at the far plane, linear in depth",
    "zbuffer": "a depth buffer: 0 at the near plane, 1 at the far plane, linear in 1 / depth",
    "reversed": "a reversed depth buffer: 1 at the near plane, 0 at the far plane",
}
PLANES = ("normalised", "zbuffer", "reversed")  # which need the near and the far plane


def check_planes(kind: Kind | None, near: float | None, far: float | None) -> None:
    """Raises ConfigError where a kind of depth lacks its planes, or they make no sense."""
    if kind in PLANES and (near is None or (far is None and kind != "reversed")):
        raise ConfigError(
            "near",
            detail=f"'{kind}' depth ({MEANINGS[kind]}) needs the planes' depths near and far",
            fix="give them: --near <depth> and --far <depth>",
        )
    if near is not None and far is not None and not 0 < near < far:
        raise ConfigError(
            "near",
            detail=f"near ({near:g}) must be above 0 and below far ({far:g})",
            fix="give both planes' depths: --near <depth> and --far <depth>",
        )


@np.errstate(divide="ignore", invalid="ignore", over="ignore")
def planar(
    stored: NDArray[np.float32],
    kind: Kind,
    *,
    slant: NDArray[np.floating[Any]] | None = None,
    near: float | None = None,
    far: float | None = None,
) -> NDArray[np.float32]:
    """Planar depth of what is `stored`, of any shape; infinite where nothing was hit.

    `slant` is the length of each pixel's ray to the plane at distance 1, which a "distance" needs.
    What isn't positive stays so, and shows nothing.
    """
    if kind == "planar":
        depth: NDArray[Any] = stored
    elif kind == "distance":
        assert slant is not None, "the plan makes sure of the field of view"
        depth = stored / slant
    elif kind == "inverse":
        depth = 1 / stored
    else:
        assert near is not None
        if kind == "normalised":
            assert far is not None
            depth = near + stored * (far - near)
        else:
            share = stored if kind == "reversed" else 1 - stored
            beyond = 0.0 if far is None else 1 / far
            depth = 1 / (beyond + share * (1 / near - beyond))
        # at the far plane nothing was hit, and before the near plane nothing is seen
        empty = stored <= 0 if kind == "reversed" else (stored >= 1) | (stored < 0)
        depth = np.where(empty, np.inf, depth)
    return depth.astype(np.float32, copy=False)
