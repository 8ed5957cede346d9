"""Ways to find people in a range image: the finder's network alone, or all of `segment`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.labels import BACKGROUND
from bodyseg_data.rigs import Camera
from bodyseg_model.networks import Network, Trained, build, name_of
from bodyseg_model.segmentation import FrameLabeller
from bodyseg_model.segmentation.finder import FinderView

Image = NDArray[np.float32]


@dataclass(frozen=True)
class Found:
    """Answer to a frame. person: probability that a pixel shows somebody, float32 [H, W], 0 where nothing was measured.
    labels: of `segment`, uint8 [H, W]; None of a network alone. bodies: people told apart, None where nobody tells.
    """

    person: Image = field(repr=False)
    labels: NDArray[np.uint8] | None = field(default=None, repr=False)
    bodies: int | None = None


Finder = Callable[[Image, Camera], Found]
"""Range image [H, W], metres, 0 = nothing measured, and its camera -> who is found."""


def network_finder(network: Network, step: int = 1) -> Finder:
    """The network alone. step: it sees one pixel in so many each way. Raises BadConfig for one that finds no people."""
    if step > 1:
        settings = {**network.settings, "classes": network.classes}
        coarse = build(name_of(network), {**settings, "focal_px": settings["focal_px"] / step}).eval()
        coarse.load_state_dict(network.state_dict())
        network = coarse
    views = lru_cache(maxsize=8)(lambda camera: FinderView(network, camera))
    return lambda range_m, camera: Found(views(camera)(range_m))


def segment_finder(finder: Trained | None = None, keep_things: bool = False) -> Finder:
    """All of `segment`: somebody is found where a pixel has a label. keep_things: whatever confidence the labels have.
    finder: by default the one that ships.
    """
    labeller = FrameLabeller(finder=finder, keep_things=keep_things, device="cpu")

    def find(range_m: Image, camera: Camera) -> Found:
        answer = labeller(range_m, camera)
        return Found((answer.labels != BACKGROUND).astype(np.float32), answer.labels, len(answer.bodies))

    return find
