"""Hard patches to learn from: the gradient in each precision beside that in float64."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from deepshade import tensors
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS, Effect
from deepshade.engines import Backend
from deepshade_report.hardcases import made
from deepshade_report.hardcases.exact import stay64
from deepshade_report.hardcases.measure import Row
from deepshade_report.hardcases.picture import Float, Picture, unit_is_length, white_world
from deepshade_trainer.evaluation import prepared
from deepshade_trainer.losses import parse_loss
from deepshade_trainer.networks import Shader, from_bundle
from deepshade_trainer.recipe import Recipe

CASE = "training"
PRECISIONS = ("fp32", "bf16")
# 24 and 8 bits, of a sum of some thousand products that mostly cancel.
_FLOORS = {"fp32": 1e-3, "bf16": 0.25}
_SPIKE = np.float32(1e5)


def patches(effect: Effect, easy: Picture) -> Iterator[tuple[str, Picture]]:
    """What is hard to learn from, the easy picture first; each has a truth."""
    assert easy.truth is not None
    yield "easy", easy
    yield "a constant patch", made.wall(effect, *easy.shape)
    spiked, truth = dict(easy.planes), easy.truth.copy()
    for name, plane in spiked.items():
        if name in ("position", "depth"):
            spiked[name] = _spike(plane, plane[:, :1, :1] * 1e3)
        elif effect.is_light and name.startswith("light"):
            spiked[name] = _spike(plane, _SPIKE)
    yield "a spike", replace(easy, planes=spiked, truth=truth)
    if effect.is_light:
        yield "a spike in the reference", replace(easy, truth=_spike(truth, _SPIKE))
        bright = {n: p * _SPIKE if n.startswith("light") else p for n, p in easy.planes.items()}
        yield "light that overflows fp16", replace(easy, planes=bright, truth=truth * _SPIKE)
    far = {n: p * _SPIKE if unit_is_length(n) else p for n, p in easy.planes.items()}
    if any(map(unit_is_length, far)):
        yield "lengths that overflow fp16", replace(easy, planes=far)


def rows(bundle: Bundle, easy: Picture) -> Iterator[Row]:
    """How far each precision's gradient is from float64's; nothing for what isn't trained."""
    if from_bundle(bundle.path).network.calculated:
        return
    effect = EFFECTS[bundle.effect]
    known: dict[str, Float] = {}
    for name, picture in patches(effect, easy):
        exact = gradient(from_bundle(bundle.path).double(), bundle, picture, "float64")
        known.setdefault("float64", exact)
        for precision in PRECISIONS:
            found = gradient(from_bundle(bundle.path), bundle, picture, precision)
            known.setdefault(precision, found)
            first = _apart(known[precision], known["float64"], known["float64"])
            error = _apart(found, exact, known["float64"])
            line = max(_FLOORS[precision], 1.1 * first)
            backend = str(Backend("pytorch", precision))
            good = bool(np.isfinite(found).all()) and error <= line
            row = bundle.effect, bundle.name, backend, "float64"
            yield Row(CASE, name, *row, error, first, line, error, line, good)


def gradient(shader: Shader, bundle: Bundle, picture: Picture, precision: str) -> Float:
    """Of the usual loss by all weights, as one vector (float64)."""
    assert picture.truth is not None
    by = picture.header.get("radius") or tensors.median_depth(picture.planes) or 1.0
    effect, multiple = EFFECTS[bundle.effect], bundle.size_multiple
    planes, runs = dict(picture.planes), bundle.per_channel
    gbuffer = tensors.tensor(effect, planes, bundle.inputs, by, per_channel=runs, multiple=multiple)
    given = _given(bundle, picture)
    height, width = picture.shape
    shader.train()
    for weight in shader.parameters():
        weight.requires_grad_(True)
    wide = precision == "float64"
    inputs = [torch.from_numpy(array.copy()) for array in (gbuffer, *given, picture.truth[None])]
    *inputs, truth = (each.double() if wide else each for each in inputs)
    context: Any = stay64() if wide else torch.autocast("cpu", torch.bfloat16, precision == "bf16")
    with context:
        image: Tensor = shader.on_curve(*inputs)[:, :, :height, :width]
    with stay64() if wide else torch.autocast("cpu", enabled=False):
        loss = parse_loss(Recipe().loss)(*shader.compared(image, truth))
        loss.backward()  # type: ignore[no-untyped-call]
    found: Float = _flat(shader)
    return found


def _flat(network: nn.Module) -> Any:
    parts = [p.grad.double().flatten() for p in network.parameters() if p.grad is not None]
    return torch.cat(parts).numpy()


def _given(bundle: Bundle, picture: Picture) -> list[Float]:
    """What the network takes beside the G-buffer, of the picture's environment or a white one."""
    around = (picture.surroundings or white_world()).environment
    names = bundle.environment
    if not names:
        return []
    found: dict[str, Float] = prepared(around).inputs(names, 0.0, "y", lambda: np.eye(3))
    return [found[name] for name in names]


def _apart(found: Float, exact: Float, easy: Float) -> float:
    """The distance of two gradients, as a share of the exact one, or of a thousandth of the easy
    one where that is longer: a constant patch has next to nothing to teach."""
    scale = max(float(np.linalg.norm(exact)), 1e-3 * float(np.linalg.norm(easy)))
    return float(np.linalg.norm(found - exact)) / scale


def _spike(plane: Float, value: Any) -> Float:
    """With one pixel of that value, in the middle."""
    height, width = plane.shape[1:]
    spiked = plane.copy()
    spiked[:, height // 2 : height // 2 + 1, width // 2 : width // 2 + 1] = value
    return spiked
