"""The search for networks that are fast and accurate: asynchronous successive halving.

Networks are drawn at random or changed from the best so far, trained a little, and timed on the
fastest engine here. Those that no other one beats at its speed are trained `GROWTH` times longer,
and so on: Li et al., *A System for Massively Parallel Hyperparameter Tuning* (MLSys 2020), with a
frontier of speed against error in place of a single score. The log is all the state there is.
"""

from __future__ import annotations

import dataclasses
import json
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from deepshade.bundles import MODEL, WEIGHTS, Bundle, write_config
from deepshade.effects import EFFECTS
from deepshade.engines import Backend, EngineError, available, load_engine
from deepshade.errors import ConfigError, DataError
from deepshade_trainer.export import INPUT, OUTPUT, write_onnx
from deepshade_trainer.networks import NetworkConfig, build
from deepshade_trainer.recipe import Recipe
from deepshade_trainer.run import Run
from deepshade_trainer.training import Progress, train

GROWTH = 3  # each rung of the ladder trains this many times as long as the one below
ENOUGH = 4  # trials on a rung before its best climb
MOST_RUNGS = 4
PICTURE = 512, 768
ROUNDS = 15
# Halves of the proposals are wholly new; the others change a good one.
NEW = 0.4

# What a network may be made of. Levels, widths and convolutions are drawn apart: see `_drawn`.
_FOLDS = (2, 4, 4, 4, 8)
_STEPS = ((2,), (4,), (2, 2), (4, 2), (2, 4), (4, 4), (2, 2, 2), (4, 2, 2), (2, 2, 2, 2))
_FIRST_WIDTHS = (16, 24, 32, 48, 64, 96)
_WIDTH_GROWTHS = (1.0, 1.25, 1.5, 2.0)
_MOST_WIDTH = 256
_RINGS = ((1, 2), (1, 1, 2, 2), (1, 2, 4, 8), (1, 2, 5, 12), (1, 1, 2, 2, 4, 4))
_DETAILS = ((), (), (1,), (1, 1))


@dataclass(frozen=True)
class Trial:
    """One network trained to one rung: milliseconds at 768 x 512, DSSIM on held-out samples."""

    network: NetworkConfig
    rung: int
    steps: int
    dssim: float
    ratio: float
    ms: float
    backend: str
    parameters: int
    halo: int
    seconds: float

    @property
    def label(self) -> str:
        """The network in one word."""
        return label(self.network)


def search(
    recipe: Recipe,
    folders: Sequence[Path],
    out: Path,
    *,
    minutes: float,
    steps: int = 400,
    most_ms: float = 25.0,
    threads: int = 2,
    device: str = "cpu",
    report: Callable[[NetworkConfig, int, Progress], None] | None = None,
) -> Iterator[Trial]:
    """Yield trials until `minutes` are over; a trial begun by then is finished.

    `out` holds `trials.jsonl` and each network's run; the same command goes on where it stood.
    Networks slower than `most_ms` aren't trained. `report` hears of every training step.

    Raises:
        DataError: the data can't be trained on, or the log is damaged.
    """
    out.mkdir(parents=True, exist_ok=True)
    end = time.monotonic() + 60 * minutes
    tried = read_trials(out / "trials.jsonl")
    refused: set[NetworkConfig] = set()
    rng = np.random.default_rng([recipe.seed, len(tried)])
    while time.monotonic() < end:
        network, rung = _next(tried, recipe.network, rng, refused)
        known = [trial for trial in tried if trial.network == network]
        if known:
            ms, backend = known[0].ms, known[0].backend
        else:
            ms, backend = milliseconds(network, recipe.effect, threads=threads)
            if ms > most_ms:
                refused.add(network)
                continue
        begun = time.monotonic()
        aim = dataclasses.replace(recipe, network=network, steps=steps * GROWTH**rung)
        figures = None
        for progress in train(aim, folders, Run(out / label(network)), device=device):
            figures = progress.figures or figures
            if report:
                report(network, rung, progress)
        if progress.step < aim.steps:
            return  # interrupted; the run is kept and goes on next time
        if figures is None:
            raise DataError("nothing to validate on", fix="search with more data")
        model = build(network)
        trial = Trial(
            network,
            rung,
            aim.steps,
            figures["dssim"],
            figures["ratio"],
            ms,
            backend,
            sum(p.numel() for p in model.parameters()),
            model.halo,
            time.monotonic() - begun,
        )
        with (out / "trials.jsonl").open("a") as log:
            log.write(json.dumps(asdict(trial)) + "\n")
        tried.append(trial)
        yield trial


def read_trials(path: Path) -> list[Trial]:
    """The trials of a log, none where there is no such file; raises DataError for a damaged one."""
    if not path.exists():
        return []
    try:
        return [_parse(line) for line in path.read_text().splitlines() if line]
    except (ValueError, TypeError, KeyError) as error:
        raise DataError(f"{path} is damaged: {error}", fix="mend the line, or remove it") from error


def frontier(trials: Sequence[Trial]) -> list[Trial]:
    """The trials that no other one beats in both speed and error, fastest first."""
    best: list[Trial] = []
    for trial in sorted(trials, key=lambda t: (t.ms, t.dssim)):
        if not best or trial.dssim < best[-1].dssim:
            best.append(trial)
    return best


def milliseconds(
    network: NetworkConfig, effect: str, *, threads: int, size: tuple[int, int] = PICTURE
) -> tuple[float, str]:
    """Median time of a picture on the fastest of this machine's fp32 and bf16, and which it is."""
    row = EFFECTS[effect]
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / effect / "trial"
        folder.mkdir(parents=True)
        model = build(network, row.background).eval()
        write_onnx(model, folder / MODEL)
        (folder / WEIGHTS).write_bytes(b"")
        bundle = write_config(
            folder,
            effect=effect,
            name="trial",
            inputs=row.inputs,
            outputs=row.outputs,
            radius=1.0,
            fov=50.0,
            size_multiple=model.size_multiple,
            halo=model.halo,
            input_name=INPUT,
            output_name=OUTPUT,
        )
        height, width = (-(-side // model.size_multiple) * model.size_multiple for side in size)
        gbuffer = np.random.default_rng(0).normal(size=(1, network.inputs, height, width))
        times = {
            backend: _timed(bundle, backend, gbuffer.astype(np.float32), threads)
            for backend in available()
            if backend.precision in ("fp32", "bf16")
        }
    if not times:
        raise EngineError("no engine is installed", fix="pip install onnxruntime or openvino")
    fastest = min(times, key=lambda backend: times[backend])
    return times[fastest], str(fastest)


def _timed(bundle: Bundle, backend: Backend, gbuffer: Any, threads: int) -> float:
    engine = load_engine(bundle, backend, threads=threads)
    engine.prepare(*gbuffer.shape[2:])
    engine.predict(gbuffer)
    found = []
    for _ in range(ROUNDS):
        begun = time.perf_counter()
        engine.predict(gbuffer)
        found.append(1e3 * (time.perf_counter() - begun))
    return statistics.median(found)


def _next(
    tried: Sequence[Trial],
    like: NetworkConfig,
    rng: np.random.Generator,
    refused: set[NetworkConfig],
) -> tuple[NetworkConfig, int]:
    """What to train next, and to which rung: a climber if there is one, else something new."""
    for rung in reversed(range(MOST_RUNGS - 1)):
        here = [trial for trial in tried if trial.rung == rung]
        above = [trial.network for trial in tried if trial.rung == rung + 1]
        if len(here) >= ENOUGH * (1 + len(above)) // 2:
            for trial in frontier(here):
                if trial.network not in above:
                    return trial.network, rung + 1
    known = {trial.network for trial in tried} | refused
    good = [trial.network for trial in frontier(tried)]
    while True:
        old = good[rng.integers(len(good))] if good and rng.random() > NEW else None
        network = _drawn(like, rng) if old is None else _changed(old, rng)
        if network not in known and _sound(network):
            return network, 0


def _drawn(like: NetworkConfig, rng: np.random.Generator) -> NetworkConfig:
    steps = _STEPS[rng.integers(len(_STEPS))]
    growth = float(rng.choice(_WIDTH_GROWTHS))
    width = float(rng.choice(_FIRST_WIDTHS))
    levels = range(len(steps) + 1)
    return dataclasses.replace(
        like,
        kind="fold",
        fold=int(rng.choice(_FOLDS)),
        steps=steps,
        widths=tuple(min(_MOST_WIDTH, 8 * round(width * growth**n / 8)) for n in levels),
        down=tuple(int(rng.integers(0 if n == 0 else 1, 4)) for n in levels),
        up=tuple(int(rng.integers(0, 4)) for _ in steps),
        rings=_RINGS[rng.integers(len(_RINGS))],
        fine_rings=_RINGS[rng.integers(len(_RINGS))],
        detail=_DETAILS[rng.integers(len(_DETAILS))],
    )


def _changed(old: NetworkConfig, rng: np.random.Generator) -> NetworkConfig:
    """`old` with one or two of a drawn network's properties, where they fit."""
    other = _drawn(old, rng)
    level = int(rng.integers(len(old.widths)))
    widths, down, up = list(old.widths), list(old.down), list(old.up)
    widths[level] = max(8, min(_MOST_WIDTH, 8 * round(widths[level] * rng.choice([0.7, 1.4]) / 8)))
    down[level] = max(0, down[level] + int(rng.choice([-1, 1])))
    up[level % len(up)] = max(0, up[level % len(up)] + int(rng.choice([-1, 1])))
    options: list[dict[str, Any]] = [
        {"widths": tuple(widths)},
        {"down": tuple(down)},
        {"up": tuple(up)},
        {"fold": other.fold},
        {"rings": other.rings, "fine_rings": other.fine_rings},
        {"detail": other.detail},
    ]
    if len(other.steps) == len(old.steps):
        options.append({"steps": other.steps})
    for k in rng.permutation(len(options))[: rng.integers(1, 3)]:
        old = dataclasses.replace(old, **options[k])
    return old


def _sound(network: NetworkConfig) -> bool:
    try:
        return build(network).size_multiple <= 128
    except ConfigError:
        return False


def _parse(line: str) -> Trial:
    entry = json.loads(line)
    network: dict[str, Any] = {
        k: tuple(v) if isinstance(v, list) else v for k, v in entry["network"].items()
    }
    return Trial(**{**entry, "network": NetworkConfig(**network)})


def label(network: NetworkConfig) -> str:
    """A network in one word, which may name a file."""
    n = network
    lists = {
        "w": n.widths,
        "s": n.steps,
        "d": n.down,
        "u": n.up,
        "r": n.rings,
        "n": n.fine_rings,
        "q": n.detail,
    }
    return f"f{n.fold}" + "".join(k + "-".join(map(str, v)) for k, v in lists.items())
