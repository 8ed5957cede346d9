"""Pixels lost together: patches that return no light, and stripes of the projected code."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Final, Literal

import numpy as np

from bodyseg_data.artifacts.artifact import Artifact, RangeImage, Scene
from bodyseg_data.artifacts.losses import lost_patches, lost_stripes
from bodyseg_data.core.errors import BadConfig, bounded, check_fields
from bodyseg_data.core.parts import PARTS
from bodyseg_data.core.randomness import Draws
from bodyseg_data.core.rig import Rig

_LABELS: Final = {part.landmark: part.label for part in PARTS}


@dataclass(frozen=True)
class PatchLoss(Artifact):
    """One to four patches lost whole, as dark cloth and hair are: a share of the body that is drawn once an image.

    The share is uniform from `low` to `high`. parts: names of the parts that may be lost, as in `PARTS`; () for all.
    With parts, the share is of their pixels.
    """

    name = "patch_loss"
    kind = "missing_data"
    purposes = ("patch share", "patch loss")
    drawn: ClassVar[Mapping[str, str]] = {"patch_share": "{:.0%} in patches"}

    low: float = bounded(0.0, 0, 1)
    high: float = bounded(0.2, 0, 1)
    parts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_fields(self)
        _check_order(self.low, self.high)
        for part in self.parts:
            if part not in _LABELS:
                raise BadConfig(f"parts must be landmarks of the 33 parts, found {part!r}")

    def draw(self, draws: Draws) -> dict[str, float]:
        """As `Artifact.draw`: "patch_share", the share lost."""
        return {"patch_share": _share(self.low, self.high, draws.chance("patch share"))}

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        """As `Artifact.apply`."""
        clean = scene.sample.range
        if self.parts:
            clean = np.where(np.isin(scene.sample.labels, [_LABELS[part] for part in self.parts]), clean, np.uint16(0))
        lost = lost_patches(clean, image.drawn["patch_share"], draws.generator("patch loss"))
        np.copyto(image.range, 0, where=lost)


@dataclass(frozen=True)
class StripeLoss(Artifact):
    """Two to twelve parallel stripes lost whole: a share of the body that is drawn once an image, uniform from `low` to
    `high`.

    along: "rows" for bands across the image, "columns" for bands down it. None for lines of one code of the rig's
    projector, at right angles to the line from camera to projector: columns for a projector beside the camera.
    """

    name = "stripe_loss"
    kind = "missing_data"
    purposes = ("stripe share", "stripe loss")
    drawn: ClassVar[Mapping[str, str]] = {"stripe_share": "{:.0%} in stripes"}

    low: float = bounded(0.0, 0, 1)
    high: float = bounded(0.2, 0, 1)
    along: Literal["rows", "columns"] | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        _check_order(self.low, self.high)

    def draw(self, draws: Draws) -> dict[str, float]:
        """As `Artifact.draw`: "stripe_share", the share lost."""
        return {"stripe_share": _share(self.low, self.high, draws.chance("stripe share"))}

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        """As `Artifact.apply`."""
        clean, generator = scene.sample.range, draws.generator("stripe loss")
        share = image.drawn["stripe_share"]
        if (self.along or code_lines(scene.rig)) == "rows":
            image.range[lost_stripes(clean, share, generator)] = 0
        else:
            image.range[lost_stripes(np.ascontiguousarray(clean.T), share, generator).T] = 0


def code_lines(rig: Rig) -> Literal["rows", "columns"]:
    """The direction in the camera's image that is nearest to lines of one code: at right angles to the baseline."""
    x, y, _ = rig.camera.axes @ np.subtract(rig.projector.position_m, rig.camera.position_m)
    return "columns" if abs(x) >= abs(y) else "rows"


def _share(low: float, high: float, chance: float) -> float:
    return low + (high - low) * chance


def _check_order(low: float, high: float) -> None:
    if low > high:
        raise BadConfig(f"shares of lost pixels must satisfy low <= high, found low {low} and high {high}")
