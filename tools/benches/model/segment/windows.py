"""`bench windows`: labels and time of a network that sees a window around each body instead of the whole image.

docs/results/segment.md has the results.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from benches.measuring import counter
from benches.model.chosen import chosen_network
from benches.model.segment.bench import cameras, made_rooms
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.labels import UNLABELLED
from bodyseg_data.loading import RangeImages
from bodyseg_data.machine import torch_threads
from bodyseg_model.networks import Network, predict
from bodyseg_model.segmentation import Segmenter, find_bodies, view_body

MARGINS: Final = (32, 64, 96, 128, None)
"""Empty pixels around a body; None: the whole image."""

_MULTIPLE: Final = 64  # windows begin at multiples of the deepest cells' side, as these lie in the whole image

Score = Callable[[torch.Tensor], float]
"""Labels uint8 [1, H, W] -> share of the body's pixels that are right."""


class Windowed(Network):
    """Gives a network the window around the body of an image, with a margin."""

    def __init__(self, network: Network, margin: int | None) -> None:
        super().__init__({}, network.classes)
        self.output_stride = network.output_stride
        self.network, self.margin = network, margin
        self.eval()

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        """Compute scores of a window, and 0 around it; see `Network.scores`."""
        if self.margin is None:
            return self.network.scores(range_m)
        measured = range_m[0, 0] > 0
        rows, columns = (self._window(seen, self.margin) for seen in (measured.any(1), measured.any(0)))
        found = self.network.scores(range_m[:, :, rows, columns])
        step = self.output_stride
        whole = found.new_zeros(*found.shape[:2], *(-(-side // step) for side in range_m.shape[2:]))
        top, left = rows.start // step, columns.start // step
        whole[:, :, top : top + found.shape[2], left : left + found.shape[3]] = found
        return whole

    @staticmethod
    def _window(seen: torch.Tensor, margin: int) -> slice:
        """Window along one axis, from what is measured there, bool [N], somewhere True."""
        (found,) = torch.nonzero(seen, as_tuple=True)
        first = max(0, int(found[0]) - margin) // _MULTIPLE * _MULTIPLE
        return slice(first, min(len(seen), int(found[-1]) + 1 + margin))


@dataclass
class _Row:
    """Sums over images. shares: of each image, pixels that are right."""

    network: Windowed
    shares: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def label(self, range_m: torch.Tensor, score: Score) -> None:
        start = time.thread_time()
        labels = predict(self.network, range_m).labels
        self.seconds.append(time.thread_time() - start)
        self.shares.append(score(labels))


def bench_windows(
    data: str, views: int = 120, images: int = 300, runs: Sequence[Path] = (), progress: ProgressCallback = silent
) -> dict[str, Any]:
    """Measure every one of `MARGINS` on bodies of a set, and of made rooms as `segment` resamples them.

    data: folder or address of the set; `images` of its test split with all artifacts are labelled, evenly spaced.
    views: made rooms of 640 x 480, seed and bodies of `bench segment`. runs: the network is in the first of them;
    without, it is the one that ships. One thread computes, one image at a time. Raises BadConfig as `RangeImages`.
    """
    network_name, trained = chosen_network(runs)
    chosen = RangeImages(data, "all", split="test")
    count = min(images, len(chosen))
    advance = counter(progress, count + views)
    camera = cameras()["640 x 480"]

    def from_set() -> Iterator[tuple[torch.Tensor, Score]]:
        for index in np.linspace(0, len(chosen) - 1, count).round().astype(int):
            image = chosen[int(index)]
            yield image["range"][None], _scored(image["labels"])
            advance()

    def from_rooms() -> Iterator[tuple[torch.Tensor, Score]]:
        segmenter = Segmenter(trained.network, camera, rig=trained.rig)
        for room in made_rooms(camera, views):
            for pixels, _ in find_bodies(room.range_m, camera, segmenter.background, segmenter.finder):
                if (room.person.ravel()[pixels] == 0).mean() > 0.5:
                    continue
                truth = torch.from_numpy(room.labels.ravel()[pixels])
                view = view_body(room.range_m, pixels, camera, trained.rig)
                backwards = torch.from_numpy(view.view_pixels)
                yield torch.from_numpy(view.range_m)[None, None], _scored(truth, backwards)
            advance()

    with torch_threads(1):
        return {
            "network": network_name,
            "sets": {"set": _measured(trained.network, from_set()), "rooms": _measured(trained.network, from_rooms())},
        }


def _scored(truth: torch.Tensor, pixels: torch.Tensor | None = None) -> Score:
    """Score labels at `pixels`, int64 [N], of the image, by default all, against the true ones of the same shape."""
    body = truth < UNLABELLED

    def score(labels: torch.Tensor) -> float:
        found = labels[0] if pixels is None else labels.ravel()[pixels]
        return float((found == truth)[body].float().mean())

    return score


def _measured(network: Network, bodies: Iterator[tuple[torch.Tensor, Score]]) -> dict[str, Any]:
    """Every margin's share of pixels right, mean over bodies, its difference from whole images with its standard
    error, and median processor time, ms.
    """
    rows = [_Row(Windowed(network, margin)) for margin in MARGINS]
    for number, (range_m, score) in enumerate(bodies):
        for row in rows[number % len(rows) :] + rows[: number % len(rows)]:  # in turns
            row.label(range_m, score)
    whole = rows[-1]
    return {
        "bodies": len(whole.shares),
        "margins": [
            {
                "margin_px": row.network.margin,
                "right": round(float(np.mean(row.shares)), 4),
                "less": round(float(np.mean(less)), 4),
                "less_error": round(float(np.std(less) / len(less) ** 0.5), 4),
                "ms": round(1000 * float(np.median(row.seconds)), 2),
            }
            for row, less in ((row, np.subtract(whole.shares, row.shares)) for row in rows)
        ],
    }
