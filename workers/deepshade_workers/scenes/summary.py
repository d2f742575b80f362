"""What a scene file holds, in figures: `deepshade inspect` of scenes, and warnings about them."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deepshade_workers.scenes.mesh import Mesh

# The largest side of a box in each unit: what people model is 5 cm to 200 m large.
UNITS = ((200.0, "metres"), (20_000.0, "centimetres"), (float("inf"), "millimetres"))
SHOWN = 8  # of objects and notes


def warn(notes: Sequence[str]) -> None:
    """Print warnings about missing parts of scenes to standard error, a few of them in full."""
    for note in notes[:SHOWN]:
        print(f"warning: {note}", file=sys.stderr)
    if len(notes) > SHOWN:
        print(f"warning: and {len(notes) - SHOWN} more; deepshade inspect SCENE", file=sys.stderr)


def inspect(files: Sequence[Path], *, as_json: bool) -> None:
    """Print `summary` of each file: as JSON, a list where there are several."""
    reports = [summary(path) for path in files]
    if as_json:
        print(json.dumps(reports[0] if len(reports) == 1 else reports, indent=2))
        return
    for report in reports:
        _show(report)


def summary(path: Path) -> dict[str, Any]:
    """The report on a scene file, as plain JSON values.

    Keys: file, box (low, high; scene units), size, units (a guess from the size; glTF says
    metres), triangles, objects (name, triangles), materials (of constant terms, with triangles),
    textures (width, height, triangles), notes.

    Raises:
        SceneError: it can't be read.
    """
    from deepshade_workers.scenes.loading import GLTF_SUFFIXES, MESH_SUFFIXES, load_mesh
    from deepshade_workers.scenes.scene import Scene

    if path.suffix.lower() not in MESH_SUFFIXES:
        scene = Scene.from_xml(path)
        return _placed(path, scene.bounds, False)
    mesh = load_mesh(path)
    used = mesh.vertices[np.unique(mesh.faces)]
    box = np.stack([used.min(0), used.max(0)])
    return {
        **_placed(path, box, path.suffix.lower() in GLTF_SUFFIXES),
        "triangles": len(mesh.faces),
        "objects": [
            {"name": item.name, "triangles": item.stop - item.start} for item in mesh.objects
        ],
        **_materials(mesh),
        "notes": list(mesh.notes),
    }


def _placed(path: Path, box: Any, metres: bool) -> dict[str, Any]:
    size = box[1] - box[0]
    guess = next(unit for most, unit in UNITS if float(size.max()) <= most)
    return {
        "file": str(path),
        "box": [[_short(value) for value in corner] for corner in box],
        "size": [_short(value) for value in size],
        "units": "metres" if metres else guess,
        "units_from": "glTF" if metres else "the size",
        "odd_size": bool(metres and guess != "metres"),
        "radius": _short(float(np.linalg.norm(size)) / 20),
    }


def _materials(mesh: Mesh) -> dict[str, Any]:
    count = len(mesh.faces)
    bitmap = np.full(count, -1) if mesh.paint is None else mesh.paint.bitmap
    rows, number = np.unique(mesh.materials[bitmap < 0], axis=0, return_counts=True)
    constant = [
        {
            "diffuse": [_short(value) for value in row[:3]],
            "specular": [_short(value) for value in row[3:6]],
            "gloss": _short(row[6]),
            "triangles": int(n),
        }
        for row, n in zip(rows, number, strict=True)
    ]
    textures = []
    for index, found in enumerate(() if mesh.paint is None else mesh.paint.bitmaps):
        height, width = found.texels.shape[:2]
        mean = found.texels[..., :3].astype(np.float32).mean((0, 1))
        textures.append(
            {
                "width": width,
                "height": height,
                "mean": [_short(value) for value in mean],
                "triangles": int((bitmap == index).sum()),
            }
        )
    return {"materials": constant, "textures": textures}


def _short(value: Any) -> float:
    return float(f"{float(value):.4g}")


def _show(report: dict[str, Any]) -> None:
    """Text for people."""
    size = " x ".join(f"{value:g}" for value in report["size"])
    low, high = (" ".join(f"{value:g}" for value in corner) for corner in report["box"])
    print(_safe(report["file"]))
    print(f"  box        {size}, from {low} to {high}")
    how = "as glTF says" if report["units_from"] == "glTF" else "a guess from the size"
    odd = "; an odd size for that: scaled on export?" if report["odd_size"] else ""
    print(f"  units      {report['units']} ({how}{odd})")
    print(f"  radius     {report['radius']:g} is what deepshade render takes by default")
    if "triangles" not in report:
        return
    print(f"  triangles  {report['triangles']:,}")
    objects = sorted(report["objects"], key=lambda item: -item["triangles"])
    print(f"  objects    {len(objects)}")
    for item in objects[:SHOWN]:
        print(f"    {item['triangles']:>9,}  {_safe(item['name'])}")
    if len(objects) > SHOWN:
        print(f"               and {len(objects) - SHOWN} smaller ones")
    print(
        f"  materials  {len(report['materials'])} of one colour, {len(report['textures'])} textured"
    )
    for item in sorted(report["materials"], key=lambda item: -item["triangles"])[:SHOWN]:
        diffuse, specular = (
            " ".join(f"{x:.2f}" for x in item[key]) for key in ("diffuse", "specular")
        )
        print(
            f"    {item['triangles']:>9,}  diffuse {diffuse}, specular {specular}, "
            f"gloss {item['gloss']:g}"
        )
    for item in sorted(report["textures"], key=lambda item: -item["triangles"])[:SHOWN]:
        mean = " ".join(f"{x:.2f}" for x in item["mean"])
        print(
            f"    {item['triangles']:>9,}  {item['width']} x {item['height']} texels, mean {mean}"
        )
    for note in report["notes"]:
        print(f"  warning: {_safe(note)}")


def _safe(text: str) -> str:
    """Text from a file: no control characters for the terminal to obey."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
