"""Fit between a network and images: do rig and sensor match those that it was trained for.

A network learns how many pixels a metre of a body has. The limits follow from the sweeps `nearer`, `farther` and `rig`
of `bodyseg stability` (docs/results/stability_networks.json): networks of short trainings lose 0 to 2 points of
accuracy where images have 0.8 to 1.25 times as many pixels a metre, 8 to 29 at 0.7 and 1.4, 20 to 34 at 0.6 and 1.7, 59
to 65 at half; the network in the box 0 to 1, 2 to 7, 6 and 38.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from bodyseg_data.artifacts.variants import Augmentation, kinds_of
from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.rig import Rig
from bodyseg_model.networks.checkpoints import Trained

SIMILAR: Final = 1.25
"""Greatest ratio of pixels a metre, either way, that costs a few points of accuracy."""

FAR_OFF: Final = 1.5
"""Ratio beyond which a score says little about a network, and is refused unless asked for."""

_SAME: Final = 1.01


@dataclass(frozen=True)
class RigFit:
    """A network's rig beside that of images. pixels_a_metre: of the images, as a multiple of those trained on, each at
    its rig's stand-off: focal length in pixels over distance.
    """

    trained: Rig
    images: Rig

    @property
    def pixels_a_metre(self) -> float:
        """Ratio of the images' to the network's; 1 fits."""
        return _pixels_a_metre(self.images) / _pixels_a_metre(self.trained)

    @property
    def factor(self) -> float:
        """The same ratio as a number of at least 1, whichever is the larger."""
        return max(self.pixels_a_metre, 1 / self.pixels_a_metre)

    def check(self, path: str, other_rig: bool) -> str | None:
        """One line of warning where the images' rig is another, None where it is not.

        path: of the images, for messages. other_rig: whether images that are far off are wanted. Raises BadConfig for
        these if they are not.
        """
        if self.images == self.trained:
            return None
        rigs = f"{path} is of rig {self.images.name}, the network was trained for rig {self.trained.name}"
        if self.factor > FAR_OFF and not other_rig:
            raise BadConfig(f"{rigs}: {self._difference()}, too far off for a score of it; --other-rig goes on")
        if self.factor > SIMILAR:
            return f"{rigs}: {self._difference()}, which costs much accuracy"
        if self.factor > _SAME:
            return f"{rigs}: {self._difference()}, which costs a few points of accuracy"
        differing = ", ".join(self._differing())
        return f"{rigs}: as many pixels a metre, another {differing}" if differing else None

    def _difference(self) -> str:
        return f"bodies have {self.pixels_a_metre:.2g} times as many pixels a metre"

    def _differing(self) -> list[str]:
        """Names of the fields that differ beside the name."""
        one, other = self.images, self.trained
        differences = {
            "image size": _size(one) != _size(other),
            "stand-off": one.stand_off_m != other.stand_off_m,
            "step of range": one.range_step_mm != other.range_step_mm,
            "projector": one.projectors != other.projectors,
        }
        return [name for name, differs in differences.items() if differs]


def sensor_warning(trained: Trained, augmentation: Augmentation, path: str) -> str | None:
    """One line where images have other artifacts than those trained on, None where they have not.

    augmentation: of the images; artifacts of kinds that its variant leaves out are not compared. path: of the images,
    for messages.
    """
    kinds = kinds_of(augmentation.variant)
    try:
        before = {each.name: each for each in trained.sensor if each.kind in kinds}
    except BadConfig as error:
        return f"the artifacts of {path} cannot be compared with those trained on: {error}"
    now = {each.name: each for each in augmentation.applied}
    differences = {
        "other strengths of": [name for name in now if name in before and now[name] != before[name]],
        "also": [name for name in now if name not in before],
        "without": [name for name in before if name not in now],
    }
    lines = [f"{what} {', '.join(names)}" for what, names in differences.items() if names]
    if not lines:
        return None
    return f"{path} has other artifacts than sensor {trained.sensor.name}, trained on: {'; '.join(lines)}"


def _pixels_a_metre(rig: Rig) -> float:
    return rig.camera.focal_px / rig.stand_off_m


def _size(rig: Rig) -> tuple[int, int]:
    return rig.camera.rows, rig.camera.columns
