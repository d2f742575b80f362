"""The manifest of a data set: which shards are complete, and what made them.

A data set is a folder of `shard-00000.safetensors` files and a `manifest.json`, which is replaced
as a whole after each shard. Readers trust only the manifest: a shard that it doesn't name is
unfinished.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from deepshade.errors import DataError
from deepshade.files import replacing

FORMAT = "deepshade-shards"
VERSION = 1
NAME = "manifest.json"
MAX_BYTES = 256 * 2**20


@dataclass(frozen=True)
class Shard:
    """One complete shard: file name in the folder, its sha256, and a record for each sample.

    A record holds what renders the sample again: `scene`, `seed`, the settings that are set
    (`radius`, `focus`, ...), `camera` (field of view, frame, window origin, worldToCamera), and
    `displacements` where objects move. A sample with a `turn` is that view turned by that symmetry
    (`deepshade.symmetry`). Under an environment also `environment` (its name), `rotate`
    and `environment_sha256`: `deepshade.environments.stored` reads it.
    """

    file: str
    sha256: str
    samples: list[dict[str, Any]]


@dataclass(frozen=True)
class Manifest:
    """The settings that a data set was made with, its tensors, and its complete shards.

    `schema` maps a tensor's name to {"dtype": ..., "shape": [channels, height, width]}.
    """

    settings: dict[str, Any]
    schema: dict[str, dict[str, Any]]
    shards: list[Shard] = field(default_factory=list)

    @property
    def count(self) -> int:
        """Samples in all complete shards."""
        return sum(len(shard.samples) for shard in self.shards)

    def with_shard(self, shard: Shard) -> Manifest:
        """The manifest with `shard` added or replaced, in order of file names."""
        others = [other for other in self.shards if other.file != shard.file]
        ordered = sorted([*others, shard], key=lambda item: item.file)
        return Manifest(self.settings, self.schema, ordered)

    def write(self, folder: Path) -> None:
        """Replace `folder`/manifest.json atomically."""
        document = {"format": FORMAT, "version": VERSION, **asdict(self)}
        with replacing(folder / NAME) as temporary:
            temporary.write_text(json.dumps(document, indent=1))

    @classmethod
    def read(cls, folder: Path) -> Manifest:
        """Read `folder`/manifest.json.

        Raises:
            DataError: there is none, or it isn't a manifest that this version reads.
        """
        path = folder / NAME
        try:
            if path.stat().st_size > MAX_BYTES:
                raise DataError(f"{path} is over {MAX_BYTES} bytes")
            document = json.loads(path.read_bytes())
        except FileNotFoundError:
            raise DataError(
                f"{folder} holds no {NAME}", fix="make a data set first: deepshade datagen --help"
            ) from None
        except ValueError as error:
            raise DataError(f"{path} is not JSON: {error}") from error
        if not isinstance(document, dict) or document.get("format") != FORMAT:
            raise DataError(f"{path} is no deepshade manifest")
        if document.get("version") != VERSION:
            raise DataError(f"{path} has version {document.get('version')}, not {VERSION}")
        try:
            shards = [Shard(**shard) for shard in document["shards"]]
            return cls(dict(document["settings"]), dict(document["schema"]), shards)
        except (KeyError, TypeError) as error:
            raise DataError(f"{path} lacks or has an unknown field: {error}") from error


def shard_path(folder: Path, shard: Shard) -> Path:
    """Where `shard` lies; a name that leaves the folder raises DataError."""
    if Path(shard.file).name != shard.file:
        raise DataError(f"the manifest names {shard.file!r}, which is not in its folder")
    return folder / shard.file
