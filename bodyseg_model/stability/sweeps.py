"""Corruptions of rising strength: the table of sweeps, and those sweeps that are computed from stored samples.

A sweep changes one thing and leaves all else clean, so two predictions at different strengths differ because of it
alone. Its first strength is clean. docs/results/stability.md describes every sweep.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.artifact import Artifact
from bodyseg_data.artifacts.losses import SHAPES, lost
from bodyseg_data.artifacts.missing_data import MissingData
from bodyseg_data.artifacts.noise import Noise
from bodyseg_data.artifacts.surface import box_of
from bodyseg_data.artifacts.variants import shown_with
from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.randomness import generator
from bodyseg_data.core.rig import Rig, load_rig
from bodyseg_data.core.sample import Sample
from bodyseg_model.recordings.cameras import other_sensors

Origin = Literal["stored", "rendered"]

DEPTHS_M: Final = (0.5, 4.5)
"""Ends of the interval that the sweep `depth_steps` divides into equal steps, metres."""

_SHARES: Final = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
_FOCALS_PX: Final = tuple(sorted({sensor.camera.focal_px for sensor in other_sensors()}, reverse=True))
_KNOWN_FOCAL_PX: Final = round(load_rig().camera.focal_px, 1)


@dataclass(frozen=True)
class Condition:
    """One sweep at one strength; the clean condition that sweeps begin with is shared by all of one `Origin`."""

    sweep: str
    strength: float = 0.0

    @property
    def name(self) -> str:
        """Words for progress and messages, such as "noise 10"."""
        return self.sweep if self in CLEAN.values() else f"{self.sweep} {self.strength:g}"


CLEAN: Final[dict[Origin, Condition]] = {"stored": Condition("clean"), "rendered": Condition("clean, rendered")}


@dataclass(frozen=True)
class Sweep:
    """One corruption. strengths: in rising severity; the first is clean.

    origin: "stored" if stored samples are corrupted, "rendered" if bodies are rendered anew. counts: True if it enters
    mCE and mRR.
    """

    title: str
    axis: str
    strengths: tuple[float, ...]
    origin: Origin = "stored"
    counts: bool = True

    def conditions(self, name: str) -> list[Condition]:
        """The conditions of the sweep, which has this name in `SWEEPS`: one for each strength."""
        return [CLEAN[self.origin], *(Condition(name, strength) for strength in self.strengths[1:])]


SWEEPS: Final = {
    "noise": Sweep("Noise", "sigma, mm", (0, 10, 20, 40, 60, 80, 100)),
    "missing": Sweep("Pixels missing at random", "share of the body", (0.0, 0.1, 0.3, 0.5, 0.7, 0.9)),
    "patches": Sweep("Patches missing (dark cloth)", "share of the body", _SHARES),
    "stripes": Sweep("Stripes missing (motion)", "share of the body", _SHARES),
    "grazing": Sweep("Grazing surfaces missing", "share of the body", _SHARES),
    "depth_steps": Sweep(f"Coarse depth, {DEPTHS_M[0]:g} to {DEPTHS_M[1]:g} m", "bits", (16, 12, 11, 10, 9, 8)),
    "crop_below": Sweep("Cut off from below", "share of the height", _SHARES),
    "crop_above": Sweep("Cut off from above", "share of the height", _SHARES),
    "crop_side": Sweep("Cut off from the left", "share of the width", _SHARES),
    "occlusion": Sweep("Projector shadow", "baseline, m", (0.0, 0.25, 0.5, 0.75, 1.0, 1.5), "rendered"),
    "nearer": Sweep("Nearer", "distance, m", (2.5, 2.25, 2.0, 1.75, 1.5), "rendered"),
    "farther": Sweep("Farther", "distance, m", (2.5, 3.0, 3.5, 4.0), "rendered"),
    "tilt": Sweep("Camera looks down", "degrees", (0, 5, 10, 15, 20, 30), "rendered"),
    "rig": Sweep("Other cameras, as they are", "focal length, px", (_KNOWN_FOCAL_PX, *_FOCALS_PX), "rendered"),
    "rig_resampled": Sweep(
        "Other cameras, resampled", "focal length, px", (_KNOWN_FOCAL_PX, *_FOCALS_PX), "rendered", counts=False
    ),
    "hidden": Sweep("Hidden by things", "share of the body", _SHARES, "rendered", counts=False),
    "hidden_shown": Sweep(
        "Hidden by things, which are in the image", "share of the body", _SHARES, "rendered", counts=False
    ),
    "hard": Sweep("Hard poses", "0: the set's, 1: hard", (0, 1), counts=False),
}
"""Name -> sweep. Resampling is a remedy, things and hard poses are not a sensor's fault, so they do not count."""


def chosen(names: tuple[str, ...], hard: bool) -> dict[str, Sweep]:
    """The sweeps of the given names, or all if none is given. hard: True if a set of hard poses is given.

    Raises BadConfig for an unknown name, or "hard" without such a set.
    """
    for name in names:
        if name not in SWEEPS:
            raise BadConfig(f"a sweep must be one of {', '.join(SWEEPS)}, found {name!r}")
    if "hard" in names and not hard:
        raise BadConfig("the sweep 'hard' needs a set of hard poses: give --hard")
    return {name: sweep for name, sweep in SWEEPS.items() if name in names or (not names and (hard or name != "hard"))}


def corrupted(sample: Sample, condition: Condition, rig: Rig, seed: int) -> NDArray[np.uint16]:
    """The range image of a stored sample under a condition of a "stored" sweep, uint16 [H, W], in the rig's steps.

    Pixels that the corruption removes are 0. Draws depend on seed and sample alone, so a greater strength removes the
    pixels of a smaller one, and more. An unchanged image is returned as it is, not copied.
    """
    if condition == CLEAN["stored"]:
        return sample.range
    if condition.sweep in _ARTIFACTS:
        return shown_with(_ARTIFACTS[condition.sweep](condition.strength), sample, rig, seed).range
    if condition.sweep in SHAPES:
        draws = generator(seed, 0, sample.key, condition.sweep)
        return sample.range * ~lost(condition.sweep, sample.range, condition.strength, rig.camera, draws)
    if condition.sweep == "depth_steps":
        return _depth_steps(sample, condition.strength, rig.range_step_m)
    return _CROPS[condition.sweep](sample, condition.strength)


def _depth_steps(sample: Sample, bits: float, step_m: float) -> NDArray[np.uint16]:
    """Ranges rounded to one of 2**bits depths, the first and last at the ends of `DEPTHS_M`."""
    low, high = (depth / step_m for depth in DEPTHS_M)
    last = 2.0**bits - 1
    step = (high - low) / last
    depths = low + step * np.clip(np.rint((sample.range - low) / step), 0, last)
    return np.where(sample.range > 0, np.rint(depths), 0).astype(np.uint16)


def _crop(image: NDArray[np.uint16], share: float, from_end: bool = False) -> NDArray[np.uint16]:
    """Remove a share of the rows that the body covers, from the top or the bottom of the body."""
    rows, _ = box_of(image) or np.s_[0:0, 0:0]
    removed = round(share * (rows.stop - rows.start))
    cropped = image.copy()
    cropped[slice(rows.stop - removed, None) if from_end else slice(rows.start + removed)] = 0
    return cropped


_ARTIFACTS: Final[dict[str, Callable[[float], Artifact]]] = {
    "noise": lambda sigma_mm: Noise(sigma_mm, sigma_mm),
    "missing": lambda share: MissingData((share,)),
}
"""The sweeps of one artifact: name -> the artifact at a strength."""

_CROPS: Final[dict[str, Callable[[Sample, float], NDArray[np.uint16]]]] = {
    "crop_below": lambda sample, share: _crop(sample.range, share, from_end=True),
    "crop_above": lambda sample, share: _crop(sample.range, share),
    "crop_side": lambda sample, share: np.ascontiguousarray(_crop(sample.range.T, share).T),
}
