"""Published bundles: numbered, never changed, behind an alias that always leads somewhere."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import pytest

from deepshade.bundles import Bundle, bundle_folders, write_config
from deepshade.errors import BundleError, ConfigError
from deepshade.versions import Alias, aliases, load


def make(folder: Path, content: bytes) -> Path:
    """A bundle whose graph is these bytes; nothing loads it."""
    folder.mkdir(parents=True)
    (folder / "model.onnx").write_bytes(content)
    config = {
        "effect": "ao",
        "name": "balanced",
        "inputs": ("normal", "position"),
        "outputs": ("Y",),
        "radius": 0.5,
        "fov": 50.0,
        "size_multiple": 4,
        "halo": 8,
        "bytes_per_pixel": 16,
    }
    write_config(folder, config, {})
    return folder


@pytest.fixture
def alias(tmp_path: Path) -> Alias:
    """Two versions, and the alias at the second."""
    alias = Alias(tmp_path / "models", "ao", "balanced")
    for content in (b"one", b"two"):
        alias.point(alias.publish(make(tmp_path / content.decode(), content)).number)
    return alias


def test_versions_are_numbered_and_the_same_content_is_the_same_version(
    alias: Alias, tmp_path: Path
) -> None:
    assert alias.numbers() == [1, 2]
    assert alias.current == 2
    assert alias.publish(tmp_path / "one").number == 1
    assert alias.numbers() == [1, 2]
    record = json.loads((alias.folder / "1/version.json").read_text())
    assert record["files"]["model.onnx"] == hashlib.sha256(b"one").hexdigest()
    assert [each.current for each in aliases(tmp_path / "models")] == [2]


PUBLISH = """
import os, sys
from pathlib import Path
from deepshade.versions import Alias
os.setuid(10001)
alias = Alias(Path(sys.argv[1]), "ao", "balanced")
version = alias.publish(Path(sys.argv[2]))
alias.point(version.number)
print(version.number)
"""


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can be another"
)
def test_who_is_not_root_publishes_too() -> None:
    """As in a container: root may write where nobody else may, and so would see nothing."""
    with tempfile.TemporaryDirectory(dir="/tmp") as name:  # pytest's own are for root alone
        bundle, models = make(Path(name) / "bundle", b"one"), Path(name) / "models"
        models.mkdir()
        os.chown(models, 10001, 10001)
        Path(name).chmod(0o755)
        command = [sys.executable, "-c", PUBLISH, str(models), str(bundle)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert done.stdout.split() == ["1"], done.stderr
        assert load(models / "ao" / "balanced").path.name == "1"


def test_readers_see_the_alias_alone(alias: Alias, tmp_path: Path) -> None:
    assert bundle_folders(tmp_path / "models") == [alias.link]
    assert load(alias.link).path == (alias.folder / "2").resolve()
    assert Bundle.load(alias.link).sha256 == hashlib.sha256(b"two").hexdigest()


def test_the_alias_leads_somewhere_at_all_times(alias: Alias) -> None:
    stop, seen, lost = threading.Event(), set[str](), list[Exception]()

    def read() -> None:
        while not stop.is_set():
            try:
                seen.add((alias.link / "model.onnx").read_text())
            except OSError as error:
                lost.append(error)

    reader = threading.Thread(target=read)
    reader.start()
    for turn in range(200):
        alias.point(1 + turn % 2)
    stop.set()
    reader.join()
    assert not lost
    assert seen == {"one", "two"}


@pytest.mark.parametrize("file", ["model.onnx", "config.json", "metrics.json"])
def test_a_changed_version_is_refused(alias: Alias, file: str) -> None:
    path = alias.folder / "1" / file
    path.chmod(0o644)
    path.write_bytes(path.read_bytes() + b" ")
    with pytest.raises(BundleError, match="not the file"):
        alias.point(1)
    with pytest.raises(BundleError, match="not the file"):
        load(alias.folder / "1")
    assert alias.current == 2


def test_a_file_too_many_is_refused(alias: Alias) -> None:
    (alias.folder / "1/more.py").write_text("print()")
    with pytest.raises(BundleError, match=r"more\.py"):
        alias.point(1)


def test_a_link_is_not_published(alias: Alias, tmp_path: Path) -> None:
    folder = make(tmp_path / "linked", b"three")
    (folder / "README.md").symlink_to("/etc/hostname")
    with pytest.raises(BundleError, match=r"README\.md"):
        alias.publish(folder)
    assert alias.numbers() == [1, 2]
    assert not list(alias.folder.glob(".*"))


def test_pins_and_the_version_before(alias: Alias) -> None:
    assert alias.before() == 1
    alias.pin(1)
    assert alias.pinned == 1
    alias.pin(None)
    assert alias.pinned is None
    alias.point(1)
    with pytest.raises(BundleError, match="no version before"):
        alias.before()
    with pytest.raises(BundleError, match="no version 7") as caught:
        alias.pin(7)
    assert "1, 2" in caught.value.fix


def test_a_folder_in_the_way_stays(tmp_path: Path) -> None:
    make(tmp_path / "models/ao/balanced", b"own")
    alias = Alias(tmp_path / "models", "ao", "balanced")
    version = alias.publish(make(tmp_path / "new", b"new"))
    with pytest.raises(BundleError, match="not an alias"):
        alias.point(version.number)
    assert (tmp_path / "models/ao/balanced/model.onnx").read_bytes() == b"own"


@pytest.mark.parametrize("name", ["versions", "..", "a/b", "", "."])
def test_names_that_no_bundle_has(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError):
        Alias(tmp_path, "ao", name)
