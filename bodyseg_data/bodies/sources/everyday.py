"""The source `everyday`: people for training whose hands, forearms, soles and shins touch their own body or the floor.

Networks trained on `open` and `wide` fail where limbs meet the body (docs/failures.md). Each of these people holds
another pose, drawn by `bodyseg_data.bodies.contacts.sampler`: a stance, then each limb sent to a place. Everything is
drawn from the body's name. The angles come from a search on the person's own skin, so a pose takes a while to draw and
is drawn when its body is built, not when bodies are listed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from functools import cached_property, partial
from typing import Final

from bodyseg_data.bodies.anny.model import Figure
from bodyseg_data.bodies.anny.people import SUBJECT_A, person
from bodyseg_data.bodies.clothes.outfits import drawn_outfit
from bodyseg_data.bodies.contacts.places import Places
from bodyseg_data.bodies.contacts.sampler import Drawn, Sampler
from bodyseg_data.bodies.contacts.stances import STANCES
from bodyseg_data.bodies.source import BodyRef
from bodyseg_data.bodies.sources.open_bodies import MadeBodies, Maker
from bodyseg_data.core.randomness import generator

EVERYDAY: Final = 1040

POSES_VERSION: Final = 1
"""Raised whenever a change of the sampler changes a pose, so that packed sets are told from each other."""

_FIRST_PERSON: Final = 3000  # beyond those of the other sets

_DRESSED: Final = 0.4
_ON_CLOTHES: Final = tuple(
    f"on {place}"
    for place in (
        "chest", "belly", "waist", "lower back", "upper back", "shoulder", "upper arm", "elbow", "forearm", "hip",
        "buttock", "thigh", "knee", "shin", "calf",
    )
)  # fmt: skip


class EverydayBodies(MadeBodies):
    """Subset "everyday": 1 040 people, all for training, each in another pose; stances take turns."""

    def __init__(self) -> None:
        super().__init__("everyday", dict(self._listed()))
        self._latest: tuple[BodyRef, Drawn] | None = None

    def drawn(self, body: BodyRef) -> Drawn:
        """Draw the pose of one of `bodies()`, with how it was found. Raises BadConfig for a body of another source."""
        self.entry(body)
        if self._latest is None or self._latest[0] != body:
            index = int(body.subject[1:])
            draws = generator(0, 0, f"everyday/{body.mesh}", "pose")
            sampler = Sampler(self.model.posable(person(_FIRST_PERSON + index)), self._places)
            self._latest = body, sampler.draw(body.pose, draws)
        return self._latest[1]

    @cached_property
    def _places(self) -> Places:
        return Places(self.model.posable(SUBJECT_A))

    def fingerprint(self, bodies: Sequence[BodyRef]) -> str:
        """Return a digest of the bodies' names and of all that shapes them. Draws no pose. Raises MissingLibrary."""
        names = [(body.mesh, body.pose) for body in bodies]
        return hashlib.sha256(repr((self.shaping(), POSES_VERSION, names)).encode()).hexdigest()

    def _listed(self) -> Iterator[tuple[BodyRef, Maker]]:
        for index in range(EVERYDAY):
            stance = [*STANCES][index % len(STANCES)]
            ref = BodyRef("everyday", f"E{index:04d}", f"everyday-{index:04d}", stance, "train")
            yield ref, partial(self._figure, ref, index)

    def _figure(self, body: BodyRef, index: int) -> Figure:
        drawn = self.drawn(body)
        draws = generator(0, 0, f"everyday/{body.mesh}", "clothes")
        dressed = draws.random() < _DRESSED
        # A hand on the body would be hidden in loose cloth, which does not know of it.
        close = any(contact.endswith(_ON_CLOTHES) for contact in drawn.contacts)
        return Figure(person(_FIRST_PERSON + index), drawn.pose, outfit=drawn_outfit(draws, close) if dressed else None)
