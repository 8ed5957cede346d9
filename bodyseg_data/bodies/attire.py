"""Attire of everyday people beyond top and trousers, drawn and put on."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.limb_reaching import Side, chosen, uniform
from bodyseg_data.bodies.outfits import Outfit
from bodyseg_data.bodies.shells import Hair, Shoes, Wearer, bun, long_hair, scalp, shoe
from bodyseg_data.bodies.skeleton import Floats
from bodyseg_data.bodies.worn import IN_HAND, Drape, Held, held_thing
from bodyseg_data.labels import LANDMARKS
from bodyseg_data.meshes import Solid, SurfacePiece


@dataclass(frozen=True)
class Attire:
    """Things that a person wears and holds over the body's own surface."""

    drape: Drape | None = None
    hair: Hair | None = None
    shoes: Shoes | None = None
    held: Held | None = None


Worn = tuple[Floats, list[tuple[Solid, tuple[int, ...]]]]
"""The body's vertices [V, 3], metres, those of the scalp moved, and the surfaces over it, each with the parts whose
labels it takes, none for a thing."""


def _parts(*endings: str) -> tuple[int, ...]:
    return tuple(label for label, name in enumerate(LANDMARKS) if name.endswith(endings))


_SIDES: Final[tuple[Side, Side]] = ("L", "R")
_HEAD: Final = _parts("Sellion", "Nuchale", "Supramenton")
_UPPER_TRUNK: Final = _parts("Suprasternale", "Bustpoint", "Substernale", "Cervicale", "Midspine", "Post.", "Acromion")
_LEGS: Final = _parts("ASIS", "PSIS", "Trochanterion", "Epicn", "Knee Crease", "Malleolus")
_UNDER_DRAPE: Final = _LEGS + _parts("Bustpoint", "Substernale", "Midspine", "Post.")
"""Parts whose labels a skirt or dress takes: not those of a hand that hangs beside it."""


_COAT_FROM: Final = 0.85  # a drape whose upper end is higher is a coat


def put_on(wearer: Wearer, attire: Attire, cloth: Solid | None) -> Worn:
    """Dress a person in a pose. cloth: of the attire's drape (`draped`)."""
    over: list[tuple[Solid, tuple[int, ...]]] = []
    if cloth is not None:
        over.append((cloth, _UNDER_DRAPE))
    points = wearer.points
    if attire.hair is not None:
        points = scalp(wearer, attire.hair)
        if attire.hair.kind == "bun":
            over.append((bun(wearer, attire.hair), _HEAD))
        else:
            over.append((long_hair(wearer, attire.hair), _HEAD + _UPPER_TRUNK))
    if attire.shoes is not None:
        over += [
            (shoe(wearer, attire.shoes, side), _parts(f"{side}t. Lateral Malleolus", f"{side}t. Digit II"))
            for side in _SIDES
        ]
    if attire.held is not None:
        over += [(thing, ()) for thing in held_thing(wearer, attire.held)]
    return points, [each for each in over if each[0].volume > 0]  # others are crumpled until they are inside out


def under(drape: Drape, outfit: Outfit) -> Outfit:
    """The top and trousers to wear under a drape: sleeves to a coat, hardly any trousers to a skirt."""
    if drape.top > _COAT_FROM:
        return replace(outfit, sleeve=max(outfit.sleeve, 0.95), gathered=False)
    return replace(outfit, leg=0.2, leg_loose_m=0.0, leg_taper=0.8, crumple=0.0, gathered=False)


def joined(
    vertices: Floats, faces: NDArray[np.int32], worn: Worn
) -> tuple[Floats, NDArray[np.int32], tuple[SurfacePiece, ...]]:
    """Join a body, [V, 3] and [F, 3], of which the points of `worn` are the first vertices, and all that is over it.

    Further vertices of the body, in the middle of its edges, move as the nearest of the first ones do.
    """
    from scipy.spatial import cKDTree

    dressed, over = worn
    own, between = np.split(vertices, [len(dressed)])
    moved = dressed - own
    if moved.any() and len(between):
        apart, near = cKDTree(own).query(between, 2)
        weights = 1 / np.maximum(apart, 1e-9)
        between = between + np.einsum("nk,nki->ni", weights / weights.sum(axis=1, keepdims=True), moved[near])
    points = [dressed, between]
    triangles, pieces, count = [faces], [], len(vertices)
    for solid, parts in over:
        pieces.append(SurfacePiece(count, parts))
        points.append(solid.vertices)
        triangles.append(solid.faces + np.int32(count))
        count += len(solid.vertices)
    return np.concatenate(points), np.concatenate(triangles), tuple(pieces)


_HEAD_PLACES: Final = ("face", "crown", "back of the head", "side of the head", "neck", "upper back", "shoulder")
_DRAPE_PLACES: Final = ("belly", "waist", "back", "hip", "buttock", "thigh", "knee", "shin", "calf", "chest")
_FREE: Final = ("in the air", "free")

_BUN, _LONG = 0.12, 0.25  # shares of people
_SKIRT, _DRESS, _COAT = 0.22, 0.14, 0.2  # of the dressed ones whose hands lie on no cloth
_OPEN: Final = 0.5  # of coats
_SHOD: Final = 0.6  # of the dressed ones
_HOLDS: Final = 0.35  # of people with a free hand
_BACKPACK: Final = 0.08  # of the dressed ones who hold nothing
_LENGTHS: Final = {(0.2, 0.38): 0.15, (0.4, 0.62): 0.45, (0.65, 0.82): 0.25, (0.88, 0.98): 0.15}
_FLARES: Final = {(0.0, 0.04): 0.3, (0.06, 0.18): 0.45, (0.18, 0.34): 0.25}
_SEEDS: Final = 1_000_000


def drawn_attire(draws: np.random.Generator, contacts: tuple[str, str], dressed: bool) -> Attire:
    """Draw a person's attire. contacts: what each hand does, left first: hair and cloth do not know of a hand on them.

    dressed: the person wears a top and trousers; others get hair and things alone.
    """
    hair, drape = _drawn_hair(draws), _drawn_drape(draws)
    shoes = Shoes(uniform(draws, 0.004, 0.009), uniform(draws, 0.006, 0.028)) if draws.random() < _SHOD else None
    free: list[Side] = [side for side, contact in zip(_SIDES, contacts, strict=True) if contact in _FREE]
    side = free[int(draws.random() * len(free))] if free else "L"
    kind, size = chosen(IN_HAND, draws), uniform(draws, 0, 1)
    holds, carries = draws.random() < _HOLDS and bool(free), draws.random() < _BACKPACK
    held = Held(kind, side, size) if holds else Held("backpack", size=size) if carries and dressed else None
    return Attire(
        drape=drape if dressed and not _touched(contacts, _DRAPE_PLACES) else None,
        hair=None if _touched(contacts, _HEAD_PLACES) else hair,
        shoes=shoes if dressed else None,
        held=held,
    )


def _touched(contacts: tuple[str, str], places: tuple[str, ...]) -> bool:
    return any(contact.endswith(places) for contact in contacts)


def _drawn_hair(draws: np.random.Generator) -> Hair | None:
    kind, values, seed = draws.random(), draws.random(3).tolist(), int(draws.random() * _SEEDS)
    if kind < _BUN:
        return Hair("bun", 0.003 + 0.008 * values[0], 0.03 + 0.028 * values[1], values[2])
    if kind < _BUN + _LONG:
        return Hair("long", 0.008 + 0.016 * values[0], 0.16 + 0.38 * values[1], values[2], seed)
    return None


def _drawn_drape(draws: np.random.Generator) -> Drape | None:
    kind, values, seed = draws.random(), draws.random(7).tolist(), int(draws.random() * _SEEDS)
    low, high = chosen(_LENGTHS, draws)
    length = low + (high - low) * values[0]
    low, high = chosen(_FLARES, draws)
    flare = low + (high - low) * values[1]
    girth = 1.15 + 0.35 * values[2] + 3 * flare
    folds = 0.07 + 0.1 * values[3], 0.004 + (0.01 + 0.06 * flare) * values[4]
    if kind < _SKIRT + _DRESS:
        top = 0.1 + 0.3 * values[5] if kind < _SKIRT else 0.45 + 0.35 * values[5]
        return Drape(top, length, 0.008 + 0.012 * values[2], flare, girth, *folds, 0, seed)
    if kind < _SKIRT + _DRESS + _COAT:
        open_deg = 8 + 20 * values[5] if values[6] < _OPEN else 0
        return Drape(0.92, length, 0.02 + 0.03 * values[2], 0.4 * flare, girth + 0.2, *folds, open_deg, seed)
    return None
