"""Scores on real frames of structured-light sensors, whose background is known, kept beside each network.

A folder holds up to four recordings (`RECORDINGS`). Labels of one still man come from the surface that his frames show
together, as in `bench real`; frames with cameras say whether two views of a point agree; of all others, the labels of
a frame and of its mirror image, right and left exchanged, can be compared.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from benches.measuring import evenly_spaced
from benches.model.real.agreement import agreement
from benches.model.real.bench import Answer, gross_errors, in_frames, surface_of
from benches.model.real.fusion import FusedSurface
from benches.model.real.recording import Frame, read_recording
from benches.model.rooms.real import CUTS, ROOM, RealFrame, cut_frames, room_frames
from benches.model.variants.scores import FILE
from benches.result_cache import ResultCache, code_digest, json_digest, network_identity
from bodyseg_data.artifacts import Artifact, MissingData, PhaseShift, shown_with
from bodyseg_data.core import BadConfig
from bodyseg_data.files import read_bytes, read_json
from bodyseg_data.labels import BACKGROUND, LANDMARKS, PART_CLASSES
from bodyseg_data.machine import torch_threads
from bodyseg_data.rigs import PlacedCamera, load_rig
from bodyseg_data.samples import Sample, SampleInfo, steps
from bodyseg_model.evaluation import ConfusionMatrix, GrossErrors, distances_to_parts
from bodyseg_model.networks import Trained, find_device, load_network
from bodyseg_model.segmentation import Background, Segmenter

LABELLED: Final = "kinect_v1"
POSED: Final = "structure_bust"
ARMS: Final = "kinect_v1_arms"
RECORDINGS: Final = {
    LABELLED: "one man from all round, Kinect v1",
    POSED: "a man's head and shoulders, Structure sensor",
    ARMS: "arms raised, Kinect v1",
    ROOM: "a man in a room, Kinect v1",
}
"""Folder -> what it shows."""

ALTERED: Final[Mapping[str, Artifact]] = {
    "thinned": MissingData((0.5,)),
    "darkened": PhaseShift(fastest_m_s=0, darkest=0.003, lightest=0.003, patterned=0, brightest=0),
}
"""What is done to the labelled frames as well: half of the pixels lost, or what shifted fringes lose on black clothes:
so near the sensor, 0.3 % of the light come back as 3 % at its stand-off."""

_PLACEMENTS: Final = ("mean", "first", "second")
_DOUBTFUL: Final = "00007"  # whose pose does not bring it onto the other frames
_FEET: Final = [number for number, name in enumerate(LANDMARKS) if "Malleolus" in name or "Digit" in name]
_SHOWN: Final = {LABELLED: (0.0, 0.5), ARMS: (0.0, 0.5)}  # where in a recording the picture's frames are
_VIEWS: Final = 24
_LEAST_PIXELS: Final = 2000  # of the man in the room

Labels = NDArray[np.uint8]
Values = dict[str, float]


@dataclass(frozen=True)
class Recording:
    """Frames of people as they are stored, background removed. mirrored: they show left for right. seen: the same
    turned right, with cameras, where these are known. truth: labels of `seen` by each placement of landmarks; surface:
    what they lie on, and the labels of its vertices by the mean placement.
    """

    name: str
    frames: Sequence[Frame] = field(repr=False)
    mirrored: bool = False
    seen: Sequence[Frame] = field(default=(), repr=False)
    truth: Mapping[str, Sequence[Labels]] = field(default_factory=dict, repr=False)
    surface: tuple[FusedSurface, Labels] | None = field(default=None, repr=False)

    def labels(self, trained: Trained, mirrored: bool) -> list[Labels]:
        """Labels of all frames, uint8 [H, W] each, as `bodyseg segment` gives them. mirrored: what it is told."""
        segment = Segmenter(
            trained.network,
            self.frames[0].placed.camera,
            Background("keep"),
            mirrored=mirrored,
            rig=trained.rig,
        )
        return [segment(frame.range_m).labels for frame in self.frames]

    def shown(self, number: int) -> Frame:
        """A frame as its labels are, turned right where that is known."""
        return self.frames[number].mirrored() if self.mirrored else self.frames[number]

    def altered(self, artifact: Artifact) -> Recording:
        """The recording with an artifact in every frame; true labels are of the pixels that are left."""
        rig, frames, truth = load_rig(LABELLED), [], []
        for frame, labels in zip(self.frames, self.truth["mean"], strict=True):
            seen = labels[:, ::-1] if self.mirrored else labels
            sensor = replace(rig, camera=frame.placed.camera)
            ranges = steps(frame.range_m, rig.range_step_m, frame.name)
            sample = Sample(frame.name, ranges, None, np.ascontiguousarray(seen), ranges > 0, SampleInfo("test"))
            kept = np.where(shown_with(artifact, sample, sensor, 0).range > 0, frame.range_m, np.float32(0))
            frames.append(replace(frame, range_m=kept, pixels=np.flatnonzero(kept)))
            shown = kept[:, ::-1] if self.mirrored else kept
            truth.append(np.where(shown > 0, labels, np.uint8(BACKGROUND)))
        return replace(self, frames=frames, truth={"mean": truth})

    def answers(self, trained: Trained) -> list[Labels]:
        """Labels of `seen`, or else of `frames`."""
        labels = self.labels(trained, self.mirrored)
        return [one[:, ::-1] for one in labels] if self.mirrored else labels

    def scores(self, trained: Trained) -> Values:
        """Every measure that the recording allows, by name; shares, distances in mm."""
        answers = self.answers(trained)
        found: Values = {}
        if self.surface is not None:
            given = [Answer(answer, np.zeros(answer.shape, np.float32)) for answer in answers]
            found = gross_errors(self.seen, self.truth["mean"], given, *self.surface) or {}
        for placement, truth in self.truth.items():
            matrix = _counted(truth, answers)
            if placement == "mean":
                found |= {"accuracy": matrix.average_per_class_accuracy(), "pixels": matrix.pixel_accuracy()}
            else:
                found[f"accuracy_{placement}"] = matrix.average_per_class_accuracy()
        for name, artifact in ALTERED.items() if self.truth else ():
            altered = self.altered(artifact)
            found[name] = _counted(altered.truth["mean"], altered.answers(trained)).average_per_class_accuracy()
        if self.seen:
            found |= _agreement(self.seen, answers)
        else:
            found |= _mirror_agreement(self.frames, answers, self.labels(trained, not self.mirrored))
        if self.name == ARMS:
            labels = np.concatenate([answer[answer != BACKGROUND] for answer in answers])
            found["feet"] = float(np.isin(labels, _FEET).mean())
        return {name: round(float(value), 5) for name, value in found.items()}


class Shown(NamedTuple):
    """A real frame of the picture: its title, the person and the labels of each row, true ones first where known."""

    title: str
    frame: Frame
    labels: Mapping[str, Labels]


class RealFrames:
    """The recordings of a folder, read when the first network without kept scores needs them.

    kept: file for true labels, which take a minute to make; not of other frames or other code. Raises BadConfig for a
    folder without any of `RECORDINGS`; reading them, as `read_recording` and `room_frames`.
    """

    def __init__(self, folder: Path, kept: Path) -> None:
        self._folder, self._kept = folder, kept
        self.names = [name for name in RECORDINGS if (folder / name).is_dir()]
        if not self.names:
            raise BadConfig(f"--real must hold folders of frames, {', '.join(RECORDINGS)}, found none in {folder}")

    @cached_property
    def recordings(self) -> dict[str, Recording]:
        """The recordings by name."""
        found = {name: _READERS[name](self._folder / name) for name in self.names if name != LABELLED}
        return ({LABELLED: self._labelled()} if LABELLED in self.names else {}) | found

    def make_labels(self) -> None:
        """Make the file of true labels, unless it is there. Raises BadConfig as reading the recording."""
        if LABELLED in self.names:
            self._labels(read_recording(self._folder / LABELLED, _VIEWS))

    def _labelled(self) -> Recording:
        """The recording with true labels. Raises BadConfig as `read_recording` and `load_placements`."""
        stored = read_recording(self._folder / LABELLED, _VIEWS)
        known = self._labels(stored)
        turned = [frame.mirrored() for frame in stored] if known["mirrored"] else stored
        seen = [
            replace(frame, placed=PlacedCamera(frame.placed.camera, axes, position))
            for frame, axes, position in zip(turned, known["axes"], known["positions"], strict=True)
        ]
        truth = {name: [*known[name]] for name in _PLACEMENTS}
        none = np.zeros((0, 3))
        surface = FusedSurface(known["vertices"], none.astype(np.int64), none, none[:, 0].astype(np.int64))
        people = [_person(frame) for frame in stored]
        return Recording(LABELLED, people, bool(known["mirrored"]), seen, truth, (surface, known["vertex_labels"]))

    def _labels(self, stored: Sequence[Frame]) -> dict[str, Any]:
        of = json_digest([self._digests[LABELLED], code_digest(__name__)])
        known: dict[str, Any] = {}
        if self._kept.exists():
            with np.load(self._kept, allow_pickle=False) as file:
                known = {name: file[name] for name in file.files} if str(file["of"]) == of else {}
        if not known:
            known = _made_labels(self._folder / LABELLED, stored)
            np.savez_compressed(self._kept, of=np.array(of), **known)
        return known

    @cached_property
    def _digests(self) -> dict[str, str]:
        digests = {}
        for name in self.names:
            digest = hashlib.blake2b(digest_size=16)
            for file in sorted(file for file in (self._folder / name).iterdir() if file.is_file()):
                digest.update(f"{file.name} {hashlib.sha256(read_bytes(file)).hexdigest()}\n".encode())
            digests[name] = digest.hexdigest()
        return digests

    def scores(self, folder: Path) -> dict[str, Values]:
        """Recording -> measure -> value, of the network in a run's folder, kept in its cached_results.json."""
        cache = ResultCache(folder / FILE, network_identity(folder), __name__)
        rig = hashlib.sha256(json.dumps(read_json(folder / "network.json").get("rig")).encode()).hexdigest()
        trained, device = None, find_device()
        found = {}
        for name in self.names:
            query = {"real frames": self._digests[name], "rig": rig, "device": device.type}
            kept = cache.get(query)
            if kept is None:
                trained = trained or _loaded(folder, device)
                with torch_threads(1):
                    kept = self.recordings[name].scores(trained)
                cache.put(query, kept)
            found[name] = kept
        return found

    def shown(self, folders: Mapping[str, Path]) -> list[Shown]:
        """Some frames of each recording, labelled by the networks of these folders, by row."""
        found = []
        for name, recording in self.recordings.items():
            numbers = sorted({int(place * len(recording.frames)) for place in _SHOWN.get(name, (0.5,))})
            some = replace(recording, frames=[recording.frames[number] for number in numbers])
            answers = {row: some.answers(_loaded(folder, find_device())) for row, folder in folders.items()}
            for place, number in enumerate(numbers):
                truth = {"true labels": recording.truth["mean"][number]} if recording.truth else {}
                labels = truth | {row: each[place] for row, each in answers.items()}
                found.append(Shown(RECORDINGS[name], recording.shown(number), labels))
        return found


def _loaded(folder: Path, device: torch.device) -> Trained:
    trained = load_network(folder)
    trained.network.to(device)
    return trained


def _made_labels(folder: Path, stored: Sequence[Frame]) -> dict[str, Any]:
    """Frames mirrored or not, the surface, the cameras that bring them onto it, labels by each placement."""
    mirrored, frames, fused, labels = surface_of(stored, folder)
    truth = in_frames(frames, fused, labels)
    made: dict[str, Any] = {
        "vertices": fused.vertices,
        "vertex_labels": labels["mean"],
        "axes": np.stack([frame.placed.axes for frame in frames]),
        "positions": np.stack([frame.placed.position for frame in frames]),
    }
    return {"mirrored": np.array(mirrored), **made, **{name: np.stack(truth[name]) for name in _PLACEMENTS}}


def _read_posed(folder: Path) -> Recording:
    poses = read_json(folder / "cameras.json")["frames"]
    frames = []
    for real in cut_frames(folder, CUTS[POSED]):
        if real.name != _DOUBTFUL:
            pose = {name: np.array(poses[real.name][name], np.float64) for name in ("R", "t")}
            frames.append(frame_of(real, _largest(real.person), PlacedCamera(real.camera, pose["R"].T, pose["t"])))
    return Recording(folder.name, frames, seen=frames)


def _read_cut(folder: Path) -> Recording:
    return Recording(folder.name, [frame_of(real, real.person) for real in cut_frames(folder, CUTS[folder.name])])


def _read_room(folder: Path) -> Recording:
    return Recording(folder.name, [frame_of(real, real.person) for real in seen_in_room(folder)])


def seen_in_room(folder: Path) -> list[RealFrame]:
    """Some frames of the man in a room, in which much of him is in view. Raises BadConfig without any."""
    in_view = [real for real in room_frames(folder) if (real.person & (real.range_m > 0)).sum() >= _LEAST_PIXELS]
    return evenly_spaced(in_view, _VIEWS)


_READERS: Final[Mapping[str, Callable[[Path], Recording]]] = {
    POSED: _read_posed,
    ARMS: _read_cut,
    ROOM: _read_room,
}


def frame_of(real: RealFrame, person: NDArray[np.bool_], placed: PlacedCamera | None = None) -> Frame:
    """The frame without what is not the person's. placed: its camera, by default at the origin."""
    kept = np.where(person, real.range_m, np.float32(0))
    at = placed or PlacedCamera(real.camera, np.eye(3), np.zeros(3))
    return Frame(real.name, kept, np.flatnonzero(kept), at)


def _person(frame: Frame) -> Frame:
    """The frame without what is not the person."""
    kept = np.zeros_like(frame.range_m)
    kept.ravel()[frame.pixels] = frame.range_m.ravel()[frame.pixels]
    return Frame(frame.name, kept, frame.pixels, frame.placed)


def _largest(person: NDArray[np.bool_]) -> NDArray[np.bool_]:
    from scipy.ndimage import label

    pieces, _ = label(person)
    largest: NDArray[np.bool_] = pieces == 1 + np.bincount(pieces[pieces > 0])[1:].argmax()
    return largest


def _counted(truth: Sequence[Labels], answers: Sequence[Labels]) -> ConfusionMatrix:
    matrix = ConfusionMatrix()
    for labels, answer in zip(truth, answers, strict=True):
        matrix.add(labels, answer)
    return matrix


def _agreement(frames: Sequence[Frame], answers: Sequence[Labels]) -> Values:
    found = agreement(frames, answers)
    return {name: found[name] for name in ("same", "within_30_mm", "within_60_mm")}


def _mirror_agreement(frames: Sequence[Frame], answers: Sequence[Labels], turned: Sequence[Labels]) -> Values:
    """Share of the pixels with one label in a frame and in its mirror image, right and left exchanged there; and shares
    of those whose label in the mirror image is nowhere near in the frame.
    """
    errors, same, pixels = GrossErrors(), 0, 0
    for frame, one, other in zip(frames, answers, turned, strict=True):
        labels, mirrored = one.ravel()[frame.pixels], PART_CLASSES.mirrored[other.ravel()[frame.pixels]]
        differs = labels != mirrored
        points = frame.points()
        errors.add(distances_to_parts(points[differs], mirrored[differs], points, labels), int((~differs).sum()))
        same, pixels = same + int((~differs).sum()), pixels + len(labels)
    return {"mirror": same / pixels, **{f"mirror_{name}": value for name, value in (errors.to_json() or {}).items()}}
