"""Body parts on a frame of any range camera: background off, each body as the network knows bodies, labels back."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.core.rig import Camera, Rig, load_rig
from bodyseg_model.networks.network import Network
from bodyseg_model.networks.registry import device_of, predict
from bodyseg_model.segmentation.foreground import Background, find_bodies
from bodyseg_model.segmentation.resampling import view_body

STAGES: Final = ("background", "resample", "network", "back")


@dataclass(frozen=True)
class LabelledBody:
    """One body of a frame. pixels: int64 [N], row * columns + column, ascending. middle_m, turn_rad, scale: its median
    range and how its view was turned and scaled for the network (`BodyView`). confidence: float32 [N].
    """

    pixels: NDArray[np.intp]
    middle_m: float
    turn_rad: float
    scale: float
    confidence: NDArray[np.float32]


@dataclass(frozen=True)
class Segmentation:
    """Labels of a frame, uint8 [H, W], 0..32 on bodies, 255 elsewhere; its bodies, the largest first; and how long each
    of `STAGES` took, milliseconds.
    """

    labels: NDArray[np.uint8]
    bodies: tuple[LabelledBody, ...]
    milliseconds: dict[str, float]

    @property
    def pixels(self) -> int:
        """How many pixels show a body."""
        return sum(len(body.pixels) for body in self.bodies)

    @property
    def mean_confidence(self) -> float | None:
        """Over all pixels that show a body; None if none does."""
        if not self.bodies:
            return None
        return float(np.concatenate([body.confidence for body in self.bodies]).mean(dtype=np.float64))


class Segmenter:
    """Labels frames that one camera took, each by itself.

    network: in evaluation mode; frames go to its device. camera: whose frames they are. background: what is taken away
    first. mirrored: whether frames show left for right, as some drivers give them. least_confidence: pixels below it
    get no label. rig: what the network was trained for, by default the paper's.
    """

    def __init__(
        self,
        network: Network,
        camera: Camera,
        background: Background | None = None,
        mirrored: bool = False,
        least_confidence: float = 0.0,
        rig: Rig | None = None,
    ) -> None:
        if not 0 <= least_confidence <= 1:
            raise BadConfig(f"a confidence must be 0 to 1, found {least_confidence:g}")
        self.camera, self.mirrored, self.least_confidence = camera, mirrored, least_confidence
        self.background = background or Background()
        self.rig = rig or load_rig()
        self.device = device_of(network)
        self._network = network

    def __call__(self, range_m: NDArray[np.float32]) -> Segmentation:
        """Label one frame, [H, W], metres along the optical axis, 0 = nothing measured. A pixel is labelled once.

        Raises BadConfig for a frame of another size than the camera's, or a body that no view can hold.
        """
        if range_m.shape != (self.camera.rows, self.camera.columns):
            raise BadConfig(
                f"a frame must have the camera's size, {self.camera.rows} x {self.camera.columns}, "
                f"found {' x '.join(map(str, range_m.shape))}"
            )
        watch = Stopwatch(STAGES)
        labels = np.full(range_m.shape, BACKGROUND, np.uint8)
        bodies = []
        with watch("background"):
            found = find_bodies(range_m, self.camera, self.background)
        for pixels in found:
            with watch("resample"):
                view = view_body(range_m, pixels, self.camera, self.rig, self.mirrored)
            with watch("network"):
                answer = predict(self._network, torch.from_numpy(view.range_m)[None, None].to(self.device))
                seen, sure = (image[0].cpu().numpy() for image in answer)
            with watch("back"):
                confidence = view.back(sure)
                labels.ravel()[pixels] = np.where(confidence >= self.least_confidence, view.back(seen), BACKGROUND)
                bodies.append(LabelledBody(pixels, view.middle_m, view.turn_rad, view.scale, confidence))
        return Segmentation(labels, tuple(bodies), watch.milliseconds)


class Stopwatch:
    """Adds up how long each stage takes: `with watch("network"): ...`. milliseconds: by stage."""

    def __init__(self, stages: Sequence[str]) -> None:
        self.milliseconds = dict.fromkeys(stages, 0.0)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.milliseconds[stage] += 1000 * (time.perf_counter() - start)
