"""What is compared: the interface of all methods, and a bundle's network on an engine."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any, Protocol

import numpy as np

from deepshade import tensors
from deepshade.bundles import Bundle
from deepshade.camera import camera_to_world
from deepshade.engines import Engine, choose, load_engine, usable
from deepshade.errors import DeepshadeError
from deepshade_report.view import Float, View, require
from deepshade_trainer.evaluation import prepared

PAPER = "paper"  # the name of the bundle that is a baseline
# families
NETWORK, PAPER_NETWORK, SCREEN_SPACE = "network", "paper's network", "screen-space"
LIMIT = "limit"  # no shader for real time: about the least error that one layer allows


class Method(Protocol):
    """A way to compute an effect from a view.

    `family` groups methods in plots; `settings` are what tells this one from others of its name.
    `prepare` does what isn't part of shading a frame (load, compile, open the scene) and keeps
    the view; `shade` computes the prepared view, and is what gets timed.
    """

    name: str
    family: str
    settings: dict[str, Any]

    def prepare(self, view: View) -> None:
        """Make ready to shade `view`. Raises DeepshadeError where that can't be."""

    def shade(self, view: View) -> Float:
        """(C, H, W), or (H, W) for one channel, of `view`, which was prepared last."""
        ...


class Network:
    """A bundle's bare network on one engine, as a Method: input ready, nothing skipped."""

    def __init__(self, bundle: Bundle, engine: Engine, *, is_paper: bool = False) -> None:
        self.bundle, self.engine = bundle, engine
        self.name = PAPER if is_paper else bundle.name
        self.family = PAPER_NETWORK if is_paper else NETWORK
        backend = engine.backend
        self.settings = {"engine": backend.engine, "precision": backend.precision}
        self._ready: Float = np.empty((1, 0, 0, 0), np.float32)
        self._given: dict[str, Float] = {}

    def prepare(self, view: View) -> None:
        """Make the network's input. Raises DeepshadeError for what the view lacks of it."""
        if missing := [name for name in self.bundle.inputs if name not in view.attributes]:
            raise DeepshadeError(
                f"bundle {self.bundle.name} needs {', '.join(missing)}, which the views lack",
                fix="render the data set again, with these attributes",
            )
        self._ready = tensors.tensor(
            view.effect,
            view.attributes,
            self.bundle.inputs,
            view.radius,
            per_channel=self.bundle.per_channel,
            multiple=self.bundle.size_multiple,
        )
        if self.bundle.environment:
            lit = require(view)
            tables = prepared(lit.environment)
            camera = partial(camera_to_world, view.attributes)
            self._given = tables.inputs(self.bundle.environment, lit.degrees, lit.up, camera)
        self.engine.prepare(*self._ready.shape[2:])

    def shade(self, view: View) -> Float:
        """(C, H, W) of the prepared view."""
        # (N, C, h, w), N runs for colour channels
        answer = self.engine.predict(self._ready, self._given)
        return answer.reshape(-1, *answer.shape[2:])[:, : view.height, : view.width]


def networks(served: list[Bundle], paper: Bundle | None, threads: int) -> Iterator[Network]:
    """Every bundle on every backend that this machine has, first on that which the rule chooses.

    What can't be loaded is left out.
    """
    for bundle in [*served, *([paper] if paper else [])]:
        for backend in dict.fromkeys((choose(bundle), *usable(bundle))):
            try:
                engine = load_engine(bundle, backend, threads=threads)
                engine.warm()
            except DeepshadeError:
                continue
            yield Network(bundle, engine, is_paper=bundle is paper)


def identity(method: Method) -> str:
    """One line that tells the method and its settings from all others."""
    settings = method.settings
    if isinstance(method, Network):
        return f"{method.name} {settings['engine']}/{settings['precision']}"
    return " ".join([method.name, *(f"{key}={value}" for key, value in settings.items())])
