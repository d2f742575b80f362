"""What an answer is judged beside: the trivial answer, and whether a view shows anything."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from deepshade import metrics
from deepshade.effects import Effect
from deepshade.effects.effect import IRRADIANCE
from deepshade.environments import Surroundings
from deepshade.errors import DataError

Float = NDArray[np.float32]


def trivial(
    effect: Effect,
    images: Mapping[str, Float],
    reference: Float,
    surroundings: Surroundings | None = None,
) -> Float:
    """The answer of doing nothing (`Effect.trivial`), shaped as the reference (C, H, W).

    `images` hold the effect's inputs and its `trivial_layer`. Raises DataError where the answer
    depends on an environment and none is given.
    """
    known = effect.trivial
    plain: Float | np.float32
    if not isinstance(known, str):
        plain = np.float32(known)
    elif known == IRRADIANCE:
        plain = _known(effect, surroundings).irradiance(images["normal_world"])
    else:
        plain = images[effect.trivial_layer or known]
        if known in effect.inputs and "environment" in effect.settings:
            plain = plain * _known(effect, surroundings).mean[:, None, None]
    return np.broadcast_to(plain, reference.shape).astype(np.float32)


def _known(effect: Effect, surroundings: Surroundings | None) -> Surroundings:
    if surroundings is None:
        raise DataError(
            f"nothing says what environment lights this, on which '{effect.name}' depends",
            fix="render it with 'deepshade datagen', which keeps maps beside what they lit",
        )
    return surroundings


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


def floor(effect: Effect, reference: Float, error: Float) -> float:
    """DSSIM that noise in the reference (C, H, W) leaves to a perfect answer, at least.

    That of the reference with as much noise again, of its standard `error`: near it where noise is
    weak, too little where it is strong.
    """
    noise = np.random.default_rng(0).standard_normal(reference.shape, np.float32)
    again, truth = exposed(effect, reference, reference + noise * error, reference)
    return metrics.dssim(again, truth)


def nothing_shown(effect: Effect, where: str, least: float) -> DataError:
    """The error of a data set none of whose views shows `least`, with what to do."""
    if effect.contrast == "deviation":
        measure = "reference has a standard deviation"
        fix = f"deepshade datagen --min-contrast {least:g}"
    else:
        measure = "trivial answer has a DSSIM"
        fix = "other scenes, or more --views"
    return DataError(
        f"no view of {where} has enough contrast: of none the {measure} of {least:g} or more",
        fix=f"render views that show more: {fix}, or see 'deepshade evaluate --min-contrast'",
    )


def contrast(effect: Effect, reference: Float, blank: Float) -> float:
    """How much a view shows, by the effect's measure: to be held against its `min_contrast`.

    The standard deviation of the reference (C, H, W), or the trivial answer's DSSIM.
    """
    image, nothing = exposed(effect, reference, reference, blank)
    return float(image.std()) if effect.contrast == "deviation" else metrics.dssim(nothing, image)
