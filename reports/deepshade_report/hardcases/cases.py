"""The cases: what is done to a picture, for which effects, and how far off the answer may be.

A case is for the effects that read, or have as a setting, what it is about. Its line is a share of
the easy case's error; where it is more than a tenth over that, it says what physics or the format
forbids.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from deepshade.attributes import ATTRIBUTES, CAMERA_DIRECTION, RADIANCE, WORLD_DIRECTION
from deepshade.effects import Effect
from deepshade_report.hardcases import made
from deepshade_report.hardcases.picture import LENGTHS, Picture, unit_is_length

LINE = 1.1
Variants = Iterator[tuple[str, Picture]]
Make = Callable[[Effect, Picture], Variants]

_HOLE = 16  # pixels along the side of a block
_NAN, _INF = np.float32(np.nan), np.float32(np.inf)
VALUES = {
    "NaN": _NAN,
    "+Inf": _INF,
    "-Inf": -_INF,
    "-0": np.float32(-0.0),
    "denormal": np.float32(1e-40),
    "65504": np.float32(65504),
}


@dataclass(frozen=True)
class Case:
    """A row: variants of one difficulty. `line` is over the easy case's error, and `why` it is."""

    name: str
    make: Make
    line: float = LINE
    why: str = ""


def _lengths(effect: Effect) -> bool:
    return any(map(unit_is_length, effect.inputs)) or bool(set(LENGTHS) & set(effect.settings))


def _lights(effect: Effect) -> list[str]:
    return [name for name in effect.inputs if ATTRIBUTES[name].unit is RADIANCE]


def _directions(effect: Effect) -> list[str]:
    units = CAMERA_DIRECTION, WORLD_DIRECTION
    names = [name for name in effect.inputs if ATTRIBUTES[name].unit in units]
    return [name for name in names if not ATTRIBUTES[name].in_background]


def _easy(effect: Effect, easy: Picture) -> Variants:
    yield "", easy


def _scaled(factor: float, effect: Effect, easy: Picture) -> Variants:
    if _lengths(effect):
        yield "", easy.scaled(factor)


def _half(effect: Effect, easy: Picture) -> Variants:
    for name in effect.inputs:
        if unit_is_length(name):
            yield name, replace(easy, half=frozenset({name}))


def _stepped(share: float, effect: Effect, easy: Picture) -> Variants:
    """World positions whose 16 bits step by `share` of the radius: the camera is that far away."""
    if "position" not in effect.inputs or "radius" not in easy.header:
        return
    # half floats between 16 and 32 are 1/64 apart
    scaled = easy.scaled(1 / 64 / (share * easy.header["radius"]))
    matrix = scaled.camera.matrix
    turn, position = matrix[:3, :3], scaled.planes["position"].astype(np.float64)
    there = position[2] < 0
    world = np.tensordot(turn.T, position - matrix[:3, 3, None, None], 1)
    low, high = (getattr(world[:, there], side)(axis=1) for side in ("min", "max"))
    away = 24 - (low + high) / 2
    # what doesn't fit between 16 and 32 is finer or coarser by one step
    matrix = matrix.copy()
    matrix[:3, 3] -= turn @ away
    planes = {name: plane for name, plane in scaled.planes.items() if name != "position"}
    shifted = np.where(there, world + away[:, None, None], 0).astype(np.float32)
    planes["position_world"] = shifted
    yield (
        "",
        replace(
            scaled,
            planes=planes,
            camera=replace(scaled.camera, world_to_camera=matrix),
            half=frozenset({"position_world"}),
        ),
    )


def _lengthened(factor: float, effect: Effect, easy: Picture) -> Variants:
    for name in _directions(effect):
        yield name, easy.put(**{name: easy.planes[name] * np.float32(factor)})


def _encoded(effect: Effect, easy: Picture) -> Variants:
    for name in _directions(effect):
        plane = easy.planes[name]
        there = np.abs(plane).sum(0) > 0
        yield name, easy.put(**{name: np.where(there, plane * 0.5 + 0.5, 0).astype(np.float32)})


def _damaged(value: np.float32, size: int, effect: Effect, easy: Picture) -> Variants:
    """A pixel or block of each attribute holds the value; all beside it counts.

    Where the value is one that light may have, what it lights is right to change.
    """
    height, width = easy.shape
    size = min(size, height // 4, width // 4)
    rows, columns = (slice(n // 2 - size // 2, n // 2 - size // 2 + size) for n in (height, width))
    compared = np.ones(easy.shape, np.bool_)
    compared[rows, columns] = False
    for name in effect.inputs:
        plane = easy.planes[name].copy()
        plane[:, rows, columns] = value
        picture = replace(easy.put(**{name: plane}), compared=compared)
        legal = not unit_is_length(name) and name not in _directions(effect)
        if (np.isfinite(value) and legal) or (value == 65504 and unit_is_length(name)):
            picture = replace(picture, truth=None, white=_white(easy))
        yield name, picture


def _white(picture: Picture) -> float | None:
    """What is exposed as white: in the truth, if it is light."""
    if picture.truth is None:
        return None
    return float(np.percentile(picture.truth, 99)) or None


def _zero(effect: Effect, easy: Picture) -> Variants:
    for name in _directions(effect):
        for _, picture in _damaged(np.float32(0), _HOLE, replace(effect, inputs=(name,)), easy):
            yield name, picture


def _flat(maker: made.Maker, effect: Effect, easy: Picture) -> Variants:
    yield "", maker(effect, *easy.shape)


def _wide(shares: Sequence[float], effect: Effect, easy: Picture) -> Variants:
    """A corner and a wall at radii that are shares of the picture's width, or pixels below 1."""
    if "radius" not in effect.settings:
        return
    height, width = easy.shape
    whole = 4 * np.tan(np.radians(made.FOV / 2))  # the picture's width, 2 away
    for share in shares:
        yield f"{share:g} of the width", made.corner(effect, height, width, radius=share * whole)


def _tiny(effect: Effect, easy: Picture) -> Variants:
    if "radius" not in effect.settings:
        return
    height, width = easy.shape
    pixel = 4 * np.tan(np.radians(made.FOV / 2)) / width
    for pixels in (1e-3, 1.0):
        picture = made.corner(effect, height, width, radius=pixels * pixel)
        # within a radius of the edge all is one pixel's mean
        edge = np.abs(np.arange(width) + 0.5 - width / 2) < 2
        yield f"{pixels:g} px", replace(picture, compared=np.broadcast_to(~edge, (height, width)))


def _exposed(factor: float, effect: Effect, easy: Picture) -> Variants:
    lights = _lights(effect)
    if lights and easy.truth is not None:
        gain = np.float32(factor)
        brighter = easy.put(**{name: easy.planes[name] * gain for name in lights})
        yield "", replace(brighter, truth=easy.truth * gain)


def _two_lights(effect: Effect, easy: Picture) -> Variants:
    """The left is lit by 1e-3, the right by 1e5; each side is compared by its own white."""
    lights, white = _lights(effect), _white(easy)
    if not lights or white is None:
        return
    width = easy.shape[1]
    gain = np.where(np.arange(width) < width // 2, 1e-3, 1e5).astype(np.float32)
    picture = easy.put(**{name: easy.planes[name] * gain for name in lights})
    for side, level in (("dark side", 1e-3), ("bright side", 1e5)):
        compared = np.broadcast_to(gain == np.float32(level), easy.shape)
        yield side, replace(picture, truth=None, compared=compared, white=white * level)


def _negative(effect: Effect, easy: Picture) -> Variants:
    for name in _lights(effect):
        plane = easy.planes[name].copy()
        plane[:, ::7, ::5] *= -1
        yield name, replace(easy.put(**{name: plane}), truth=None, white=_white(easy))


def _focused(effect: Effect, easy: Picture) -> Variants:
    """Lens settings at their ends. A lens that sees one light everywhere gives it back."""
    if "focus" not in effect.settings:
        return
    depth = easy.planes.get("depth")
    if depth is None and "position" in easy.planes:
        depth = -easy.planes["position"][2:]
    if depth is None:
        depth = np.full((1, *easy.shape), 2, np.float32)
        depth[:, :, easy.shape[1] // 2 :] = 5
    lens = {
        "focus at 1e30": {"focus": 1e30, "aperture": 0.08},
        "focus at 1e-30, on the eye": {"focus": 1e-30, "aperture": 1e-30},
        "focus at 1e-30, lens of 1": {"focus": 1e-30, "aperture": 1.0},
        "circles wider than the picture": {"focus": 0.5, "aperture": 40.0},
        "lens of 0": {"focus": 3.0, "aperture": 0.0},
    }
    for name, header in lens.items():
        for light, picture in (
            ("", replace(easy, truth=None, white=_white(easy))),
            (", even light", made.wall(effect, *easy.shape)),
        ):
            planes = {k: v for k, v in picture.planes.items() if k != "focal"}
            known = {"depth": depth} if "position" not in planes else {}
            yield name + light, replace(picture, planes=planes | known).say(**header)
    yield "focus at 0", replace(easy, refused=True).ask(focus=0.0)


def _moved(effect: Effect, easy: Picture) -> Variants:
    """Motion across the paper's seam at an angle of π, none, and off the picture."""
    if "motion" not in effect.inputs:
        return
    height, width = easy.shape
    plain = replace(easy, truth=None, white=_white(easy))

    def by(u: float, v: float, picture: Picture = plain) -> Picture:
        plane = np.broadcast_to(np.array([u, v], np.float32).reshape(2, 1, 1), (2, height, width))
        return picture.put(motion=np.ascontiguousarray(plane))

    for angle, size in ((1e-6, 20.0), (-1e-6, 20.0), (1e-3, 2.0), (-1e-3, 2.0)):
        yield f"{size:g} px at π {angle:+g}", replace(by(-size, size * angle), like=by(-size, 0.0))
    for size in (20.0, 2.0):  # the shutter has no direction
        yield f"{size:g} px back", replace(by(-size, 0.5), like=by(size, -0.5))
    rest = plain.planes[_lights(effect)[0]]
    yield "at rest", replace(by(0, 0), truth=rest, closed=True, white=None)
    yield "1e-30 px", replace(by(1e-30, -1e-30), truth=rest, closed=True, white=None)
    even = made.wall(effect, height, width)
    for size in (1e3, 1e6, 1e30):
        yield f"{size:g} px", by(size, size)
        yield f"{size:g} px, even light", by(size, -size, even)


def _scattered(effect: Effect, easy: Picture) -> Variants:
    if "scatter" not in effect.inputs:
        return
    plain = replace(easy, truth=None, white=_white(easy))
    even = made.wall(effect, *easy.shape)
    for path in (0.0, 1e-30, 1e-6):
        light = plain.planes["light"]
        still = plain.put(scatter=np.full_like(plain.planes["scatter"], path))
        yield f"mean free path {path:g}", replace(still, truth=light, closed=True, white=None)
    for path in (1e3, 1e9, 1e30):
        plane = np.full_like(plain.planes["scatter"], path)
        yield f"mean free path {path:g}", plain.put(scatter=plane)
        yield f"mean free path {path:g}, even light", even.put(scatter=plane)


def _sized(effect: Effect, easy: Picture) -> Variants:
    """Windows of the picture; the float64 answer sees no more than they do."""
    height, width = easy.shape
    plain = replace(easy, truth=None, white=_white(easy)).ask(trust=True)
    for rows, columns in ((1, 1), (1, width), (height, 1), (2, 3), (height - 5, width - 7)):
        window = slice(5, 5 + rows), slice(7, 7 + columns)
        if 5 + rows > height:
            window = slice(0, rows), window[1]
        if 7 + columns > width:
            window = window[0], slice(0, columns)
        yield f"{columns} x {rows}", plain.cut(*window)


def _tiled(effect: Effect, easy: Picture) -> Variants:
    """A wide picture in several tiles; what counts is the answer to it in one."""
    wide = {name: np.tile(plane, (1, 1, 6)) for name, plane in easy.planes.items()}
    height, width = easy.shape
    camera = replace(easy.camera, width=6 * width, height=height, x0=0, y0=0)
    whole = replace(
        easy, planes=wide, camera=camera, truth=None, white=_white(easy), tiles=1 << 62
    ).ask(trust=True)
    yield f"{6 * width} x {height}", replace(whole, tiles=1, like=whole)


def _large(effect: Effect, easy: Picture) -> Variants:
    """8K, the picture over and over, in small tiles; the answer in the usual ones counts."""
    height, width = easy.shape
    over = -(-4320 // height), -(-7680 // width)
    planes = {name: np.tile(plane, (1, *over)) for name, plane in easy.planes.items()}
    planes = {n: np.ascontiguousarray(plane[:, :4320, :7680]) for n, plane in planes.items()}
    camera = replace(easy.camera, width=7680, height=4320, x0=0, y0=0)
    whole = replace(easy, planes=planes, camera=camera, truth=None, white=_white(easy))
    whole = whole.ask(trust=True)
    yield "7680 x 4320", replace(whole, tiles=1 << 21, like=whole)


_STEP = "16 bits hold no more: the truth lies anywhere within a step"
_UNSEEN = "what lies outside the picture can't be seen: within the radius most of it does"

CASES: tuple[Case, ...] = (
    Case("easy", _easy),
    *(
        Case(f"scene x 1e{power}", partial(_scaled, 10.0**power))
        for power in (-3, -2, -1, 1, 2, 3, 4, 5, 6)
    ),
    Case("lengths of 16 bits", _half),
    Case("16-bit world positions, steps of R / 60", partial(_stepped, 1 / 60)),
    Case("16-bit world positions, steps of R / 30", partial(_stepped, 1 / 30)),
    Case("16-bit world positions, steps of R / 15", partial(_stepped, 1 / 15), 1.25, _STEP),
    Case("normals 10 % short", partial(_lengthened, 0.9)),
    Case("normals half as long", partial(_lengthened, 0.5)),
    Case("normals twice as long", partial(_lengthened, 2.0)),
    Case("normals encoded", _encoded),
    Case("normals of 0 in a block", _zero),
    *(
        Case(f"{name} in {where}", partial(_damaged, value, size))
        for name, value in VALUES.items()
        for where, size in (("a pixel", 1), ("a block", _HOLE))
    ),
    Case("a wall", partial(_flat, made.wall)),
    Case("grazing angles, to the horizon", partial(_flat, made.ground)),
    Case("thin bars before a far wall", partial(_flat, made.bars)),
    Case("coplanar surfaces", partial(_flat, made.coplanar)),
    Case("interpenetrating surfaces", partial(_flat, made.corner)),
    Case("radius of .001 px and 1 px", _tiny),
    Case("radius of the whole view", partial(_wide, (0.25, 1.0, 100.0)), 8.0, _UNSEEN),
    Case("light x 1e-3", partial(_exposed, 1e-3)),
    Case("light x 1e5", partial(_exposed, 1e5)),
    Case("light of 1e5 beside 1e-3", _two_lights),
    Case("negative light", _negative),
    Case("lens", _focused),
    Case("motion", _moved),
    Case("mean free paths", _scattered),
    Case("sizes", _sized),
    Case("tile seams", _tiled),
)
LARGE = Case("8K", _large)
