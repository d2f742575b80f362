"""What a scene file names: textures, buffers, material libraries."""

from __future__ import annotations

import base64
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote, unquote_to_bytes

from deepshade_workers.scenes.bitmap import Picture


@dataclass
class Resources:
    """Files named by the scene at `path`, and `notes` of those that can't be had."""

    path: Path
    notes: dict[str, None] = field(default_factory=dict)

    def note(self, text: str) -> None:
        """Say `text` once."""
        self.notes[f"{self.path}: {text}"] = None

    def note_transparent(self, triangles: int, opacity: float) -> None:
        """Say that so many triangles are left out."""
        self.note(
            f"{triangles:,} triangles of opacity {opacity:.2g} are left out: what lets through "
            "more than half of the light is no surface"
        )

    def read(self, uri: str) -> bytes:
        """The bytes of a data URI or of a file beside the scene.

        Raises:
            OSError: there is none.
            ValueError: it lies on the network.
        """
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            return base64.b64decode(body) if head.endswith(";base64") else unquote_to_bytes(body)
        if "://" in uri:
            raise ValueError(f"{uri} is not beside it")
        plain = uri.replace("\\", "/")
        for name in (plain, unquote(plain)):
            place = self.path.parent / name
            if place.is_file():
                return place.read_bytes()
        raise FileNotFoundError(2, "no such file", str(self.path.parent / plain))

    def picture(self, uri: str) -> Picture | None:
        """The picture `uri`, whose format is known; else None, and a note that names the file."""
        try:
            return self.checked(uri, self.read(uri))
        except (OSError, ValueError):
            self.note(f"its texture {uri[:200]} is missing")
            return None

    def checked(self, name: str, data: bytes) -> Picture | None:
        """A picture that can be decoded; else None, and a note."""
        picture = Picture(name, data)
        try:
            picture.image()
        except (OSError, ValueError, SyntaxError) as error:
            self.note(f"its texture {name[:200]} can't be read: {error}")
            return None
        return picture
