"""What a request for a job says, and the plan that it becomes."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

from deepshade.bundles import CONFIG, Bundle, check_name
from deepshade.effects import EFFECTS
from deepshade.errors import BundleError, ConfigError, nearest
from deepshade.manifest import NAME
from deepshade.versions import Alias
from deepshade_trainer.networks import check_learns
from deepshade_trainer.service.config import REHEARSAL, TEST, Settings
from deepshade_trainer.service.places import confined
from deepshade_trainer.service.store import QUEUED, Job
from deepshade_trainer.service.uploads import Uploads
from deepshade_trainer.tuning.plan import RANGES, Plan
from deepshade_trainer.tuning.rendering import Rendering

GENERATED = ("procedural", "compose")


def _between(key: str) -> Any:
    low, high = RANGES[key]
    return Field(ge=low, le=high)


class TrainRequest(BaseModel):
    """What to tune to (one of `data`, `upload` and `scene`), how long, and what has to hold."""

    model_config = ConfigDict(extra="forbid")

    base: str = Field("balanced", description="The effect's bundle to begin with.")
    name: str | None = Field(None, description="What to publish as. Default: as the base.")
    data: str | None = Field(None, description="Data folder below the trainer's --data.")
    upload: str | None = Field(None, description="Name of an upload (PUT /data/{name}/…).")
    scene: str | None = Field(
        None, description="Scene file below --data, or procedural:<family>:<seed>, to render."
    )
    views: int = Field(64, ge=8, le=100_000, description="Views of the scene to render.")
    size: int = Field(256, ge=16, le=2048, description="Their side in pixels.")
    spp: int = Field(256, ge=2, le=65536, description="Their reference rays a pixel.")
    minutes: Annotated[float, _between("minutes")] = Field(10.0, description="Of training.")
    steps: Annotated[int, _between("steps")] = Field(0, description="Instead of minutes.")
    seed: Annotated[int, _between("seed")] = 0
    lr: Annotated[float, _between("lr")] = Field(0.0, description="Learning rate; 0: default.")
    batch: Annotated[int, _between("batch")] = Field(0, description="Samples a step; 0: default.")
    share: Annotated[float, _between("share")] = Field(
        0.5, description="Of a batch, from older views, where the trainer has a library of them."
    )
    worse: Annotated[float, _between("worse")] = Field(
        0.03, description="How much worse it may get on the test, as a share."
    )
    slower: Annotated[float, _between("slower")] = Field(
        1.1, description="How many times the base's time it may take."
    )
    processes: Annotated[int, _between("processes")] = Field(
        1, description="Above 1: on Ray, so many train together."
    )

    @model_validator(mode="after")
    def _one_source(self) -> TrainRequest:
        given = [n for n in ("data", "upload", "scene") if getattr(self, n) is not None]
        if len(given) != 1:
            raise ValueError(
                "name what to tune to: one of data, upload and scene"
                + (f", not {' and '.join(given)}" if given else "")
            )
        return self


def job_of(
    effect: str, asked: TrainRequest, settings: Settings, uploads: Uploads
) -> tuple[Job, Plan, Rendering | None]:
    """The job that a request asks for. Reads manifests; raises DeepshadeError for what can't be."""
    if effect not in EFFECTS:
        raise ConfigError(effect, EFFECTS, detail=f"no effect is called {effect[:100]!r}")
    base = find_base(effect, asked.base, settings)
    check_learns(effect, Bundle.load(base).network.get("kind"))
    name = asked.name or asked.base
    Alias(settings.published, effect, name)  # may it be called so?
    rendering = _rendering(effect, asked, settings)
    if rendering is not None:
        data = rendering.out
    elif asked.upload is not None:
        data = str(uploads.folder(asked.upload))
    else:
        data = str(_data(asked.data or "", settings))
    plan = Plan(
        effect=effect,
        base=str(base),
        name=name,
        data=(data,),
        rehearsal=settings.stored(effect, REHEARSAL) if asked.share else (),
        test=settings.stored(effect, TEST),
        threads=settings.threads,
        **{key: getattr(asked, key) for key in RANGES if key != "threads"},
    )
    key = plan.key() if rendering is None else plan.key(rendering.key)
    now = time.time()
    job = Job(
        id=key[:16],
        key=key,
        effect=effect,
        name=name,
        asked=asked.model_dump(exclude_none=True),
        state=QUEUED,
        place=now,
        created=now,
        begun=0,
        sentence="",
        fix="",
    )
    return job, plan, rendering


def find_base(effect: str, name: str, settings: Settings) -> Path:
    """The real folder of the bundle to begin with: versions stay. Raises BundleError."""
    check_name(name)
    for root in settings.roots:
        if (root / effect / name / CONFIG).is_file():
            return (root / effect / name).resolve()
    known = [p.parent.name for root in settings.roots for p in root.glob(f"{effect}/*/{CONFIG}")]
    close = nearest(name, known)
    raise BundleError(
        f"there is no bundle {effect}/{name} to begin with",
        fix=f"did you mean {close!r}?" if close else f"there are: {', '.join(known) or 'none'}",
    )


def _data(name: str, settings: Settings) -> Path:
    path = confined(name, settings.data)
    if not (path / NAME).is_file():
        raise ConfigError(
            "data", detail=f"{path} is no data folder of 'deepshade datagen': it has no {NAME}"
        )
    return path


def _rendering(effect: str, asked: TrainRequest, settings: Settings) -> Rendering | None:
    if asked.scene is None:
        return None
    kind, _, rest = asked.scene.partition(":")
    files: tuple[str, ...]
    if kind not in GENERATED:
        scene = str(confined(asked.scene, settings.data))
        files = (scene,)
    elif kind == "compose":
        names, colon, seed = rest.partition(":")
        files = tuple(str(confined(each, settings.data)) for each in names.split("+"))
        scene = f"{kind}:{'+'.join(files)}{colon}{seed}"
    else:
        scene, files = asked.scene, ()
    rendering = Rendering(
        scene=scene,
        effect=effect,
        views=asked.views,
        size=asked.size,
        spp=asked.spp,
        seed=asked.seed,
        out="",
        files=files,
        address=settings.ray_address,
    )
    out = settings.folder / "rendered" / rendering.key[:16]
    return replace(rendering, out=str(out.resolve()))
