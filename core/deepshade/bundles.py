"""Model bundles: one trained shader in one folder, refused unless its hashes match."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from deepshade.attributes import ATTRIBUTES
from deepshade.effects import EFFECTS
from deepshade.errors import BundleError, nearest
from deepshade.files import replacing, sha256

MODEL = "model.onnx"
WEIGHTS = "model.safetensors"
INT8 = "model.int8.onnx"
PROBE = "probe.exr"
CONFIG = "config.json"
METRICS = "metrics.json"

_MAX_BYTES = {CONFIG: 1 << 20, METRICS: 16 << 20, MODEL: 1 << 30, WEIGHTS: 1 << 30}
_MAX_BYTES |= {INT8: 1 << 30, PROBE: 64 << 20}
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_SCALES = ("1/radius", "none")


@dataclass(frozen=True, slots=True)
class Bundle:
    """A verified bundle. `config.json` holds every field but `path` and `metrics`.

    `inputs` are attribute names in network order; positions reach the graph multiplied by
    `position_scale` ("1/radius", or "none"). `radius` is the default effect radius in scene
    units and `fov` the horizontal angle in degrees that it was trained at. Image sides must be
    multiples of `size_multiple`; pixels within `halo` of a tile's inner side depend on its
    neighbour. Background farther than `background_halo` from all geometry changes no pixel of
    it, so it need not be computed (as far as `halo`, unless the configuration says less). `ranges`
    are the (lowest, highest) values seen in training; `hashes` maps file names to sha256.

    Two files may be absent: the graph in 8 bits (`INT8`), quantised on real G-buffers, and
    `PROBE`, a few held-out G-buffers with their reference, on which a machine measures what a
    precision costs it (see `deepshade.probe`).
    """

    path: Path
    effect: str
    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    radius: float
    fov: float
    size_multiple: int
    halo: int
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)
    hashes: dict[str, str] = field(default_factory=dict)
    metrics: dict[str, Any] = field(default_factory=dict)
    version: str = "1"
    position_scale: str = "1/radius"
    input_name: str = "gbuffer"
    output_name: str = "shade"
    background_halo: int = -1

    def __post_init__(self) -> None:
        if self.background_halo < 0:
            object.__setattr__(self, "background_halo", self.halo)

    @property
    def model(self) -> Path:
        """The ONNX graph."""
        return self.path / MODEL

    @property
    def weights(self) -> Path:
        """The same weights for further training."""
        return self.path / WEIGHTS

    @property
    def int8(self) -> Path | None:
        """The ONNX graph in 8 bits, None without one."""
        return self.path / INT8 if INT8 in self.hashes else None

    @property
    def probe(self) -> Path | None:
        """Held-out G-buffers with their reference, None without them."""
        return self.path / PROBE if PROBE in self.hashes else None

    @property
    def sha256(self) -> str:
        """The graph's hash."""
        return self.hashes[MODEL]

    @property
    def short_hash(self) -> str:
        """Its first 12 digits, for people."""
        return self.sha256[:12]

    @classmethod
    def load(cls, path: Path | str) -> Bundle:
        """Reads and verifies a bundle's folder.

        Raises BundleError when a file is missing, too large or doesn't match its hash, or when
        the configuration has an unknown, missing or impossible entry.
        """
        path = Path(path)
        config = _read_json(path / CONFIG)
        metrics = _read_json(path / METRICS) if (path / METRICS).exists() else {}
        bundle = _from_config(path, config, metrics)
        for name, expected in bundle.hashes.items():
            found = _hash(path / name)
            if found != expected:
                raise BundleError(
                    f"{path / name} is not the file that {CONFIG} describes "
                    f"(sha256 {found[:12]}…, expected {expected[:12]}…)",
                    fix="get the bundle again, or export it again",
                )
        return bundle


def bundle_root() -> Path:
    """Where models are: $DEEPSHADE_MODELS, else ./models if it is there, else the sources' own."""
    chosen = os.environ.get("DEEPSHADE_MODELS")
    if chosen:
        return Path(chosen)
    here = Path("models")
    return here if here.is_dir() else Path(__file__).resolve().parents[2] / "models"


def bundle_folders(root: Path | str) -> list[Path]:
    """The folder of every bundle under `root`/<effect>/<name>/, unverified, by effect and name."""
    return [path.parent for path in sorted(Path(root).glob(f"*/*/{CONFIG}"))]


def write_config(
    path: Path | str,
    *,
    effect: str,
    name: str,
    inputs: Sequence[str],
    outputs: Sequence[str],
    radius: float,
    fov: float,
    size_multiple: int,
    halo: int,
    ranges: Mapping[str, Sequence[float]] | None = None,
    metrics: Mapping[str, Any] | None = None,
    version: str = "1",
    position_scale: str = "1/radius",
    input_name: str = "gbuffer",
    output_name: str = "shade",
    background_halo: int | None = None,
) -> Bundle:
    """Completes a bundle's folder that already holds its model files: hashes and configuration.

    The optional files count if they are there: remove what belongs to an older model before.
    Written atomically, `config.json` last: a folder without it is no bundle yet. Raises
    BundleError for missing files or impossible values.
    """
    path = Path(path)
    config: dict[str, Any] = {
        "effect": effect,
        "name": name,
        "version": version,
        "inputs": list(inputs),
        "outputs": list(outputs),
        "input_name": input_name,
        "output_name": output_name,
        "position_scale": position_scale,
        "radius": radius,
        "fov": fov,
        "size_multiple": size_multiple,
        "halo": halo,
        "ranges": {key: list(value) for key, value in (ranges or {}).items()},
        "hashes": {file: _hash(path / file) for file in _files(path)},
    }
    if background_halo is not None:
        config["background_halo"] = background_halo
    bundle = _from_config(path, config, dict(metrics or {}))
    if metrics is not None:
        _write_json(path / METRICS, metrics)
    _write_json(path / CONFIG, config)
    return bundle


def _files(path: Path) -> list[str]:
    """What a bundle's folder holds of the files that its configuration vouches for."""
    return [MODEL, WEIGHTS, *(name for name in (INT8, PROBE) if (path / name).exists())]


def _hash(path: Path) -> str:
    """Raises BundleError if the file is absent, too large or unreadable."""
    _check_size(path)
    try:
        return sha256(path)
    except OSError as error:
        raise BundleError(f"can't read {path}: {error.strerror}") from None


def _from_config(path: Path, config: Mapping[str, Any], metrics: dict[str, Any]) -> Bundle:
    known = {f.name: f for f in fields(Bundle) if f.name not in ("path", "metrics")}
    where = path / CONFIG
    for key in config:
        if key not in known:
            near = nearest(key, known)
            raise BundleError(
                f"{where}: unknown entry '{key}'", fix=f"did you mean '{near}'?" if near else ""
            )
    for key in ("effect", "name", "inputs", "outputs", "radius", "fov", "size_multiple", "halo"):
        if key not in config:
            near = nearest(key, config)
            hint = f"; is it '{near}'?" if near and near not in known else ""
            raise BundleError(f"{where}: the entry '{key}' is missing", fix=f"add it{hint}")
    values = dict(config)
    for key, (check, wanted) in _CHECKS.items():
        if key in values and not check(values[key]):
            raise BundleError(f"{where}: '{key}' is {values[key]!r:.60}, it must be {wanted}")
    for name in values["inputs"]:
        if name not in ATTRIBUTES:
            near = nearest(name, ATTRIBUTES)
            raise BundleError(
                f"{where}: no attribute is called '{name}'",
                fix=f"did you mean '{near}'?" if near else "",
            )
    hashes = values.get("hashes", {})
    for name in (MODEL, WEIGHTS):
        if name not in hashes:
            raise BundleError(f"{where}: 'hashes' has none for {name}", fix="export it again")
    values["inputs"], values["outputs"] = tuple(values["inputs"]), tuple(values["outputs"])
    values["ranges"] = {k: (float(v[0]), float(v[1])) for k, v in values.get("ranges", {}).items()}
    values["radius"], values["fov"] = float(values["radius"]), float(values["fov"])
    return Bundle(path=path, metrics=metrics, **values)


def _number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) <= sys.float_info.max  # false for NaN, and for integers beyond any float


def _whole(value: Any, lowest: int, highest: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and lowest <= value <= highest


def _names(value: Any) -> bool:
    return (
        isinstance(value, (list, tuple))
        and 0 < len(value) <= 64
        and all(isinstance(v, str) and v for v in value)
        and len(set(value)) == len(value)
    )


def _label(value: Any) -> bool:
    return isinstance(value, str) and _NAME.fullmatch(value) is not None


def _ranges(value: Any) -> bool:
    return isinstance(value, dict) and all(
        isinstance(v, (list, tuple)) and len(v) == 2 and all(map(_number, v)) and v[0] <= v[1]
        for v in value.values()
    )


def _hashes(value: Any) -> bool:
    return isinstance(value, dict) and all(
        _label(name) and isinstance(digest, str) and re.fullmatch("[0-9a-f]{64}", digest)
        for name, digest in value.items()
    )


_CHECKS: dict[str, tuple[Any, str]] = {
    "effect": (lambda v: isinstance(v, str) and v in EFFECTS, f"one of {', '.join(EFFECTS)}"),
    "name": (_label, "a short name of letters, digits, '.', '_' and '-'"),
    "version": (_label, "a short text of letters, digits, '.', '_' and '-'"),
    "inputs": (_names, "a list of attribute names"),
    "outputs": (_names, "a list of channel names"),
    "input_name": (_label, "a tensor's name"),
    "output_name": (_label, "a tensor's name"),
    "position_scale": (lambda v: v in _SCALES, f"one of {', '.join(_SCALES)}"),
    "radius": (lambda v: _number(v) and v > 0, "a number > 0"),
    "fov": (lambda v: _number(v) and 0 < v < 180, "degrees between 0 and 180"),
    "size_multiple": (lambda v: _whole(v, 1, 4096), "a whole number from 1 to 4096"),
    "halo": (lambda v: _whole(v, 0, 8192), "a whole number from 0 to 8192"),
    "background_halo": (lambda v: _whole(v, 0, 8192), "a whole number from 0 to 8192"),
    "ranges": (_ranges, "pairs of numbers, lowest first"),
    "hashes": (_hashes, "file names with sha256 digests"),
}


def _check_size(path: Path) -> None:
    try:
        size = path.stat().st_size
    except OSError:
        raise BundleError(f"{path} is missing", fix="get or export the bundle again") from None
    maximum = _MAX_BYTES.get(path.name, 1 << 30)
    if size > maximum:
        raise BundleError(f"{path} has {size:,} bytes, at most {maximum:,} are allowed")


def _read_json(path: Path) -> dict[str, Any]:
    _check_size(path)
    try:
        value = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise BundleError(f"{path} is no valid JSON: {error}") from None
    if not isinstance(value, dict):
        raise BundleError(f"{path} must hold a JSON object")
    return value


def _write_json(path: Path, value: Mapping[str, Any]) -> None:
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(value, indent=2, allow_nan=False) + "\n", "utf-8")
