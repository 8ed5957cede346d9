"""The source `everyday`: people for training whose hands, forearms, soles and shins touch their own body or the floor.

Networks trained on `open` and `wide` fail where limbs meet the body (docs/results/failures.md). Each of these people
holds another pose, drawn by `bodyseg_data.bodies.contacts.sampler`: a stance, then each limb sent to a place.
Everything is drawn from the body's name. The angles come from a search on the person's own skin, so a pose takes a
while to draw and is drawn when its body is built, not when bodies are listed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.anny.model import Figure, standing
from bodyseg_data.bodies.anny.people import SUBJECT_A, person
from bodyseg_data.bodies.clothes.outfits import Outfit, drawn_outfit
from bodyseg_data.bodies.contacts.places import Places
from bodyseg_data.bodies.contacts.sampler import ContactSampler, DrawnContact
from bodyseg_data.bodies.contacts.stances import STANCES
from bodyseg_data.bodies.source import Body, BodyRef
from bodyseg_data.bodies.sources.open_bodies import Listed, MadeBodies
from bodyseg_data.bodies.worn.attire import Attire, drawn_attire, joined, put_on, under
from bodyseg_data.bodies.worn.drapes import draped
from bodyseg_data.bodies.worn.held import gripping
from bodyseg_data.bodies.worn.wearer import Wearer
from bodyseg_data.core.randomness import generator
from bodyseg_data.meshes.landmarks.by_vertex import load_landmarks
from bodyseg_data.meshes.mesh import Mesh

EVERYDAY: Final = 1040

POSES_VERSION: Final = 1
"""Raised whenever a change of the sampler changes a pose, so that packed sets are told from each other."""

CLOTHES_VERSION: Final = 2
"""Raised whenever what people wear or hold changes, for the same reason."""

_FIRST_PERSON: Final = 3000  # beyond those of the other sets

_DRESSED: Final = 0.5
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
        self._latest: tuple[BodyRef, DrawnContact] | None = None

    def drawn(self, body: BodyRef) -> DrawnContact:
        """Draw the pose of one of `bodies()`, with how it was found. Raises BadConfig for a body of another source."""
        self.entry(body)
        if self._latest is None or self._latest[0] != body:
            index = int(body.subject[1:])
            draws = generator(0, 0, f"everyday/{body.mesh}", "pose")
            sampler = ContactSampler(self.model.posable(person(_FIRST_PERSON + index)), self._places)
            self._latest = body, sampler.draw(body.pose, draws)
        return self._latest[1]

    @cached_property
    def _places(self) -> Places:
        return Places(self.model.posable(SUBJECT_A))

    def fingerprint(self, bodies: Sequence[BodyRef]) -> str:
        """Return a digest of the bodies' names and of all that shapes them. Draws no pose. Raises MissingLibrary."""
        names = [(body.mesh, body.pose) for body in bodies]
        return hashlib.sha256(repr((self.shaping(), POSES_VERSION, CLOTHES_VERSION, names)).encode()).hexdigest()

    def _listed(self) -> Listed:
        for index in range(EVERYDAY):
            stance = [*STANCES][index % len(STANCES)]
            ref = BodyRef("everyday", f"E{index:04d}", f"everyday-{index:04d}", stance, "train")
            yield ref, partial(self._figure, ref, index)

    def build(self, body: BodyRef, dressed: bool = True) -> Body:
        """Build a body as `MadeBodies.build` does, with what it wears and holds over its surface as further pieces.

        Someone whose pose leaves too little of a skirt or coat (`draped`) wears trousers instead. dressed: False takes
        off all of it. Same errors.
        """
        attire = self.attire(body)
        if not dressed or attire == Attire():
            return super().build(body, dressed)
        figure = self.figure(body)
        wearer, vertices, faces = self._wearer(figure)
        cloth = None if attire.drape is None else draped(wearer, attire.drape)
        if attire.drape is not None and cloth is None:
            wearer, vertices, faces = self._wearer(replace(figure, outfit=self._outfit(body)))
        vertices, faces, pieces = joined(vertices, faces, put_on(wearer, attire, cloth))
        landmarks = np.array(load_landmarks("open").vertices, np.int64)
        return Body(Mesh(body.mesh, standing(vertices), faces), landmarks, pieces=pieces)

    def _wearer(self, figure: Figure) -> tuple[Wearer, NDArray[np.float64], NDArray[np.int32]]:
        vertices, faces = self.model.surface(figure, dressed=True)
        person = self.model.posable(figure.who)
        return Wearer(person, vertices[: len(person.modelled)], self._places), vertices, faces

    def attire(self, body: BodyRef) -> Attire:
        """Return what one of `bodies()` wears and holds beyond top and trousers, as drawn. Raises BadConfig."""
        draws = generator(0, 0, f"everyday/{body.mesh}", "attire")
        return drawn_attire(draws, self.drawn(body).contacts, self._outfit(body) is not None)

    def _outfit(self, body: BodyRef) -> Outfit | None:
        """Return the top and trousers that are drawn for a body, or None."""
        draws = generator(0, 0, f"everyday/{body.mesh}", "clothes")
        dressed = draws.random() < _DRESSED
        # A hand on the body would be hidden in loose cloth, which does not know of it.
        close = any(contact.endswith(_ON_CLOTHES) for contact in self.drawn(body).contacts)
        return drawn_outfit(draws, close) if dressed else None

    def _figure(self, body: BodyRef, index: int) -> Figure:
        pose, attire, outfit = self.drawn(body).pose, self.attire(body), self._outfit(body)
        if outfit is not None and attire.drape is not None:
            outfit = under(attire.drape, outfit)
        if attire.held is not None:
            pose = gripping(pose, attire.held)
        return Figure(person(_FIRST_PERSON + index), pose, outfit=outfit)
