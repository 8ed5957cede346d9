"""Frames of one sensor with the pixels of people marked, as every measurement here reads them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.rig import Camera
from bodyseg_model.recordings.frames import to_metres
from bodyseg_model.recordings.recording import Frame as RecordedFrame
from bodyseg_model.recordings.recording import evenly_apart
from bodyseg_model.recordings.skipping import Skipping
from bodyseg_model.segmentation.foreground import Background, find_bodies
from bodyseg_model.sensor_fit.masks import closing, require_libraries_of_fit
from bodyseg_model.sensor_fit.surfaces import third_differences

MOST_FRAMES: Final = 40
"""The most frames that are measured: of a longer recording, pairs of neighbours spread evenly over it."""

STILL_SHARE: Final = 0.5
"""Least overlap of the bodies of two frames (intersection over union) for a body that stands still; half of each may be
lost, and elsewhere."""

_BLOCK: Final = 8
_MOST_DRIFT: Final = 0.4  # of the pixels' differences; blocks of 64 independent pixels show an eighth
_LEAST_DRIFT_M: Final = 3e-4

Mask = NDArray[np.bool_]
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Frame:
    """One frame. stored: uint16 [H, W] as in the file. range_m: float32 [H, W], metres, 0 where nothing was measured.

    body: bool [H, W], measured pixels of people; room: all other measured pixels.
    """

    name: str
    stored: NDArray[np.uint16]
    range_m: Floats
    body: Mask

    @cached_property
    def room(self) -> Mask:
        """Measured pixels that show no body, bool [H, W]."""
        return (self.range_m > 0) & ~self.body

    @cached_property
    def noise_m(self) -> float:
        """A robust standard deviation of the body's noise, metres, by `third_differences`; 0 where there are none."""
        values, _ = third_differences(self.range_m, self.body)
        return float(1.4826 * np.median(np.abs(values))) if len(values) else 0.0


@dataclass(frozen=True)
class Recording:
    """Frames of one camera. step_m: metres in one step of the files. pairs: indices of successive frames."""

    frames: tuple[Frame, ...]
    camera: Camera
    step_m: float
    pairs: tuple[tuple[int, int], ...] = ()

    @cached_property
    def still(self) -> bool:
        """True if the bodies of all pairs and of the first and last frame stand still: frames then differ by noise."""
        if not self.pairs:
            return False
        return all(self._still(a, b) for a, b in (*self.pairs, (0, len(self.frames) - 1)))

    @cached_property
    def still_room(self) -> bool:
        """True if the room behind the bodies stays the same between the frames of every pair."""
        return bool(self.pairs) and all(self.unmoved(a, b, body=False) for a, b in self.pairs)

    def unmoved(self, a: int, b: int, body: bool) -> bool:
        """Compare two frames: True if the body's (or the room's) ranges differ from pixel to pixel, not over areas."""
        first, second = self.frames[a], self.frames[b]
        both = first.body & second.body if body else first.room & second.room
        difference = np.where(both, second.range_m - first.range_m, 0)
        rows, columns = (side // _BLOCK * _BLOCK for side in both.shape)
        blocks = difference[:rows, :columns].reshape(rows // _BLOCK, _BLOCK, -1, _BLOCK).swapaxes(1, 2)
        counts = both[:rows, :columns].reshape(rows // _BLOCK, _BLOCK, -1, _BLOCK).swapaxes(1, 2).sum((2, 3))
        full = counts >= _BLOCK * _BLOCK // 4
        if np.count_nonzero(full) < 4:
            return False
        means = blocks.sum((2, 3))[full] / counts[full]
        spread = _robust(difference[both])
        # Fewer pixels in a block leave more of the noise in its mean.
        by_chance = spread / np.sqrt(np.median(counts[full]))
        return bool(_robust(means) <= 2 * by_chance + _MOST_DRIFT * spread / 2 + _LEAST_DRIFT_M)

    def _still(self, a: int, b: int) -> bool:
        first, second = (closing(self.frames[index].body, 2) for index in (a, b))
        either = np.count_nonzero(first | second)
        if not either or np.count_nonzero(first & second) < STILL_SHARE * either:
            return False
        return self.unmoved(a, b, body=True)


def read_recording(
    files: Sequence[RecordedFrame],
    camera: Camera,
    background: Background,
    nearer_than_m: float | None,
    skipping: Skipping | None = None,
) -> Recording:
    """Read frames and find the bodies in them.

    files: in the order of time. nearer_than_m: every measured pixel nearer than this is a body's; None: bodies are
    found by `background`, as `bodyseg segment` does. skipping: of frames that cannot be read, by default none. Raises
    BadConfig for frames that cannot be read, that are not the camera's, of different units, or none of which shows a
    body; MissingLibrary without the extra `sensor`.
    """
    require_libraries_of_fit()
    skipping = skipping or Skipping()
    step_m = files[0].step_m
    chosen, pairs = chosen_frames(len(files))
    frames: list[Frame] = []
    places: dict[int, int] = {}
    for place, index in enumerate(chosen):
        if files[index].step_m != step_m:
            raise BadConfig(
                f"frames must have one unit, found {step_m:g} and {files[index].step_m:g} m a step: "
                f"{files[index].where}"
            )
        stored = skipping.read(files[index])
        if stored is None:
            continue
        places[place] = len(frames)
        if stored.shape != (camera.rows, camera.columns):
            raise BadConfig(
                f"frames must have the size of the first, {camera.rows} x {camera.columns}, "
                f"found {stored.shape[0]} x {stored.shape[1]}: {files[index].where}"
            )
        frames.append(_frame(files[index].name, stored, camera, step_m, background, nearer_than_m))
    if not any(frame.body.any() for frame in frames):
        raise BadConfig("no frame shows a body: are --units, --near, --far or --nearer-than right?")
    pairs = tuple((places[a], places[b]) for a, b in pairs if a in places and b in places)
    return Recording(tuple(frames), camera, step_m, pairs)


def chosen_frames(count: int, most: int = MOST_FRAMES) -> tuple[list[int], tuple[tuple[int, int], ...]]:
    """Indices of the frames to measure, ascending, and pairs of neighbours as positions in that list."""
    if count <= most:
        return list(range(count)), tuple((index, index + 1) for index in range(count - 1))
    chosen = sorted({start + shift for start in evenly_apart(count - 1, most // 2) for shift in (0, 1)})
    pairs = [(index, index + 1) for index in range(len(chosen) - 1) if chosen[index + 1] == chosen[index] + 1]
    return chosen, tuple(pairs)


def _frame(
    name: str,
    stored: NDArray[np.uint16],
    camera: Camera,
    step_m: float,
    background: Background,
    nearer_than_m: float | None,
) -> Frame:
    range_m = to_metres(stored, step_m)
    body = np.zeros(stored.shape, np.bool_)
    if nearer_than_m is not None:
        body[(range_m > 0) & (range_m < nearer_than_m)] = True
    else:
        for pixels in find_bodies(range_m, camera, background):
            body.ravel()[pixels] = True
    return Frame(name, stored, range_m, body)


def _robust(values: Floats) -> float:
    """Standard deviation by the median of sizes; where more than half are 0, by the mean square."""
    median = float(np.median(np.abs(values))) if len(values) else 0.0
    return 1.4826 * median if median else float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0
