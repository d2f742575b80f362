"""What is compared: bundles on engines, the paper's network, and the interface of baselines."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from deepshade import tensors
from deepshade.bundles import Bundle, bundle_folders
from deepshade.engines import Engine, available, load_engine
from deepshade.errors import DeepshadeError
from deepshade_report.view import Float, View

QUALITIES = ("fast", "balanced", "best")
PAPER = "paper"
NETWORK, PAPER_NETWORK = "network", "paper's network"


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


@dataclass
class Network:
    """A bundle's bare network on one engine, as a Method: input ready, nothing skipped."""

    bundle: Bundle
    engine: Engine
    name: str
    family: str = NETWORK
    settings: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        backend = self.engine.backend
        self.settings = {"engine": backend.engine, "precision": backend.precision}
        self._ready: Float = np.empty((1, 0, 0, 0), np.float32)

    def prepare(self, view: View) -> None:
        """Make the network's input. Raises DeepshadeError for an attribute that the view lacks."""
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
        self.engine.prepare(*self._ready.shape[2:])

    def shade(self, view: View) -> Float:
        """(C, H, W) of the prepared view."""
        answer = self.engine.predict(self._ready)  # (N, C, h, w), N runs for colour channels
        return answer.reshape(-1, *answer.shape[2:])[:, : view.height, : view.width]


def bundles(models: Path, effect: str) -> list[Bundle]:
    """The served bundles of an effect, the shipped qualities first, from fast to best.

    Raises BundleError for a damaged one. One called `paper` is the baseline, not served.
    """
    folders = [path for path in bundle_folders(models) if path.parent.name == effect]
    found = [Bundle.load(path) for path in folders if path.name != PAPER]
    rank = {name: index for index, name in enumerate(QUALITIES)}
    return sorted(found, key=lambda bundle: (rank.get(bundle.name, len(rank)), bundle.name))


def paper_bundle(paper: Path | None, models: Path, effect: str) -> Bundle | None:
    """The paper's network: the folder that was named, else models/<effect>/paper, else None.

    Raises BundleError when the named folder holds none.
    """
    folder = paper or models / effect / PAPER
    return Bundle.load(folder) if paper or folder.is_dir() else None


def networks(served: list[Bundle], paper: Bundle | None, threads: int) -> Iterator[Network]:
    """Every bundle on every backend that this machine has; what can't be loaded is left out."""
    for bundle in [*served, *([paper] if paper else [])]:
        name, family = (PAPER, PAPER_NETWORK) if bundle is paper else (bundle.name, NETWORK)
        for backend in available():
            try:
                engine = load_engine(bundle, backend, threads=threads)
                engine.warm()
            except DeepshadeError:
                continue
            yield Network(bundle, engine, name, family)


def identity(method: Method) -> str:
    """One line that tells the method and its settings from all others."""
    settings = method.settings
    if {"engine", "precision"} <= set(settings):
        return f"{method.name} {settings['engine']}/{settings['precision']}"
    return " ".join([method.name, *(f"{key}={value}" for key, value in settings.items())])
