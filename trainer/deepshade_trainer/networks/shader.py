"""A network with all that surrounds it, alike in training, evaluation and export."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from deepshade import transfer
from deepshade.attributes import ATTRIBUTES, RADIANCE
from deepshade.effects import Effect
from deepshade.errors import ConfigError
from deepshade.tensors import channel_slices
from deepshade_trainer.networks.horizons import covered
from deepshade_trainer.networks.network import Network

_BLACK = 1e-30  # of radiance


class Shader(nn.Module):
    """A G-buffer (N, C, H, W), as `deepshade.tensors` makes it, to the effect's answer.

    The network sees light through the effect's transfer curve and answers on it, but one that is
    linear in light, which carries all three colours at once. Where the
    effect's background is a number, that number stands where there is no surface. In evaluation
    mode the answer is kept within the effect's range; in training nothing is clamped.
    """

    def __init__(self, effect: Effect, network: Network) -> None:
        super().__init__()
        self.effect, self.network = effect, network
        self.transfer = "linear" if network.linear else effect.transfer
        self.per_channel = effect.per_channel and not network.linear
        self.inputs = network.attributes or effect.inputs
        self.places = channel_slices(self.inputs, self.per_channel)
        self.lights = [
            self.places[name] for name in self.inputs if ATTRIBUTES[name].unit is RADIANCE
        ]
        self.background: float | None = None  # on the curve
        if isinstance(effect.background, float):
            self.background = float(self.curve(torch.tensor(effect.background)))
            if not {"position", "depth", "normal_object"} & set(self.inputs):
                raise ConfigError(
                    effect.name, detail=f"no input of '{effect.name}' says where background is"
                )

    @property
    def channels(self) -> int:
        """Of a G-buffer."""
        return int(max(place.stop for place in self.places.values()))

    @property
    def size_multiple(self) -> int:
        """See `Network.size_multiple`."""
        return self.network.size_multiple

    @property
    def halo(self) -> int:
        """See `Network.halo`."""
        return self.network.halo

    def forward(self, gbuffer: Tensor, *given: Tensor) -> Tensor:
        """(N, C, H, W) to the answer (N, outputs, H, W), float32, in physical units.

        `given` is what the network needs of an environment (`Network.environment`).
        """
        return self.bounded(self.on_curve(gbuffer, *given))

    def bounded(self, answer: Tensor) -> Tensor:
        """What `on_curve` gave in physical units, and in evaluation mode within the range."""
        image: Tensor = transfer.inverse(answer, self.transfer, torch)
        unbounded = self.training or self.effect.range == (None, None)
        return image if unbounded else image.clamp(*self.effect.range)

    def padded(self, gbuffer: Tensor) -> Tensor:
        """(N, C, H, W) with more to the right and below, up to multiples of `size_multiple`.

        That is what `deepshade.tensors` puts there.
        """
        height, width = (-side % self.size_multiple for side in gbuffer.shape[2:])
        if not height and not width:
            return gbuffer
        pieces = [
            F.pad(
                gbuffer[:, place],
                (0, width, 0, height),
                "replicate" if ATTRIBUTES[name].goes_on else "constant",
            )
            for name, place in self.places.items()
        ]
        return torch.cat(pieces, 1)

    def on_curve(self, gbuffer: Tensor, *given: Tensor) -> Tensor:
        """(N, C, H, W) to the answer on the transfer curve (N, outputs, H, W): what is learnt."""
        image: Tensor = self.network(self._seen(gbuffer), *given).float()
        if self.background is None:
            return image
        return (image - self.background) * self._coverage(gbuffer) + self.background

    def curve(self, image: Tensor) -> Tensor:
        """Light or answers through the transfer curve."""
        seen: Tensor = transfer.forward(image, self.transfer, torch)
        return seen

    def compared(self, image: Tensor, reference: Tensor) -> tuple[Tensor, Tensor]:
        """What `on_curve` gave and the reference (N, outputs, H, W), as losses compare them.

        Light is exposed as when it is judged, each picture by its reference; what would be clipped
        then is bent instead, so that it still teaches.
        """
        if not self.effect.is_light:
            return image, self.curve(reference)
        image = transfer.inverse(image, self.transfer, torch)
        flat = reference[:, :, ::2, ::2].flatten(1)  # plenty, and sorting takes long
        white = torch.quantile(flat, 0.99, dim=1)
        white = torch.where(white > _BLACK, white, flat.amax(1))
        # all is black: as `metrics.exposure`, or what little an answer gives there would overflow
        white = torch.where(white > _BLACK, white, torch.ones_like(white))
        factor = (1 / white)[:, None, None, None]
        return _bent(image * factor), _bent(reference * factor)

    def _seen(self, gbuffer: Tensor) -> Tensor:
        """The G-buffer with its light on the curve."""
        if not self.lights or self.transfer == "linear":
            return gbuffer
        pieces = [gbuffer[:, place] for place in self.places.values()]
        return torch.cat(
            [
                self.curve(piece) if place in self.lights else piece
                for piece, place in zip(pieces, self.places.values(), strict=True)
            ],
            1,
        )

    def _coverage(self, gbuffer: Tensor) -> Tensor:
        """(N, 1, H, W): 1 where there is a surface, else 0."""
        if "position" in self.places:
            last = self.places["position"].stop
            return covered(gbuffer[:, last - 1 : last])
        if "depth" in self.places:
            return covered(-gbuffer[:, self.places["depth"]])
        normal = gbuffer[:, self.places["normal_object"]]
        return covered(-(normal * normal).sum(1, keepdim=True))


def _bent(image: Tensor) -> Tensor:
    """The identity up to 1, a logarithm above."""
    return torch.where(image > 1, 1 + torch.log(image.clamp_min(1)), image)
