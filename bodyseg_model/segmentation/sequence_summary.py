"""Summary of a labelled sequence: bodies, confidence, time and flicker, for each frame and in all; plain JSON.

Flicker is the pixels whose label changes from one frame to the next, without compensation for motion. A pixel is
compared with the same pixel of the next frame, so labels also change where the body moves. Pixels whose range hardly
changed are counted separately: few of them change for that reason.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from bodyseg_data.labels import BACKGROUND
from bodyseg_model.segmentation.segmenter import STAGES as SEGMENTER_STAGES
from bodyseg_model.segmentation.segmenter import LabelledBody, Segmentation

STILL_M: Final = 0.02
"""A pixel whose range changed by less, metres, is taken to see the same point of the body."""

STAGES: Final = ("read", *SEGMENTER_STAGES, "write")


def flicker(before: Segmentation, after: Segmentation) -> Counter[str]:
    """Pixels that have a label in both of two frames, `shared`; of these `changed`, whose label changed; and `still`
    and `still_changed`, the same of those whose range changed by less than `STILL_M`.
    """
    shared = (before.labels != BACKGROUND) & (after.labels != BACKGROUND)
    changed = shared & (before.labels != after.labels)
    still = shared & (np.abs(before.range_m - after.range_m) < STILL_M)
    masks = {"shared": shared, "changed": changed, "still": still, "still_changed": still & changed}
    return Counter({name: int(np.count_nonzero(mask)) for name, mask in masks.items()})


def flicker_shares(counts: Counter[str]) -> dict[str, Any]:
    """Counts and shares of `flicker`, as plain JSON; a share of nothing is null."""
    return {
        "shared_pixels": counts["shared"],
        "changed": _share(counts["changed"], counts["shared"]),
        "still_pixels": counts["still"],
        "still_changed": _share(counts["still_changed"], counts["still"]),
    }


def _share(part: int, whole: int) -> float | None:
    return round(part / whole, 5) if whole else None


class SequenceSummary:
    """Collects the frames of a sequence one by one, in order; only the last frame's images are kept in memory."""

    def __init__(self) -> None:
        self._frames: list[dict[str, Any]] = []
        self._flicker = Counter[str]()
        self._sure_pixels = 0.0  # sum of the confidence of all pixels that show a body
        self._last: tuple[int, Segmentation] | None = None

    def add(
        self,
        segmentation: Segmentation,
        milliseconds: Mapping[str, float],
        sequence: int = 0,
        camera: Mapping[str, Any] | None = None,
    ) -> None:
        """Add one frame.

        milliseconds: of all `STAGES`. sequence: number of its recording; flicker is counted within one, between frames
        of one size. camera: of this frame alone, where it has one.
        """
        labels, bodies, sure = segmentation.labels, segmentation.bodies, segmentation.mean_confidence
        self._sure_pixels += (sure or 0.0) * segmentation.pixels
        change = None
        if self._last is not None and (self._last[0], self._last[1].labels.shape) == (sequence, labels.shape):
            change = flicker(self._last[1], segmentation)
            self._flicker.update(change)
        self._last = sequence, segmentation
        self._frames.append(
            {
                **({} if camera is None else {"camera": dict(camera)}),
                "people": len(bodies),
                "pixels": segmentation.pixels,
                "labelled": int(np.count_nonzero(labels != BACKGROUND)),
                "mean_confidence": _rounded(sure),
                "bodies": [_body(body, labels.shape[1]) for body in bodies],
                "things": [_body(thing, labels.shape[1]) for thing in segmentation.things],
                "flicker": None if change is None else flicker_shares(change),
                "ms": {stage: round(milliseconds[stage], 3) for stage in STAGES},
            }
        )

    @property
    def people(self) -> int:
        """Bodies in all frames together."""
        return sum(frame["people"] for frame in self._frames)

    @property
    def median_range_m(self) -> float | None:
        """Median over all bodies of their ranges, metres; None if there is no body."""
        ranges = [body["range_m"] for frame in self._frames for body in frame["bodies"]]
        return float(np.median(ranges)) if ranges else None

    @property
    def doubted(self) -> int:
        """Number of things that looked like people and the network doubted, in all frames; not those in no view."""
        return sum(thing["scale"] > 0 for frame in self._frames for thing in frame["things"])

    @property
    def mean_confidence(self) -> float | None:
        """Mean over all pixels that show a body; None if none does."""
        pixels = sum(frame["pixels"] for frame in self._frames)
        return self._sure_pixels / pixels if pixels else None

    @property
    def milliseconds(self) -> dict[str, dict[str, float]]:
        """Mean, standard deviation and 95th percentile of every stage, and of all but "write" together ("frame"), from
        the frame's file to its labels: results are written beside the next frame.

        The first frame is left out if there are others, because libraries are initialised during it.
        """
        counted = [frame["ms"] for frame in self._frames[1:] or self._frames]
        stages = {stage: _spread([frame[stage] for frame in counted]) for stage in STAGES}
        return {**stages, "frame": _spread([sum(frame.values()) - frame["write"] for frame in counted])}

    def to_json(self) -> dict[str, Any]:
        """The whole summary. `pixels` show a body; `labelled` of them have a label."""
        return {
            "frames": len(self._frames),
            "frames_with_people": sum(frame["people"] > 0 for frame in self._frames),
            "people": self.people,
            "things": sum(len(frame["things"]) for frame in self._frames),
            "pixels": sum(frame["pixels"] for frame in self._frames),
            "labelled": sum(frame["labelled"] for frame in self._frames),
            "mean_confidence": _rounded(self.mean_confidence),
            "ms": {"first_frame_counted": len(self._frames) == 1, **self.milliseconds},
            "flicker": flicker_shares(self._flicker),
            "each": self._frames,
        }


def _body(body: LabelledBody, columns: int) -> dict[str, Any]:
    row, column = np.divmod(body.pixels, columns)
    return {
        "pixels": len(body.pixels),
        "box": [int(row.min()), int(column.min()), int(row.max()) + 1, int(column.max()) + 1],
        "range_m": round(body.median_range_m, 4),
        "turn_deg": round(math.degrees(body.turn_rad), 2),
        "scale": round(body.scale, 4),
        "mean_confidence": _rounded(body.mean_confidence),
        **({} if body.person is None else {"person": _rounded(body.person)}),
        **({} if body.track is None else {"track": body.track}),
    }


def _rounded(share: float | None) -> float | None:
    return None if share is None else round(share, 4)


def _spread(values: Sequence[float]) -> dict[str, float]:
    measured = np.asarray(values)
    return {
        "mean": round(float(measured.mean()), 2),
        "sd": round(float(measured.std()), 2),
        "p95": round(float(np.quantile(measured, 0.95)), 2),
    }
