"""Drawing of the page of a set: one sample with a sensor's artifacts, its variants, and a network's answer."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from bodyseg_data.artifacts import VARIANTS, Augmentation, RangeImage, SensorModel, VariantName, load_sensor_model
from bodyseg_data.drawing import colour_range, span_of, span_text, window_of
from bodyseg_data.labels import BACKGROUND, LabelMap, load_label_map
from bodyseg_data.loading import RangeImages
from bodyseg_data.rigs import PlacedCamera
from bodyseg_data.samples import ReadSplit, Sample, View, Window, metres
from bodyseg_model.evaluation import KINDS, RigFit, kinds_of, told_kinds
from bodyseg_model.networks import Trained, device_of, predict
from bodyseg_model.viewing.pictures import (
    CONFIDENCE_LEGEND,
    KIND_LEGEND,
    Drawing,
    Layout,
    Legend,
    Panel,
    Points,
    class_image,
    class_legend,
    point_gap_m,
    points_at,
    rig_before,
    share_image,
)

Colouring = Literal["parts", "range", "network", "mistakes", "confidence"]
COLOURINGS: Final[tuple[Colouring, ...]] = get_args(Colouring)
"""What points are coloured by; the last three need a network."""

_COLUMNS: Final = 5
_FIRST: Final = 2000
_FRONT_DEG: Final = 20
_KIND_COLOURS: Final = np.array([colour for _, colour in KIND_LEGEND], np.uint8)


@dataclass(frozen=True)
class Shown:
    """Choice of what is drawn. index: of the sample. epoch: of its draws. network: whether it is asked."""

    index: int = 0
    variant: VariantName = "all"
    epoch: int = 0
    colouring: Colouring = "parts"
    sensor: SensorModel = field(default_factory=load_sensor_model)
    network: bool = True


@dataclass(frozen=True)
class Layers:
    """Images of one size: range in steps, classes, and of the network classes, kinds (255: no class) and confidence."""

    range: NDArray[np.uint16]
    labels: NDArray[np.uint8]
    answer: NDArray[np.uint8] | None = None
    kinds: NDArray[np.uint8] | None = None
    confidence: NDArray[np.float32] | None = None

    def picked(self, pick: Callable[[NDArray[Any]], NDArray[Any]]) -> Layers:
        """The layers after a choice of pixels."""
        picked: dict[str, Any] = {name: None if image is None else pick(image) for name, image in vars(self).items()}
        return Layers(**picked)


@dataclass(frozen=True)
class SampleImages:
    """All images of a sample. variants: name -> image of each of `VARIANTS` and of the one shown. layers: of the one
    shown. milliseconds: of the network. placed: camera and projectors, the body before them.
    """

    sample: Sample
    variants: dict[VariantName, RangeImage] = field(repr=False)
    layers: Layers = field(repr=False)
    milliseconds: float
    placed: tuple[PlacedCamera, ...]

    @property
    def devices(self) -> dict[str, PlacedCamera]:
        """Camera and projectors by their names, to draw."""
        names = ("camera", *("projector", "second projector")[: len(self.placed) - 1])
        return dict(zip(names, self.placed, strict=True))


class SetView:
    """Draws samples of a set. trained: the network to ask, or None.

    path, split, only, where, val_share: as for `RangeImages`, and raises as it does. seed: of the draws. labels: the
    classes that are shown, unions of a network's; None: the network's, or the set's own. Raises BadConfig for others.
    """

    def __init__(
        self,
        path: str | Path,
        trained: Trained | None = None,
        split: ReadSplit | None = None,
        only: Sequence[str] = (),
        where: Sequence[str] = (),
        val_share: float = 0.0,
        seed: int = 0,
        labels: str | Path | LabelMap | None = None,
    ) -> None:
        opened = partial(RangeImages, path, "none", split, seed, only=only or (), where=where, val_share=val_share)
        self.images = opened()
        self.path, self.trained, self.val_share, self.seed = path, trained, val_share, seed
        own = self.images.label_map
        self.label_map = own if trained is None else load_label_map(trained.label_map, self.images.manifest.classes)
        self._joined: NDArray[np.uint8] | None = None
        if labels is not None:
            shown = load_label_map(labels, self.images.manifest.classes)
            answered = shown if trained is None else self.label_map  # only a network's answers are joined
            self.label_map, self._joined = shown, answered.joined_to(shown)
        if self.label_map.template is not None or self.label_map.has_rest:  # of what samples do not hold as a class
            self.images = opened(labels=self.label_map)
        self.rig = self.images.manifest.rig
        self._clean = lru_cache(maxsize=4)(self.images.clean)
        self._asked = False

    def __len__(self) -> int:
        return len(self.images)

    def chosen(self, split: ReadSplit | None, only: Sequence[str], where: Sequence[str]) -> SetView:
        """The view of another choice of the set's samples. Raises BadConfig for one that is wrong or empty."""
        labels = None if self._joined is None else self.label_map
        return SetView(self.path, self.trained, split, only, where, self.val_share, self.seed, labels)

    def first_index(self) -> int:
        """Index of a sample to begin with, among the first ones: of somebody who stands and is seen from the front."""

        def fit(index: int) -> tuple[bool, bool, int]:
            known = self.images.describe(index)
            azimuth = known.get("azimuth_deg")  # a user's own field of that name may be text
            front = isinstance(azimuth, int) and abs((azimuth + 180) % 360 - 180) <= _FRONT_DEG
            return str(known.get("pose")).startswith("stand"), front, -index

        return max(range(min(len(self), _FIRST)), key=fit)

    def index_of(self, key: str) -> int | None:
        """Index of the sample with this key; None if it is not among those chosen."""
        keys = self.images.keys
        return keys.index(key) if key in keys else None

    @property
    def warning(self) -> str | None:
        """One line if the network was trained for another rig than one of the set's."""
        if self.trained is None:
            return None
        return RigFit.worst(self.trained.rig, self.images.manifest.rigs).check(str(self.path), True)

    def images_of(self, shown: Shown) -> SampleImages:
        """Make a sample's images. Raises BadShard for a damaged one, BadConfig or BadSample for artifacts unlike it."""
        sample = self._clean(shown.index)
        rig, lit = self.images.manifest.rig_of(sample), sample.projector_range is not None
        classes = self.images.augmentation.classes
        makers = [
            Augmentation(rig, each, self.seed, shown.sensor, classes)
            for each in dict.fromkeys((*VARIANTS, shown.variant))
        ]
        made = {each.variant: each(sample, shown.epoch) for each in makers if lit or not each.needs_projector}
        image = made[shown.variant if shown.variant in made else "none"]
        layers = Layers(image.range, self.label_map.table[image.labels])
        milliseconds = 0.0
        if self.trained is not None and shown.network:
            layers, milliseconds = self._answered(self.trained, layers)
        return SampleImages(sample, made, layers, milliseconds, rig_before(rig, sample.info.view or View(255, 0)))

    def draw(self, shown: Shown) -> Drawing:
        """Draw a sample. Raises as `images_of`."""
        images = self.images_of(shown)
        lacking: tuple[str, ...] = ()
        if shown.variant not in images.variants:
            lacking = (f"{shown.variant} needs the projector's range, which the sample has not: none is shown",)
            shown = replace(shown, variant="none")
        range_m = metres(images.layers.range, self.rig.range_step_m)
        seen = np.flatnonzero(range_m)
        colours = self._colours(shown.colouring, images.layers.picked(lambda each: each.ravel()[None, seen]))[0]
        return Drawing(
            Points(points_at(range_m, images.placed[0]), colours),
            images.devices,
            self.layout_of(images.sample)[0].draw(self._panels(images, shown)),
            self.facts_of(images, shown) + lacking,
            point_gap_m(range_m, images.placed[0].camera),
            len(seen),
            self.legend_of(images, shown.colouring),
        )

    def layout_of(self, sample: Sample) -> tuple[Layout, Window]:
        """Layout of a sample's panels, and the part of its images that they show: its body, where that is small."""
        window = window_of([sample.range])
        rows, columns = sample.range[window].shape
        return Layout.of(_COLUMNS, (rows, columns)), window

    def _answered(self, trained: Trained, layers: Layers) -> tuple[Layers, float]:
        """The layers with the network's, and its time, milliseconds."""
        batch = torch.from_numpy(metres(layers.range, self.rig.range_step_m))[None, None].to(device_of(trained.network))
        if not self._asked:  # the first answer takes longer than others, for what is loaded then
            predict(trained.network, batch)
            self._asked = True
        start = time.perf_counter()
        labels, confidence = (each[0].cpu().numpy() for each in predict(trained.network, batch))
        milliseconds = 1000 * (time.perf_counter() - start)
        if self._joined is not None:
            labels = self._joined[labels]
        kinds = np.full(labels.shape, BACKGROUND, np.uint8)
        known = layers.labels != BACKGROUND
        kinds[known] = kinds_of(self.label_map)[layers.labels[known], labels[known]]
        return replace(layers, answer=labels, kinds=kinds, confidence=confidence), milliseconds

    def _colours(self, colouring: Colouring, layers: Layers) -> NDArray[np.uint8]:
        """Colours of all pixels, sRGB uint8 [H, W, 3]; without an answer, what it would colour is coloured by parts."""
        seen = layers.range > 0
        if colouring == "range":
            return colour_range(layers.range, *span_of(layers.range))
        if layers.answer is not None and colouring == "network":
            return class_image(layers.answer, seen, self.label_map.colours)
        if layers.kinds is not None and colouring == "mistakes":
            return class_image(layers.kinds, seen, _KIND_COLOURS)
        if layers.confidence is not None and colouring == "confidence":
            return share_image(layers.confidence, seen)
        return class_image(layers.labels, seen, self.label_map.colours)

    def legend_of(self, images: SampleImages, colouring: Colouring) -> Legend:
        """Names of the colours of points; of ranges, those of the panels of labels."""
        if images.layers.confidence is not None and colouring == "confidence":
            return CONFIDENCE_LEGEND
        if images.layers.kinds is not None and colouring == "mistakes":
            told = told_kinds(self.label_map)
            return tuple(each for kind, each in zip(KINDS, KIND_LEGEND, strict=True) if kind in told)
        return class_legend(self.label_map)

    def _panels(self, images: SampleImages, shown: Shown) -> list[list[Panel]]:
        """Two lines: what is stored and the network's answer; the five variants."""
        sample, made, layers = images.sample, images.variants, images.layers
        layout, window = self.layout_of(sample)
        span, projector = span_of(sample.range), sample.projector_range
        measured = span_text(sample.range, self.rig.range_step_m)
        pixels = np.count_nonzero(layers.range)

        def reduced(image: NDArray[Any]) -> NDArray[Any]:
            return layout.reduced(image[window] if image.shape == sample.range.shape else image)

        small = layers.picked(reduced)
        stored = [
            Panel("stored range", colour_range(reduced(sample.range), *span), measured),
            Panel(f"labels, {shown.variant}", self._colours("parts", small), f"{pixels} pixels"),
        ]
        if projector is not None:
            view = colour_range(reduced(projector), *span_of(projector))
            stored.insert(1, Panel("projector's view", view, "what casts shadows"))
        if layers.kinds is not None:
            note = f"{shown.variant}, {images.milliseconds:.0f} ms"
            stored += [
                Panel("network's answer", self._colours("network", small), note),
                Panel("mistakes", self._colours("mistakes", small), f"{_share_right(layers.kinds):.1%} right"),
            ]
        variants = [
            Panel(name, colour_range(reduced(made[name].range), *span), shown.sensor.caption(made[name].drawn))
            for name in VARIANTS
            if name in made
        ]
        return [stored, variants]

    def facts_of(self, images: SampleImages, shown: Shown) -> tuple[str, ...]:
        """Lines of text on a sample: its key, its view, and how much of it the network has right."""
        sample, image, layers = images.sample, images.variants[shown.variant], images.layers
        info, caption = sample.info, shown.sensor.caption(image.drawn)
        body = [str(info.get(name, "")) for name in ("subject", "pose")]
        facts = [
            sample.key,
            ", ".join(filter(None, (*body, info.view.words if info.view else "", f"split {info.split}"))),
            f"{np.count_nonzero(image.range)} pixels of {np.count_nonzero(sample.range)} measured in {shown.variant}"
            + (f": {caption}" if caption else ""),
        ]
        if layers.kinds is not None:
            known = layers.kinds[layers.kinds != BACKGROUND]
            shares = np.bincount(known, minlength=len(KINDS)) / max(1, len(known))
            told = told_kinds(self.label_map)
            named = zip(KINDS, KIND_LEGEND, shares.tolist(), strict=True)
            wrong = ", ".join(f"{name} {share:.1%}" for kind, (name, _), share in named if kind in told - {"right"})
            facts.append(f"network: {_share_right(layers.kinds):.1%} of pixels right; {wrong}")
            facts += [] if self.warning is None else [self.warning]
        return tuple(facts)


def _share_right(kinds: NDArray[np.uint8]) -> float:
    """Share of the pixels with a true class whose answer is right; kinds: uint8 [H, W]."""
    known = kinds[kinds != BACKGROUND]
    return float((known == 0).mean()) if len(known) else 0.0
