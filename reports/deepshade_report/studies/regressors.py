"""Random forests and shallow perceptrons on patches beside the network (the paper's figure 13).

Their features are what the network sees in a square around a pixel: normals, and positions in
effect radii. Positions are given relative to the pixel's and clipped to two radii, which is easier
than the raw ones that the paper's networks learn from.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view

from deepshade import metrics
from deepshade.timing import significant
from deepshade_report.studies.common.bench import Bench
from deepshade_report.studies.common.drawing import bars, plot
from deepshade_report.studies.common.learning import recipe, shown, trained
from deepshade_report.studies.common.rows import Point, Row, by
from deepshade_report.view import Float
from deepshade_trainer.dataset import Dataset
from deepshade_trainer.networks import Shader, build
from deepshade_trainer.run import Run

TITLE = "Other regressors of ambient occlusion, on test views"
FIGURE = "13"

MODELS = (("forest", 21), ("perceptron", 11), ("perceptron", 21), ("network", 0))
_HIDDEN = 64
_REACH = 2.0  # effect radii
_ROWS = 16  # of a picture at a time, which bounds memory


def points(bench: Bench) -> list[Point]:
    """Every model with every seed; side 0: whole pictures."""
    return [{"model": m, "side": s, "seed": k} for m, s in MODELS for k in bench.scale.seeds]


def measure(bench: Bench, point: Point) -> dict[str, Any]:
    """Errors on the test views, and seconds: of learning, and of one megapixel."""
    side, held = int(point["side"]), Dataset([bench.set("held")], "ao")
    test = shown(held, range(bench.scale.val_views, len(held.entries)))
    began = time.perf_counter()
    if not side:
        made = recipe(bench, seed=point["seed"])
        name = f"network-s{point['seed']}"
        found = trained(bench, made, name)
        shader = Shader(held.effect, build(made.network)).eval()
        shader.network.load_state_dict(Run(bench.runs(name)).load()[0]["average"])
        learnt = {"learning": round(time.perf_counter() - began, 1), "curve": found["curve"]}
    else:
        learning = Dataset([bench.set("learn")], "ao")
        x, y = samples(learning, side, bench.scale.pixels, point["seed"])
        bench.doing(f"fitting {point['model']} to {len(y)} patches of {x.shape[1]} values")
        with warnings.catch_warnings():  # of a perceptron that would go on learning
            warnings.simplefilter("ignore")
            model = _model(bench, point).fit(x, y)
        learnt = {"learning": round(time.perf_counter() - began, 1), "patches": len(y)}
    errors, seconds = [], 0.0
    for number in test:
        gbuffer, sample = held.judged(number)
        began = time.perf_counter()
        if side:
            image = _answer(model, gbuffer[0].numpy(), side)
        else:
            with torch.inference_mode():
                image = shader(shader.padded(gbuffer))[0, 0].numpy()
        seconds += time.perf_counter() - began
        truth = sample[held.reference][0]
        image = np.clip(image[: truth.shape[0], : truth.shape[1]], 0, 1)
        errors.append((metrics.dssim(image, truth), metrics.mae(image, truth)))
    dssim, mae = (significant(float(each)) for each in np.mean(errors, axis=0))
    per_megapixel = seconds / (len(test) * truth.size / 1e6)
    return {"test": {"dssim": dssim, "mae": mae}, "seconds_per_megapixel": per_megapixel, **learnt}


def samples(data: Dataset, side: int, count: int, seed: int) -> tuple[Float, Float]:
    """Patches (n, 6 side²) and references (n,) of `count` surface pixels of each sample."""
    rng, xs, ys = np.random.default_rng(seed), [], []
    for number in range(len(data.entries)):
        gbuffer, sample = data.judged(number)
        planes = gbuffer[0].numpy()
        rows, columns = np.nonzero(planes[5] < 0)
        drawn = rng.choice(len(rows), min(count, len(rows)), replace=False)
        rows, columns = rows[drawn], columns[drawn]
        xs.append(patches(planes, side, rows, columns))
        ys.append(sample[data.reference][0][rows, columns])
    return np.concatenate(xs), np.concatenate(ys)


def patches(planes: Float, side: int, rows: Any, columns: Any) -> Float:
    """(n, 6 side²): normals and relative positions in squares about the pixels (n,).

    `planes` (6, H, W) are normals and positions in effect radii; the border is repeated, and
    background has no normal and lies at the reach behind the pixel.
    """
    half = side // 2
    padded = np.pad(planes, ((0, 0), (half, half), (half, half)), "edge")
    windows = sliding_window_view(padded, (side, side), axis=(1, 2))
    found = windows[:, rows, columns].transpose(1, 0, 2, 3).copy()  # (n, 6, side, side)
    empty = found[:, 5:6] >= 0
    found[:, 3:] -= planes[3:, rows, columns].T[:, :, None, None]
    found[:, 3:] = np.clip(found[:, 3:] / _REACH, -1, 1)
    found[:, 3:] = np.where(empty, np.array([0, 0, -1], np.float32)[:, None, None], found[:, 3:])
    return np.ascontiguousarray(found.reshape(len(found), -1), np.float32)


def draw(bench: Bench, rows: Sequence[Row]) -> bytes:
    """Error, and time for a megapixel, means over seeds."""
    named = [{**row, "point": {"name": _title(row["point"])}} for row in rows]
    with plot(3, TITLE, size=(11, 2.6)) as made:
        bars(made.axes[0], by(named, "name", lambda row: row["test"]["dssim"]), "DSSIM")
        bars(made.axes[1], by(named, "name", lambda row: row["test"]["mae"]), "MAE")
        speed = by(named, "name", lambda row: row["seconds_per_megapixel"])
        bars(made.axes[2], speed, "seconds a megapixel")
        made.axes[2].set_xscale("log")
    return made.image


def _title(point: Point) -> str:
    side = point["side"]
    return f"{point['model']}, {side} x {side}" if side else "the paper's network"


def _model(bench: Bench, point: Point) -> Any:
    if point["model"] == "forest":
        from sklearn.ensemble import RandomForestRegressor

        return RandomForestRegressor(
            bench.scale.trees,
            min_samples_leaf=3,
            max_features="sqrt",
            n_jobs=bench.threads,
            random_state=point["seed"],
        )
    from sklearn.neural_network import MLPRegressor

    return MLPRegressor(
        hidden_layer_sizes=(_HIDDEN,),
        early_stopping=True,
        n_iter_no_change=5,
        max_iter=60,
        random_state=point["seed"],
    )


def _answer(model: Any, planes: Float, side: int) -> Float:
    """(H, W): the model's answer to every surface pixel, 1 at background."""
    image = np.ones(planes.shape[1:], np.float32)
    rows, columns = np.nonzero(planes[5] < 0)
    for top in range(0, planes.shape[1], _ROWS):
        own = (rows >= top) & (rows < top + _ROWS)
        if own.any():
            at = rows[own], columns[own]
            image[at] = model.predict(patches(planes, side, *at))
    return image
