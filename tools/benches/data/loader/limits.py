"""Targets of the loader relative to the baselines, and whether it reaches them."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any, Final

from benches.data.loader.pngs import png
from benches.measuring import evenly_spaced
from bodyseg_data.artifacts import VariantName
from bodyseg_data.loading import RangeImages

PNG_SAMPLES: Final = 60

_SPEEDS: Final[Mapping[str, Mapping[str, float]]] = {
    "0": {"webdataset_png": 2.5, "mds_raw": 0.8},
    "2": {"webdataset_png": 3.5, "mds_raw": 1.0, "memory": 0.9},
}
"""Number of workers -> loader -> least speed of `all`, made on the fly, relative to it."""

_THROUGH_DATALOADER: Final = (
    "ours_all_dataloader",
    "ours_all_batch_sampler",
    "ours_all_wrapped",
    "ours_all_transform",
    "ours_all_labels",
)
"""Loaders that may take 1.2 times the time of tensors in memory with two workers, all through PyTorch's DataLoader."""

Rounds = Mapping[str, Mapping[str, Sequence[float]]]
"""Name -> number of workers -> samples a second, round by round."""


def ratio(rounds: Rounds, workers: str, fast: str, slow: str) -> float | None:
    """Median of the rounds' ratios, since what else a machine does changes from one round to the next."""
    if workers not in rounds[fast] or workers not in rounds[slow]:
        return None
    pairs = zip(rounds[fast][workers], rounds[slow][workers], strict=True)
    return round(statistics.median(above / below for above, below in pairs), 3)


def limits(rounds: Rounds, bytes_per_sample: Mapping[str, float | None], five_pngs: float) -> list[dict[str, Any]]:
    """Every limit with what was measured; holds is None where a loader is missing."""
    counts = sorted({count for by_workers in rounds.values() for count in by_workers}, key=int)
    found = [
        _limit(f"all / {other}, {n} workers", ratio(rounds, n, "ours_all", other), target)
        for n in counts
        for other, target in _SPEEDS.get(n, {}).items()
    ]
    found += [
        _limit(f"time of {name} / time of memory, {n} workers", ratio(rounds, n, "memory", name), 1.2, most=True)
        for n in counts
        for name in _THROUGH_DATALOADER
        if n == "2" and name in rounds
    ]
    for n in counts:
        cost = ratio(rounds, n, "ours_none", "ours_all")
        found.append(_limit(f"time of all / time of none, {n} workers", cost, 1.35, most=True))
    ours = bytes_per_sample["ours_all"]
    found.append(_limit("bytes a sample", ours, 50_000, most=True))
    share = None if ours is None else round(ours / five_pngs, 4)
    found.append(_limit("bytes / bytes of five PNG sets", share, round(1 / 6, 4), most=True))
    return found


def _limit(what: str, measured: float | None, target: float, most: bool = False) -> dict[str, Any]:
    holds = None if measured is None else (measured <= target if most else measured >= target)
    return {"what": what, "at_most" if most else "at_least": target, "measured": measured, "holds": holds}


def five_png_bytes(images: Mapping[VariantName, RangeImages]) -> float:
    """Bytes that PNG images of all five variants take per sample, on at most 60 samples of the set."""
    chosen = evenly_spaced(range(len(images["all"])), PNG_SAMPLES)
    made = (seen.image(index, 0) for seen in images.values() for index in chosen)
    return sum(len(png(image.range)) + len(png(image.labels)) for image in made) / len(chosen)
