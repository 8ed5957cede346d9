"""What a sensor does to its images, in rising strength: the sweeps, and those made of stored samples.

In every sweep one thing changes and all else is clean, so that a network's answers to two strengths differ by that
thing alone. The first strength of a sweep is its clean end. docs/stability.md describes every sweep.
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
from bodyseg_data.artifacts.variants import shown_with
from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.randomness import generator
from bodyseg_data.core.rig import Rig, load_rig
from bodyseg_data.core.sample import RANGE_STEP_M, Sample
from bodyseg_model.segmentation.cameras import other_sensors

Origin = Literal["stored", "rendered"]

DEPTHS_M: Final = (0.5, 4.5)
"""The interval that a sensor of few bits shares out evenly."""

_SHARES: Final = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
_FOCALS_PX: Final = tuple(sorted({sensor.camera.focal_px for sensor in other_sensors()}, reverse=True))
_KNOWN_FOCAL_PX: Final = round(load_rig().camera.focal_px, 1)


@dataclass(frozen=True)
class Setting:
    """The images of one sweep at one strength; the clean images that sweeps begin with are one setting for all."""

    sweep: str
    strength: float = 0.0

    @property
    def name(self) -> str:
        """In words."""
        return self.sweep if self in CLEAN.values() else f"{self.sweep} {self.strength:g}"


CLEAN: Final[dict[Origin, Setting]] = {"stored": Setting("clean"), "rendered": Setting("clean, rendered")}


@dataclass(frozen=True)
class Sweep:
    """One thing that goes wrong. strengths: in rising severity, the first is the clean end.

    origin: whether its images are changed stored samples, or drawn anew. counts: whether it enters mCE and mRR.
    """

    title: str
    axis: str
    strengths: tuple[float, ...]
    origin: Origin = "stored"
    counts: bool = True

    def settings(self, name: str) -> list[Setting]:
        """One for each strength."""
        return [CLEAN[self.origin], *(Setting(name, strength) for strength in self.strengths[1:])]


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
    "rig_made_over": Sweep(
        "Other cameras, made over", "focal length, px", (_KNOWN_FOCAL_PX, *_FOCALS_PX), "rendered", counts=False
    ),
    "hard": Sweep("Hard poses", "0: the set's, 1: hard", (0, 1), counts=False),
}
"""Name -> sweep. Neither the remedy for other cameras nor other bodies are a sensor's fault, so they do not count."""


def chosen(names: tuple[str, ...], hard: bool) -> dict[str, Sweep]:
    """The sweeps of these names, or all if there are none; hard: whether there are hard poses. Raises BadConfig."""
    for name in names:
        if name not in SWEEPS:
            raise BadConfig(f"a sweep must be one of {', '.join(SWEEPS)}, found {name!r}")
    if "hard" in names and not hard:
        raise BadConfig("the sweep 'hard' needs a set of hard poses: give --hard")
    return {name: sweep for name, sweep in SWEEPS.items() if name in names or (not names and (hard or name != "hard"))}


def altered(sample: Sample, setting: Setting, rig: Rig, seed: int) -> NDArray[np.uint16]:
    """The range image of a stored sample in a setting of a sweep of stored samples, uint16 [H, W], steps of 0.1 mm.

    A pixel of 0 shows nothing any more. Draws belong to seed and sample, so that a higher strength adds to a lower one.
    """
    if setting == CLEAN["stored"]:
        return sample.range
    if setting.sweep in _ARTIFACTS:
        return shown_with(_ARTIFACTS[setting.sweep](setting.strength), sample, rig, seed).range
    if setting.sweep in SHAPES:
        draws = generator(seed, 0, sample.key, setting.sweep)
        return sample.range * ~lost(setting.sweep, sample.range, setting.strength, rig.camera, draws)
    return _CHANGES[setting.sweep](sample, setting.strength)


def _depth_steps(sample: Sample, bits: float) -> NDArray[np.uint16]:
    """Ranges rounded to one of 2**bits depths, the first and last at the ends of `DEPTHS_M`."""
    low, high = (depth / RANGE_STEP_M for depth in DEPTHS_M)
    last = 2.0**bits - 1
    step = (high - low) / last
    depths = low + step * np.clip(np.rint((sample.range - low) / step), 0, last)
    return np.where(sample.range > 0, np.rint(depths), 0).astype(np.uint16)


def _crop_below(sample: Sample, share: float) -> NDArray[np.uint16]:
    top, bottom = _extent(sample.range, 0)
    image = sample.range.copy()
    image[bottom - round(share * (bottom - top)) :] = 0
    return image


def _crop_above(sample: Sample, share: float) -> NDArray[np.uint16]:
    top, bottom = _extent(sample.range, 0)
    image = sample.range.copy()
    image[: top + round(share * (bottom - top))] = 0
    return image


def _crop_side(sample: Sample, share: float) -> NDArray[np.uint16]:
    left, right = _extent(sample.range, 1)
    image = sample.range.copy()
    image[:, : left + round(share * (right - left))] = 0
    return image


def _extent(image: NDArray[np.uint16], axis: int) -> tuple[int, int]:
    """The first row (axis 0) or column (axis 1) that shows anything, and the first after the last; 0 and 0 if none."""
    places = np.flatnonzero(image.sum(axis=1 - axis, dtype=np.int64))
    return (int(places[0]), int(places[-1]) + 1) if len(places) else (0, 0)


_ARTIFACTS: Final[dict[str, Callable[[float], Artifact]]] = {
    "noise": lambda sigma_mm: Noise(sigma_mm, sigma_mm),
    "missing": lambda share: MissingData((share,)),
}
"""The sweeps of one artifact: name -> the artifact at a strength."""

_CHANGES: Final[dict[str, Callable[[Sample, float], NDArray[np.uint16]]]] = {
    "depth_steps": _depth_steps,
    "crop_below": _crop_below,
    "crop_above": _crop_above,
    "crop_side": _crop_side,
}
