"""What an answer is judged beside: the trivial answer, and whether a view shows anything."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from deepshade import metrics
from deepshade.effects import Effect

Float = NDArray[np.float32]


def trivial(
    effect: Effect,
    attributes: Mapping[str, Float],
    reference: Float,
    environment: NDArray[np.floating] | None = None,
) -> Float:
    """The answer of doing nothing, shaped as the reference (C, H, W).

    Under an `environment`, whose mean (3,) this is, it is multiplied by that.
    """
    factor = np.float32(1) if environment is None else environment[:, None, None]
    plain = attributes[effect.trivial] if isinstance(effect.trivial, str) else effect.trivial
    return np.broadcast_to(plain * factor, reference.shape).astype(np.float32)


def exposed(effect: Effect, reference: Float, *images: Float) -> list[Float]:
    """Images (C, H, W) as they are compared, in [0, 1].

    Light is multiplied by the one factor that makes the reference's 99th percentile 1, and all
    is clipped.
    """
    factor = np.float32(metrics.exposure(reference) if effect.is_light else 1)
    with np.errstate(over="ignore"):  # an infinite value is clipped
        return [np.clip(image * factor, 0, 1) for image in images]


def relative(reference: Float, image: Float) -> float:
    """SMAPE of light (C, H, W), exposed as the reference is but not clipped; in [0, 1].

    Raises ValueError for non-finite values.
    """
    factor = metrics.exposure(reference)
    pair = (np.asarray(planes, np.float64) * factor for planes in (image, reference))
    return metrics.smape(*pair)


def contrast(effect: Effect, reference: Float, blank: Float) -> float:
    """How much a view shows, by the effect's measure: to be held against its `min_contrast`.

    The standard deviation of the reference (C, H, W), or the trivial answer's DSSIM.
    """
    image, nothing = exposed(effect, reference, reference, blank)
    return float(image.std()) if effect.contrast == "deviation" else metrics.dssim(nothing, image)
