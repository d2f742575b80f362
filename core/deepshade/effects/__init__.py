"""The effects: one file each. Adding an effect is adding a file that holds its row, `EFFECT`."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules

from deepshade.effects.effect import Effect
from deepshade.effects.settings import SETTINGS, Setting

__all__ = ["EFFECTS", "SETTINGS", "Effect", "Setting"]

_NAMES = sorted({module.name for module in iter_modules(__path__)} - {"effect", "settings"})
EFFECTS: dict[str, Effect] = {name: import_module(f"{__name__}.{name}").EFFECT for name in _NAMES}
