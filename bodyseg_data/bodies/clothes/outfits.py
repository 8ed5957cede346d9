"""Outfits: the extent, looseness and folds of each garment."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.randomness import check_seed


@dataclass(frozen=True)
class Outfit:
    """A top and trousers. Raises BadConfig for a number that is out of its range.

    sleeve: end of the sleeves, 0 shoulder to 1 wrist. hem: end of the top, 0 hip bones (ASIS) to 1 crotch.
    leg: end of the trousers, 0 crotch to 1 ankle bone.
    top_loose_m, leg_loose_m: mean distance of the cloth from the body, beyond that of a straight fall, metres.
    top_taper, sleeve_taper, leg_taper: metres by which the cloth narrows for every metre below the part that carries it
    (chest, shoulder, seat, thigh); 0 falls straight, large numbers follow the body.
    gathered: the top ends in a band at hem and wrists, and blouses above it, instead of hanging open.
    fold_m: wavelength of the folds. slack: excess length of the cloth at rest, as a share; it makes the folds of every
    pose. crumple: the same at the ends of sleeves and trousers, where cloth gathers. seed: of the fold patterns.
    """

    sleeve: float
    hem: float
    leg: float
    top_loose_m: float
    leg_loose_m: float
    top_taper: float
    sleeve_taper: float
    leg_taper: float
    gathered: bool
    fold_m: float
    slack: float
    crumple: float
    seed: int

    def __post_init__(self) -> None:
        check_seed(self.seed)
        for field in fields(self):
            value, (low, high) = getattr(self, field.name), _RANGES.get(field.name, (0, 1))
            if field.name != "seed" and not low <= value <= high:
                raise BadConfig(f"an outfit's {field.name} must be {low:g} to {high:g}, found {value!r}")


_GATHERED: Final = 0.25  # share of loose outfits with bands
_SEEDS: Final = 1_000_000

_RANGES: Final[dict[str, tuple[float, float]]] = {
    "sleeve": (0.15, 1),
    "hem": (0, 0.8),  # farther down, a top would have to join the legs
    "leg": (0.2, 1),
    "top_loose_m": (0, 0.06),
    "leg_loose_m": (0, 0.06),
    "fold_m": (0.04, 0.3),
    "slack": (0, 0.2),
    "crumple": (0, 0.4),
}

OUTFITS: Final[dict[str, Outfit]] = {
    # A loose T-shirt that hangs over wide, long trousers.
    "B": Outfit(
        sleeve=0.42, hem=0.66, leg=1.0, top_loose_m=0.014, leg_loose_m=0.012, top_taper=0.04, sleeve_taper=0.0,
        leg_taper=0.06, gathered=False, fold_m=0.075, slack=0.07, crumple=0.14, seed=2,
    ),
    # A sweatshirt with bands at hem and wrists over straight trousers.
    "C": Outfit(
        sleeve=1.0, hem=0.45, leg=0.98, top_loose_m=0.026, leg_loose_m=0.012, top_taper=0.02, sleeve_taper=0.03,
        leg_taper=0.08, gathered=True, fold_m=0.085, slack=0.08, crumple=0.1, seed=3,
    ),
    # A T-shirt and wide shorts.
    "shorts": Outfit(
        sleeve=0.36, hem=0.52, leg=0.33, top_loose_m=0.01, leg_loose_m=0.014, top_taper=0.08, sleeve_taper=0.02,
        leg_taper=0.0, gathered=False, fold_m=0.075, slack=0.06, crumple=0.05, seed=4,
    ),
    # A wide jumper that hangs open over narrow trousers.
    "jumper": Outfit(
        sleeve=0.94, hem=0.7, leg=0.97, top_loose_m=0.024, leg_loose_m=0.004, top_taper=0.0, sleeve_taper=0.02,
        leg_taper=0.3, gathered=False, fold_m=0.095, slack=0.09, crumple=0.12, seed=5,
    ),
}  # fmt: skip
"""Outfits by name. "B" and "C" are for the subjects of those names."""

_LOOSE: Final[dict[str, tuple[float, float]]] = {
    "sleeve": (0.3, 1.0), "hem": (0.4, 0.8), "leg": (0.25, 1.0), "top_loose_m": (0.01, 0.05),
    "leg_loose_m": (0.008, 0.045), "top_taper": (0.0, 0.06), "sleeve_taper": (0.0, 0.04), "leg_taper": (0.0, 0.2),
    "fold_m": (0.06, 0.16),
    "slack": (0.04, 0.12), "crumple": (0.03, 0.18),
}  # fmt: skip


_CLOSE: Final[dict[str, tuple[float, float]]] = _LOOSE | {
    "top_loose_m": (0.0, 0.004), "leg_loose_m": (0.0, 0.004), "top_taper": (0.35, 0.8), "sleeve_taper": (0.35, 0.8),
    "leg_taper": (0.35, 0.8), "slack": (0.0, 0.03), "crumple": (0.0, 0.05),
}  # fmt: skip


def drawn_outfit(draws: np.random.Generator, close: bool) -> Outfit:
    """Draw a top and trousers: loose shirts, jumpers, wide trousers, shorts; close: the same close to the body."""
    ranges = _CLOSE if close else _LOOSE
    values = {name: round(low + (high - low) * float(draws.random()), 4) for name, (low, high) in ranges.items()}
    gathered, seed = bool(draws.random() < _GATHERED), int(draws.random() * _SEEDS)
    return Outfit(**values, gathered=gathered, seed=seed)
