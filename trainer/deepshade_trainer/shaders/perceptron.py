"""A mesh's perceptron as one fragment shader whose weights are a uniform buffer."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from deepshade.errors import ConfigError
from deepshade.files import replacing

if TYPE_CHECKING:
    from deepshade.bundles import Bundle

NAME = "perceptron"


def uniform(bundle: Bundle) -> NDArray[np.float32]:
    """All weights without gaps, layer by layer: each its weights, row by row, then its biases.

    Two hidden layers of 16 and 8 are (48 · 16 + 16 + 16 · 8 + 8 + 8 + 1) · 4 = 3,716 bytes, 32 and
    16 are 8,452, and 64 and 32 are 20,996.
    """
    from deepshade_trainer.networks import bundle_weights

    found = bundle_weights(bundle)
    layers = [*(f"hidden.{k}" for k in range(len(bundle.network["widths"]))), "last"]
    parts = [found[f"{each}.{kind}"].numpy() for each in layers for kind in ("weight", "bias")]
    return np.concatenate([part.astype(np.float32).ravel() for part in parts])


def write_uniform_shader(bundle: Bundle, folder: Path) -> list[Path]:
    """Write `perceptron.frag`, `.vert`, and `.f32`: the uniform buffer, little-endian float32.

    Raises ConfigError: layers that fill no vec4s.
    """
    widths = bundle.network["widths"]
    if len(widths) != 2 or any(width % 4 for width in widths):
        raise ConfigError(
            "widths", detail=f"the shader is for two hidden layers of 4, 8, 12 …, not {widths}"
        )
    weights = uniform(bundle)
    texts = {kind: files(__package__) / "hosts" / f"{NAME}.{kind}" for kind in ("vert", "frag")}
    numbers = {
        "WIDE": widths[0],
        "HIGH": widths[1],
        "COUNT": weights.size // 4,
        "CIRCLE": bundle.network["circle"],
    }
    made: list[Path] = []
    for kind, source in texts.items():
        text = source.read_text("utf-8")
        for word, number in numbers.items():
            text = text.replace(word, str(number))
        with replacing(folder / f"{NAME}.{kind}") as part:
            part.write_text(text, "utf-8")
        made.append(folder / f"{NAME}.{kind}")
    with replacing(folder / f"{NAME}.f32") as part:
        weights.astype("<f4").tofile(part)
    return [*made, folder / f"{NAME}.f32"]
