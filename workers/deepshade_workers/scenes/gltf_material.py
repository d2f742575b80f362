"""Materials of glTF files, with the defaults of the specification (section 5.22 and extensions)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from deepshade_workers.scenes.bitmap import (
    CLAMP,
    DIELECTRIC,
    MIRROR,
    REPEAT,
    WHITE,
    Picture,
    Surface,
)
from deepshade_workers.scenes.gltf_document import Document
from deepshade_workers.scenes.mesh import Floats

WRAPS = {10497: REPEAT, 33648: MIRROR, 33071: CLAMP}
NEAREST = 9728
# What lets more than half of the light through is taken for absent: a pixel has one surface.
HALF = 0.5
MISSING = (0.7, 0.7, 0.7)


@dataclass(frozen=True)
class Texturing:
    """A surface, the vertices' set of texture coordinates that it uses, and their transform (2, 3).

    `surface` None: the file says nothing.
    """

    surface: Surface | None
    uv_set: int = 0
    transform: Floats = field(default_factory=lambda: np.eye(2, 3))


def surface_of(source: Document, material: Mapping[str, Any]) -> Texturing:
    """What `material` says; pictures that can't be had are noted and left out."""
    extensions = material.get("extensions", {})
    if gloss := extensions.get("KHR_materials_pbrSpecularGlossiness"):
        main, shine = gloss.get("diffuseTexture"), gloss.get("specularGlossinessTexture")
        factor = gloss.get("diffuseFactor", (1, 1, 1, 1))
        terms: dict[str, Any] = {
            "specular": _colour(gloss.get("specularFactor", WHITE)),
            "roughness": 1 - _unit(gloss.get("glossinessFactor", 1)),
            "specular_picture": _picture(source, shine),
            "conserving": True,
        }
        other = shine
    else:
        rough = material.get("pbrMetallicRoughness", {})
        main, other = rough.get("baseColorTexture"), rough.get("metallicRoughnessTexture")
        factor = rough.get("baseColorFactor", (1, 1, 1, 1))
        terms = {
            "metallic": _unit(rough.get("metallicFactor", 1)),
            "roughness": _unit(rough.get("roughnessFactor", 1)),
            "metal_rough": _picture(source, other),
            "specular": _dielectric(extensions),
        }
    if "KHR_materials_unlit" in extensions:
        terms |= {"metallic": 0.0, "specular": (0.0, 0.0, 0.0), "metal_rough": None}
    picture = _picture(source, main)
    base = _colour(factor[:3])
    if main is not None and picture is None and base == WHITE:
        base = MISSING  # white for what has a colour that we don't know would be too bright
    sampler = _sampler(source, main or other)
    surface = Surface(
        base=base,
        base_picture=picture,
        alpha=_opacity(factor, extensions),
        cutoff=_cutoff(material, extensions),
        wrap=(WRAPS[sampler.get("wrapS", 10497)], WRAPS[sampler.get("wrapT", 10497)]),
        nearest=sampler.get("magFilter") == NEAREST,
        **terms,
    )
    uv_set, transform = _placement(main or other)
    if main and other:
        second, turned = _placement(other)
        if second != uv_set or (turned != transform).any():
            source.resources.note(
                f"material {material.get('name', '')!r} lays its textures by different "
                "coordinates; all are laid by those of its base colour"
            )
    return Texturing(surface, uv_set, transform)


def _dielectric(extensions: Mapping[str, Any]) -> tuple[float, float, float]:
    """Reflectance straight on of what is no metal (KHR_materials_ior, KHR_materials_specular)."""
    found = DIELECTRIC
    if "KHR_materials_ior" in extensions:
        ior = float(extensions["KHR_materials_ior"].get("ior", 1.5))
        found = ((ior - 1) / (ior + 1)) ** 2 if ior > 0 else 1.0
    specular = extensions.get("KHR_materials_specular", {})
    found *= _unit(specular.get("specularFactor", 1))
    r, g, b = specular.get("specularColorFactor", WHITE)
    return min(found * r, 1.0), min(found * g, 1.0), min(found * b, 1.0)


def _opacity(factor: Any, extensions: Mapping[str, Any]) -> float:
    alpha = _unit(factor[3]) if len(factor) > 3 else 1.0
    transmission = extensions.get("KHR_materials_transmission", {})
    return alpha * (1 - _unit(transmission.get("transmissionFactor", 0)))


def _cutoff(material: Mapping[str, Any], extensions: Mapping[str, Any]) -> float | None:
    mode = material.get("alphaMode", "OPAQUE")
    if mode == "MASK":
        return float(material.get("alphaCutoff", HALF))
    through = "KHR_materials_transmission" in extensions
    return HALF if mode == "BLEND" or through else None


def _picture(source: Document, info: Mapping[str, Any] | None) -> Picture | None:
    """The image of a texture, WebP ones too; None where there is none or it can't be had."""
    if info is None:
        return None
    texture = source.json["textures"][info["index"]]
    extensions = texture.get("extensions", {})
    index = texture.get("source")
    if "EXT_texture_webp" in extensions:
        index = extensions["EXT_texture_webp"]["source"]
    if index is None:
        source.resources.note(f"a texture can't be read: {', '.join(extensions) or 'no source'}")
        return None
    image = source.json["images"][index]
    if "uri" in image:
        return source.resources.picture(image["uri"])
    data, _ = source.view(image["bufferView"])
    return source.resources.checked(image.get("name") or f"image {index}", data)


def _sampler(source: Document, info: Mapping[str, Any] | None) -> Mapping[str, Any]:
    texture = source.json["textures"][info["index"]] if info else {}
    found: Mapping[str, Any] = {}
    if "sampler" in texture:
        found = source.json["samplers"][texture["sampler"]]
    return found


def _placement(info: Mapping[str, Any] | None) -> tuple[int, Floats]:
    """The set of coordinates, and KHR_texture_transform's matrix."""
    if info is None:
        return 0, np.eye(2, 3)
    change = info.get("extensions", {}).get("KHR_texture_transform", {})
    x, y = change.get("scale", (1, 1))
    angle = change.get("rotation", 0)
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.array([[cosine, sine], [-sine, cosine]]) * (x, y)
    matrix = np.concatenate([turn, np.reshape(change.get("offset", (0, 0)), (2, 1))], 1)
    return int(change.get("texCoord", info.get("texCoord", 0))), matrix


def _unit(value: Any) -> float:
    return float(np.clip(value, 0, 1))


def _colour(values: Any) -> tuple[float, float, float]:
    r, g, b = (_unit(value) for value in values)
    return r, g, b
