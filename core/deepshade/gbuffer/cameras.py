"""The camera of a plan: what the shaded parts' headers say of it, and what overrides them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from deepshade import exr
from deepshade.camera import Camera, Projection, matrix_from_header
from deepshade.errors import CameraError
from deepshade.gbuffer.lenses import LATLONG, Lens, envmap, lens_in
from deepshade.gbuffer.profiles import Profile

if TYPE_CHECKING:
    from deepshade.gbuffer.plan import Plan


def _facts(plan: Plan, needs: Sequence[str]) -> dict[str, Any]:
    """The attributes of the parts that are shaded, never another part's or view's.

    Files of one part belong to the view that they are sent as.
    """
    direct = [plan.choices[name] for name in needs if name in plan.choices]
    rest = [c for c in plan.choices.values() if c.quantity not in ("alpha", "beauty")]
    whole = len(direct) == len(needs)
    parts = [part for c in (direct if whole else direct + rest) for part in plan.parts(c)]
    if not parts:
        parts = [part for header in plan.headers for part in header.parts]
    parts += [header.parts[0] for header in plan.headers if len(header.parts) == 1]
    facts: dict[str, Any] = {}
    for part in parts:
        facts = part.attributes | facts
    return facts


def see(
    plan: Plan,
    needs: Sequence[str],
    fov: float | None,
    projection: Projection | None,
    across: float | None,
) -> None:
    """Adds the camera, as far as it is known; what can't be used of a header blocks nothing yet.

    `needs` are the attributes that are wanted. `fov` (degrees), `projection` and the width `across`
    an orthographic frame override what headers say. Raises CameraError for a lens that is none.
    """
    facts = plan.attributes = _facts(plan, needs)
    try:
        plan.matrix = _matrix(facts, plan.profile)
    except CameraError as error:
        plan.unusable["matrix"] = str(error)
    part = plan.parts(next(iter(plan.choices.values())))[0] if plan.choices else None
    part = part or plan.headers[0].parts[0]
    windows = part.data_window, part.display_window
    if across is not None and projection is None:
        projection = "orthographic"
    said = lens_in(facts, part.display_window, plan.profile.fov if plan.profile else ())
    if fov is not None and projection in (None, "perspective"):
        lens: Lens | None = Lens("perspective", fov)
    elif projection == "latlong":
        lens = Lens("latlong", 360.0)
    elif across is not None:
        lens = Lens("orthographic", across)
    else:
        lens = said if said and projection in (None, said.projection) else None
    plan.projection = projection or (lens.projection if lens else None)
    if lens is None:
        if envmap(facts) not in (None, LATLONG):
            plan.unusable["fov"] = "the header's envmap is a cube, which isn't read"
        return
    plan.camera = Camera.framed(
        facts,
        *windows,
        plan.matrix,
        projection=lens.projection,
        fov=lens.width if lens.projection == "perspective" else 0.0,
        across=lens.width if lens.projection == "orthographic" else 0.0,
    )


def _matrix(attributes: Mapping[str, Any], profile: Profile | None) -> NDArray[np.float64] | None:
    matrix = matrix_from_header(attributes)
    if matrix is None:
        return profile.matrix(attributes) if profile is not None and profile.matrix else None
    # A right-handed world and a matrix that mirrors mean a left-handed camera looking down +z,
    # as Arnold and Karma write it; ours looks down -z.
    world_is_left = profile is not None and profile.world == "left"
    if (np.linalg.det(matrix[:3, :3]) < 0) != world_is_left:
        matrix = np.diag([1.0, 1.0, -1.0, 1.0]) @ matrix
    return matrix


def framed(camera: Camera, part: exr.Part) -> Camera:
    """The camera for the windows of `part`."""
    (x0, y0, *_), (left, top, right, bottom) = part.data_window, part.display_window
    return replace(
        camera, width=right - left + 1, height=bottom - top + 1, x0=x0 - left, y0=y0 - top
    )
