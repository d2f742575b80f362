"""Views of a scene that a job renders first: what is to be rendered, and by which command."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from deepshade.errors import DataError
from deepshade.files import replacing
from deepshade.files import sha256 as sha256_of
from deepshade.manifest import NAME, Manifest

FILE = "rendering.json"


@dataclass(frozen=True, kw_only=True)
class Rendering:
    """Views of `scene` for `effect` into the folder `out`, as `deepshade datagen` makes them.

    `files` are what `scene` names on this machine. `address` is a running Ray cluster's.
    """

    scene: str
    effect: str
    views: int
    size: int
    spp: int
    seed: int
    out: str
    files: tuple[str, ...] = ()
    address: str = ""

    @property
    def key(self) -> str:
        """A hash of what decides the views; of what lies beside a file, names, sizes and times."""
        facts: dict[str, Any] = asdict(self)
        del facts["out"], facts["address"]
        facts["files"] = [_contents(Path(name)) for name in self.files]
        if self.files:
            del facts["scene"]
        return sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()

    @property
    def count(self) -> int:
        """Views that are complete."""
        folder = Path(self.out)
        return Manifest.read(folder).count if (folder / NAME).exists() else 0

    def command(self) -> list[str]:
        """The command that renders what is missing."""
        options = {"out": self.out, "scenes": self.scene, "views": self.views, "size": self.size}
        options |= {"spp": self.spp, "seed": self.seed, "effects": self.effect}
        if self.address:
            options["address"] = self.address
        words = [word for key, value in options.items() for word in (f"--{key}", str(value))]
        return [sys.executable, "-m", "deepshade.cli", "datagen", *words, "--json"]

    def write(self, folder: Path) -> None:
        """Save it in a job's folder."""
        with replacing(folder / FILE) as temporary:
            temporary.write_text(json.dumps(asdict(self), indent=1))

    @classmethod
    def read(cls, folder: Path) -> Rendering | None:
        """What `write` saved; None for a job that renders nothing."""
        if not (folder / FILE).exists():
            return None
        found = json.loads((folder / FILE).read_text())
        return cls(**{**found, "files": tuple(found["files"])})


def _contents(path: Path) -> Any:
    try:
        beside = sorted(p for p in path.parent.rglob("*") if p.is_file())[:10000]
        known = [
            (str(p.relative_to(path.parent)), p.stat().st_size, p.stat().st_mtime_ns)
            for p in beside
        ]
        return [sha256_of(path), known]
    except OSError as error:
        raise DataError(f"can't read {path}: {error.strerror}") from error
