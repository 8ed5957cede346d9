"""Conditions under which `bench variants` evaluates every network, and the scores, kept beside the network.

Section 3.6 of the paper: "test images always include random additive noise, missing data, and occlusions". So where it
sweeps one artifact (Figs. 7 and 8), the other two are as in X_all: the images of that set, each with the same strength
of the one artifact in place of its own. Section 4.2 agrees: over its sweep of noise, training with missing data and
with occlusions gains most, which it only can where test images have them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.model.border_distance import BorderErrors
from benches.result_cache import ResultCache, network_identity
from bodyseg_data.artifacts import VARIANTS, RangeImage, VariantName
from bodyseg_data.core import Draws
from bodyseg_data.loading import RangeImages
from bodyseg_model.evaluation import evaluate, open_images, report
from bodyseg_model.networks import Network, device_of

FILE: Final = "cached_results.json"
"""In a run's folder."""

SIGMAS_MM: Final = (0, 10, 20, 30, 40, 50, 60, 80, 100)
MISSING: Final = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
GRAINS_PX: Final = (1, 4, 16, 64)
GRAIN_MM: Final = 40

_SEED: Final = 0  # of the tests' draws, whatever the training's was: all networks see the same images
_BATCH: Final = 1  # as a sensor gives them
_KEPT: Final = ("images", "pixels", "average_per_class_accuracy", "pixel_accuracy", "mean_iou", "swaps", "subsets")


@dataclass(frozen=True)
class Condition:
    """Test images of one kind: a variant, with one strength of noise or of missing data for all if it is not None.

    grain_px: noise of `GRAIN_MM` that is equal over squares of so many pixels, on top of all else; 0 for none. flat:
    the body is at one range, so that its outline alone is left.
    """

    variant: VariantName
    noise_mm: float | None = None
    missing: float | None = None
    grain_px: int = 0
    flat: bool = False

    @property
    def name(self) -> str:
        """The condition in words."""
        strengths = [f"sigma {self.noise_mm:g} mm"] if self.noise_mm is not None else []
        strengths += [f"{self.missing:.0%} missing"] if self.missing is not None else []
        strengths += [f"{GRAIN_MM} mm by {self.grain_px} px"] if self.grain_px else []
        strengths += ["flat"] if self.flat else []
        return ", ".join([self.variant, *strengths])

    def open(self, data: str) -> RangeImages:
        """The images, of the test split."""
        if self.grain_px or self.flat:
            return ReliefImages(data, self)
        return open_images(data, self.variant, "test", _SEED, noise_mm=self.noise_mm, missing=self.missing)


class AlteredImages(RangeImages, ABC):
    """Test images that are altered after their artifacts."""

    def write(
        self,
        index: int,
        epoch: int,
        image: NDArray[np.uint16],
        labels: NDArray[np.uint8],
        planes: Sequence[NDArray[Any]] = (),
    ) -> None:
        """As `RangeImages.write`."""
        super().write(index, epoch, image, labels, planes)
        self.alter(index, epoch, image, labels)

    def image(self, index: int, epoch: int | None = None) -> RangeImage:
        """As `RangeImages.image`."""
        made = super().image(index, epoch)
        self.alter(index, self.epoch if epoch is None else epoch, made.range, made.labels)
        return made

    @abstractmethod
    def alter(self, index: int, epoch: int, image: NDArray[np.uint16], labels: NDArray[np.uint8]) -> None:
        """Alter an image, uint16 [H, W], stored steps, and its labels, uint8 [H, W], in place."""


class ReliefImages(AlteredImages):
    """Test images of a condition with a grain, or flat."""

    def __init__(self, path: str, condition: Condition) -> None:
        super().__init__(path, condition.variant, "test", _SEED)
        self._grain_px, self._flat = condition.grain_px, condition.flat

    def alter(self, index: int, epoch: int, image: NDArray[np.uint16], labels: NDArray[np.uint8]) -> None:
        """As `AlteredImages.alter`."""
        if self._flat:
            image[image > 0] = np.median(image[image > 0])
        if self._grain_px:
            draws = Draws(self.seed, epoch, self.clean(index).key).generator("grain")
            sides = [-(-side // self._grain_px) for side in image.shape]
            noise = draws.normal(0, GRAIN_MM / 1e3 / self.step_m, sides)
            whole = noise.repeat(self._grain_px, 0).repeat(self._grain_px, 1)[: image.shape[0], : image.shape[1]]
            image[...] = np.where(image > 0, np.clip(np.rint(image + whole), 1, 65535), 0)

    def identity(self) -> dict[str, Any]:
        """As `RangeImages.identity`, with what else is done to the images."""
        return super().identity() | {"grain": [self._grain_px, GRAIN_MM], "flat": self._flat}


@dataclass(frozen=True)
class Sweep:
    """One artifact in rising strength; the conditions belong to the strengths, one by one."""

    title: str
    strengths: tuple[float, ...]
    conditions: tuple[Condition, ...]

    def at(self, strength: float) -> Condition:
        """The condition of one of the strengths."""
        return self.conditions[self.strengths.index(strength)]


TABLE: Final = {name: Condition(name) for name in VARIANTS}
"""The test sets of Table 1."""

SWEEPS: Final = {
    "noise": Sweep("noise", SIGMAS_MM, tuple(Condition("all", noise_mm=sigma) for sigma in SIGMAS_MM)),
    "missing": Sweep("missing data", MISSING, tuple(Condition("all", missing=share) for share in MISSING)),
    "grain": Sweep("grain of noise", GRAINS_PX, tuple(Condition("none", grain_px=size) for size in GRAINS_PX)),
}
"""Figs. 7 and 8: the other artifacts as in X_all. And noise that a patch of pixels averages away, or does not."""


class Evaluator:
    """Evaluates networks, each condition once: scores are kept in the network's folder."""

    def __init__(self, data: str, images: int) -> None:
        self._data, self._count = data, images
        self._opened: tuple[Condition, RangeImages] | None = None
        self._caches: dict[tuple[Path, str], ResultCache] = {}

    def images(self, condition: Condition) -> RangeImages:
        """The test images of a condition; the last ones stay open."""
        if self._opened is None or self._opened[0] != condition:
            self._opened = condition, condition.open(self._data)
        return self._opened[1]

    def scores(self, folder: Path, network: Network, condition: Condition, extras: bool) -> dict[str, Any]:
        """Scores of the network of a run's folder, as of `evaluation_report.report` but for its tables.

        extras: count confidences and distances to borders as well. Raises as `ResultCache` and `evaluate`.
        """
        images = self.images(condition)
        query = {
            "condition": condition.name,
            "images": images.identity(),
            "count": self._count,
            "batch": _BATCH,
            "extras": extras,
            "device": device_of(network).type,
        }
        cache = self._cache(folder, type(condition).__module__)
        found = cache.get(query)
        if found is None:
            borders = BorderErrors(images)
            watch = borders.watch if extras else None
            judged = evaluate(network, images, self._count, confidences=extras, batch_size=_BATCH, watch=watch)
            answer = report(judged)
            found = {name: answer[name] for name in _KEPT}
            if extras:
                found |= {"confidence": answer["confidence"], "border_distance_px": borders.to_json()}
            cache.put(query, found)
        return found

    def _cache(self, folder: Path, conditions: str) -> ResultCache:
        """The cache in a run's folder. conditions: the module that makes the images."""
        key = folder, conditions
        if key not in self._caches:
            self._caches[key] = ResultCache(folder / FILE, network_identity(folder), __name__, conditions)
        return self._caches[key]
