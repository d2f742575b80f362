"""Which of a file's names look as if they were meant for what is missing."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence

from deepshade.attributes import ATTRIBUTES
from deepshade.gbuffer.channels import Layer
from deepshade.gbuffer.profiles import PROFILES

# Names come from strangers: what is compared for a hint is bounded, whatever a file holds.
MAX_NAME = 64
MAX_WORDS_OF_A_NAME = 8
MAX_WORDS = 1024
MIN_RATIO = 0.6  # difflib's ratio


def near_misses(layers: Sequence[Layer], attributes: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """For each attribute the names of layers and channels that look as if they were meant for it.

    At most three, best first. Long names and very many names are compared in part.
    """
    words = {name: _words_for(name) for name in attributes}
    scores: dict[str, dict[str, float]] = {}  # word of a layer's name -> attribute -> closeness
    best: dict[str, dict[str, float]] = {name: {} for name in attributes}
    for layer in layers:
        label = layer.name or (layer.channels[0] if len(layer.channels) == 1 else "")
        name = label[:MAX_NAME].lower()
        pieces = [piece for piece in re.split(r"[._:/\-\s]+", name) if piece]
        for piece in dict.fromkeys((name, *pieces[-MAX_WORDS_OF_A_NAME:])):
            if piece not in scores and len(scores) < MAX_WORDS:
                scores[piece] = _closeness(piece, words)
            for attribute, score in scores.get(piece, {}).items():
                best[attribute][label] = max(score, best[attribute].get(label, 0.0))
    return {
        attribute: tuple(sorted(scored, key=lambda name: -scored[name])[:3])
        for attribute, scored in best.items()
    }


def _words_for(attribute: str) -> set[str]:
    """What an attribute is called: by us, and by the renderers that we know."""
    aliases = {attribute, *ATTRIBUTES[attribute].channels} if attribute in ATTRIBUTES else set()
    for p in PROFILES.values():
        for source in p.sources:
            if source.quantity.split("_world")[0] == attribute.split("_world")[0]:
                aliases |= set(source.layers)
    return {alias.lower() for alias in aliases if len(alias) > 2}


def _closeness(piece: str, words: Mapping[str, Iterable[str]]) -> dict[str, float]:
    """How close `piece` comes to the words of each attribute, for those that it comes close to."""
    if not piece:
        return {}
    found: dict[str, float] = {}
    matcher = difflib.SequenceMatcher(None)
    matcher.set_seq2(piece)  # the one that it prepares for
    for attribute, mine in words.items():
        for word in mine:
            matcher.set_seq1(word)
            least = max(MIN_RATIO, found.get(attribute, 0.0))
            # upper bounds first: nearly all words fail them
            if matcher.real_quick_ratio() >= least and matcher.quick_ratio() >= least:
                ratio = matcher.ratio()
                if ratio >= least:
                    found[attribute] = ratio
    return found
