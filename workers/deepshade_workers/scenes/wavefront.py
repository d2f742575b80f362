"""OBJ files with their material libraries (Wavefront's MTL, as at paulbourke.net/dataformats/mtl).

trimesh reads the geometry; materials are read here, for it leaves out most of what they say, and
is silent about files that are missing.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from deepshade_workers.scenes.bitmap import CLAMP, REPEAT, WHITE, Picture, Surface, roughness_of
from deepshade_workers.scenes.gltf_material import HALF, MISSING
from deepshade_workers.scenes.resources import Resources

# Options of texture statements and how many values follow each, at most.
OPTIONS = {"-s": 3, "-o": 3, "-t": 3, "-mm": 2}
SHINY = ["2", "3", "4", "5", "6", "7", "8", "9"]  # of `illum`: the models that have highlights


class Names:
    """What trimesh asks for as an OBJ's material library: names alone, so that meshes keep them."""

    def __init__(self, names: Sequence[str]) -> None:
        self.text = "\n".join(f"newmtl {name}\nKd 1 1 1" for name in names)

    def get(self, name: str) -> bytes:
        """The library, whatever its name."""
        return self.text.encode()

    __getitem__ = get


def load_obj(path: Path, resources: Resources) -> tuple[Any, dict[str, Surface]]:
    """trimesh's scene of an OBJ, and the surfaces of its materials by name."""
    import trimesh

    text = path.read_bytes().decode("utf-8", "replace")
    used = [name.strip() for name in re.findall(r"(?m)^[ \t]*usemtl[ \t]+(.+)$", text)]
    used = list(dict.fromkeys(used))
    surfaces: dict[str, Surface] = {}
    listed = opened = False
    for line in re.findall(r"(?m)^[ \t]*mtllib[ \t]+(.+)$", text):
        for name in _libraries(line.strip(), path.parent):
            listed = True
            try:
                data = resources.read(name).decode("utf-8", "replace")
            except (OSError, ValueError):
                resources.note(f"its material library {name} is missing: all of it is grey")
                continue
            opened = True
            surfaces |= read_mtl(data, resources, used)
    unknown = [name for name in used if name not in surfaces]
    if unknown and not listed:
        resources.note("it names materials but no material library: they are grey")
    elif unknown and opened:
        resources.note(f"its material {unknown[0]} is in no library: it is grey")
    if not listed:
        text = f"mtllib none\n{text}"  # else trimesh forgets which material is where
    library: Any = Names(used)
    loaded = trimesh.load_scene(
        io.BytesIO(text.encode()), file_type="obj", resolver=library, process=False
    )
    return loaded, surfaces


def read_mtl(text: str, resources: Resources, used: Sequence[str]) -> dict[str, Surface]:
    """Surfaces of those materials of a library that are `used`, by name.

    Kd and map_Kd are the base colour, Ks and Ns reflectance and exponent of the highlight where
    `illum` has one, d (or 1 - Tr) the opacity, times map_d: its alpha, or without one its grey,
    unless it is map_Kd's own file, whose alpha counts anyway. Where Kd and Ks sum to more than 1
    Ks is what Kd leaves: no surface reflects more light than it gets.
    """
    found: dict[str, dict[str, str]] = {}
    terms: dict[str, str] = {}
    for line in text.splitlines():
        # "#" within a word is of a name, such as "Material #25"; between may stand tabs
        key, *rest = re.split(r"(?:^|\s)#(?:\s|$)", line)[0].split(None, 1)[:2] or [""]
        if key.lower() == "newmtl":
            terms = found.setdefault("".join(rest).strip(), {})
        elif rest:
            terms[key.lower()] = rest[0].strip()
    return {name: _surface(found[name], resources) for name in used if name in found}


def _surface(terms: Mapping[str, str], resources: Resources) -> Surface:
    named = terms.get("map_kd")
    picture, wrap = None, (REPEAT, REPEAT)
    if named is not None:
        options, file = _texture(named)
        picture = resources.picture(file)
        if options.get("-clamp") == "on":
            wrap = (CLAMP, CLAMP)
    base = _colour(terms.get("kd"), WHITE if picture else MISSING)
    shape = _texture(terms.get("map_d", ""))[1]
    if shape and shape != _texture(named or "")[1] and (mask := resources.picture(shape)):
        picture = _masked(picture, mask)
    specular = _colour(terms.get("ks"), (0.0, 0.0, 0.0))
    if terms.get("illum", "2") not in SHINY:
        specular = (0.0, 0.0, 0.0)
    r, g, b = (min(shine, 1 - main) for shine, main in zip(specular, base, strict=True))
    alpha = _number(terms.get("d"), 1 - _number(terms.get("tr"), 0))
    return Surface(
        base=base,
        base_picture=picture,
        roughness=roughness_of(_number(terms.get("ns"), 16)),
        specular=(r, g, b),
        alpha=min(max(alpha, 0), 1),
        cutoff=HALF if alpha < 1 or "map_d" in terms else None,
        wrap=wrap,
    )


def _masked(picture: Picture | None, mask: Picture) -> Picture:
    """The picture, or white, with the alpha of the mask, which without one is its grey."""
    from PIL import Image

    image = mask.image()
    alpha = image.getchannel("A")
    if alpha.getextrema() == (255, 255):
        alpha = image.convert("L")
    found = picture.image().copy() if picture else Image.new("RGBA", image.size, "white")
    found.putalpha(alpha.resize(found.size))
    return Picture.of(found)


def _libraries(line: str, folder: Path) -> list[str]:
    """The files of an mtllib line: one whose name has blanks, or several."""
    return [line] if (folder / line).is_file() else line.split()


def _texture(text: str) -> tuple[dict[str, str], str]:
    """The options of a texture statement and its file's name, which may hold blanks."""
    words = text.split()
    options: dict[str, str] = {}
    while len(words) > 1 and words[0].startswith("-"):
        key = words.pop(0)
        options[key] = words.pop(0)
        for _ in range(OPTIONS.get(key, 1) - 1):
            if len(words) > 1 and re.fullmatch(r"[-+.\deE]+", words[0]):
                words.pop(0)
    return options, " ".join(words)


def _colour(text: str | None, default: tuple[float, float, float]) -> tuple[float, float, float]:
    """Values in [0, 1]; one stands for three. Spectra and CIE XYZ give the default."""
    try:
        values = [min(max(float(word), 0.0), 1.0) for word in (text or "").split()]
    except ValueError:
        return default
    if len(values) == 1:
        values *= 3
    return (values[0], values[1], values[2]) if len(values) >= 3 else default


def _number(text: str | None, default: float) -> float:
    try:
        return float((text or "").split()[-1])
    except (ValueError, IndexError):
        return default
