"""Model bundles: one trained shader in one folder, refused unless its hashes match."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any

from deepshade.attributes import ATTRIBUTES
from deepshade.effects import EFFECTS
from deepshade.environments import INPUTS
from deepshade.errors import BundleError, ConfigError, nearest
from deepshade.files import replacing, sha256, shipped
from deepshade.tensors import channel_count

# in a graph: an entry of TensorProto.external_data whose key is "location" (onnx.proto)
_EXTERNAL = b"\x0a\x08location\x12"
SHIPPED = "shipped"  # as a folder of models: those that come with the program
MODEL = "model.onnx"
CONFIG = "config.json"
METRICS = "metrics.json"

_MAX_BYTES = {CONFIG: 1 << 20, METRICS: 16 << 20, MODEL: 1 << 30}
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_TENSOR = re.compile(r"[ -~]{1,256}")


@dataclass(frozen=True, slots=True)
class Bundle:
    """A verified bundle. `config.json` holds every field but `path` and `metrics`.

    `inputs` are attribute names in network order, in physical units but for lengths, which are
    divided as the effect's row says. With `per_channel` the graph sees one colour channel and
    runs three times. `radius` is the default effect radius in scene units and `fov` the
    horizontal angle in degrees that it was trained at. Image sides must be multiples of
    `size_multiple`; pixels within `halo` of a tile's inner side depend on its neighbour.
    `bytes_per_pixel` is the memory that a prediction takes for each pixel, in float32.

    `float32` names the tensors up to which the graph must be calculated in float32: arithmetic on
    lengths and light, which 16 bits would round. `float32_after` names those from which on it must
    be again: weights that light is blended by. Where `float32` names the output, all must. `int8`
    maps the weights of convolutions that may be
    calculated in 8 bits to the range of what they convolve, and `int8_kinds` are the kinds of CPU
    (`machine.cpu_kind`) on which that was found to add little error. `network` is the trainer's
    configuration of the network, whose weights the graph holds by their own names. `environment`
    names the graph's further inputs (`deepshade.environments.INPUTS`). `ranges` are
    the (lowest, highest) values seen in training; `hashes` maps file names to sha256.
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
    bytes_per_pixel: int
    per_channel: bool = False
    float32: tuple[str, ...] = ()
    float32_after: tuple[str, ...] = ()
    int8: dict[str, tuple[float, float]] = field(default_factory=dict)
    int8_kinds: tuple[str, ...] = ()
    network: dict[str, Any] = field(default_factory=dict)
    environment: tuple[str, ...] = ()
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)
    hashes: dict[str, str] = field(default_factory=dict)
    metrics: dict[str, Any] = field(default_factory=dict)
    version: str = "2"
    input_name: str = "gbuffer"
    output_name: str = "shade"

    @property
    def model(self) -> Path:
        """The ONNX graph, weights included."""
        return self.path / MODEL

    @property
    def channels(self) -> int:
        """The channels of the graph's input."""
        return channel_count(self.inputs, self.per_channel)

    @property
    def exact(self) -> bool:
        """Whether nothing of it may be calculated in 16 or 8 bits."""
        return self.output_name in self.float32

    @property
    def sha256(self) -> str:
        """The graph's hash."""
        return self.hashes[MODEL]

    @property
    def short_hash(self) -> str:
        """Its first 12 digits, for people."""
        return self.sha256[:12]

    @property
    def dssim(self) -> float | None:
        """Its error in fp32 on its real test set, else on its first; None where unknown."""
        errors = self.metrics.get("error")
        if not isinstance(errors, dict):
            return None
        for name in ("test-real", *errors):
            try:
                return float(errors[name]["exact"]["dssim"])
            except (KeyError, TypeError, ValueError):
                continue
        return None

    @classmethod
    def load(cls, path: Path | str) -> Bundle:
        """The verified bundle in a folder.

        Raises BundleError when a file is missing, too large or doesn't match its hash, or when
        the configuration has an unknown, missing or impossible entry.
        """
        path = Path(path)
        config = _read_json(path / CONFIG)
        metrics = _read_json(path / METRICS) if (path / METRICS).exists() else {}
        bundle = _from_config(path, config, metrics)
        found = _hash(path / MODEL)
        if found != bundle.sha256:
            raise BundleError(
                f"{path / MODEL} is not the file that {CONFIG} describes "
                f"(sha256 {found[:12]}…, expected {bundle.short_hash}…)",
                fix="get the bundle again, or export it again",
            )
        if _EXTERNAL in (path / MODEL).read_bytes():
            raise BundleError(
                f"{path / MODEL} has tensors in other files, which nothing would verify",
                fix="export it with all tensors inside",
            )
        return bundle


def bundle_roots(named: Sequence[Path | str] = ()) -> tuple[Path, ...]:
    """The folders of models: those `named`, else $DEEPSHADE_MODELS, else the shipped ones.

    The variable may hold several, as PATH does. SHIPPED among them stands for the shipped ones.
    Raises ConfigError for one that isn't there.
    """
    variable = filter(None, os.environ.get("DEEPSHADE_MODELS", "").split(os.pathsep))
    source = "--models" if named else "DEEPSHADE_MODELS"
    roots = [
        shipped("models") if str(place) == SHIPPED else Path(place)
        for place in named or list(variable) or [SHIPPED]
    ]
    for root in roots:
        if not root.is_dir():
            detail = f"there is no folder {root}; {source} says where bundles are"
            raise ConfigError("models", detail=f"{detail} ('{SHIPPED}': those that ship)")
    return tuple(dict.fromkeys(roots))


def bundle_root() -> Path:
    """The first of the folders of models, by default the shipped one."""
    return bundle_roots()[0]


def overlooked(roots: Sequence[Path]) -> str:
    """What to tell people who keep bundles in ./models and didn't name it; "" where they don't."""
    here = Path("models")
    if any(root.resolve() == here.resolve() for root in roots) or not bundle_folders(here):
        return ""
    return f"the bundles in ./models aren't used; --models models --models {SHIPPED} uses them too"


def bundle_folders(*roots: Path | str) -> list[Path]:
    """The folders of the bundles in <root>/<effect>/<name>/, unverified, by effect and name.

    Of two with the same effect and name the one of the earlier root counts.
    """
    found: dict[tuple[str, str], Path] = {}
    for root in roots:
        for path in Path(root).glob(f"*/*/{CONFIG}"):
            found.setdefault((path.parts[-3], path.parts[-2]), path.parent)
    return [found[key] for key in sorted(found)]


def check_name(name: str) -> None:
    """Raises ConfigError for what no bundle may be called."""
    if not _label(name):
        raise ConfigError(
            "name",
            detail=f"{name[:100]!r} can't be a bundle's name: up to 64 letters, digits, '.', '_' "
            "and '-', the first a letter or digit",
        )


def write_config(
    path: Path | str,
    config: Mapping[str, Any],
    metrics: Mapping[str, Any],
    *,
    graph: Path | None = None,
) -> Bundle:
    """The bundle that a folder with its graph becomes: completed by configuration and metrics.

    `config` holds the fields of `Bundle` but `path`, `hashes` and `metrics`. A new `graph`, a file
    in the folder, takes the place of the one there. All is written before anything is replaced, so
    that a full disk costs no bundle, and `config.json` is replaced last: what is cut off there is
    refused by its hash. Raises BundleError for a missing graph or impossible values.
    """
    path = Path(path)
    config = {**config, "hashes": {MODEL: _hash(graph or path / MODEL)}}
    bundle = _from_config(path, config, dict(metrics))
    with replacing(path / CONFIG) as last, replacing(path / METRICS) as first:
        _write_json(first, metrics)
        _write_json(last, config)
        if graph is not None:
            with replacing(path / MODEL) as model:
                graph.replace(model)
    return bundle


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
    for key in (f.name for f in known.values() if f.default is f.default_factory is MISSING):
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
    if MODEL not in values.get("hashes", {}):
        raise BundleError(f"{where}: 'hashes' has none for {MODEL}", fix="export it again")
    for key in ("inputs", "outputs", "float32", "float32_after", "int8_kinds", "environment"):
        values[key] = tuple(values.get(key, ()))
    for key in ("ranges", "int8"):
        pairs = values.get(key, {})
        values[key] = {name: (float(pair[0]), float(pair[1])) for name, pair in pairs.items()}
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


def _tensors(value: Any) -> bool:
    return isinstance(value, list | tuple) and all(
        isinstance(v, str) and _TENSOR.fullmatch(v) is not None for v in value
    )


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
    "radius": (lambda v: _number(v) and v > 0, "a number > 0"),
    "fov": (lambda v: _number(v) and 0 < v < 180, "degrees between 0 and 180"),
    "size_multiple": (lambda v: _whole(v, 1, 4096), "a whole number from 1 to 4096"),
    "halo": (lambda v: _whole(v, 0, 8192), "a whole number from 0 to 8192"),
    "bytes_per_pixel": (lambda v: _whole(v, 1, 1 << 24), "a whole number above 0"),
    "per_channel": (lambda v: isinstance(v, bool), "true or false"),
    "float32": (_tensors, "a list of names of the graph's tensors"),
    "float32_after": (_tensors, "a list of names of the graph's tensors"),
    "environment": (
        lambda v: isinstance(v, (list, tuple)) and set(v) <= set(INPUTS),
        f"a list of {', '.join(INPUTS)}",
    ),
    "int8": (_ranges, "pairs of numbers, lowest first"),
    "int8_kinds": (_tensors, "a list of kinds of CPU"),
    "network": (lambda v: isinstance(v, dict), "an object"),
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
    path.write_text(json.dumps(value, indent=2, allow_nan=False) + "\n", "utf-8")
