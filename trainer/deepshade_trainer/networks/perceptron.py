"""The perceptron of a mesh: normals on a circle around a pixel to its ambient occlusion.

A. Erra, N. F. Capece and R. Agatiello, *Ambient Occlusion Baking via a Feed-Forward Neural Network*
(Eurographics 2017, short papers): 16 normals of object space on a circle of 10 pixels, two hidden
layers with tanh, a linear output. One network knows one mesh.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from deepshade.circles import POINTS, RADIUS, offsets
from deepshade.errors import ConfigError
from deepshade_trainer.networks.network import Network, check_types
from deepshade_trainer.networks.receptive_field import Span, grown


@dataclass(frozen=True)
class PerceptronConfig:
    """Hidden layers of `widths` over what lies `circle` pixels around.

    0 is the pixel itself, as often as there are points: the paper's way to run what was learnt
    with 10.
    """

    kind: str = "perceptron"
    inputs: int = 3
    outputs: int = 1
    widths: tuple[int, ...] = (16, 8)
    circle: int = RADIUS

    def __post_init__(self) -> None:
        """Raise ConfigError for values that no network could mean."""
        check_types(self)
        if not self.widths or 0 in self.widths or not 0 <= self.circle <= 64:
            raise ConfigError("widths", detail="widths must be above 0 and circle from 0 to 64")


class Perceptron(Network):
    """See the module. Weights of the first layer go by points, then by x, y, z."""

    attributes = ("normal_object",)
    rounded = None  # a few hundred weights, and 8 bits of tanh would show as bands

    def __init__(self, config: PerceptronConfig) -> None:
        super().__init__()
        self.circle = config.circle
        sides = (config.inputs * POINTS, *config.widths)
        self.hidden = nn.ModuleList(nn.Conv2d(a, b, 1) for a, b in itertools.pairwise(sides))
        self.last = nn.Conv2d(sides[-1], config.outputs, 1)
        for layer in (*self.hidden, self.last):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)

    @property
    def size_multiple(self) -> int:
        """Any size will do."""
        return 1

    def receptive_field(self, pixel: int) -> Span:
        """See `Network.receptive_field`."""
        return grown((pixel, pixel), self.circle)

    def forward(self, gbuffer: Tensor) -> Tensor:
        """See `Network.forward`. Past the picture there is no normal: 0."""
        reach = self.circle
        if not reach:
            return self.answered(torch.cat([gbuffer] * POINTS, 1))
        wide = F.pad(gbuffer, (reach, reach, reach, reach))
        around = [
            F.pad(wide, (-reach - x, x - reach, -reach - y, y - reach))  # one operation
            for x, y in offsets(reach)
        ]
        return self.answered(torch.cat(around, 1))  # (N, 48, H, W)

    def answered(self, around: Tensor) -> Tensor:
        """(N, 48, H, W), the normals around each pixel, to its answer (N, outputs, H, W)."""
        x = around
        for layer in self.hidden:
            x = torch.tanh(layer(x))
        answer: Tensor = self.last(x)
        return answer
