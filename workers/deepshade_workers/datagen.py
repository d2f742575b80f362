"""Renders a data set on Ray: one task a shard, resumable, the same bytes for the same seed."""

from __future__ import annotations

import itertools
import os
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from deepshade import symmetry
from deepshade.environments.stored import store, stored_path
from deepshade.errors import ConfigError, DataError, DeepshadeError, SceneError
from deepshade.files import sha256
from deepshade.manifest import NAME, Manifest, Shard
from deepshade_workers.dataspec import DataSpec
from deepshade_workers.scenes.loading import is_unseeded
from deepshade_workers.shards import shard_name, write_shard
from deepshade_workers.view import Images, Vector, View

# How often a sample whose scene shows nothing useful may ask for another scene.
SCENE_TRIES = 16
STARTS = 3  # of Ray, which gives a busy machine no more than 30 s for one


def make_sample(
    spec: DataSpec, index: int, *, displacements: Mapping[str, Vector] | None = None
) -> tuple[Images, dict[str, Any]]:
    """Render sample `index`: its images and the record that makes it again.

    The sample's own random stream picks scene, view, radius and noise, so it doesn't matter
    which worker renders it, or when. `displacements` move the scene's objects (`view.View`).
    """
    images, record, _ = _rendered(spec, index, displacements)
    return images, record


def _rendered(
    spec: DataSpec, index: int, displacements: Mapping[str, Vector] | None = None
) -> tuple[Images, dict[str, Any], View]:
    from deepshade_workers.environments import EnvironmentLight
    from deepshade_workers.maps import draw_map
    from deepshade_workers.records import record_of
    from deepshade_workers.render import render_sample
    from deepshade_workers.scenes.loading import open_scene
    from deepshade_workers.viewpoints import sample_view

    rng = np.random.default_rng([spec.seed, index])
    choice = spec.scenes[index % len(spec.scenes)]
    if spec.pixels:
        return _drawn(spec, index, choice, int(rng.integers(2**63)))
    for attempt in range(SCENE_TRIES):
        fresh = is_unseeded(choice)
        name = f"{choice}:{int(rng.integers(2**31))}" if fresh else choice
        scene = open_scene(name)
        try:
            view = sample_view(
                scene,
                rng,
                frame=spec.frame,
                size=spec.size,
                radius=spec.radius,
                min_contrast=spec.least_contrast,
                displacements=displacements,
                limits=spec.limits,
            )
            break
        except SceneError:
            if attempt == SCENE_TRIES - 1:
                raise
            # One bare scene shall not end a long job: another takes its place.
            choice = spec.scenes[int(rng.integers(len(spec.scenes)))]
    if spec.surrounded:
        drawn = draw_map(rng.spawn(1)[0], spec.environments, spec.skies, spec.seed)
        view = replace(view, surroundings=EnvironmentLight.of(*drawn))
    noise = int(rng.integers(2**63))
    images = render_sample(
        scene,
        view,
        spec.size,
        spec.size,
        effects=spec.effects,
        attributes=spec.attributes,
        samples=spec.spp,
        seed=noise,
    )
    record = {"scene": name, "seed": noise, **record_of(view)}
    return images, record, view


def _drawn(
    spec: DataSpec, index: int, name: str, noise: int
) -> tuple[Images, dict[str, Any], View]:
    """Some pixels of a view around a scene."""
    from deepshade_workers.circles import render_circles, view_around
    from deepshade_workers.records import record_of
    from deepshade_workers.scenes.loading import open_scene

    if is_unseeded(name):
        raise ConfigError("pixels", detail=f"--pixels is of one mesh: {name} is many; name a seed")
    scene = open_scene(name)
    view = view_around(scene, index // len(spec.scenes), spec.seed, spec.size, spec.radius)
    images = render_circles(
        scene, view, spec.size, spec.pixels, effects=spec.effects, samples=spec.spp, seed=noise
    )
    return images, {"scene": name, "seed": noise, **record_of(view)}, view


def make_shard(spec: DataSpec, index: int, folder: Path, tick: Callable[[], object]) -> Shard:
    """Render and write shard `index`, its environment maps first; `tick` after each sample."""
    tensors = spec.schema()
    images, records = [], []
    for number in spec.samples(index):
        sample, record, view = _rendered(spec, number)
        if view.surroundings is not None:
            store(folder, view.surroundings.environment)
        for turn in spec.turns:
            images.append({name: symmetry.apply(sample[name], name, turn) for name in tensors})
            records.append({**record, "turn": turn} if spec.augment else record)
        tick()
    return write_shard(folder, index, tensors, images, records)


def open_manifest(spec: DataSpec, folder: Path) -> Manifest:
    """The manifest to go on with: that of `folder` if the same settings made it, else a new one.

    A data set may grow: more views than it was begun with are the same spec.

    Raises:
        DataError: the folder holds a data set of other settings.
    """
    ours = spec.settings()
    if not (folder / NAME).exists():
        return Manifest(ours, spec.schema())
    manifest = Manifest.read(folder)
    theirs = manifest.settings
    differing = [key for key in ours if theirs.get(key) != ours[key]]
    if differing == ["views"] and theirs["views"] < spec.views:
        return Manifest(ours, manifest.schema, manifest.shards)
    if differing:
        was = ", ".join(f"{key} {theirs.get(key)!r}" for key in differing)
        raise DataError(
            f"{folder} holds a data set made with other settings: {was}",
            fix="give the same settings to complete it, or another --out",
        )
    return manifest


def generate(
    spec: DataSpec, folder: Path, *, address: str | None = None
) -> Iterator[tuple[int, int]]:
    """Render what is missing of `spec` into `folder` on a Ray cluster.

    `address` is a running cluster's; None takes RAY_ADDRESS, or else starts a cluster in this
    process. All nodes must see `folder` and the scenes under the same paths. Yields (samples
    done, samples in all) a few times a second. A killed worker's shard is rendered anew by another.

    Raises:
        DataError: the folder holds another data set.
        SceneError: a scene can't be read or shows nothing.
    """
    import ray

    folder = folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    manifest = open_manifest(spec, folder)
    for leftover in (*folder.glob(".*.tmp"), *folder.glob("*/.*.tmp")):  # of a killed job
        leftover.unlink(missing_ok=True)
    missing = [k for k in range(spec.shards) if not _complete(spec, k, manifest, folder)]
    counted = ready = spec.views - sum(len(spec.samples(k)) for k in missing)
    yield ready, spec.views
    if not missing:
        return
    _connect(address)
    try:
        tally: Any = ray.remote(num_cpus=0, max_restarts=-1, max_task_retries=-1)(Tally)
        tally = tally.remote()
        task = ray.remote(num_cpus=1, max_retries=5)(_shard_task)
        # A few at a time: a kill then loses little, and the cluster's memory stays flat.
        resources = ray.cluster_resources()  # type: ignore[no-untyped-call]
        slots = max(1, 2 * int(resources.get("CPU", 1)))
        running: list[Any] = []
        waiting = iter(missing)
        while True:
            for k in itertools.islice(waiting, slots - len(running)):
                running.append(task.remote(spec, k, str(folder), str(Path.cwd()), tally))
            if not running:
                break
            finished, running = ray.wait(running, num_returns=1, timeout=0.5)
            for reference in finished:
                manifest = manifest.with_shard(_result(reference))
                manifest.write(folder)
            with suppress(ray.exceptions.RayActorError):  # restarting; counts come back
                counted = max(counted, ready + ray.get(tally.total.remote()))
            yield min(counted, spec.views), spec.views
        yield spec.views, spec.views
    finally:
        ray.shutdown()


def _complete(spec: DataSpec, index: int, manifest: Manifest, folder: Path) -> bool:
    return any(
        shard.file == shard_name(index)
        and len(shard.samples) == len(spec.samples(index)) * len(spec.turns)
        and (folder / shard.file).is_file()
        and sha256(folder / shard.file) == shard.sha256
        and all(
            stored_path(folder, record["environment_sha256"]).is_file()
            for record in shard.samples
            if "environment_sha256" in record
        )
        for shard in manifest.shards
    )


class Tally:
    """Counts rendered samples across the cluster; a shard begun again counts once."""

    def __init__(self) -> None:
        self.counts: dict[int, int] = {}

    def set(self, shard: int, count: int) -> None:
        """Shard `shard` has `count` samples now."""
        self.counts[shard] = count

    def total(self) -> int:
        """Samples rendered in all."""
        return sum(self.counts.values())


def _shard_task(spec: DataSpec, index: int, folder: str, home: str, tally: Any) -> Shard:
    from deepshade_workers.backend import mitsuba

    os.chdir(home)  # scenes may have relative names
    mitsuba()  # first: it says what is missing
    import drjit as dr

    dr.set_thread_count(1)  # Ray gave this task one core
    counts = itertools.count(1)
    return make_shard(spec, index, Path(folder), lambda: tally.set.remote(index, next(counts)))


def _result(reference: Any) -> Shard:
    import ray

    try:
        return cast(Shard, ray.get(reference))
    except ray.exceptions.RayTaskError as error:
        raise error.cause if isinstance(error.cause, DeepshadeError) else error from None


def _connect(address: str | None) -> None:
    import ray

    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    where = address or os.environ.get("RAY_ADDRESS") or "local"
    options: dict[str, Any] = {"logging_level": "ERROR", "log_to_driver": False}
    if where == "local":
        options["include_dashboard"] = False
    host, _, port = where.removeprefix("ray://").rpartition(":")
    try:
        if host and port.isdigit():  # where nothing listens Ray itself would try for minutes
            socket.create_connection((host.strip("[]"), int(port)), timeout=10).close()
        for tries in range(STARTS, 0, -1):
            try:
                ray.init(address=where, **options)
                return
            except Exception as error:  # Ray has no type of its own for it
                ray.shutdown()
                if "timed out during startup" not in str(error):
                    raise
                if tries == 1:
                    raise DataError(
                        f"Ray did not start within its 30 s, {STARTS} times",
                        fix="the machine is busy: run the same command again",
                    ) from error
    except (OSError, ray.exceptions.AuthenticationError) as error:
        raise DataError(
            f"there is no Ray cluster for us at {where}: {error}",
            fix="start one with 'ray start --head', or leave --address out; where it has a token, "
            "set RAY_AUTH_MODE=token and RAY_AUTH_TOKEN to what 'ray get-auth-token' prints there",
        ) from error
