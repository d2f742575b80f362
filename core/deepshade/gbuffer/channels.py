"""Which channels of which files hold which quantity: names, profiles, explicit mappings."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from deepshade.errors import AmbiguousChannelError, ConfigError, MissingAttributeError
from deepshade.exr import Header, Part
from deepshade.gbuffer import views
from deepshade.gbuffer.profiles import PROFILES, QUANTITIES, Profile, Source, match_rank
from deepshade.gbuffer.views import Views

_WORDS = {"red": "r", "green": "g", "blue": "b", "alpha": "a"}
_COMPONENTS = {letter: letter for letter in "xyzwrgbauvt"} | _WORDS
# which components may stand for one, two or three values, best first
_SETS = {3: ("xyz", "rgb"), 2: ("uv", "xy", "rg"), 1: ("v", "z", "t", "y", "r", "x", "a")}


@dataclass(slots=True)
class Layer:
    """Channels of one file and part that belong together: component -> qualified names.

    `unique` is the layer's name as shown to people and accepted in a mapping.
    """

    file: int
    name: str
    part: int = 0
    from_stem: bool = False
    components: dict[str, list[str]] = field(default_factory=dict)

    @property
    def channels(self) -> list[str]:
        """All its channels' qualified names."""
        return [name for names in self.components.values() for name in names]

    def pick(self, quantity: str, components: str = "") -> tuple[str, ...] | None:
        """The channels that hold `quantity`, in order; None if the layer can't hold it.

        Raises AmbiguousChannelError when several sets of channels could.
        """
        count = QUANTITIES[quantity]
        if count == 1 and len(self.channels) == 1:
            return (self.channels[0],)
        complete = [
            letters
            for letters in ((components,) if components else _SETS[count])
            if all(letter in self.components for letter in letters)
        ]
        if not complete:
            return None
        doubled = [c for c in complete[0] if len(self.components[c]) > 1]
        if doubled or (count == 3 and len(complete) > 1):
            listed = ",".join(self.components[letter][0] for letter in complete[0])
            fix = f"name its channels: --map {quantity}={listed}"
            raise AmbiguousChannelError(quantity, self.channels, fix=fix)
        return tuple(self.components[letter][0] for letter in complete[0])


@dataclass(frozen=True, slots=True)
class Choice:
    """The channels found for a quantity, and the profile whose conventions they follow."""

    quantity: str
    file: int
    channels: tuple[str, ...]
    signs: tuple[int, ...] = ()
    profile: str = ""
    per_frame: bool = False

    def __str__(self) -> str:
        names = ", ".join(self.channels)
        return f"{names} ({self.profile})" if self.profile not in ("", "deepshade") else names


def parse_mapping(pairs: Iterable[str]) -> dict[str, str]:
    """`["normal=Nn", …]`, as `--map` takes it, as a mapping. Raises ConfigError."""
    mapping: dict[str, str] = {}
    for pair in pairs:
        name, equals, target = (piece.strip() for piece in pair.partition("="))
        if not (name and equals and target):
            raise ConfigError(pair, detail=f"'{pair:.100}' is no attribute=channel pair")
        if name in mapping:
            raise ConfigError(name, detail=f"'{name:.100}' is mapped twice")
        mapping[name] = target
    return mapping


def layers(
    headers: Sequence[Header], stems: Sequence[str], view: Views | None = None
) -> list[Layer]:
    """Groups the channels of each file, or of one `view` in them, into layers.

    `stems` are the file names ("" if none).
    """
    view = view or Views()
    found: dict[tuple[int, int, str], Layer] = {}
    for file, (header, stem) in enumerate(zip(headers, stems, strict=True)):
        mine: list[tuple[str, int, str]] = []  # of the view: qualified name, part, name in it
        for qualified, (at, channel) in header.channels().items():
            part = header.parts[at]
            if views.holds(view, channel, part):
                mine.append(
                    (qualified, at, views.split(channel, part)[1] if view.read else channel)
                )
        bare = [
            {name.lower() for _, at, name in mine if at == part and "." not in name}
            for part in range(len(header.parts))
        ]
        for qualified, at, channel in mine:
            layer, component = _split(channel, bare[at])
            key = (file, at, layer)
            if key not in found:
                part = header.parts[at]
                name = layer or (_part_name(part, view) if len(header.parts) > 1 else "")
                found[key] = Layer(file, name, at)
            found[key].components.setdefault(component, []).append(qualified)
        own = [layer for (at, _, _), layer in found.items() if at == file and layer.name != "A"]
        # a file that holds one nameless layer, or grey, is about what its own name says
        if len(own) == 1 and own[0].name in ("", "Y", "V", "L") and stem:
            own[0].name, own[0].from_stem = stem, True
    return list(found.values())


def _part_name(part: Part, view: Views) -> str:
    """A part's name, which stands for its nameless layer, without the view's."""
    name = re.sub(rf"[._ ]?{re.escape(view.read)}$", "", part.name) if view.read else ""
    return name or part.name


def choose(
    layers: Sequence[Layer],
    wanted: Iterable[str],
    profile: Profile | None,
    mapping: Mapping[str, str],
) -> tuple[dict[str, Choice], dict[str, AmbiguousChannelError]]:
    """Finds each wanted quantity: (found, ambiguous); what is in neither isn't there.

    An explicit mapping wins. With a `profile` only its names count besides deepshade's own;
    without, all renderers with fixed names are tried, and a tie between conventions that would
    read the values differently is ambiguous. Raises ConfigError for a mapping of an unknown
    quantity, MissingAttributeError for one to a channel that isn't there.
    """
    found: dict[str, Choice] = {}
    ambiguous: dict[str, AmbiguousChannelError] = {}
    for quantity, target in mapping.items():
        if quantity not in QUANTITIES:
            raise ConfigError(quantity, QUANTITIES, detail=f"no attribute is called '{quantity}'")
        found[quantity] = _mapped(layers, quantity, target, profile)
    taken = {(choice.file, name) for choice in found.values() for name in choice.channels}
    free = [
        layer for layer in layers if not any((layer.file, name) in taken for name in layer.channels)
    ]
    readings = [_read_as(layer, profile) for layer in free]
    for quantity in wanted:
        if quantity in found:
            continue
        try:
            choice = _search(free, readings, quantity)
        except AmbiguousChannelError as error:
            ambiguous[quantity] = error
        else:
            if choice:
                found[quantity] = choice
    return found, ambiguous


def _split(channel: str, bare: set[str]) -> tuple[str, str]:
    """(layer, component) of a channel; `bare` are the part's dotless names, lower case."""
    layer, dot, last = channel.rpartition(".")
    component = _COMPONENTS.get(last.lower(), "")
    if dot:
        return (layer, component) if component else (channel, "")
    if component in ("r", "g", "b"):
        return "", component
    for together in ("xyz", "uv", "xy"):
        # X Y Z are a vector; a lone Z beside R G B is the depth
        if component in together and set(together) <= bare:
            return "", component
    return channel, ""


def _read_as(layer: Layer, profile: Profile | None) -> tuple[int, list[tuple[Profile, Source]]]:
    """What a layer's name says it is: (tier, readings of the best tier, one for each profile).

    With a profile: its own names (0), then deepshade's (1). Without: deepshade's canonical names,
    also in file names (0), then names in the right case (1), then in any case (2).
    """
    canonical = PROFILES["deepshade"]
    if profile is None:
        profiles = [p for p in PROFILES.values() if not p.free_names]
    else:
        profiles = list(dict.fromkeys((profile, canonical)))
    best: dict[tuple[int, str], tuple[int, Profile, Source]] = {}
    for p in profiles:
        for source in p.sources:
            for alias in source.layers:
                rank = match_rank(layer.name, alias, from_stem=layer.from_stem)
                if rank is None:
                    continue
                if profile is not None:
                    tier = 0 if p is profile else 1
                elif p is canonical and (rank == 0 or layer.from_stem):
                    tier = 0
                else:
                    tier = 1 if rank < 2 else 2
                length, *_ = best.get((tier, p.name), (0,))
                if len(alias) > length:  # "normal_world" rather than "world"
                    best[tier, p.name] = len(alias), p, source
    if not best:
        return 9, []
    lowest = min(tier for tier, _ in best)
    return lowest, [(p, s) for (tier, _), (_, p, s) in best.items() if tier == lowest]


def _search(
    layers: Sequence[Layer],
    readings: Sequence[tuple[int, list[tuple[Profile, Source]]]],
    quantity: str,
) -> Choice | None:
    found: list[tuple[int, Layer, Choice]] = []
    for layer, (rank, options) in zip(layers, readings, strict=True):
        for p, source in options:
            if source.quantity != quantity:
                continue
            channels = layer.pick(quantity, source.components)
            if channels is None:
                continue
            rivals = {(s.quantity, s.signs, s.components) for _, s in options if _fits(layer, s)}
            if len(rivals) > 1:
                raise AmbiguousChannelError(
                    quantity,
                    [f"{', '.join(channels)} as {q.name} writes {s.quantity}" for q, s in options],
                    fix="say what it is: "
                    + " or ".join(
                        f"--map {q}={layer.name}" for q in {s.quantity: 0 for _, s in options}
                    )
                    if len({s.quantity for _, s in options}) > 1
                    else "say by whom: " + " or ".join(f"--profile {q.name}" for q, _ in options),
                )
            choice = Choice(quantity, layer.file, channels, source.signs, p.name, source.per_frame)
            found.append((rank, layer, choice))
            break
    if not found:
        return None
    best = min(rank for rank, _, _ in found)
    equals = [(layer, choice) for rank, layer, choice in found if rank == best]
    if len(equals) > 1:
        same = len({layer.name for layer, _ in equals}) < len(equals)
        names = [choice.channels[0] if same else layer.name for layer, choice in equals]
        raise AmbiguousChannelError(quantity, names)
    return equals[0][1]


def _fits(layer: Layer, source: Source) -> bool:
    return layer.pick(source.quantity, source.components) is not None


def _mapped(layers: Sequence[Layer], quantity: str, target: str, profile: Profile | None) -> Choice:
    names = [name.strip() for name in target.split(",")]
    holders: list[tuple[Layer, tuple[str, ...]]] = []
    if len(names) == QUANTITIES[quantity]:  # listed one by one, from whatever layers of a file
        for file in sorted({layer.file for layer in layers}):
            mine = [layer for layer in layers if layer.file == file]
            known_here = {name.lower(): (name, layer) for layer in mine for name in layer.channels}
            if all(name.lower() in known_here for name in names):
                picked = [known_here[name.lower()] for name in names]
                holders.append((picked[0][1], tuple(name for name, _ in picked)))
    for layer in layers if not holders and len(names) == 1 else ():
        if layer.name.lower() == target.lower():
            channels = layer.pick(quantity)
            if channels is not None:
                holders.append((layer, channels))
    if not holders and len(names) == 1:  # one component names its layer
        for layer in layers:
            channels = layer.pick(quantity)
            if channels is not None and target.lower() in [c.lower() for c in layer.channels]:
                holders.append((layer, channels))
    if not holders:
        found = [name for layer in layers for name in layer.channels]
        known = {layer.name for layer in layers if layer.name} | set(found)
        near = tuple(difflib.get_close_matches(target, known, 3, 0.5))
        why = f"there is no '{target}' with {QUANTITIES[quantity]} channels"
        raise MissingAttributeError([quantity], found, {quantity: near}, why={quantity: why})
    if len(holders) > 1:
        raise AmbiguousChannelError(quantity, [", ".join(channels) for _, channels in holders])
    layer, channels = holders[0]
    signs: tuple[int, ...] = ()
    if profile is not None:  # the profile knows this layer: keep its signs
        for source in profile.sources:
            if source.quantity == quantity and any(
                match_rank(layer.name, alias) is not None for alias in source.layers
            ):
                signs = source.signs
    return Choice(quantity, layer.file, channels, signs, profile.name if profile and signs else "")
