"""The trainer service's settings, in one place."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from deepshade.bundles import bundle_roots
from deepshade.effects import EFFECTS
from deepshade.errors import ConfigError
from deepshade.machine import cpu_count
from deepshade.manifest import NAME

REHEARSAL, TEST = "rehearsal", "test"


@dataclass(frozen=True)
class Settings:
    """Everything an operator can set.

    `folder` holds jobs, uploads and rendered views; `published` is the folder of models that
    versions go to, and `bases` are where bundles to begin with are looked for after it. `data` are
    the roots that data and scenes must lie in. `library` has <effect>/rehearsal and <effect>/test:
    older views not to forget, and views that mustn't get worse. `services` are told of changes.
    `upload_bytes` bounds all uploads together, `queue` the jobs that wait.
    """

    folder: Path
    published: Path
    bases: tuple[Path, ...] = field(default_factory=bundle_roots)
    data: tuple[Path, ...] = ()
    library: Path | None = None
    database: str = ""
    services: tuple[str, ...] = ()
    token: str | None = field(default=None, repr=False)
    at_a_time: int = 1
    threads: int = field(default_factory=cpu_count)
    queue: int = 100
    upload_bytes: int = 20 * 2**30
    ray_address: str = ""

    def __post_init__(self) -> None:
        for root in self.data:
            if not root.is_dir():
                raise ConfigError("data", detail=f"there is no folder {root} (--data)")
        if self.library is not None and not self.library.is_dir():
            raise ConfigError("library", detail=f"there is no folder {self.library} (--library)")
        if self.at_a_time < 1 or self.threads < 1:
            raise ConfigError("at_a_time", detail="at least one job at a time, of one thread")
        for service in self.services:
            if not service.startswith(("http://", "https://")):
                raise ConfigError(
                    "service", detail=f"{service!r} is no address like http://host:8000"
                )
        for each in (self.folder, self.published):
            each.mkdir(parents=True, exist_ok=True)

    @property
    def url(self) -> str:
        """The database's, SQLite in `folder` by default."""
        return self.database or f"sqlite:///{(self.folder / 'jobs.db').resolve()}"

    @property
    def roots(self) -> tuple[Path, ...]:
        """Where bundles are: what was published counts before what it began with."""
        return tuple(dict.fromkeys((self.published, *self.bases)))

    def stored(self, effect: str, kind: str) -> tuple[str, ...]:
        """The library's data sets of that kind for an effect."""
        if self.library is None or effect not in EFFECTS:
            return ()
        folder = self.library / effect / kind
        return (str(folder.resolve()),) if (folder / NAME).exists() else ()
