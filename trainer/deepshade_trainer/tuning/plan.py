"""All that the result of a fine-tuning job depends on, and the key that follows from it."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import deepshade
import deepshade_trainer
from deepshade.bundles import Bundle
from deepshade.errors import ConfigError
from deepshade.files import replacing
from deepshade.manifest import Manifest

FILE = "plan.json"


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What to tune, to what, how long, and what has to hold for it to be published.

    `base` is the bundle to begin with and `name` what the result is published as; `data` are the
    folders of views to tune to, `rehearsal` those of older data from which a `share` of every batch
    comes, so that it isn't forgotten, and `test` those that must not get worse by more than the
    share `worse`. `minutes` of training become a number of steps on the machine that begins the
    job, unless `steps` says it. The network may take `slower` times as long as the base's. With
    `processes` above 1 so many train together on Ray. `lr` and `batch` 0 are the defaults.
    """

    effect: str
    base: str
    name: str
    data: tuple[str, ...]
    rehearsal: tuple[str, ...] = ()
    test: tuple[str, ...] = ()
    minutes: float = 10.0
    steps: int = 0
    seed: int = 0
    lr: float = 0.0
    batch: int = 0
    share: float = 0.5
    worse: float = 0.03
    slower: float = 1.1
    threads: int = 1
    processes: int = 1

    def __post_init__(self) -> None:
        """Raise ConfigError for a value that no job could mean."""
        for key, (low, high) in RANGES.items():
            value = getattr(self, key)
            if not (math.isfinite(value) and low <= value <= high):
                raise ConfigError(
                    key, detail=f"{key} must be from {low:g} to {high:g}, not {value:g}"
                )

    def key(self, data: str = "") -> str:
        """A hash of what decides the result: contents, settings and code, but no folders' names.

        `data` stands for the contents of views that are still to be rendered.
        """
        facts: dict[str, Any] = asdict(self)
        facts["base"] = Bundle.load(Path(self.base)).sha256
        for name in ("data", "rehearsal", "test"):
            folders = () if name == "data" and data else getattr(self, name)
            facts[name] = sorted(digest(Path(folder)) for folder in folders)
        facts["data"] = data or facts["data"]
        facts["code"] = code()
        return sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()

    def write(self, folder: Path) -> None:
        """Save it in a job's folder."""
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(folder / FILE) as temporary:
            temporary.write_text(json.dumps(asdict(self), indent=1))

    @classmethod
    def read(cls, folder: Path) -> Plan:
        """What `write` saved."""
        found = json.loads((folder / FILE).read_text())
        lists = {name: tuple(found[name]) for name in ("data", "rehearsal", "test")}
        return cls(**{**found, **lists})


# What a person may ask for: a service is no place for a week's training.
RANGES: dict[str, tuple[float, float]] = {
    "minutes": (0.01, 24 * 60),
    "steps": (0, 1_000_000),
    "seed": (0, 2**31),
    "lr": (0, 0.1),
    "batch": (0, 256),
    "share": (0, 0.95),
    "worse": (0, 1),
    "slower": (0.1, 100),
    "threads": (1, 1024),
    "processes": (1, 64),
}


def digest(folder: Path) -> str:
    """A hash of a data set: of its shards' hashes, which are verified when they are read."""
    manifest = Manifest.read(folder)
    names = sorted((shard.sha256, len(shard.samples)) for shard in manifest.shards)
    return sha256(json.dumps([manifest.schema, names], sort_keys=True).encode()).hexdigest()


@cache
def code() -> str:
    """A hash of the code that trains and decides."""
    whole = sha256()
    for package in (deepshade, deepshade_trainer):
        root = Path(str(package.__file__)).parent
        for path in sorted(root.rglob("*.py")):
            whole.update(f"{path.relative_to(root)}\0".encode() + path.read_bytes())
    return whole.hexdigest()
