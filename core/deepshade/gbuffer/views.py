"""The views of stereo and multi-part files: which channels belong to which, and which is read.

A single-part file lists its views in `multiView`, the default one first; the others' names stand
before a channel's last component ("depth.right.Z", as OpenEXR has it, and Blender for all views)
or first ("right.depth.Z", as Nuke does). Parts of a multi-part file say `view`.
(openexr.com/en/latest/MultiViewOpenEXR.html)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from deepshade.errors import ConfigError, nearest
from deepshade.exr import Header, Part

STEREO = ("left", "right")  # which are views even where nothing says so


@dataclass(frozen=True, slots=True)
class Views:
    """The `names` of the views that files hold, and the one that is `read`; "" for all there is.

    `default` says that nobody asked for it.
    """

    names: tuple[str, ...] = ()
    read: str = ""
    default: bool = True

    @property
    def note(self) -> str:
        """What to say of it; "" where there is no other."""
        others = [name for name in self.names if name != self.read]
        if not (self.read and others):
            return ""
        return f"'{self.read}'; also here: {', '.join(others)}"


def split(channel: str, part: Part) -> tuple[str, str]:
    """(the view that a channel of `part` says it is of, its name without that); "" for none."""
    *layers, last = channel.split(".")
    known = {name.lower(): name for name in (*STEREO, *listed(part))}
    for at in dict.fromkeys((len(layers) - 1, 0)):
        if 0 <= at < len(layers) and layers[at].lower() in known:
            return known[layers[at].lower()], ".".join([*layers[:at], *layers[at + 1 :], last])
    return "", channel


def listed(part: Part) -> tuple[str, ...]:
    """The views that a part's header names, the default one first."""
    many = part.attributes.get("multiView")
    if isinstance(many, list):
        return tuple(str(name) for name in many)
    one = part.attributes.get("view")
    return (one,) if isinstance(one, str) and one else ()


def of(channel: str, part: Part) -> str:
    """The view that a channel is of; "" where it may be any."""
    said, _ = split(channel, part)
    return said or next(iter(listed(part)), "")


def choose(headers: Sequence[Header], asked: str | None) -> Views:
    """The views of these files, and the one to read: as `asked`, else the default one.

    A part's name will do for a view. Raises ConfigError for a view that isn't there.
    """
    parts = [part for header in headers for part in header.parts]
    said = [name for part in parts for name in listed(part)]
    found = [view for part in parts for name in part.channels if (view := split(name, part)[0])]
    names = tuple(dict.fromkeys(said + found))
    if asked is not None:
        known = {name.lower(): name for name in (*(part.name for part in parts), *names) if name}
        if asked.lower() not in known:
            there = list(known.values())
            raise ConfigError(
                asked,
                detail=f"there is no view '{asked:.60}' here, only {', '.join(there):.200}"
                if there
                else f"there is no view '{asked:.60}' here, nor any other",
                fix=f"read one that is there: --view {nearest(asked, there) or there[0]}"
                if there
                else "leave out --view",
            )
        return Views(names, known[asked.lower()], default=False)
    if len(names) < 2:
        return Views(names, names[0] if names else "")
    # the first of a list is the default one; of parts, only of a pair of eyes is it known
    if any(isinstance(part.attributes.get("multiView"), list) for part in parts):
        return Views(names, names[0])
    return Views(names, STEREO[0]) if set(said) == set(STEREO) else Views(names)


def holds(views: Views, channel: str, part: Part) -> bool:
    """Whether a channel belongs to the view that is read."""
    if not views.read:
        return True
    if views.read in views.names:
        return of(channel, part) in ("", views.read)
    return part.name == views.read
