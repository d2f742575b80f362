"""`deepshade inspect`: what is in an EXR, what it maps to, what is missing for each effect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from rich.console import Console

    from deepshade.camera import Projection
    from deepshade.exr import Limits
    from deepshade.gbuffer.conventions import Conventions
    from deepshade.gbuffer.plan import Plan

SCENE_SUFFIXES = {".obj", ".ply", ".gltf", ".glb", ".stl", ".off", ".xml"}


def inspect(
    files: Annotated[
        list[Path], typer.Argument(help="EXR files of one view, or scenes (GLB, glTF, OBJ, PLY …).")
    ],
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
    map_: Annotated[
        list[str] | None,
        typer.Option("--map", help="attribute=layer, or attribute=channel,channel,channel."),
    ] = None,
    profile: Annotated[
        str | None, typer.Option(help="The renderer whose names and conventions to use.")
    ] = None,
    fov: Annotated[float | None, typer.Option(help="Full horizontal angle, degrees.")] = None,
    projection: Annotated[
        Literal["perspective", "orthographic", "latlong"] | None,
        typer.Option(help="The camera's, where the header doesn't say."),
    ] = None,
    ortho_width: Annotated[
        float | None, typer.Option(help="Width of an orthographic frame, scene units.")
    ] = None,
    view: Annotated[
        str | None, typer.Option(help="Which view of a stereo file, or part of a file.")
    ] = None,
    axes: Annotated[
        list[str] | None,
        typer.Option(help="Stored axes, as position:x,-y,-z or opencv; repeatable."),
    ] = None,
    normals: Annotated[
        str | None, typer.Option(help="How normals are stored: signed, encoded or scaled.")
    ] = None,
    depth: Annotated[
        str | None, typer.Option(help="What is stored as depth: planar, distance, inverse, …")
    ] = None,
    near: Annotated[float | None, typer.Option(help="Depth of the near plane.")] = None,
    far: Annotated[float | None, typer.Option(help="Depth of the far plane.")] = None,
    world_to_camera: Annotated[
        str | None,
        typer.Option(help="The camera's matrix: 16 numbers, row by row, for column vectors."),
    ] = None,
) -> None:
    """Show what EXR files hold, what it maps to, and what each effect still needs.

    Of a scene: its box, units, objects, triangles, materials, and what is missing.

    Examples:

      deepshade inspect shot.exr

      deepshade inspect shot_normal.exr shot_depth.exr --map normal=MyLayer.N --fov 40

      deepshade inspect scene.glb
    """
    from deepshade.camera import parse_matrix
    from deepshade.gbuffer.channels import parse_mapping
    from deepshade.gbuffer.conventions import parse_conventions

    if any(file.suffix.lower() in SCENE_SUFFIXES for file in files):
        # By name, for the core imports no other part; without the extra, run() says so.
        import_module("deepshade_workers.scenes.summary").inspect(files, as_json=json)
        return
    matrix = parse_matrix(world_to_camera) if world_to_camera else None
    report = inspect_files(
        files,
        mapping=parse_mapping(map_ or ()),
        profile=profile,
        fov=fov,
        projection=projection,
        ortho_width=ortho_width,
        view=view,
        matrix=matrix,
        conventions=parse_conventions(axes or (), normals, depth, near, far),
    )
    if json:
        import json as json_module

        typer.echo(json_module.dumps(report, indent=2))
    else:
        from deepshade.console import stdout

        _show(report, stdout())


def inspect_files(
    files: Sequence[Path | str],
    *,
    mapping: Mapping[str, str] | None = None,
    profile: str | None = None,
    fov: float | None = None,
    projection: Projection | None = None,
    ortho_width: float | None = None,
    view: str | None = None,
    matrix: NDArray[np.float64] | None = None,
    limits: Limits | None = None,
    conventions: Conventions | None = None,
) -> dict[str, Any]:
    """The report on files of one view, as plain JSON values.

    Keys: files (parts, channels, windows), profile, views and the one shown, camera, mapped,
    ambiguous, effects (for each: ready, bundles, have, derived, missing), statistics, and checks
    (derived, warnings, and the contradiction with its fix, if there is one). `matrix` is
    worldToCamera (4, 4), for column vectors, in place of the header's. An effect is ready when a
    bundle of it is installed whose inputs are there or can be derived. Raises what `load_gbuffer`
    raises for files that can't be read, but not for missing or ambiguous attributes: those are the
    report.
    """
    from deepshade import exr
    from deepshade.attributes import ATTRIBUTES
    from deepshade.effects import EFFECTS
    from deepshade.gbuffer.plan import plan_gbuffer

    limits, installed = limits or exr.Limits(), _installed()
    paths = [Path(file) for file in files]
    bodies = [exr.fetch(path, limits) for path in paths]
    headers = [exr.read_header(body, limits) for body in bodies]
    if matrix is not None:
        for part in (part for header in headers for part in header.parts):
            part.attributes["worldToCamera"] = matrix.T
    stems, wanted = [path.stem for path in paths], list(ATTRIBUTES)
    seen: dict[str, Any] = {
        "profile": profile,
        "mapping": mapping,
        "fov": fov,
        "projection": projection,
        "view": view,
    }
    plan = plan_gbuffer(headers, stems, wanted, **seen, across=ortho_width)
    return {
        "files": [_file(path, header) for path, header in zip(paths, headers, strict=True)],
        "profile": plan.profile.name if plan.profile else None,
        "views": list(plan.views.names),
        "view": plan.views.read or None,
        "camera": {
            "projection": plan.projection,
            "fov": (plan.camera.fov or None) if plan.camera else None,
            "ortho_width": (plan.camera.across or None) if plan.camera else None,
            "unusable": dict(plan.unusable),
            "world_to_camera": plan.matrix.tolist() if plan.matrix is not None else None,
        },
        "mapped": {name: str(choice) for name, choice in plan.choices.items()},
        "ambiguous": {name: list(e.candidates) for name, e in plan.ambiguous.items()},
        "effects": {
            name: _effect(plan, effect.inputs, installed.get(name, {}))
            for name, effect in EFFECTS.items()
        },
        "statistics": _statistics(plan, bodies, limits),
        "checks": _checks(
            plan,
            list(zip([path.name for path in paths], bodies, strict=True)),
            **seen,
            ortho_width=ortho_width,
            limits=limits,
            headers=headers,
            conventions=conventions,
        ),
    }


def _file(path: Path, header: Any) -> dict[str, Any]:
    return {
        "file": str(path),
        "bytes": header.body_bytes,
        "decoded_bytes": header.decoded_bytes,
        "parts": [
            {
                "name": part.name,
                "channels": part.channels,
                "data_window": list(part.data_window),
                "display_window": list(part.display_window),
                "compression": part.compression,
                "tiled": part.tiled,
                "subsampled": sorted(part.subsampled),
            }
            for part in header.parts
        ],
    }


def _installed() -> dict[str, dict[str, list[str]]]:
    """The inputs of every bundle here, unverified: effect -> bundle -> attributes."""
    import json

    from deepshade.bundles import CONFIG, bundle_folders, bundle_roots

    found: dict[str, dict[str, list[str]]] = {}
    for folder in bundle_folders(*bundle_roots()):
        with suppress(OSError, ValueError, KeyError, TypeError):  # a damaged one is none
            config = json.loads((folder / CONFIG).read_text("utf-8"))
            found.setdefault(config["effect"], {})[folder.name] = config["inputs"]
    return found


def _effect(
    plan: Plan, inputs: Sequence[str], bundles: Mapping[str, Sequence[str]]
) -> dict[str, Any]:
    """What the bundle that lacks least has and lacks, or without one the effect itself."""
    states = [_state(plan, names) for names in bundles.values() or [inputs]]
    state = min(states, key=lambda each: len(each["missing"]))
    return {
        "ready": bool(bundles) and not state["missing"],
        "bundles": sorted(bundles),
        **state,
    }


def _state(plan: Plan, inputs: Sequence[str]) -> dict[str, Any]:
    from deepshade.errors import AmbiguousChannelError, DeepshadeError
    from deepshade.gbuffer.suggestions import near_misses

    missing: dict[str, Any] = {}
    derived: dict[str, str] = {}
    have: list[str] = []
    for name in inputs:
        try:
            plan.require([name])
        except AmbiguousChannelError as error:
            missing[name] = {"why": str(error), "fix": error.fix, "near": list(error.candidates)}
        except DeepshadeError as error:
            near = list(near_misses(plan.layers, [name])[name])
            missing[name] = {"why": plan.explain(name), "fix": error.fix, "near": near}
        else:
            steps = plan.steps(name) or []
            derived |= {step.target: plan.how(step) for step in steps}
            if not steps:
                have.append(name)
    return {"have": have, "derived": derived, "missing": missing}


def _checks(plan: Plan, sources: Sequence[tuple[str, bytes]], **how: Any) -> dict[str, Any]:
    """What the geometry says of itself, as when it is shaded."""
    from deepshade.errors import ContradictionError, DeepshadeError
    from deepshade.gbuffer import load_gbuffer

    needs = [name for name in ("normal", "position", "depth") if plan.steps(name) is not None]
    if plan.camera is None and {"depth", "normal"} <= plan.choices.keys():
        needs = ["normal", "position"]  # which says what lens would fit
    found: dict[str, Any] = {"derived": {}, "warnings": [], "contradiction": None}
    try:
        if needs:
            gbuffer = load_gbuffer(sources, needs, **how)
            found |= {"derived": gbuffer.derived, "warnings": list(gbuffer.warnings)}
    except ContradictionError as error:
        found["contradiction"] = {"detail": str(error), "fix": error.fix}
    except DeepshadeError as error:
        found["warnings"] = [str(error)]
    return found


def _statistics(plan: Plan, bodies: Sequence[bytes], limits: Limits) -> dict[str, Any]:
    """Of every mapped quantity: pixels, non-finite ones, the finite values' range; lengths."""
    import numpy as np

    from deepshade import exr
    from deepshade.gbuffer.conventions import NORMALS

    result: dict[str, Any] = {}
    for index, body in enumerate(bodies):
        mine = {name: choice for name, choice in plan.choices.items() if choice.file == index}
        if not mine:
            continue
        wanted = [channel for choice in mine.values() for channel in choice.channels]
        image = exr.read(body, wanted, limits, header=plan.headers[index])
        for name, choice in mine.items():
            values = image.stack(choice.channels)
            finite = np.isfinite(values).all(axis=0)
            inside = values[:, finite]
            row: dict[str, Any] = {
                "pixels": int(finite.size),
                "nonfinite": int(finite.size - np.count_nonzero(finite)),
                "min": inside.min(1).tolist() if inside.size else None,
                "max": inside.max(1).tolist() if inside.size else None,
            }
            if name in NORMALS and inside.size:
                lengths = np.sqrt((inside.astype(np.float64) ** 2).sum(0))
                lit = lengths[lengths > 0]
                row["zero"] = int(lengths.size - lit.size)
                row["length"] = [float(lit.min()), float(lit.max())] if lit.size else None
            if name in ("depth", "distance") and inside.size:
                hit = inside[(inside > 0) & (inside < 1e10)]
                row["background"] = int(finite.size - hit.size)
                row["depth"] = [float(hit.min()), float(hit.max())] if hit.size else None
            result[name] = row
    return result


def _show(report: Mapping[str, Any], console: Console) -> None:
    from rich.table import Table

    for file in report["files"]:
        console.print(f"[bold]{_safe(file['file'])}[/bold]  {file['bytes']:,} bytes")
        for index, part in enumerate(file["parts"]):
            name = f"{_safe(part['name'] or str(index))}: " if len(file["parts"]) > 1 else ""
            console.print(f"  {name}{_size(part)}: {_safe(_listed(part['channels']))}")
    camera = report["camera"]
    console.print(
        f"renderer: {report['profile'] or 'not recognised'}; {_lens(camera)}; "
        f"worldToCamera: {'yes' if camera['world_to_camera'] else 'no'}"
    )
    for why in camera["unusable"].values():
        console.print(f"[yellow]not used:[/yellow] {_safe(why)}")
    if len(report["views"]) > 1:
        read = f"; this is of {report['view']}" if report["view"] else ""
        console.print(f"views: {_safe(', '.join(report['views']))}{_safe(read)}")

    table = Table("attribute", "from", "non-finite", "values")
    for name, where in report["mapped"].items():
        row = report["statistics"].get(name, {})
        table.add_row(name, _safe(where), str(row.get("nonfinite", "")), _values(row))
    derived = {n: how for each in report["effects"].values() for n, how in each["derived"].items()}
    for name, how in derived.items():
        table.add_row(name, _safe(how))
    for name, candidates in report["ambiguous"].items():
        table.add_row(name, f"[yellow]ambiguous:[/yellow] {_safe(', '.join(candidates))}")
    console.print(table)

    checks = report["checks"]
    for name, how in checks["derived"].items():
        console.print(f"{name}: {_safe(how)}")
    for warning in checks["warnings"]:
        console.print(f"[yellow]warning:[/yellow] {_safe(warning)}")
    if checks["contradiction"]:
        console.print(f"[red]contradiction:[/red] {_safe(checks['contradiction']['detail'])}")
        console.print(f"  fix: {_safe(checks['contradiction']['fix'])}")

    table = Table("effect", "state", "lacks")
    for name, effect in report["effects"].items():
        if effect["ready"]:
            state = "[green]ready[/green]"
        else:
            state = "[red]missing[/red]" if effect["bundles"] else "[red]no bundle here[/red]"
        table.add_row(name, state, _safe(_lacks(effect["missing"])))
    console.print(table)


def _lens(camera: Mapping[str, Any]) -> str:
    if camera["projection"] == "latlong":
        return "latitude-longitude panorama"
    if camera["projection"] == "orthographic":
        width = camera["ortho_width"]
        return f"orthographic, {f'{width:.4g}' if width else 'unknown'} wide"
    fov = camera["fov"]
    return f"field of view: {f'{fov:.4g}°' if fov else 'unknown'}"


def _size(part: Mapping[str, Any]) -> str:
    (x0, y0, x1, y1), frame = part["data_window"], part["display_window"]
    text = f"{x1 - x0 + 1} x {y1 - y0 + 1}"
    if part["data_window"] != frame or (x0, y0) != (0, 0):
        text += (
            f" at ({x0}, {y0}) of the frame ({frame[0]}, {frame[1]}) to ({frame[2]}, {frame[3]})"
        )
    return f"{text}, {part['compression']}{' tiled' if part['tiled'] else ''}"


def _listed(channels: Mapping[str, str]) -> str:
    """Channels by layer and type: "normal.X .Y .Z float; Z half"."""
    layers: dict[tuple[str, str], list[str]] = {}
    for name, kind in channels.items():
        layer, dot, last = name.rpartition(".")
        layers.setdefault((f"{layer}{dot}", kind), []).append(last)
    return "; ".join(
        f"{layer}{(' .' if layer else ' ').join(names)} {kind}"
        for (layer, kind), names in layers.items()
    )


def _lacks(missing: Mapping[str, Any]) -> str:
    """What is missing, in a line: what isn't there by name, of the rest what it needs."""
    from deepshade.gbuffer.plan import ABSENT

    absent = [name for name, facts in missing.items() if facts["why"] == ABSENT]
    texts = [", ".join(absent)] if absent else []
    texts += [f"{n}: {facts['why']}" for n, facts in missing.items() if n not in absent]
    near = dict.fromkeys(each for name in absent for each in missing[name]["near"])
    return "; ".join(texts) + (f" (near: {', '.join(near)})" if near else "")


def _values(row: Mapping[str, Any]) -> str:
    if not row or row["min"] is None:
        return "no finite value"
    if row.get("depth"):
        lowest, highest = row["depth"]
        return f"{lowest:.4g} … {highest:.4g}, background {row['background']:,}"
    text = f"{min(row['min']):.4g} … {max(row['max']):.4g}"
    if row.get("length"):
        lowest, highest = row["length"]
        text += f", length {lowest:.4g} … {highest:.4g}, zero {row['zero']:,}"
    return text


def _safe(text: str) -> str:
    """Text from a file: no markup, no control characters for the terminal to obey."""
    from rich.markup import escape

    return escape("".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text))
