"""A network on pixels repeated twice each way: its effect radius covers twice as many pixels."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade_report.method import Network
from deepshade_report.view import Float, View


class Doubled:
    """A network as a Method: 2 x 2 equal pixels for each go in, their mean comes out."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self.name, self.family = f"{network.name}, doubled", network.family
        self.settings = network.settings

    def prepare(self, view: View) -> None:
        """Make the network's input of four times the pixels."""
        self._view = replace(
            view,
            attributes={name: repeated(plane) for name, plane in view.attributes.items()},
            background=repeated(view.background),
        )
        self.network.prepare(self._view)

    def shade(self, view: View) -> Float:
        """(C, H, W) of the prepared view."""
        answer = self.network.shade(self._view)
        blocks = answer.reshape(len(answer), view.height, 2, view.width, 2)
        return np.asarray(blocks.mean((2, 4)))


def repeated(plane: NDArray[Any]) -> NDArray[Any]:
    """(…, 2 H, 2 W)."""
    return plane.repeat(2, -1).repeat(2, -2)
