"""Test images of `bench ablation`, the same for every network: each kind tests one effect."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.model.variants.scores import AlteredImages, Condition
from bodyseg_data.artifacts import SHAPES, SensorModel, load_sensor_model
from bodyseg_data.core import Draws
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.loading import RangeImages
from bodyseg_model.evaluation.evaluation import fixed_artifacts

STEPS_MM: Final = (1, 2, 4, 8)
"""Steps of range, coarser than the stored ones."""

_SEED: Final = 0  # of the tests' draws, whatever the training's was: all networks see the same images


@dataclass(frozen=True)
class AblationCondition(Condition):
    """Test images of one kind. label: its name in the results; title: in words.

    only: patterns of the samples' keys. lost: the kind of loss that takes `share` of every image's foreground as well.
    step_mm: what ranges are rounded to, last of all. data: another set than that of the bench. sensor: its artifacts.
    """

    label: str = ""
    title: str = ""
    only: tuple[str, ...] = ()
    lost: str | None = None
    share: float = 0.0
    step_mm: float | None = None
    data: str | None = None
    sensor: SensorModel = field(default_factory=load_sensor_model)

    @property
    def name(self) -> str:
        """The label."""
        return self.label

    def open(self, data: str) -> RangeImages:
        """The images, of the test split. Raises as `RangeImages`."""
        return ConditionImages(self.data or data, self)


CONDITIONS: Final = (
    AblationCondition("all", label="all", title="all artifacts"),
    AblationCondition("none", label="none", title="no artifact"),
    AblationCondition("all", noise_mm=80, label="noise_80", title="noise of 80 mm"),
    AblationCondition("all", missing=0.5, label="missing_50", title="half of the pixels missing"),
    *(
        AblationCondition("all", lost=kind, share=0.3, label=f"{kind}_30", title=f"30 % lost: {kind}")
        for kind in SHAPES
    ),
    AblationCondition("all", only=("*-d215-*", "*-d295-*"), label="near_far", title="2.15 m and 2.95 m away"),
    AblationCondition("all", only=("*-a1?0",), label="other_side", title="azimuths of 100 to 170 degrees"),
    AblationCondition("all", only=("open-A-*",), label="A", title="subject A, postures"),
    AblationCondition("all", only=("open-B-*",), label="B", title="subject B, dressed"),
    AblationCondition("all", only=("open-C-*",), label="C", title="subject C, dressed"),
    AblationCondition("all", only=("open-P*",), label="people", title="other people"),
)


def hard_condition(data: str) -> AblationCondition:
    """The condition of a set of hard poses."""
    return AblationCondition("all", label="hard", title="hard poses", data=data)


def clothes_conditions(dressed: str, bare: str) -> tuple[AblationCondition, ...]:
    """The conditions of dressed bodies, and of the same bodies bare, in two sets that are alike otherwise."""
    worn = ("*-B-*", "*-C-*")
    return (
        AblationCondition("all", label="dressed", title="B and C in clothes", only=worn, data=dressed),
        AblationCondition("all", label="bare", title="B and C without clothes", only=worn, data=bare),
    )


def coarse_conditions(step_mm: float) -> tuple[AblationCondition, ...]:
    """The conditions with coarse steps, for networks trained on fine steps; labelled like those with fine ones."""
    return tuple(AblationCondition(name, label=name, title=name, step_mm=step_mm) for name in ("all", "none"))


class ConditionImages(AlteredImages):
    """Test images of a condition: those of the variant, then with losses, then rounded."""

    def __init__(self, path: str, condition: AblationCondition) -> None:
        fixed = condition.sensor.with_artifacts(*fixed_artifacts(condition.noise_mm, condition.missing))
        super().__init__(path, condition.variant, "test", _SEED, sensor=fixed, only=condition.only)
        self._condition = condition

    def identity(self) -> dict[str, Any]:
        """As `RangeImages.identity`, with what else is done to the images, if anything is."""
        facts = asdict(self._condition)
        altered = {name: facts[name] for name in ("lost", "share", "step_mm") if facts[name]}
        return super().identity() | ({"altered": altered} if altered else {})

    def alter(self, index: int, epoch: int, image: NDArray[np.uint16], labels: NDArray[np.uint8]) -> None:
        """As `AlteredImages.alter`."""
        if self._condition.lost is not None:
            gone = self._lost(self._condition.lost, index, epoch)
            image[gone] = 0
            labels[gone] = BACKGROUND
        if self._condition.step_mm is not None:
            steps = steps_of(self._condition.step_mm, self.step_m)
            image[...] = stepped(image, steps) * steps

    def _lost(self, shape: str, index: int, epoch: int) -> NDArray[np.bool_]:
        clean = self.clean(index)
        draws = Draws(self.seed, epoch, clean.key).generator(f"lost {shape}")
        return SHAPES[shape](clean.range, self._condition.share, draws)


def steps_of(step_mm: float, step_m: float) -> int:
    """Number of stored steps, of `step_m` metres each, in one of `step_mm`; at least 1."""
    return max(1, round(step_mm / 1e3 / step_m))


def stepped(image: NDArray[np.uint16], steps: int) -> NDArray[np.uint16]:
    """A stored range image in steps that are `steps` times as long, uint16 [H, W]; a body stays in front."""
    rounded = np.maximum(np.rint(image / np.float32(steps)), 1)
    return np.where(image == 0, 0, np.minimum(rounded, 65535 // steps)).astype(np.uint16)
