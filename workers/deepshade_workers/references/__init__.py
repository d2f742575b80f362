"""Monte Carlo references: a file for each effect, `<effect>.py`, that defines

    reference(scene, view, hits, images, *, samples, seed) -> (value, standard error)

`scene` (`scenes.scene.Scene`) is what rays are traced in, `view` (`view.View`) the camera and
settings, `hits` (`trace.Hits`) what each pixel's centre sees, and `images` the attributes that
were made of them, at least the effect's inputs. `samples` are per pixel; the same `seed` gives the
same noise. Both results are planar (C, H, W) float32 with the effect's outputs as channels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from importlib import import_module
from pkgutil import iter_modules

from deepshade.errors import ConfigError
from deepshade_workers.view import Image

Reference = Callable[..., tuple[Image, Image]]


def known() -> tuple[str, ...]:
    """The effects that have a reference, in order of their names."""
    return tuple(sorted(module.name for module in iter_modules(__path__)))


def require(effects: Iterable[str]) -> None:
    """Raise ConfigError where one of `effects` has no reference."""
    there = known()
    for effect in effects:
        if effect not in there:
            raise ConfigError(
                effect, there, detail=f"no reference for {effect!r}; there are: {', '.join(there)}"
            )


def reference_of(effect: str) -> Reference:
    """The function that renders the reference of `effect`; ConfigError if there is none."""
    require([effect])
    function: Reference = import_module(f"{__name__}.{effect}").reference
    return function
