"""The default bodies, made from the open model Anny: sources `open`, `bare`, `wide`, `everyday` and `candidates`.

Anny (PyPI, Apache-2.0) carries its mesh data in the package, so nothing is downloaded. The first use on a machine
parses that data for about 12 seconds and keeps the result in ~/.cache/anny (or ANNY_CACHE_DIR); later ones take two.

`open` is one person in 71 postures, two in motion, 583 people standing; `bare` the same without clothes. Networks
trained on it fail on unseen poses: on the floor, with arms before the trunk (docs/results/failures.md).

`wide` has 900 more people for training. Each posture is a stance and two arms, drawn independently of one another,
every joint uniform within a range. So people who crouch cross their arms as well as people who stand, and no posture is
copied from `hard`, which remains a test set. No floor or chair is modelled, and limbs may touch or intersect a little.
Stances, sexes and outfits take turns, so men alone have five of the ten stances and two of the four outfits.

`everyday` has people for training whose hands, forearms, soles and shins touch their own body or the floor, where
networks trained on the others fail. Each holds another pose, drawn by `contact_poses`: a stance, then each limb sent to
a place. Everything is drawn from the body's name. The angles come from a search on the person's own skin, so a pose
takes a while to draw and is drawn when its body is built, not when bodies are listed.
"""

import hashlib
import importlib.metadata
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import ClassVar, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.anny_model import AnnyModel, Figure, standing
from bodyseg_data.bodies.anny_people import EVERYDAY_POSES, PEOPLE, POSTURES, SUBJECT_A, person, standing_pose
from bodyseg_data.bodies.attire import Attire, drawn_attire, joined, put_on, under
from bodyseg_data.bodies.contact_poses import ContactSampler, DrawnContact
from bodyseg_data.bodies.limb_reaching import Ranges, within
from bodyseg_data.bodies.motions.catalogue import MOTIONS, SUBJECTS, Motion
from bodyseg_data.bodies.outfits import OUTFITS, Outfit, drawn_outfit, of_every_third
from bodyseg_data.bodies.shells import Wearer
from bodyseg_data.bodies.skeleton import Arm, Leg, Pose, Trunk
from bodyseg_data.bodies.source import Body, BodyRef, ListedBodies
from bodyseg_data.bodies.stances import CANDIDATE_STANCES, STANCES, Places
from bodyseg_data.bodies.template import off_skin
from bodyseg_data.bodies.worn import draped, gripping
from bodyseg_data.core import BadLandmarks, Draws
from bodyseg_data.labels import LANDMARKS
from bodyseg_data.machine import missing_library
from bodyseg_data.meshes import Mesh, PointLandmarks, load_landmark_file, load_landmarks
from bodyseg_data.samples import Split, split_by_motion, split_by_order

Maker = Callable[[], Figure]
Listed = Iterator[tuple[BodyRef, Maker]]


class MadeBodies(ListedBodies[Maker]):
    """Bodies that are made on demand, each from its figure."""

    on_template = True
    """Their `Body.template` is known."""

    def __init__(self, name: str, figures: Mapping[BodyRef, Maker]) -> None:
        """figures: called for one body at a time, so that listing bodies computes no pose."""
        super().__init__(figures)
        self.name = name
        self.landmarks = load_landmarks("open")

    def label_by(self, file: Path) -> None:
        """Label all bodies by a landmark file of vertices of their skin. Raises BadLandmarks for any other file."""
        read, own = load_landmark_file(file), self.landmarks
        if isinstance(read, PointLandmarks):
            raise BadLandmarks(f"landmarks {file}: the source {self.name!r} needs them by vertex, found coordinates")
        read.check_counts(own.vertex_count, own.face_count, f"bodies of {self.name!r}")
        for at in np.flatnonzero(off_skin(read.vertices)).tolist():
            rule = f"{LANDMARKS[at]!r} must lie on the skin, not on an eye or inside the head"
            raise BadLandmarks(f"landmarks {file}: {rule}, found vertex {read.vertices[at]}")
        self.landmarks = read

    def figure(self, body: BodyRef) -> Figure:
        """Return the description of one of `bodies()`. Raises BadConfig for a body of another source."""
        return self.entry(body)()

    def fingerprint(self, bodies: Sequence[BodyRef]) -> str:
        """Return a digest of persons, poses, outfits, landmarks and the version of Anny. Raises MissingLibrary."""
        figures = [self.figure(body) for body in bodies]
        return hashlib.sha256(repr((*self.shaping(), figures)).encode()).hexdigest()

    def shaping(self) -> tuple[str, tuple[int, ...]]:
        """Return what shapes all made bodies: the version of Anny, and the landmarks. Raises MissingLibrary."""
        try:
            version = importlib.metadata.version("anny")
        except importlib.metadata.PackageNotFoundError as error:
            raise missing_library("making bodies", error) from error
        return version, self.landmarks.vertices

    @cached_property
    def model(self) -> AnnyModel:
        """The body model, loaded when it is first asked for. Raises the errors of `build`."""
        return AnnyModel()

    def build(self, body: BodyRef, dressed: bool = True) -> Body:
        """Build a mesh of 13 718 vertices and 27 420 triangles over the origin, its lowest point at y = height_m.

        A dressed body has smaller triangles where its outfit folds, about 22 000 vertices; the first 13 718 are those
        of all bodies. dressed: False takes the outfit off and leaves the triangles. The same bits in every process.
        Raises BadConfig for a body of another source or if Anny's cache cannot be used, MissingLibrary without Anny.
        """
        return self._built(body, self.figure(body), dressed)

    def in_pose(self, body: BodyRef, pose: str) -> Body:
        """Build a body in one of `EVERYDAY_POSES`, dressed as it is, on the floor. Raises as `build`."""
        return self._built(body, replace(self.figure(body), pose=EVERYDAY_POSES[pose], height_m=0.0), True)

    def _built(self, body: BodyRef, figure: Figure, dressed: bool) -> Body:
        vertices, faces = self.model.surface(figure, dressed)
        landmarks = np.array(self.landmarks.vertices, np.int64)
        return Body(Mesh(body.mesh, vertices, faces), landmarks, template=partial(self.model.places, figure))


class OpenBodies(MadeBodies):
    """Open bodies in place of the paper's subsets, 2 329 in all.

    A: one man in 71 postures. B and C: a man and a woman, dressed, in four motions each. people: 583 people standing
    with their arms a little off.
    """

    def __init__(self) -> None:
        super().__init__("open", _figures(dressed=True))


class BareBodies(MadeBodies):
    """The bodies of `OpenBodies`, B and C without clothes, to measure the effect of clothes."""

    def __init__(self) -> None:
        super().__init__("bare", _figures(dressed=False))


def _figures(dressed: bool) -> dict[BodyRef, Maker]:
    moving = (each for subject in MOTIONS for each in _moving(subject, dressed))
    return dict([*_postures(), *moving, *_people()])


def _postures() -> Listed:
    for index, (name, pose) in enumerate(POSTURES):
        ref = BodyRef("A", "A", f"posture-{index:02d}", name, split_by_order("A", index))
        yield ref, partial(Figure, SUBJECT_A, pose)


def _moving(subject: Literal["B", "C"], dressed: bool) -> Listed:
    for name, motion in MOTIONS[subject].items():
        split = split_by_motion(subject, name)
        for index in range(motion.frames):
            ref = BodyRef(subject, subject, f"{subject}-{name}-{index:03d}", name, split)
            yield ref, partial(_moved, subject, motion, index, OUTFITS[subject] if dressed else None)


def _moved(subject: Literal["B", "C"], motion: Motion, index: int, outfit: Outfit | None) -> Figure:
    return Figure(SUBJECTS[subject], *motion.frame(index), outfit)


def _people() -> Listed:
    for index in range(PEOPLE):
        ref = BodyRef("people", f"P{index:03d}", f"person-{index:03d}", "standing", split_by_order("people", index))
        yield ref, partial(_person, index)


def _person(index: int) -> Figure:
    return Figure(person(index), standing_pose(index))


WIDE: Final = 900
_FIRST_PERSON: Final = 1000  # beyond those of the open and the hard set


class WideStance(NamedTuple):
    """Ranges of trunk and legs, degrees. alike: both legs have the same angles."""

    trunk: Ranges
    leg: Ranges
    alike: bool = False


_HEAD: Final[Ranges] = {"nod": (-20, 25), "tilt": (-15, 15), "look": (-45, 45)}
_LYING_LEG: Final[Ranges] = {
    "flex": (-5, 90), "abduct": (-4, 25), "twist": (-10, 40), "knee": (0, 110), "planted": (0, 0), "ankle": (5, 40),
}  # fmt: skip
_ANY_WAY: Final = {"turn": (-180.0, 180.0)}

WIDE_STANCES: Final[dict[str, WideStance]] = {
    "upright": WideStance(
        {"lean": (-5, 8), "bend": (-8, 18), "side": (-12, 12), "twist": (-25, 25)} | _HEAD,
        {"flex": (-12, 25), "abduct": (-3, 15), "twist": (-5, 25), "knee": (0, 25)},
    ),
    "bent": WideStance(
        {"lean": (15, 65), "bend": (10, 60), "side": (-15, 15), "twist": (-25, 25)} | _HEAD,
        {"flex": (30, 75), "abduct": (0, 15), "twist": (0, 20), "knee": (0, 45)},
    ),
    "crouching": WideStance(
        {"lean": (5, 45), "bend": (5, 45), "side": (-10, 10), "twist": (-20, 20)} | _HEAD,
        {"flex": (70, 125), "abduct": (0, 30), "twist": (0, 35), "knee": (75, 132)},
    ),
    "on a chair": WideStance(
        {"lean": (-15, 15), "bend": (0, 35), "side": (-10, 10), "twist": (-20, 20)} | _HEAD,
        {"flex": (72, 108), "abduct": (-2, 25), "twist": (-5, 35), "knee": (60, 112)},
    ),
    "on the floor": WideStance(
        {"lean": (-35, 0), "bend": (0, 45), "twist": (-20, 20)} | _HEAD,
        {
            "flex": (55, 120),
            "abduct": (0, 42),
            "twist": (-5, 45),
            "knee": (0, 130),
            "planted": (0, 0),
            "ankle": (0, 25),
        },
    ),
    "kneeling": WideStance(
        {"lean": (-8, 25), "bend": (-5, 30), "side": (-10, 10), "twist": (-25, 25)} | _HEAD,
        {"flex": (-5, 60), "abduct": (0, 15), "knee": (85, 134), "planted": (0, 0), "ankle": (20, 48)},
        alike=True,
    ),
    "bent double": WideStance(
        {"lean": (60, 90), "bend": (0, 70), "twist": (-20, 20)} | _HEAD,
        {"flex": (55, 100), "abduct": (0, 15), "knee": (0, 95), "planted": (0, 0), "ankle": (0, 40)},
        alike=True,
    ),
    "on the back": WideStance({"lean": (-95, -80), "bend": (-5, 20)} | _HEAD | _ANY_WAY, _LYING_LEG),
    "on the front": WideStance(
        {"lean": (80, 95), "bend": (-25, 5)} | _HEAD | _ANY_WAY, _LYING_LEG | {"flex": (-10, 30), "knee": (0, 60)}
    ),
    "on the side": WideStance({"roll": (-95, 95), "bend": (0, 45)} | _HEAD | _ANY_WAY, _LYING_LEG),
}

ARMS: Final[dict[str, Ranges]] = {
    "hanging": {"flex": (-25, 30), "abduct": (4, 25), "twist": (-20, 20), "elbow": (0, 40)},
    "before the chest": {"flex": (20, 70), "abduct": (-6, 14), "twist": (-68, -40), "elbow": (75, 120)},
    "at the belly": {"flex": (5, 40), "abduct": (2, 16), "twist": (-62, -35), "elbow": (40, 95)},
    "at the face": {"flex": (25, 70), "abduct": (-4, 35), "twist": (-30, 10), "elbow": (112, 145)},
    "at the head": {"flex": (5, 65), "abduct": (70, 120), "twist": (50, 90), "elbow": (100, 142)},
    "on the hip": {"flex": (-35, -10), "abduct": (35, 55), "twist": (-45, -25), "elbow": (75, 105)},
    "on the thigh": {"flex": (15, 65), "abduct": (0, 16), "twist": (-30, 5), "elbow": (5, 65)},
    "behind the back": {"flex": (-50, -30), "abduct": (14, 28), "twist": (-62, -45), "elbow": (45, 80)},
    "forward": {"flex": (50, 125), "abduct": (-5, 30), "twist": (-30, 30), "elbow": (0, 70)},
    "to the side": {"flex": (-20, 30), "abduct": (50, 125), "twist": (-30, 80), "elbow": (0, 110)},
    "overhead": {"flex": (120, 175), "abduct": (0, 25), "twist": (-20, 40), "elbow": (0, 70)},
}

_HAND: Final[Ranges] = {"supinate": (-60, 40), "wrist": (-30, 30), "fist": (0, 0.8)}


class WideBodies(MadeBodies):
    """The bodies of `OpenBodies`, and the subset "wide": 900 people, all for training, each in another posture."""

    def __init__(self) -> None:
        super().__init__("wide", _figures(dressed=True) | dict(_drawn()))


def _drawn() -> Listed:
    for index in range(WIDE):
        stance = [*WIDE_STANCES][index % len(WIDE_STANCES)]
        ref = BodyRef("wide", f"W{index:03d}", f"wide-{index:03d}", stance.replace(" ", "_"), "train")
        yield ref, partial(_figure, index)


def _figure(index: int) -> Figure:
    return Figure(person(_FIRST_PERSON + index), drawn_pose(index), outfit=of_every_third(index, 0))


def drawn_pose(index: int) -> Pose:
    """Draw the posture of body number `index`: stances take turns, everything else is random."""
    draws = Draws(0, 0, f"wide/{index:03d}").generator("posture")
    stance = [*WIDE_STANCES.values()][index % len(WIDE_STANCES)]
    trunk = Trunk(**within(stance.trunk, draws))
    if "roll" in stance.trunk:
        trunk = Trunk(**vars(trunk) | {"roll": float(np.copysign(90 + trunk.roll % 10 - 5, trunk.roll))})
    left, right = (within(stance.leg, draws) for _ in range(2))
    kinds = [*ARMS.values()]
    arms = [Arm(**within(kinds[int(draws.random() * len(kinds))] | _HAND, draws)) for _ in range(2)]
    return Pose(trunk, arms[0], arms[1], Leg(**left), Leg(**(left if stance.alike else right)))


EVERYDAY: Final = 1040
CANDIDATES: Final = 1900

POSES_VERSION: Final = 1
"""Raised whenever a change of the sampler changes a pose, so that packed sets are told from each other."""

CLOTHES_VERSION: Final = 2
"""Raised whenever what people wear or hold changes, for the same reason."""

_FIRST_EVERYDAY_PERSON: Final = 3000  # beyond those of the other sets

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

    _NAME: ClassVar = "everyday"
    _NUMBERS: ClassVar = range(EVERYDAY)
    _STANCES: ClassVar = tuple(STANCES)
    _TESTED: ClassVar = range(0)

    def __init__(self) -> None:
        super().__init__(self._NAME, dict(self._listed()))
        self._latest: tuple[BodyRef, DrawnContact] | None = None

    def drawn(self, body: BodyRef) -> DrawnContact:
        """Draw the pose of one of `bodies()`, with how it was found. Raises BadConfig for a body of another source."""
        self.entry(body)
        if self._latest is None or self._latest[0] != body:
            index = int(body.subject[1:])
            draws = Draws(0, 0, f"everyday/{body.mesh}").generator("pose")
            sampler = ContactSampler(self.model.posable(person(_FIRST_EVERYDAY_PERSON + index)), self._places)
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
        for index in self._NUMBERS:
            name, stance = f"{self._NAME}-{index:04d}", self._STANCES[index % len(self._STANCES)]
            split: Split = "test" if index in self._TESTED else "train"
            ref = BodyRef(self._NAME, f"{self._NAME[0].upper()}{index:04d}", name, stance, split)
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
            figure = replace(figure, outfit=self._outfit(body))
            wearer, vertices, faces = self._wearer(figure)
        vertices, faces, pieces = joined(vertices, faces, put_on(wearer, attire, cloth))
        landmarks = np.array(self.landmarks.vertices, np.int64)
        mesh = Mesh(body.mesh, standing(vertices), faces)
        return Body(mesh, landmarks, pieces=pieces, template=partial(self.model.places, figure))

    def _wearer(self, figure: Figure) -> tuple[Wearer, NDArray[np.float64], NDArray[np.int32]]:
        vertices, faces = self.model.surface(figure, dressed=True)
        person = self.model.posable(figure.who)
        return Wearer(person, vertices[: len(person.modelled)], self._places), vertices, faces

    def attire(self, body: BodyRef) -> Attire:
        """Return what one of `bodies()` wears and holds beyond top and trousers, as drawn. Raises BadConfig."""
        draws = Draws(0, 0, f"everyday/{body.mesh}").generator("attire")
        return drawn_attire(draws, self.drawn(body).contacts, self._outfit(body) is not None)

    def _outfit(self, body: BodyRef) -> Outfit | None:
        """Return the top and trousers that are drawn for a body, or None."""
        draws = Draws(0, 0, f"everyday/{body.mesh}").generator("clothes")
        dressed = draws.random() < _DRESSED
        # Loose cloth, whose shape does not depend on hands, would hide a hand on the body.
        close = any(contact.endswith(_ON_CLOTHES) for contact in self.drawn(body).contacts)
        return drawn_outfit(draws, close) if dressed else None

    def _figure(self, body: BodyRef, index: int) -> Figure:
        pose, attire, outfit = self.drawn(body).pose, self.attire(body), self._outfit(body)
        if outfit is not None and attire.drape is not None:
            outfit = under(attire.drape, outfit)
        if attire.held is not None:
            pose = gripping(pose, attire.held)
        return Figure(person(_FIRST_EVERYDAY_PERSON + index), pose, outfit=outfit)


class CandidateBodies(EverydayBodies):
    """Subset "candidates": 1 900 more people in the poses of `CANDIDATE_STANCES`, one of each for testing.

    `bench mining` finds those of them that a network labels worst, to train it further.
    """

    _NAME = "candidates"
    _NUMBERS = range(EVERYDAY, EVERYDAY + CANDIDATES)
    _STANCES = tuple(CANDIDATE_STANCES)
    _TESTED = _NUMBERS[: 5 * len(CANDIDATE_STANCES) : 5]
