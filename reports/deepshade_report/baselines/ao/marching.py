"""What the methods that march over the screen have in common as Methods."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

from deepshade_report.method import Float, View

if TYPE_CHECKING:
    from deepshade_report.baselines.ao.compiled import Screen


class Marching(ABC):
    """A screen-space method with a number of directions, steps in each, and parameters."""

    family = "screen-space"
    name: str

    def __init__(self, settings: dict[str, Any]) -> None:
        self.settings = settings
        self._screen: Screen | None = None

    def prepare(self, view: View) -> None:
        """Put the view on the device. Raises DeepshadeError without a libLLVM."""
        from deepshade_report.baselines.ao import compiled

        self._screen = compiled.open_screen(view)

    def shade(self, view: View) -> Float:
        """(H, W) of the prepared view."""
        if self._screen is None:
            self.prepare(view)
        assert self._screen is not None
        return self.march(self._screen)

    @abstractmethod
    def march(self, screen: Screen) -> Float:
        """(H, W) ambient occlusion in [0, 1], 1 = open."""
