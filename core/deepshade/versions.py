"""Published bundles: numbered versions that never change, and an alias that moves by one rename.

    models/<effect>/<name>                     the alias: a link to one of
    models/<effect>/versions/<name>/<number>/  a bundle, and version.json with all its files' hashes
    models/<effect>/versions/<name>/pinned     the number that the alias is to stay at, if it is

What reads bundles as <effect>/<name>/ sees the alias alone. Whoever moves it tells the services.
"""

from __future__ import annotations

import hashlib
import json
import secrets
import shutil
from dataclasses import dataclass
from pathlib import Path

from deepshade.bundles import CONFIG, Bundle, check_name
from deepshade.effects import EFFECTS
from deepshade.errors import BundleError, ConfigError
from deepshade.files import replacing, sha256, sync_folder

FOLDER = "versions"
RECORD = "version.json"
PINNED = "pinned"

_MAX_FILES, _MAX_RECORD = 64, 1 << 20


@dataclass(frozen=True, slots=True)
class Version:
    """One published version. `files` maps its files' names to sha256, `sha256` is of them all."""

    path: Path
    number: int
    files: dict[str, str]

    @property
    def sha256(self) -> str:
        """The hash of names and contents: two versions with the same are the same."""
        lines = "".join(f"{digest}  {name}\n" for name, digest in sorted(self.files.items()))
        return hashlib.sha256(lines.encode()).hexdigest()

    def verify(self) -> None:
        """Raises BundleError where a file isn't the one that was published, or one is too many."""
        for name in sorted(self.files.keys() | _names(self.path)):
            if self.files.get(name) != _hash(self.path / name):
                raise BundleError(
                    f"{self.path / name} is not the file that {RECORD} describes",
                    fix="versions never change: get it again, or roll back to another",
                )


class Alias:
    """The name under which a root's versions of a bundle are used. Raises ConfigError for a bad
    effect or name."""

    def __init__(self, root: Path, effect: str, name: str) -> None:
        if effect not in EFFECTS:
            raise ConfigError(effect, EFFECTS, detail=f"no effect is called {effect[:100]!r}")
        check_name(name)
        if name == FOLDER:
            raise ConfigError("name", detail=f"no bundle can be called {name!r}")
        self.effect, self.name = effect, name
        self.link = root / effect / name
        self.folder = root / effect / FOLDER / name

    @property
    def current(self) -> int | None:
        """The version that the alias leads to; None where there is none of ours."""
        if not self.link.is_symlink():
            return None
        target = self.link.readlink()
        ours = self.link.parent / target.parent == self.folder
        return int(target.name) if ours and target.name.isdecimal() else None

    @property
    def pinned(self) -> int | None:
        """The version that it stays at, whatever is published."""
        try:
            text = (self.folder / PINNED).read_text().strip()
        except FileNotFoundError:
            return None
        return int(text) if text.isdecimal() else None

    def numbers(self) -> list[int]:
        """All versions, the first first."""
        if not self.folder.is_dir():
            return []
        return sorted(int(p.name) for p in self.folder.iterdir() if p.name.isdecimal())

    def version(self, number: int) -> Version:
        """That version, unverified. Raises BundleError where there is none or its record is bad."""
        path = self.folder / str(number)
        if number not in self.numbers():
            have = ", ".join(map(str, self.numbers())) or "none"
            raise BundleError(
                f"{self.effect}/{self.name} has no version {number}", fix=f"there are: {have}"
            )
        return read_version(path)

    def publish(self, bundle: Path) -> Version:
        """A copy of the bundle in a folder as the next version; one of the same content is kept.

        The alias stays where it is. Raises BundleError where the folder is no sound bundle.
        """
        Bundle.load(bundle)
        files = {name: _hash(bundle / name) for name in _names(bundle)}
        new = Version(bundle, 0, files).sha256
        for number in self.numbers():
            if (known := self.version(number)).sha256 == new:
                return known
        self.folder.mkdir(parents=True, exist_ok=True)
        scratch = self.folder / f".{secrets.token_hex(4)}.tmp"
        try:
            scratch.mkdir()
            for name in files:
                with replacing(scratch / name) as temporary:
                    shutil.copyfile(bundle / name, temporary)
                (scratch / name).chmod(0o444)  # not before: who isn't root may not sync it then
            while True:
                number = max(self.numbers(), default=0) + 1
                record = {"effect": self.effect, "name": self.name, "number": number}
                with replacing(scratch / RECORD) as temporary:
                    temporary.write_text(json.dumps({**record, "sha256": new, "files": files}))
                try:
                    scratch.rename(self.folder / str(number))
                    break
                except OSError:
                    if number not in self.numbers():
                        raise  # else another published meanwhile
            sync_folder(self.folder)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
        version = self.version(number)
        version.verify()
        return version

    def point(self, number: int) -> None:
        """Let the alias lead to that version: one rename, so that it leads somewhere at all times.

        Raises BundleError where there is no such version, it is damaged, or a folder is in the way.
        """
        self.version(number).verify()
        if self.link.exists() and not self.link.is_symlink():
            raise BundleError(
                f"{self.link} is a folder, not an alias",
                fix="publish into a folder of models of its own: --models published",
            )
        temporary = self.link.with_name(f".{self.name}.{secrets.token_hex(4)}.tmp")
        temporary.symlink_to(Path(FOLDER, self.name, str(number)))
        try:
            temporary.replace(self.link)
        finally:
            temporary.unlink(missing_ok=True)
        sync_folder(self.link.parent)

    def pin(self, number: int | None) -> None:
        """Keep the alias at that version, or with None let it move again."""
        if number is None:
            (self.folder / PINNED).unlink(missing_ok=True)
            return
        self.version(number)
        with replacing(self.folder / PINNED) as temporary:
            temporary.write_text(f"{number}\n")

    def before(self) -> int:
        """The version before the current one. Raises BundleError where there is none."""
        older = [number for number in self.numbers() if number < (self.current or 0)]
        if not older:
            raise BundleError(
                f"{self.effect}/{self.name} has no version before its current one",
                fix="'deepshade-client bundles' lists them; one of them can be pinned",
            )
        return older[-1]


def aliases(root: Path) -> list[Alias]:
    """All names with versions below a root, by effect and name."""
    found = sorted(path for path in root.glob(f"*/{FOLDER}/*") if path.is_dir())
    return [Alias(root, path.parts[-3], path.name) for path in found]


def read_version(path: Path) -> Version:
    """The version in a folder, unverified. Raises BundleError for a bad record."""
    try:
        if (path / RECORD).stat().st_size > _MAX_RECORD:
            raise ValueError("it is too large")
        record = json.loads((path / RECORD).read_bytes())
        number, files = record["number"], record["files"]
        sound = all(isinstance(n, str) and isinstance(d, str) for n, d in files.items())
        version = Version(path, int(number), dict(files))
        if not sound or record["sha256"] != version.sha256:
            raise ValueError("its hash is wrong")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise BundleError(f"{path / RECORD} can't be used: {error}") from error
    return version


def load(path: Path) -> Bundle:
    """The verified bundle that a folder or an alias leads to, by its real path.

    Of a version all files are verified. Raises BundleError.
    """
    real = path.resolve()
    if (real / RECORD).exists():
        read_version(real).verify()
    return Bundle.load(real)


def _names(path: Path) -> set[str]:
    """The files of a bundle; raises BundleError for what a bundle has none of."""
    found = {entry.name for entry in path.iterdir()} - {RECORD}
    odd = [n for n in found if (path / n).is_symlink() or not (path / n).is_file()]
    if odd or len(found) > _MAX_FILES or CONFIG not in found:
        raise BundleError(f"{path} is no bundle: {', '.join(sorted(odd)[:5]) or 'too many files'}")
    return found


def _hash(path: Path) -> str:
    try:
        return sha256(path)
    except OSError as error:
        raise BundleError(f"can't read {path}: {error.strerror}") from error
