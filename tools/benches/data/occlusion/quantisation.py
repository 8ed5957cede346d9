"""`bench quantisation`: bytes, decoding time and errors of the shadow test against the step of stored range.

The error is that against exact shadow rays: a ray from the point that the camera sees, before any rounding, to the
projector meets nothing.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from benches.data.occlusion.tallies import share
from benches.data.occlusion.views import ExactView, exact_views, postures
from benches.measuring import median_time
from bodyseg_data.artifacts import ShadowTest
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.rigs import load_rig
from bodyseg_data.shards.codecs.bodyseg_images import decode_images, encode_images

STEPS_MM: Final = (0.1, 0.25, 0.5, 1.0, 2.0)
LIMIT: Final = 0.005
"""The largest share of wrong pixels that the default rig's step may give."""
RESOLUTION_MM: Final = 1.0
"""What the paper's sensor resolves (docs/how-to/rig.md): the default rig's step may not be coarser."""

_ROUNDS: Final = 8


@dataclass
class _Tally:
    """One step's figures; one entry a view in the lists."""

    test: ShadowTest
    counts: list[tuple[int, int, int]] = field(default_factory=list)  # wrongly lit, wrongly dark, all pixels
    data: list[bytes] = field(default_factory=list)
    projector_bytes: list[int] = field(default_factory=list)

    def add(self, view: ExactView) -> None:
        sample, inside = view.sample, view.inside
        lit = self.test.lit(sample.range, sample.occluder_range(), sample.faces_projector)
        false_lit, false_dark = lit & ~view.lit & inside, ~lit & view.lit & inside
        self.counts.append((int(false_lit.sum()), int(false_dark.sum()), int(inside.sum())))
        facing = sample.faces_projector.view(np.uint8)
        self.data.append(encode_images(sample.range, sample.labels, facing, sample.occluder_range()))
        without = encode_images(sample.range, sample.labels, facing, None)
        self.projector_bytes.append(len(self.data[-1]) - len(without))

    def row(self, decode_s: Sequence[float]) -> dict[str, Any]:
        false_lit, false_dark, pixels = (sum(count) for count in zip(*self.counts, strict=True))
        return {
            "bytes": round(statistics.mean(map(len, self.data))),
            "projector_bytes": round(statistics.mean(self.projector_bytes)),
            "decode_ms": round(1e3 * statistics.mean(decode_s), 4),
            "wrong_pixels": share(false_lit + false_dark, pixels),
            "false_lit": share(false_lit, pixels),
            "false_shadow": share(false_dark, pixels),
            "worst_view": round(max((lit + dark) / max(whole, 1) for lit, dark, whole in self.counts), 6),
            "gap_steps": int(self.test.gap_steps),
            "edge_steps": int(self.test.edge_steps),
        }


def bench_quantisation(views: int = 40, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Every step in `STEPS_MM` of the default rig on the same `views` ordinary views of `bench occlusion`.

    steps: step in millimetres -> mean bytes of a sample's images and of the projector's among them; decode_ms:
    processor time to decode them, mean over views of the median of eight rounds in which the steps take turns;
    wrong_pixels, false_lit, false_shadow: shares of the foreground pixels inside the projector's view, all views
    pooled; worst_view: the largest share in one of them. best: the step of fewest bytes with at most `limit` wrong that
    is not coarser than `resolution_mm`. default: the step of the default rig.
    """
    tallies = {}
    for number, step_mm in enumerate(STEPS_MM):
        rig = replace(load_rig(), range_step_mm=step_mm)
        tallies[step_mm] = tally = _Tally(ShadowTest(rig))
        for done, view in enumerate(exact_views(rig, postures(), views, labelled=True), start=1):
            tally.add(view)
            progress(number * views + done, len(STEPS_MM) * views)
    times = _decoding_times({step_mm: tally.data for step_mm, tally in tallies.items()})
    rows = {f"{step_mm:g}": tally.row(times[step_mm]) for step_mm, tally in tallies.items()}
    fit = [name for name, row in rows.items() if row["wrong_pixels"] <= LIMIT and float(name) <= RESOLUTION_MM]
    return {
        "steps": rows,
        "limit": LIMIT,
        "resolution_mm": RESOLUTION_MM,
        "best": min(fit, key=lambda name: rows[name]["bytes"], default=None),
        "default": f"{load_rig().range_step_mm:g}",
        "views": views,
    }


def _decoding_times(data: dict[float, list[bytes]]) -> dict[float, list[float]]:
    """Processor seconds to decode each view of each step, the median of the rounds; the steps take turns."""
    rounds: dict[float, list[list[float]]] = {step_mm: [[] for _ in encoded] for step_mm, encoded in data.items()}
    for turn in range(_ROUNDS * len(data)):
        step_mm = list(data)[turn % len(data)]
        for number, encoded in enumerate(data[step_mm]):
            seconds, _ = median_time(lambda encoded=encoded: decode_images(encoded, True))  # type: ignore[misc]
            rounds[step_mm][number].append(seconds)
    return {step_mm: [*map(statistics.median, views)] for step_mm, views in rounds.items()}
