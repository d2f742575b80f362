"""What a data set holds: scenes, effects, sizes, samples, and what views draw."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from deepshade import symmetry
from deepshade.attributes import ATTRIBUTES
from deepshade.effects import EFFECTS
from deepshade.errors import ConfigError, SceneError
from deepshade.manifest import NAME, Manifest
from deepshade_workers.maps import map_files
from deepshade_workers.references import require
from deepshade_workers.scenes.loading import (
    COMPOSED,
    PROCEDURAL,
    SUFFIXES,
    parse_composed,
    parse_procedural,
)
from deepshade_workers.scenes.procedural import FAMILIES
from deepshade_workers.shards import circle_schema, schema
from deepshade_workers.view import MIN_CONTRAST, Limits

MAX_SHARD = 128  # samples
# Attributes that the camera and the scene's shape alone decide.
GEOMETRY = {"position", "normal", "normal_world", "normal_object", "depth", "view", "view_angle"}


@dataclass(frozen=True)
class DataSpec:
    """What a data set holds; two equal ones make equal bytes.

    `scenes` are files, `procedural:<family>` or `compose:<parts>`; `size` is a sample's side and
    `frame` that of the view it is cut from, in pixels; `radius` None draws one for each view;
    `min_contrast` None is what the effects' rows ask of occlusion, so that each view counts.
    Effects that see more than places and normals have light, lens, motions and materials drawn for
    each view, up to `max_blur`, `max_motion` and `max_scatter` pixels (`view.Limits`), with
    pictures from the folder `textures` among their textures. Effects under an environment get, for
    each view, a map of the folder `environments` or one of `skies` generated ones, and a rotation.
    With `augment` each view is stored in all turns and mirrors that its effects have (`turns`), and
    `views` counts it once. `attributes` come beside the effects' inputs. With `pixels` a view is
    seen from a sphere around its scene, and a sample is so many of its pixels with the normals
    around each (`circles`).
    """

    scenes: tuple[str, ...]
    views: int
    effects: tuple[str, ...] = ("ao",)
    size: int = 256
    frame: int = 256
    spp: int = 256
    seed: int = 0
    radius: float | None = None
    min_contrast: float | None = None
    shard_size: int = 128
    max_blur: float = Limits.max_blur
    max_motion: float = Limits.max_motion
    max_scatter: float = Limits.max_scatter
    textures: str | None = None
    environments: str | None = None
    skies: int = 64
    augment: bool = False
    attributes: tuple[str, ...] = ()
    pixels: int = 0

    def __post_init__(self) -> None:
        least = {"views": 1, "size": 1, "frame": self.size, "spp": 1, "seed": 0, "shard_size": 1}
        least["skies"] = least["pixels"] = 0
        for key, low in least.items():
            value = getattr(self, key)
            if value < low:
                raise ConfigError(key, detail=f"{key} must be at least {low}, not {value}")
        if self.radius is not None and not (math.isfinite(self.radius) and self.radius > 0):
            raise ConfigError("radius", detail=f"the radius must be above 0, not {self.radius}")
        for key in ("max_blur", "max_motion", "max_scatter"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(key, detail=f"{key} must be above 0 pixels, not {value}")
        if not self.effects:
            raise ConfigError("effects", detail="no effects were given: --effects ao, say")
        require(self.effects)
        for name in self.attributes:
            if name not in ATTRIBUTES:
                raise ConfigError(name, ATTRIBUTES, detail=f"no attribute is called {name!r}")
        if self.pixels:
            self._check_pixels()
        if self.environments is not None:
            map_files(self.environments)
        elif self.surrounded and not self.skies:
            raise ConfigError("environments", detail="give --environments, or some --skies")
        if not self.scenes:
            raise ConfigError("scenes", detail="no scenes were given: --scenes procedural, say")

    def _check_pixels(self) -> None:
        """Raise ConfigError where a few pixels can't tell what is asked for."""
        seen = {name for effect in self.effects for name in EFFECTS[effect].inputs}
        if not seen <= GEOMETRY or self.surrounded:
            raise ConfigError("pixels", detail="--pixels is for effects of geometry alone, as ao")
        for key in ("augment", "attributes"):
            if getattr(self, key):
                raise ConfigError("pixels", detail=f"--pixels and --{key} exclude each other")
        if self.frame != self.size:
            raise ConfigError("pixels", detail="--pixels takes whole views: leave --frame out")

    @property
    def shards(self) -> int:
        """How many shards hold all views."""
        return -(-self.views // self.shard_size)

    def samples(self, shard: int) -> range:
        """The sample numbers of a shard."""
        return range(shard * self.shard_size, min(self.views, (shard + 1) * self.shard_size))

    def schema(self) -> dict[str, dict[str, Any]]:
        """What a shard holds (`shards.schema`)."""
        if self.pixels:
            return circle_schema(self.effects, self.pixels)
        return schema(self.effects, self.size, self.attributes)

    @property
    def turns(self) -> tuple[int, ...]:
        """The symmetries in which a view is stored: those that all effects have."""
        if not self.augment:
            return (0,)
        return tuple(
            t for t in symmetry.ALL if all(t in EFFECTS[e].symmetries for e in self.effects)
        )

    @property
    def least_contrast(self) -> float:
        """Least standard deviation of a view's ambient occlusion."""
        if self.min_contrast is not None:
            return self.min_contrast
        rows = [EFFECTS[name] for name in self.effects]
        asked = (row.min_contrast for row in rows if row.contrast == "deviation")
        return max([MIN_CONTRAST, *asked])

    @property
    def limits(self) -> Limits | None:
        """What views draw beside the camera; None where no effect would see it."""
        seen = {name for effect in self.effects for name in EFFECTS[effect].inputs}
        if seen <= GEOMETRY:
            return None
        return Limits(self.max_blur, self.max_motion, self.max_scatter, self.textures)

    @property
    def surrounded(self) -> bool:
        """Whether an effect needs an environment."""
        return any("environment" in EFFECTS[effect].settings for effect in self.effects)

    def settings(self) -> dict[str, Any]:
        """JSON-ready settings, for the manifest; those that nothing depends on are left out."""
        found = {**asdict(self), "scenes": list(self.scenes), "effects": list(self.effects)}
        found["min_contrast"] = self.least_contrast
        if self.limits is None:
            for key in asdict(Limits()):
                del found[key]
        if not self.surrounded:
            del found["environments"], found["skies"]
        for key in ("augment", "pixels"):
            if not found[key]:
                del found[key]
        if self.attributes:
            found["attributes"] = list(self.attributes)
        else:
            del found["attributes"]
        return found


def default_shard_size(views: int, folder: Path, turns: int = 1) -> int:
    """A sixteenth of the views, so that cores share them and a kill loses little; 128 at most.

    Each may be stored in several `turns`. A data set that is there keeps its own.
    """
    if (folder / NAME).exists():
        return int(Manifest.read(folder).settings.get("shard_size", MAX_SHARD))
    return max(1, min(MAX_SHARD // turns, views // 16))


def expand_scenes(names: list[str]) -> tuple[str, ...]:
    """`procedural` becomes all families, folders become the scene files in them.

    Raises:
        SceneError: a name fits nothing.
    """
    found: list[str] = []
    for name in names:
        if name == PROCEDURAL:
            found += [f"{PROCEDURAL}:{family}" for family in FAMILIES]
        elif name.startswith(f"{PROCEDURAL}:"):
            parse_procedural(name)
            found.append(name)
        elif name.startswith(f"{COMPOSED}:"):
            parse_composed(name)
            found.append(name)
        elif Path(name).is_dir():
            inside = sorted(p for p in Path(name).iterdir() if p.suffix.lower() in SUFFIXES)
            if not inside:
                raise SceneError(f"the folder {name} holds no scene files")
            found += [str(p) for p in inside]
        elif Path(name).is_file() and Path(name).suffix.lower() in SUFFIXES:
            found.append(name)
        else:
            raise SceneError(
                f"there is no scene {name!r}",
                fix=f"give a file ({', '.join(sorted(SUFFIXES))}), a folder, 'procedural' or "
                "compose:FOLDER",
            )
    return tuple(found)
