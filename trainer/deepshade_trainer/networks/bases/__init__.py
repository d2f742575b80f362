"""What light is blended from: classical filters that geometry steers, a file each.

Each calculates what is known, linearly in light, and leaves what it can't know to blend weights
that a network predicts (`carrier.Carrier`).
"""

from deepshade_trainer.networks.bases.base import Bases
from deepshade_trainer.networks.bases.bounces import Bounces
from deepshade_trainer.networks.bases.diffusion import Diffusion
from deepshade_trainer.networks.bases.lines import Lines
from deepshade_trainer.networks.bases.neighbours import Neighbours

BASES: dict[str, type[Bases]] = {
    "bounces": Bounces,
    "diffusion": Diffusion,
    "lines": Lines,
    "neighbours": Neighbours,
}
