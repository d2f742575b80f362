"""What a report compares: every bundle on every backend, the paper's network, and the rivals."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.attributes import ATTRIBUTES
from deepshade.bundles import Bundle, bundle_folders
from deepshade.engines import Backend, Engine, load_engine
from deepshade.engines.registry import usable
from deepshade.errors import DeepshadeError
from deepshade_report.method import Method, View

Float = NDArray[np.float32]

QUALITIES = ("fast", "balanced", "best")
PAPER = "paper"
REFERENCE = Backend("onnxruntime", "fp32")
NETWORK, PAPER_NETWORK = "network", "paper's network"


@dataclass
class Network:
    """A bundle's bare network on one backend, as a Method: input ready, nothing skipped.

    `family` tells the bundles that are served from the paper's network.
    """

    bundle: Bundle
    engine: Engine
    name: str
    family: str = NETWORK
    settings: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        backend = self.engine.backend
        self.settings = {"engine": backend.engine, "precision": backend.precision}
        self._ready: Float = np.empty((1, 0, 0, 0), np.float32)
        self._shape = (0, 0)

    def prepare(self, view: View) -> None:
        """Stack the inputs in network order, positions divided by the radius, sides padded."""
        self._shape = (view.background.shape[0], view.background.shape[1])
        self._ready = stacked(self.bundle, view)
        self.engine.prepare(*self._ready.shape[2:])

    def shade(self, view: View) -> Float:
        """(H, W) of the prepared view."""
        height, width = self._shape
        shade: Float = self.engine.predict(self._ready)[0, 0, :height, :width]
        return shade


def stacked(bundle: Bundle, view: View) -> Float:
    """(1, C, h, w) as the bundle's network wants the view: zero where there is background.

    Raises DeepshadeError for an attribute that held-out views don't have.
    """
    planes: list[Float] = []
    for name in bundle.inputs:
        image = getattr(view, name, None)
        if image is None:
            raise DeepshadeError(f"bundle {bundle.name} needs '{name}', which the views lack")
        scaled = ATTRIBUTES[name].kind == "point" and bundle.position_scale == "1/radius"
        planes += list(image / np.float32(view.radius) if scaled else image)
    height, width = view.background.shape
    step = bundle.size_multiple
    gbuffer = np.zeros((1, len(planes), -(-height // step) * step, -(-width // step) * step))
    gbuffer = gbuffer.astype(np.float32)
    gbuffer[0, :, :height, :width] = np.where(view.background, np.float32(0), np.stack(planes))
    return gbuffer


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
    if paper is None:
        folder = models / effect / PAPER
        return Bundle.load(folder) if folder.is_dir() else None
    return Bundle.load(paper)


def identity(method: Method) -> str:
    """One line that tells the method and its settings from all others."""
    settings = method.settings
    if {"engine", "precision"} <= set(settings):
        return f"{method.name} {settings['engine']}/{settings['precision']}"
    return " ".join([method.name, *(f"{key}={value}" for key, value in settings.items())])


def networks(served: list[Bundle], paper: Bundle | None, threads: int) -> Iterator[Network]:
    """Every bundle on every backend that this machine has; what can't be loaded is left out."""
    for bundle in [*served, *([paper] if paper else [])]:
        is_paper = bundle is paper
        for backend in usable(bundle):
            try:
                engine = load_engine(bundle, backend, threads=threads)
                engine.warm()
            except DeepshadeError:
                continue
            name, family = (PAPER, PAPER_NETWORK) if is_paper else (bundle.name, NETWORK)
            yield Network(bundle, engine, name, family)
