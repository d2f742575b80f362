"""From uploaded bytes to the G-buffers of a request, with the settings that it asks for."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from deepshade import exr
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS, SETTINGS, Effect, Setting
from deepshade.errors import MissingAttributeError
from deepshade.gbuffer import GBuffer, load_gbuffers
from deepshade_service.parameters import LENS, ShadeParameters, Share
from deepshade_service.problems import Problem


class Source(Protocol):
    """What a file or a live frame is called, and what it holds."""

    @property
    def name(self) -> str:
        """Its file name, or ""."""

    @property
    def data(self) -> bytes | exr.Planes:
        """An EXR file's bytes, or planes."""


def read_headers(
    files: Sequence[Source], asked: ShadeParameters, limits: exr.Limits
) -> list[exr.Header]:
    """The files' checked headers, in which lens and camera are those asked for.

    Raises what `exr.read_header` raises.
    """
    headers = [exr.read_header(file.data, limits) for file in files]
    lens = {SETTINGS[name].header: getattr(asked, name) for name in LENS}
    said = {key: value for key, value in lens.items() if value is not None}
    if (matrix := asked.matrix) is not None:
        said["worldToCamera"] = matrix.T.astype(np.float32)  # Imath multiplies row vectors
    for part in (part for header in headers for part in header.parts):
        part.attributes.update(said)
    return headers


def decode(
    files: Sequence[Source],
    headers: Sequence[exr.Header],
    bundles: Sequence[Bundle],
    asked: ShadeParameters,
    limits: exr.Limits,
) -> Generator[GBuffer]:
    """The G-buffer that each bundle's network needs, found or derived in the files.

    Nothing else is decoded, and nothing twice. A blur circle that the files hold is of their lens:
    where another is asked for, it is derived. Raises what `load_gbuffers` raises, and Problem 422
    for a shutter asked for where the header doesn't say which one the motion holds for.
    """
    needs = {bundle.effect: list(bundle.inputs) for bundle in bundles}
    for effect, names in needs.items():
        if EFFECTS[effect].background == "light" and "light" not in names:
            names.append("light")
    new_lens = any(getattr(asked, name) is not None for name in LENS)
    gbuffers = load_gbuffers(
        [(file.name, file.data) for file in files],
        list(needs.values()),
        profile=asked.profile,
        mapping=asked.mapping,
        fov=asked.fov,
        projection=asked.projection,
        ortho_width=asked.ortho_width,
        view=asked.view,
        limits=limits,
        headers=headers,
        anew=(*(name.value for name in asked.derive), *(("focal",) if new_lens else ())),
        conventions=asked.conventions,
        radius=None if isinstance(asked.radius, Share) else asked.radius,
    )
    try:
        for bundle, gbuffer in zip(bundles, gbuffers, strict=True):
            yield _shuttered(gbuffer, EFFECTS[bundle.effect], asked)
            del gbuffer
    except MissingAttributeError as error:
        if len(needs) == 1:
            raise
        users = {
            name: f"for {', '.join(effect for effect, names in needs.items() if name in names)}"
            for name in error.missing
        }
        raise MissingAttributeError(
            error.missing, error.found, error.near, why=users, fix=error.fix
        ) from None


def _shuttered(gbuffer: GBuffer, effect: Effect, asked: ShadeParameters) -> GBuffer:
    """The G-buffer, its motion scaled to the shutter that is asked for."""
    setting = SETTINGS["shutter"]
    if not effect.takes(setting):
        return gbuffer
    if asked.shutter is None:
        if not gbuffer.per_frame:
            return gbuffer
        why = (
            "the motion is that of the whole interval between two frames, and how much of it the"
            " shutter is open isn't known: ?shutter=0.5 is half of it"
        )
        if asked.strict:
            raise Problem(422, "contradiction", why, fix="say it: ?shutter=0.5")
        return replace(gbuffer, warnings=(*gbuffer.warnings, why))
    shutter = stored(gbuffer, setting)
    if not shutter:
        raise Problem(
            422,
            "bad-parameter",
            "shutter: motion can't be scaled, for the header doesn't say how long the shutter"
            " is open that it holds for",
            fix=f"write {setting.header}, in {setting.unit} above 0, or leave out ?shutter=",
        )
    # not in place: other effects may see the same array
    motion = gbuffer.attributes["motion"] * np.float32(asked.shutter / shutter)
    return replace(
        gbuffer,
        attributes=gbuffer.attributes | {"motion": motion},
        header=gbuffer.header | {setting.header: asked.shutter},
    )


def stored(gbuffer: GBuffer, setting: Setting, instead: str = "") -> float | None:
    """What the header says of a setting. Raises Problem 422 where it can't mean that."""
    said = gbuffer.header.get(setting.header)
    if said is None:
        return None
    try:
        value = float(said)
    except (TypeError, ValueError):
        value = float("nan")
    assert setting.lowest is not None and setting.highest is not None, "only numbers are stored"
    if not setting.lowest <= value <= setting.highest:
        raise Problem(
            422,
            "bad-header",
            f"the image's header says {setting.header} = {str(said)[:60]}",
            fix=f"it must be a number from {setting.lowest:g} to {setting.highest:g}{instead}",
        )
    return value
