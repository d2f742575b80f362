"""Measures cases: each picture takes a request's path, on every engine and precision here."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from deepshade import exr, metrics
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS, Effect
from deepshade.engines import Backend, Engine, load_engine
from deepshade.errors import DeepshadeError
from deepshade.files import shipped
from deepshade_report.hardcases.cases import Case
from deepshade_report.hardcases.exact import FLOAT64, ROUNDED, Float64, Rounded
from deepshade_report.hardcases.picture import Float, Mask, Picture, of_view
from deepshade_report.samples import sample_views
from deepshade_report.view import fullest
from deepshade_service.decoding import decode, read_headers
from deepshade_service.memory import Need, need_of
from deepshade_service.parameters import ShadeParameters
from deepshade_service.problems import Problem
from deepshade_service.selection import Selection
from deepshade_service.shading import Job, run
from deepshade_service.uploads import Upload
from deepshade_trainer.evaluation import prepared

MEMORY = 8 * 2**30
# What may differ from float64 in any case: 16 bits have 2^-9 of a value, 8 bits 2^-8 of a range,
# and a network is some dozen such steps.
FLOORS = {"fp32": 1e-5, "bf16": 2**-8, "int8": 2**-6}
_SEAMS = 1e-5  # what tiles may change, in fp32


@dataclass(frozen=True)
class Row:
    """One variant of a case, by one bundle on one backend.

    `error` is against `against` ("reference": DSSIM; "closed form": mean absolute difference;
    "float64": the same number as `float64`), `easy` the easy case's over the same pixels, and
    `line` what it may be. `float64` is the root mean square of what differs from the same network
    in float64, of white or of itself where that is brighter, and `float64_line` what that may be.
    Where no answer came, `refused` says which error did.
    """

    case: str
    variant: str
    effect: str
    bundle: str
    backend: str
    against: str
    error: float | None
    easy: float | None
    line: float | None
    float64: float | None
    float64_line: float | None
    passed: bool
    why: str = ""
    refused: str = ""

    @property
    def key(self) -> tuple[str, str, str, str, str]:
        """What tells it from all others."""
        return self.effect, self.bundle, self.backend, self.case, self.variant

    @property
    def severity(self) -> float:
        """How near its lines it is, or how far over: 1 is on a line."""
        if self.refused or self.error is None:
            return 0.0 if self.passed else np.inf
        pairs = (self.error, self.line), (self.float64, self.float64_line)
        return max(value / line for value, line in pairs if value is not None and line)

    def as_json(self) -> dict[str, Any]:
        """As JSON values."""
        return asdict(self)


class Bench:
    """A bundle on some backends and in float64, with what it makes of the easy case."""

    def __init__(
        self, bundle: Bundle, backends: Sequence[Backend], shape: tuple[int, int], threads: int
    ) -> None:
        self.bundle, self.effect = bundle, EFFECTS[bundle.effect]
        self.exact = Float64(bundle)
        self.engines: list[Engine] = []
        for backend in backends:
            made = (
                Rounded(bundle)
                if backend == ROUNDED
                else load_engine(bundle, backend, threads=threads)
            )
            self.engines.append(made)
        views = sample_views(shipped("samples"), bundle.effect)
        self.easy = of_view(fullest(views), *shape)
        self._easy = {e.backend: self.shade(e, self.easy) for e in (self.exact, *self.engines)}

    def shade(self, engine: Engine, picture: Picture) -> Float:
        """(C', H, W), as the service answers. Raises what it does, a Problem or DeepshadeError."""
        try:
            asked = ShadeParameters(**picture.asked)
        except ValidationError as error:  # what a request is answered with a 422 for
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"]))
            raise Problem(422, "bad-parameter", f"{where}: {first['msg']}") from None
        upload = Upload("", "case.exr", picture.body())
        asked.check([self.effect])
        limits = exr.Limits()
        headers = read_headers([upload], asked, limits)
        need = need_of(headers, self.bundle, MEMORY)
        need = Need(need.total, picture.tiles or need.max_pixels)
        environment = None
        if self.bundle.environment and picture.surroundings is not None:
            environment = prepared(picture.surroundings.environment)
        selection = Selection(self.bundle, engine.backend, "a case")
        job = Job(selection, need, environment, engine)
        (gbuffer,) = decode([upload], headers, [self.bundle], asked, limits)
        shade, _ = run(job, gbuffer, headers, asked, 0, threading.Event())
        return shade

    def rows(self, case: Case) -> Iterator[tuple[Row, Picture, Float | None]]:
        """Of every variant on every backend, with what was sent and answered."""
        for variant, picture in case.make(self.effect, self.easy):
            truth = self.truth(picture)
            for engine in self.engines:
                yield self._row(case, variant, picture, truth, engine)

    def truth(self, picture: Picture) -> Float | None:
        """The float64 answer that the picture's is held against; None where there is none."""
        if picture.tiles is not None:  # too large for float64: its own engine's, in one tile
            return None
        try:
            return self.shade(self.exact, picture.like or picture)
        except (DeepshadeError, Problem):
            return None

    def _row(
        self, case: Case, variant: str, picture: Picture, truth: Float | None, engine: Engine
    ) -> tuple[Row, Picture, Float | None]:
        names = case.name, variant, self.bundle.effect, self.bundle.name, str(engine.backend)
        try:
            answer = self.shade(engine, picture)
            if picture.tiles is not None and picture.like is not None:
                truth = self.shade(engine, picture.like)
        except (DeepshadeError, Problem) as problem:
            said = f"{getattr(problem, 'kind', type(problem).__name__)}: {problem}"
            return _unanswered(names, picture.refused, case.why, said), picture, None
        if truth is None or picture.refused:
            return _unanswered(names, False, "answered, where it can't be"), picture, None
        off = deviation(self.effect, picture, answer, truth)
        floor = FLOORS[engine.backend.precision]
        if picture.tiles is not None:
            allowed = max(_SEAMS, floor if engine.backend.precision != "fp32" else 0)
        else:
            easy = self._easy[engine.backend], self._easy[FLOAT64]
            same = picture.compared if picture.shape == self.easy.shape else None
            allowed = max(floor, case.line * self._deviation(easy, same))
        against, error, easy_error = self._error(picture, engine, answer)
        line = None if easy_error is None else case.line * easy_error
        if error is None:
            error, line = off, allowed
        good = np.isfinite(answer).all() and off <= allowed and (line is None or error <= line)
        row = Row(*names, against, error, easy_error, line, off, allowed, bool(good), case.why)
        return row, picture, answer

    def _deviation(self, easy: tuple[Float, Float], compared: Mask | None) -> float:
        return deviation(self.effect, replace(self.easy, compared=compared), *easy)

    def _error(
        self, picture: Picture, engine: Engine, answer: Float
    ) -> tuple[str, float | None, float | None]:
        """(against what, error, the easy case's)."""
        easy, known = self._easy[engine.backend], self.easy.truth
        assert known is not None
        if picture.truth is None:
            return "float64", None, None
        if picture.closed:
            own = mean_error(self.effect, answer, picture.truth, picture.compared)
            return "closed form", own, mean_error(self.effect, easy, known, None)
        error = structural(self.effect, answer, picture.truth, picture.compared)
        return "reference", error, structural(self.effect, easy, known, picture.compared)


def _unanswered(
    names: tuple[str, str, str, str, str], passed: bool, why: str, refused: str = ""
) -> Row:
    return Row(*names, "", None, None, None, None, None, passed, why, refused)


def deviation(effect: Effect, picture: Picture, answer: Float, exact: Float) -> float:
    """Root mean square of a difference, of white, or of the exact value where that is brighter."""
    white = picture.white
    if white is None:
        known = exact if picture.truth is None else picture.truth
        white = 1 / metrics.exposure(known) if effect.is_light else 1.0
    a, b = np.asarray(answer, np.float64), np.asarray(exact, np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(a - b) / np.maximum(np.abs(b), white)
    if picture.compared is not None:
        off = off[:, picture.compared]
    return float(np.sqrt(np.mean(off * off))) if off.size else 0.0


def mean_error(effect: Effect, answer: Float, truth: Float, compared: Mask | None) -> float:
    """Mean absolute difference, of what is exposed as white; where there is no light, of 1."""
    factor = metrics.exposure(truth) if effect.is_light else 1.0
    off = np.abs(np.asarray(answer, np.float64) - truth) * factor
    off = np.minimum(off, 1)
    return float(off.mean() if compared is None else off[:, compared].mean())


def structural(effect: Effect, answer: Float, truth: Float, compared: Mask | None) -> float:
    """DSSIM of windows that lie within what is compared, both exposed by the truth."""
    factor = metrics.exposure(truth) if effect.is_light else 1.0
    pair = [
        np.clip(np.nan_to_num(image.astype(np.float64) * factor), 0, 1) for image in (answer, truth)
    ]
    seen = metrics.ssim_map(*pair)
    if compared is not None:
        seen = seen[:, _windows(compared)]
    return float((1 - seen.mean()) / 2)


def _windows(compared: NDArray[np.bool_]) -> Mask:
    """Which windows of SSIM lie within what is compared."""
    side = metrics.WINDOW
    views = np.lib.stride_tricks.sliding_window_view(compared, (side, side))
    return np.asarray(views.all((2, 3)))
