"""People found in real frames: a room in which a man walks about, and people of whom the background was cut away."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Picture

from benches.measuring import evenly_spaced
from benches.model.rooms.finders import Finder, Image
from bodyseg_data.core import BadConfig
from bodyseg_data.rigs import Camera, load_sensor

THRESHOLDS: Final = 0.5, 0.7, 0.9
"""Least probabilities of a person at which pixels are counted."""

ROOM: Final = "kinect_v1_room"
_WITHIN_PX: Final = 15
_BELOW_PX: Final = 60
"""A pixel within so many pixels of a mask, or so many below that, is the person's: masks err at borders, and lack lower
legs.
"""

Marks = NDArray[np.bool_]


@dataclass(frozen=True)
class RealFrame:
    """A real frame. range_m: [H, W], metres, 0 = nothing measured. person: bool [H, W], who is to be found. near: bool
    [H, W], where a pixel counts as his.
    """

    name: str
    camera: Camera = field(repr=False)
    range_m: Image = field(repr=False)
    person: Marks = field(repr=False)
    near: Marks = field(repr=False)


@dataclass(frozen=True)
class Cut:
    """Frames of people alone. focal_px: of their camera. near_m: what is nearer is the person. most: frames used."""

    focal_px: float
    pattern: str
    near_m: float = np.inf
    most: int = 12


CUTS: Final = {
    "kinect_v1": Cut(525.0, "*_depth.png", 1.2),
    "kinect_v1_arms": Cut(585.0, "*_depth.png"),
    "kinect_v2": Cut(365.6, "*.png"),
    "structure_bust": Cut(567.6, "*.png", 1.15),
}
"""Folder -> its frames."""


def room_frames(folder: Path) -> list[RealFrame]:
    """Read NNN_depth.png, millimetres, with NNN_person.png of a Kinect v1. Raises BadConfig without any."""
    camera, found = load_sensor("kinect_v1").camera, []
    for file in sorted(folder.glob("*_person.png")):
        with Picture.open(file) as image:
            person = np.asarray(image) > 0
        range_m = _metres(file.with_name(file.name.replace("person", "depth")))
        found.append(RealFrame(file.name[:-11], camera, range_m, person, nearby(person)))
    if not found:
        raise BadConfig(f"{folder} must hold frames NNN_depth.png with masks NNN_person.png, found none")
    return found


def cut_frames(folder: Path, cut: Cut) -> Iterator[RealFrame]:
    """Read frames of people alone; what is farther than `near_m` is nobody."""
    for file in evenly_spaced(sorted(folder.glob(cut.pattern)), cut.most):
        range_m = _metres(file)
        rows, columns = range_m.shape
        camera = replace(
            load_sensor("kinect_v1").camera,
            rows=rows,
            columns=columns,
            focal_px=cut.focal_px,
            centre_px=(columns / 2, rows / 2),
        )
        person = (range_m > 0) & (range_m < cut.near_m)
        yield RealFrame(file.stem.partition("_")[0], camera, range_m, person, person)


def _metres(file: Path) -> Image:
    with Picture.open(file) as image:
        return (np.asarray(image) / 1000).astype(np.float32)


def nearby(person: Marks) -> Marks:
    """True within `_WITHIN_PX` of a mask, and down to `_BELOW_PX` below that."""
    from scipy.ndimage import binary_dilation, distance_transform_edt

    if not person.any():
        return person
    near = distance_transform_edt(~person) <= _WITHIN_PX
    down = np.zeros((2 * _BELOW_PX + 1, 1), np.bool_)
    down[_BELOW_PX:] = True
    below: Marks = binary_dilation(near, down)
    return below


def score_room(finder: Finder, frames: Sequence[RealFrame], thresholds: Sequence[float] = THRESHOLDS) -> dict[str, Any]:
    """Precision and recall of pixels over all frames at each threshold, and bodies a frame; null of nothing."""
    answers = [finder(frame.range_m, frame.camera) for frame in frames]
    persons = sum(int(frame.person.sum()) for frame in frames)
    rows: dict[str, Any] = {}
    for threshold in thresholds:
        labelled = [answer.person >= threshold for answer in answers]
        own = sum(int((each & frame.near).sum()) for each, frame in zip(labelled, frames, strict=True))
        seen = sum(int((each & frame.person).sum()) for each, frame in zip(labelled, frames, strict=True))
        rows[f"{threshold:g}"] = {
            "precision": share(own, sum(int(each.sum()) for each in labelled)),
            "recall": share(seen, persons),
        }
    bodies = [answer.bodies for answer in answers if answer.bodies is not None]
    bodies_a_frame = round(float(np.mean(bodies)), 2) if bodies else None
    return {"frames": len(frames), "at": rows, "bodies_a_frame": bodies_a_frame}


def score_cut(finder: Finder, frames: Sequence[RealFrame], threshold: float = THRESHOLDS[0]) -> dict[str, Any]:
    """Share of people's pixels found over all frames, and frames in which half of them are."""
    found = [
        (int(((finder(frame.range_m, frame.camera).person >= threshold) & frame.person).sum()), int(frame.person.sum()))
        for frame in frames
    ]
    return {
        "frames": len(frames),
        "found": sum((share(*counts) or 0) >= 0.5 for counts in found),
        "recall": share(sum(seen for seen, _ in found), sum(whole for _, whole in found)),
    }


def share(part: float, whole: float) -> float | None:
    """Share, in four decimals; None of nothing."""
    return round(part / whole, 4) if whole else None


def real(finder: Finder, data: Path, thresholds: Sequence[float] = THRESHOLDS) -> dict[str, Any]:
    """Figures of all real frames below a folder; those of a folder that is not there are null. Raises BadConfig without
    the room's.
    """
    figures: dict[str, Any] = {ROOM: score_room(finder, room_frames(data / ROOM), thresholds)}
    for name, cut in CUTS.items():
        frames = list(cut_frames(data / name, cut))
        figures[name] = score_cut(finder, frames, thresholds[0]) if frames else None
    return figures
