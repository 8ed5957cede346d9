"""How steady labels are while a body moves: TC and VC by exact correspondence, with fresh artifacts in every frame.

TC is the mIoU of a prediction and the next one warped onto it (Liu et al., "Efficient semantic video segmentation with
per-frame inference", 2020); VC is the share of places whose label stays through a window of frames (Miao et al.,
"VSPW: a large-scale dataset for video scene parsing in the wild", 2021). They follow places by optical flow, or pixels
without following them; here meshes say where a place of the skin has gone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from bodyseg_data.artifacts.artifact import RangeImage
from bodyseg_data.artifacts.variants import Augmentation, VariantName
from bodyseg_data.bodies.motions.catalogue import FRAMES_PER_SECOND
from bodyseg_data.bodies.source import BodySource
from bodyseg_data.bodies.sources import open_source
from bodyseg_data.core.errors import BadConfig, check_int
from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.core.rig import Rig, load_rig
from bodyseg_data.loading.range_images import metres
from bodyseg_model.evaluation.scores import ConfusionMatrix
from bodyseg_model.networks.network import Network
from bodyseg_model.networks.registry import device_of, predict
from bodyseg_model.stability.correspondence import NOT_SEEN, SeenBody, follow
from bodyseg_model.stability.motion_frames import Frame, choose_shots, take_shot

SHOTS: Final = 4
FRAMES: Final = 16
WINDOW: Final = 8
WITH_AND_WITHOUT: Final[tuple[VariantName, ...]] = ("all", "none")
"""Fresh artifacts in every frame, and what flickers without any."""

Labels = NDArray[np.uint8]


@dataclass(frozen=True)
class Tracks:
    """Where places of the skin are seen, as places in flat images.

    pairs: for every frame but the last, int [2, P], here and in the next. windows: for every frame that begins a
    window, int [window, P], places seen in all of its frames.
    """

    pairs: list[NDArray[np.intp]]
    windows: list[NDArray[np.intp]]

    def measured(self, images: NDArray[np.bool_]) -> Tracks:
        """Those places whose pixel was measured in all their frames. images: bool [frames, H, W]."""
        flat = images.reshape(len(images), -1)
        pairs, windows = (
            [places[:, _through(flat, start, places).all(axis=0)] for start, places in enumerate(tracks)]
            for tracks in (self.pairs, self.windows)
        )
        return Tracks(pairs, windows)

    def places(self) -> int:
        """How many places are seen throughout a window, summed over windows."""
        return sum(places.shape[1] for places in self.windows)


def find_tracks(bodies: Sequence[SeenBody], window: int) -> Tracks:
    """Follow what each frame sees through the window that begins there. Raises BadConfig as `follow`.

    Every frame of a window is reached from its first at once, so that nothing adds up on the way.
    """
    tracks = Tracks([], [])
    for start, first in enumerate(bodies[:-1]):
        whole = start + window <= len(bodies)
        later = bodies[start + 1 : start + window] if whole else bodies[start + 1 : start + 2]
        found = np.stack([first.pixels, *(follow(first, body) for body in later)])
        tracks.pairs.append(found[:2, found[1] != NOT_SEEN])
        if whole:
            tracks.windows.append(found[:, (found != NOT_SEEN).all(axis=0)])
    return tracks


class Steadiness:
    """Counts over shots. `agreement`: prediction against the next one; `truth`: prediction against truth.

    Of places in windows: places, how many; constant, those with one label throughout; right, with one and the true one.
    material, material_constant, material_right: the same three of places whose true label is one throughout.
    """

    def __init__(self) -> None:
        self.agreement, self.truth = ConfusionMatrix(), ConfusionMatrix()
        self.places = self.constant = self.right = 0
        self.material = self.material_constant = self.material_right = 0

    def add(self, predicted: Labels, truth: Labels, tracks: Tracks) -> None:
        """Count one shot. predicted, truth: uint8 [frames, H, W], labels wherever tracks lead; pixels whose truth is
        255 do not count.
        """
        self.truth.add(truth, predicted)
        flat, true = predicted.reshape(len(predicted), -1), truth.reshape(len(truth), -1)
        for start, places in enumerate(tracks.pairs):
            self.agreement.add(*_through(flat, start, places))
        for start, places in enumerate(tracks.windows):
            labels, wanted = _through(flat, start, places), _through(true, start, places)
            constant, material = (labels == labels[0]).all(axis=0), (wanted == wanted[0]).all(axis=0)
            right = constant & (labels == wanted).all(axis=0)
            self.places += places.shape[1]
            self.constant += int(constant.sum())
            self.right += int(right.sum())
            self.material += int(material.sum())
            self.material_constant += int((constant & material).sum())
            self.material_right += int((right & material).sum())

    def to_json(self) -> dict[str, Any]:
        """Scores; a share of nothing is null."""
        return {
            "tc": _share(self.agreement.mean_iou()),
            "vc": _share(self.constant, self.places),
            "vc_right": _share(self.right, self.places),
            "vc_where_truth_stays": _share(self.material_constant, self.material),
            "vc_right_where_truth_stays": _share(self.material_right, self.material),
            "accuracy": _share(self.truth.average_per_class_accuracy()),
        }


def _through(flat: NDArray[Any], start: int, places: NDArray[np.intp]) -> NDArray[Any]:
    """What flat images [frames, H * W] from frame `start` on hold at places [n, P], [n, P]."""
    return np.stack([image.take(row) for image, row in zip(flat[start:], places, strict=False)])


def temporal(
    networks: Mapping[str, Network],
    source: BodySource | None = None,
    *,
    shots: int = SHOTS,
    frames: int = FRAMES,
    window: int = WINDOW,
    variants: Sequence[VariantName] = WITH_AND_WITHOUT,
    seed: int = 0,
    rig: Rig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """TC and VC of every network, in evaluation mode, over shots of motions that nobody was trained on; plain JSON.

    source: whose bodies move, the open ones by default; rig: what sees them, the paper's by default. Each shot is
    rendered once. Every network labels every frame alone, as it would come from a sensor, in every variant; draws are
    new in every frame. All variants are counted at the same places, those measured in each of them. The truth is asked
    too, as a network that is always right: what it lacks of 1 is what pixels and the partition do.
    progress: called with frames done and frames in all; rendering one counts as one, as does labelling one.

    Raises BadConfig for counts that are too small, a window longer than a shot or no variant; otherwise as
    `choose_shots`, `take_shot` and `predict`.
    """
    shots = check_int("the number of shots", shots, 1)
    window = check_int("the frames of a window", window, 2)
    if check_int("the frames of a shot", frames, 2) < window:
        raise BadConfig(f"a shot must be at least as long as a window, found {frames} frames and a window of {window}")
    if not variants:
        raise BadConfig("steadiness needs at least one variant, found none")
    source, rig = open_source("open") if source is None else source, load_rig() if rig is None else rig
    augmentations = {variant: Augmentation(rig, variant, seed) for variant in variants}
    chosen = choose_shots(source, shots, frames)
    tallies = {name: {variant: Steadiness() for variant in variants} for name in networks}
    truth, seen_throughout = Steadiness(), 0
    done, total = 0, shots * frames * (1 + len(variants) * len(networks))

    def advance(count: int = 1) -> None:
        nonlocal done
        done += count
        if progress is not None:
            progress(done, total)

    for shot in chosen:
        taken: list[Frame] = []
        for frame in take_shot(source, shot, rig):
            taken.append(frame)
            advance()
        tracks = find_tracks([frame.seen for frame in taken], window)
        images = {
            variant: [augmentation(frame.sample) for frame in taken] for variant, augmentation in augmentations.items()
        }
        measured: NDArray[np.bool_] = np.all([[image.range > 0 for image in made] for made in images.values()], axis=0)
        kept = tracks.measured(measured)
        labels = np.where(measured, np.stack([frame.sample.labels for frame in taken]), np.uint8(BACKGROUND))
        seen_throughout += tracks.places()
        truth.add(labels, labels, kept)
        for variant, made in images.items():
            for name, network in networks.items():
                tallies[name][variant].add(_labels(network, made), labels, kept)
                advance(frames)
    return {
        "source": source.name,
        "shots": [{"first": shot.bodies[0].mesh, "last": shot.bodies[-1].mesh, **asdict(shot.view)} for shot in chosen],
        "frames": frames,
        "window": window,
        "frames_per_second": FRAMES_PER_SECOND,
        "seed": seed,
        "pairs": truth.agreement.pixels,
        "places": truth.places,
        "measured_throughout": _share(truth.places, seen_throughout),
        "truth_stays": _share(truth.material, truth.places),
        "truth": truth.to_json(),
        "networks": {
            name: {variant: tally.to_json() for variant, tally in by_variant.items()}
            for name, by_variant in tallies.items()
        },
    }


def _labels(network: Network, images: Sequence[RangeImage]) -> Labels:
    """What a network says of frames that come one by one, uint8 [frames, H, W]."""
    device = device_of(network)
    ranges = (torch.from_numpy(metres(image.range))[None, None].to(device) for image in images)
    return np.stack([predict(network, range_m).labels[0].cpu().numpy() for range_m in ranges])


def _share(part: float, whole: float = 1) -> float | None:
    return round(part / whole, 5) if whole and not np.isnan(part) else None
