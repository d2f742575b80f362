"""A view as a JSON-ready record, and back: what was drawn, so that it can be rendered again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from deepshade.camera import Camera
from deepshade.environments.stored import read_stored
from deepshade_workers.environments import EnvironmentLight
from deepshade_workers.look import Look
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.view import Light, LookRecord, Vector, View


def record_of(view: View) -> dict[str, Any]:
    """The view's settings and camera, and what else it has.

    Displacements, light and look; of an environment its name, `rotate` in degrees and
    `environment_sha256`, by which `deepshade.environments.stored` finds it beside a data set.
    """
    camera = view.camera
    record: dict[str, Any] = {
        **view.settings(),
        "camera": {
            "fov": camera.fov,
            "frame": [camera.width, camera.height],
            "origin": [camera.x0, camera.y0],
            "world_to_camera": camera.matrix.tolist(),
        },
    }
    if view.displacements:
        record["displacements"] = {name: list(by) for name, by in view.displacements.items()}
    if view.light is not None:
        record["light"] = {
            name: value if isinstance(value, float) else list(value)
            for name, value in asdict(view.light).items()
        }
    if view.surroundings is not None:
        record["rotate"] = view.surroundings.rotation
        record["environment_sha256"] = view.surroundings.environment.sha256
    if view.look is not None:
        look = view.look.record
        scatter = {name: list(path) for name, path in look.scatter.items()}
        record["look"] = {**asdict(look), "scatter": scatter}
    return record


def view_of(record: Mapping[str, Any], scene: Scene, folder: Path | None = None) -> View:
    """The view of `scene` that `record_of` made `record` of.

    Its environment is that of the data set in `folder`; without one, none.

    Raises:
        DataError: the environment isn't there.
    """
    seen: dict[str, Any] = record["camera"]
    (width, height), (x0, y0) = seen["frame"], seen["origin"]
    camera = Camera(seen["fov"], width, height, np.array(seen["world_to_camera"]), x0, y0)
    light = record.get("light")
    look = record.get("look")
    if light is not None:
        colours = {name: _vector(value) for name, value in light.items() if name != "size"}
        light = Light(size=light["size"], **colours)
    if look is not None:
        scatter = {name: _vector(path) for name, path in look["scatter"].items()}
        look = Look.draw(scene, camera, LookRecord(**{**look, "scatter": scatter}))
    surroundings = None
    if folder is not None and "environment" in record:
        found = read_stored(folder, record["environment_sha256"], record["environment"])
        surroundings = EnvironmentLight.of(found, record["rotate"])
    return View(
        camera,
        record["radius"],
        focus=record.get("focus"),
        aperture=record.get("aperture"),
        shutter=record.get("shutter"),
        displacements={k: _vector(v) for k, v in record.get("displacements", {}).items()},
        light=light,
        look=look,
        surroundings=surroundings,
    )


def _vector(values: Any) -> Vector:
    x, y, z = values
    return float(x), float(y), float(z)
