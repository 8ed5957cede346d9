"""Segmentation of a frame of any range camera: remove the background, resample and label each body, map labels back."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import NoneType
from typing import Any, Final, Self

import numpy as np
import torch
from numpy.typing import NDArray

from bodyseg_data.bodies import load_template
from bodyseg_data.core import BadConfig, Stopwatch, check_choice, check_class
from bodyseg_data.labels import BACKGROUND, NOWHERE, PART_COUNT, PARTS33, LabelMap, load_label_map
from bodyseg_data.machine import of_each, required
from bodyseg_data.rigs import Camera, Rig, load_rig
from bodyseg_model.networks import Network, Trained, check_label_map, device_of, predict_each
from bodyseg_model.runtimes import on_backend
from bodyseg_model.segmentation.carried_labels import CarriedLabels
from bodyseg_model.segmentation.finder import Background, Found, find_bodies, part_people, shipped_finder, view_of
from bodyseg_model.segmentation.joints import found_joints
from bodyseg_model.segmentation.persons import Records, SurfacePixels
from bodyseg_model.segmentation.views import BodyView, metres_of, usual_views, view_body, view_frame

STAGES: Final = ("find", "resample", "network", "back", "video")
_SURE: Final = 0.8  # mean confidence; less have at most 3 of 276 images of people who stand, and half of those who lie

LEAST_CONFIDENCE: Final = "least_confidence_of_people"
"""Entry of a network's card: bodies are things whose mean probability of a person, times the mean confidence of their
labels, is less."""


def least_confidence_of_people(card: Mapping[str, Any]) -> float:
    """Read that entry, 0 for a card without one. Raises BadConfig for a value that is none from 0 to 1."""
    least = card.get(LEAST_CONFIDENCE, 0.0)
    if isinstance(least, bool) or not isinstance(least, (int, float)) or not 0 <= least <= 1:
        raise BadConfig(f"a network's card: {LEAST_CONFIDENCE} must be a number from 0 to 1, found {least!r}")
    return float(least)


@dataclass(frozen=True, eq=False)
class LabelledBody:
    """One body of a frame: its pixels, int64 [N], row * columns + column, ascending, and their confidence, float32 [N].

    median_range_m, turn_rad, scale: its median range, and rotation and scale of its view for the network (`BodyView`).
    person: mean probability over its pixels that they show a person, 0 to 1, by the finder; None if none was asked.
    places: with a dense segmenter alone, the point of the template that each pixel shows, uint16 [N]. track: in a video
    alone, the number that the body keeps from frame to frame (`CarriedLabels`).
    """

    pixels: NDArray[np.intp] = field(repr=False)
    median_range_m: float
    turn_rad: float
    scale: float
    confidence: NDArray[np.float32] = field(repr=False)
    person: float | None = None
    places: NDArray[np.uint16] | None = field(default=None, repr=False)
    track: int | None = None

    @property
    def mean_confidence(self) -> float:
        """Mean confidence of its pixels, 0 to 1."""
        return float(self.confidence.mean(dtype=np.float64))


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Answer to a frame: its labels and bodies, from which methods make points, parts and joints of people.

    labels: uint8 [H, W], the network's classes on bodies, 255 elsewhere; label_map: these classes, if known.
    bodies: the largest first. things: what the finder takes for people and the network doubts, or sees in no view
    (scale and confidence 0), without labels.
    range_m: float32 [H, W], the frame without lens distortion, metres, 0 = nothing measured; camera: of `range_m`.
    mirrored: the frame shows left for right. milliseconds: time of each of `STAGES`.
    """

    labels: NDArray[np.uint8] = field(repr=False)
    bodies: tuple[LabelledBody, ...]
    milliseconds: dict[str, float]
    range_m: NDArray[np.float32] = field(repr=False)
    camera: Camera = field(repr=False)
    things: tuple[LabelledBody, ...] = ()
    mirrored: bool = field(default=False, repr=False)
    label_map: LabelMap | None = field(default=None, repr=False)

    @property
    def pixels(self) -> int:
        """Number of pixels that show a body."""
        return sum(len(body.pixels) for body in self.bodies)

    @property
    def mean_confidence(self) -> float | None:
        """Mean confidence, 0 to 1, of all pixels that show a body; None if none does."""
        if not self.bodies:
            return None
        return float(np.concatenate([body.confidence for body in self.bodies]).mean(dtype=np.float64))

    @property
    def confidence(self) -> NDArray[np.float32]:
        """Confidence of every pixel, float32 [H, W], 0 to 1; 0 where there is no body."""
        return self._image(np.float32(0), [body.confidence for body in self.bodies])

    @property
    def persons(self) -> NDArray[np.uint16]:
        """The person that each pixel shows, uint16 [H, W]: from 1, in the order of `bodies`; 0 where there is none."""
        return self._image(np.uint16(0), range(1, len(self.bodies) + 1))

    @property
    def template(self) -> NDArray[np.uint16]:
        """The point of the body's template that each pixel shows, uint16 [H, W] (`bodyseg_data.load_template`); 65535
        where there is no label, and everywhere unless the segmenter is dense.
        """
        places = [NOWHERE if body.places is None else body.places for body in self.bodies]
        image = self._image(np.uint16(NOWHERE), places)
        image[self.labels == BACKGROUND] = NOWHERE
        return image

    def _image(self, nothing: Any, of_bodies: Iterable[Any]) -> NDArray[Any]:
        """An image [H, W] of one value or [N] values for each body, and `nothing` elsewhere, whose type it has."""
        image = np.full(self.labels.shape, nothing)
        for body, values in zip(self.bodies, of_bodies, strict=True):
            image.ravel()[body.pixels] = values
        return image

    def joined(self, coarser: str | Path | LabelMap) -> Self:
        """The same answer with labels of coarser classes, of which the network's are parts; confidences stay those of
        the finer labels. Raises BadConfig as `load_label_map` and `LabelMap.joined_to`, or without a `label_map`.
        """
        if self.label_map is None:
            raise BadConfig(f"labels {coarser!s} are joined from known classes: the segmenter has no label_map")
        coarser = coarser if isinstance(coarser, LabelMap) else load_label_map(coarser, self.label_map.of)
        return replace(self, labels=self.label_map.joined_to(coarser)[self.labels], label_map=coarser)

    def points(self) -> Records:
        """Points of people, `POINT` [N]: x, y, z (metres: right, down, ahead), label (255 none), person, confidence."""
        return SurfacePixels(self).points()

    def parts(self, near_m: Sequence[float] = (0.0, 0.0, 0.0)) -> Records:
        """Each person's parts, `PART` [N]: labelled pixels, box, centroid_m, nearest_m, distance_m, confidence; axes as
        of `points`. near_m: the point to which distances are. Raises BadConfig unless it is three finite numbers.
        """
        return SurfacePixels(self).parts(near_m)

    def joints(self) -> Records:
        """The 15 `JOINTS` of every person, `JOINT` [people, 15]: position_m, metres, axes as of `points`, NaN where
        unsure; error_m, to be expected. Raises BadConfig for a network of other classes than the 33 parts.
        """
        return found_joints(self)


def turned_image(image: NDArray[Any], quarters: int) -> NDArray[Any]:
    """An image [H, W] turned clockwise by right angles, in rows of its own; the image itself for none."""
    return np.ascontiguousarray(np.rot90(image, -quarters)) if quarters % 4 else image


def _turned_back(answer: Segmentation, quarters: int) -> Segmentation:
    """Turn the answer to an upright frame back to the frame, which was turned clockwise by so many right angles."""
    # place: for each pixel of the upright frame, its pixel in the original one.
    labels, range_m = (turned_image(image, -quarters) for image in (answer.labels, answer.range_m))
    place = turned_image(np.arange(labels.size).reshape(labels.shape), quarters).ravel()

    def back(body: LabelledBody) -> LabelledBody:
        order = np.argsort(pixels := place[body.pixels])
        places = None if body.places is None else body.places[order]
        return replace(body, pixels=pixels[order], confidence=body.confidence[order], places=places)

    bodies, things = (tuple(map(back, each)) for each in (answer.bodies, answer.things))
    return replace(answer, labels=labels, bodies=bodies, things=things, range_m=range_m)


def _may_lie(range_m: NDArray[np.float32]) -> bool:
    """True for a view, [h, w], metres, of a person who may lie: a fifth wider than high, as seen from the height of the
    floor; or the upper third of pixels 0.15 m farther away than the lower third, as seen from above.
    """
    seen = range_m > 0
    high, wide = (np.count_nonzero(seen.any(axis=axis)) for axis in (1, 0))
    ranges = range_m[seen]
    third = max(1, len(ranges) // 3)
    return bool(wide > 1.2 * high or ranges[:third].mean() > ranges[-third:].mean() + 0.15)


class Segmenter:
    """Labels the frames of one camera without lens distortion, each alone or, with `video`, steadied by those before.

    network: in evaluation mode, on any backend (`on_backend`); frames are moved to its device. With its card, a
    `Trained`, it brings rig, label_map, doubted_below and background. camera: the one that takes the frames; with lens
    distortion, they must be undistorted first (`Undistortion`). background, mirrored, least_confidence, finder: as of
    `FrameLabeller`; the background of a network alone is by default `Background()`.
    rig: that the network was trained for, by default the paper's. label_map: the network's classes; by default the 33
    parts for a network of 33. doubted_below: in the background mode "people", people whose mean probability, by the
    finder, times the mean confidence of their labels is less are things (`least_confidence_of_people`).
    video: carries evidence from frame to frame, which must come in order (`CarriedLabels`); None to label each alone.
    quarters: right angles, 0 to 3, by which the camera is mounted turned clockwise, as seen from behind it.
    dense: also tell where on the body's template each pixel lies (`Segmentation.template`).
    either_way: a person of whose parts the network is unsure is labelled upside down, too; the surer labels stay.
    Raises BadConfig for a confidence or quarters out of range, a camera with distortion, a network of other classes or
    that knows no places and is to be dense, and a finder that is none or is to label; MissingLibrary without numba.
    """

    def __init__(
        self,
        network: Network | Trained,
        camera: Camera,
        background: Background | None = None,
        *,
        mirrored: bool = False,
        least_confidence: float = 0.0,
        rig: Rig | None = None,
        doubted_below: float | None = None,
        video: CarriedLabels | None = None,
        quarters: int = 0,
        label_map: LabelMap | None = None,
        finder: Network | None = None,
        dense: bool = False,
        either_way: bool = True,
    ) -> None:
        if isinstance(network, Trained):
            rig, label_map = rig or network.rig, label_map or network.label_map
            background = background or Background.usual(label_map)
            doubted_below = least_confidence_of_people(network.card) if doubted_below is None else doubted_below
            network = network.network
        check_class("camera", camera, Camera)
        check_class("background", background, Background, NoneType)
        check_class("rig", rig, Rig, NoneType)
        check_class("video", video, CarriedLabels, NoneType)
        if not 0 <= least_confidence <= 1:
            raise BadConfig(f"a confidence must be 0 to 1, found {least_confidence:g}")
        if camera.distortion is not None:
            raise BadConfig(f"frames must be undistorted before they are labelled, found {camera.distortion}")
        required("numba", "labelling frames", "segment")
        self.camera, self.mirrored, self.least_confidence = camera, mirrored, least_confidence
        self.quarters = check_choice("quarters", quarters, range(4))  # not degrees
        self._upright = camera.turned(quarters)
        self.background = background or Background()
        self.rig = rig or load_rig()
        self.video = video
        self._network = on_backend(network)
        if dense and not self._network.on_template:
            raise BadConfig(
                "dense answers need a network with places on the template, computed by torch: that of `compact` ships, "
                "`train --settings '{\"template\": true}'` trains one"
            )
        if self._network.settings.get("focal_px") and self.background.mode != "frame":
            raise BadConfig("a network with focal_px sees whole frames: it is for --finder or --background frame")
        finds = self.background.mode == "people"
        self.doubted_below = (doubted_below or 0.0) if finds else 0.0
        self.finder = on_backend(finder or shipped_finder().network) if finds else None
        if self.finder is not None:
            view_of(self.finder, self._upright)  # now, so that what is no finder is refused
        self.label_map = label_map or (PARTS33 if network.classes == PART_COUNT else None)
        self._asked = dense, self.label_map == PARTS33
        self._either_way = either_way and self.label_map == PARTS33 and self.background.mode != "frame"
        if self.label_map is not None:
            check_label_map(self._network, self.label_map)
        self._prepared = False

    def __repr__(self) -> str:
        camera = f"{self.camera.rows} x {self.camera.columns} pixels, focal length {self.camera.focal_px:g} px"
        return f"Segmenter({type(self._network).__name__} on {device_of(self._network)}, {camera}, {self.background})"

    def __call__(self, range_m: NDArray[np.float32]) -> Segmentation:
        """Label one frame, [H, W], metres along the optical axis, 0 = nothing measured. With `video`, frames must come
        in order. Those that the network doubts too much to be people become things.

        Raises BadConfig as `metres_of`, or for a body that no view can show; in the background mode "people", where a
        wide camera meets one in a thousand, that is a thing, too.
        """
        range_m, watch = metres_of(range_m, self.camera), Stopwatch(STAGES)
        with watch("find"):
            range_m = turned_image(range_m, self.quarters)
            # Mirrored frames are not turned: half of the images that finders are trained on are mirrored.
            found = find_bodies(range_m, self._upright, self.background, self.finder)
        with watch("resample"):
            views = of_each(partial(self._view, range_m), [body.pixels for body in found], torch.get_num_threads())
        labels = np.full(range_m.shape, BACKGROUND, np.uint8)
        seen, bodies, things = list[tuple[Found, BodyView]](), list[LabelledBody](), list[LabelledBody]()
        for one, view in zip(found, views, strict=True):
            if view is not None:
                seen.append((one, view))
                continue
            median_m, nothing = float(np.median(range_m.ravel()[one.pixels])), np.zeros(len(one.pixels), np.float32)
            things.append(LabelledBody(one.pixels, median_m, 0.0, 0.0, nothing, one.person))
        with watch("network"):
            answers = self._answers([view.range_m for _, view in seen])
        with watch("back"):
            for ((pixels, person), view), answer in zip(seen, answers, strict=True):
                own_labels, confidence, *places = map(view.back, answer)
                seen_as = view.median_range_m, view.turn_rad, view.scale
                body = LabelledBody(pixels, *seen_as, confidence, person, places=places[0] if places else None)
                if person is not None and person * body.mean_confidence < self.doubted_below:
                    things.append(body)
                    continue
                labels.ravel()[pixels] = own_labels
                bodies.append(body)
        if self.video is not None:
            with watch("video"):
                steadied = [(body.pixels, body.confidence) for body in bodies]
                labels = self.video(range_m, labels, steadied, self._upright)
                bodies = [replace(body, track=n) for body, n in zip(bodies, self.video.tracks, strict=True)]
                if all(self._asked):  # the network's points are of the parts that it sees, not of those shown
                    nearest, shown = load_template().nearest_of_parts, labels.ravel()
                    bodies = [replace(body, places=nearest[shown[body.pixels], body.places]) for body in bodies]
        for labelled in bodies:
            labels.ravel()[labelled.pixels[labelled.confidence < self.least_confidence]] = BACKGROUND
        made = labels, tuple(bodies), watch.milliseconds, range_m, self.camera, tuple(things)
        segmentation = Segmentation(*made, self.mirrored, self.label_map)
        return _turned_back(segmentation, self.quarters) if self.quarters else segmentation

    def _view(self, range_m: NDArray[np.float32], pixels: NDArray[np.intp]) -> BodyView | None:
        """What the network sees of a body; None for one of people whom no view can show."""
        if self.background.mode == "frame":
            return view_frame(range_m, pixels, self.mirrored)
        try:
            return view_body(range_m, pixels, self._upright, self.rig, self.mirrored)
        except BadConfig:
            if self.background.mode != "people":
                raise
            return None

    def _answers(self, views: Sequence[NDArray[np.float32]]) -> list[tuple[NDArray[Any], ...]]:
        """The network's answers to views, as of `predict_each`: where it is unsure, those to the views upside down, if
        it is surer of these. In training it saw more of the people who lie from one end than from the other.
        """
        answers = predict_each(self._network, views, *self._asked)
        unsure = [n for n, (_, sure, *_) in enumerate(answers) if sure.sum() < _SURE * np.count_nonzero(sure)]
        again = [n for n in unsure if self._either_way and _may_lie(views[n])]
        others = predict_each(self._network, [turned_image(views[n], 2) for n in again], *self._asked)
        for n, answer in zip(again, others, strict=True):
            if answer[1].sum() > answers[n][1].sum():
                answers[n] = tuple(turned_image(each, 2) for each in answer)
        return answers

    def prepare(self) -> None:
        """Load the compiled loops and label usual views, so that the first frames take no longer than others: a network
        takes longer for each size and number of views that it has not met. Further calls do nothing.
        """
        if self._prepared:
            return
        self._prepared = True
        room = np.full((self._upright.rows, self._upright.columns), self.background.far_m, np.float32)
        find_bodies(room, self._upright, self.background, self.finder)
        if self.finder is not None:
            part_people(room, room > 0, self._upright)
        view_body(np.full_like(room, self.rig.stand_off_m), np.arange(1), self._upright, self.rig, self.mirrored)
        if self.video is not None:
            seen = [(np.arange(room[:9].size), np.ones(room[:9].size, np.float32))]
            another = CarriedLabels(self.video.carrying)  # the second frame moves
            for _ in range(2):
                another(room, np.zeros(room.shape, np.uint8), seen, self._upright)
            if all(self._asked):
                _ = load_template().nearest_of_parts
        whole = self.background.mode == "frame"  # then there are no views of bodies
        for views in [[room]] if whole else usual_views(self.rig, self._network.together):
            predict_each(self._network, views, *self._asked)
