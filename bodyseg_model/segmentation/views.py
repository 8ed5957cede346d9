"""Views of a frame as networks see them: without lens distortion, each body as the trained camera would see it.

A body is resampled from any camera's frame to the camera that a network was trained for, and its labels back.
The trained camera aims at the body from a fixed distance, the stand-off. So the view is first rotated about the
vertical axis towards the body, as if the frame's camera had turned on the spot. Then it is scaled: a camera of focal
length f shows a surface at range Z with f / Z pixels a metre, and the body's median range gets as many as the trained
camera has at its stand-off. Both steps are exact where only focal length and direction differ; where distances differ,
a body keeps its original perspective. Ranges are picked from the nearest pixel, never interpolated: between a body and
the wall behind it there is no surface.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import import_module
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, reported
from bodyseg_data.rigs import Camera, Distortion, Rig
from bodyseg_data.samples import FARTHEST_STEPS
from bodyseg_model.recordings import check_metres

BackgroundMode = Literal["people", "limits", "keep", "frame"]
Turned = Literal["0", "90", "180", "270", "auto"]

TURNED_HELP: Final = "turn of the camera, by where heads point in frames: up 0, left 90, down 180, right 270; or auto"
"""Help of `--turned`."""

LARGEST_SIDE: Final = 2048
"""Greatest side that a body's view may need, pixels: 6.7 m at the stand-off of the paper's rig."""

MARGIN: Final = 32
"""Least number of empty pixels around the body in a view, so that a network sees the body's outline."""

STEP: Final = 64
"""Views larger than the trained camera's image are so by multiples of this, pixels: a runtime prepares for every size
that it meets, and views of one size go through a network together."""

USUAL_PEOPLE: Final = 3
"""Surfaces of one size that a frame may show a network, for which `usual_views` prepares it."""


@dataclass(frozen=True)
class BodyView:
    """One body as the trained camera would see it from its stand-off.

    range_m: float32 [h, w], metres, 0 where nothing was measured; as large as the trained camera's image, or larger by
    multiples of `STEP` if the body needs it, with the body in the middle. corner: first row and column of the view in
    that image, which may be negative. view_pixels: int64 [N], for every pixel of the body in the frame the pixel of the
    view that contains its centre, row * w + column; all of these are measured. turn_rad: rotation of the view to the
    frame's right. median_range_m: the median range after the rotation, which becomes the stand-off. scale: view pixels
    for each frame pixel, on the frame's optical axis.
    """

    range_m: NDArray[np.float32] = field(repr=False)
    corner: tuple[int, int]
    view_pixels: NDArray[np.intp] = field(repr=False)
    turn_rad: float
    median_range_m: float
    scale: float

    def back(self, image: NDArray[Any]) -> NDArray[Any]:
        """Values of an image [h, w] of this view at every pixel of the body in the frame, [N]."""
        return image.ravel()[self.view_pixels]


def view_frame(range_m: NDArray[np.float32], pixels: NDArray[np.intp], mirrored: bool = False) -> BodyView:
    """A whole frame as it stands. range_m, pixels, mirrored: as of `view_body`; all else is left out of the view."""
    shown, (rows, columns) = np.zeros_like(range_m), np.divmod(pixels, range_m.shape[1])
    ranges = range_m.ravel()[pixels]
    columns = range_m.shape[1] - 1 - columns if mirrored else columns
    shown[rows, columns] = ranges
    return BodyView(shown, (0, 0), rows * range_m.shape[1] + columns, 0.0, float(np.median(ranges)), 1.0)


def view_body(
    range_m: NDArray[np.float32],
    pixels: NDArray[np.intp],
    camera: Camera,
    rig: Rig,
    mirrored: bool = False,
    turn_rad: float | None = None,
) -> BodyView:
    """Resample one body of a frame to `rig.camera` at `rig.stand_off_m`.

    range_m: [H, W], metres, taken by `camera`, whose pose is not used. pixels: the body's, int64 [N], at least one,
    row * W + column, ascending; ranges there must not be 0. mirrored: True if the frame shows left for right.
    turn_rad: rotation of the view, -1.5 to 1.5; None turns it to the middle of the body's outline.

    A pixel of the view gets the range of the frame pixel that contains its centre. If that pixel is not the body's but
    the view pixel contains centres of the body's pixels, it gets the range of the nearest of these, so that thin parts
    are not lost where the view is coarser. Raises BadConfig for ranges that are not finite or not in front of the view,
    or if it would be larger than `LARGEST_SIDE`; MissingLibrary without numba.
    """
    loops = compiled_loops()
    rows, columns = np.divmod(pixels, range_m.shape[1])
    depths, across = range_m.ravel()[pixels].astype(np.float64), columns + 0.5 - camera.centre_px[0]
    turn = turn_rad
    if turn is None:
        with np.errstate(invalid="ignore"):  # bad ranges are refused below
            sides = across * depths
        turn = math.atan2((sides.min() + sides.max()) / 2, float(np.median(depths)) * camera.focal_px)
    sine, cosine = math.sin(turn), math.cos(turn)
    depths *= across / camera.focal_px * sine + cosine
    seen = (depths > 0) & (depths < np.inf)
    if not seen.all():  # a loop below writes at indices computed from these
        raise BadConfig(f"a body's ranges must be finite and in front of its view, found {depths[~seen][0]:g} m")
    median_m = float(np.median(depths))
    focal_px = rig.camera.focal_px / rig.stand_off_m * median_m
    sign = -1.0 if mirrored else 1.0
    mapping = Turn(*camera.centre_px, camera.focal_px, *rig.camera.centre_px, focal_px, sine, cosine, sign)

    down, across = np.empty(len(pixels)), np.empty(len(pixels))
    ends = loops.map_to_view(rows, columns, mapping, down, across)
    scale = focal_px / camera.focal_px
    top, left = (math.floor(end - scale / 2) for end in ends[::2])
    # Half a pixel is less than rounding where a body is too near to be measured.
    bottom, right = (max(math.ceil(end + scale / 2), math.floor(end) + 1) for end in ends[1::2])
    needed = max(rig.camera.rows, bottom - top + 2 * MARGIN), max(rig.camera.columns, right - left + 2 * MARGIN)
    if max(needed) > LARGEST_SIDE:
        raise BadConfig(
            f"a body's view must be at most {LARGEST_SIDE} pixels wide and high, found {needed[1]} x {needed[0]} "
            f"for {len(pixels)} pixels at {median_m:.3g} m"
        )
    height, width = _in_steps(rig.camera.rows, needed[0]), _in_steps(rig.camera.columns, needed[1])
    corner = (top + bottom - height) // 2, (left + right - width) // 2

    # Only the body's boxes in frame and view are computed: most pixels of both are empty.
    begin = int(rows[0]) - 1, int(columns.min()) - 1
    own = np.zeros((int(rows[-1]) - begin[0] + 2, int(columns.max()) - begin[1] + 2))  # a border of empty pixels
    own.ravel()[(rows - begin[0]) * own.shape[1] + (columns - begin[1])] = depths
    box, view_pixels = np.zeros((bottom - top, right - left)), np.empty(len(pixels), np.intp)
    loops.pick_ranges(own, begin, mapping, (top, left), box)
    loops.fill_lost(down, across, (top, left), depths, box, corner, width, view_pixels)
    nearest, farthest = rig.range_step_m, float(FARTHEST_STEPS) * rig.range_step_m  # as training images have them
    view = np.zeros((height, width), np.float32)
    inside = view[top - corner[0] : bottom - corner[0], left - corner[1] : right - corner[1]]
    inside[:] = np.where(box > 0, np.clip(box + (rig.stand_off_m - median_m), nearest, farthest), 0)
    return BodyView(view, corner, view_pixels, turn, median_m, scale)


def usual_views(rig: Rig, together: bool) -> Iterator[list[NDArray[np.float32]]]:
    """Views, as in `BodyView`, of the sizes and numbers that most frames give: of the trained camera's image and wider
    ones up to a square, each alone, and, for a network that takes several `together`, up to `USUAL_PEOPLE` of the
    first. All show a surface at the stand-off.
    """
    rows, columns = rig.camera.rows, rig.camera.columns
    for width in range(columns, max(rows, columns) + STEP, STEP):
        view = np.zeros((rows, width), np.float32)
        view[: rows // 4] = rig.stand_off_m
        most = USUAL_PEOPLE if together and width == columns else 1
        yield from ([view] * several for several in range(1, most + 1))


def check_size(shape: tuple[int, ...], camera: Camera) -> None:
    """Raise BadConfig for a frame of another shape than the camera's."""
    if shape != (camera.rows, camera.columns):
        raise BadConfig(
            f"a frame must have the camera's size, {camera.rows} x {camera.columns}, "
            f"found {' x '.join(map(str, shape)) or 'none'}"
        )


def metres_of(frame: Any, camera: Camera) -> NDArray[np.float32]:
    """A copy of a frame, float32 [H, W], metres: an array, whose masked pixels are 0, or tensor of floating point.

    Raises BadConfig for another size than the camera's, and as `check_metres`.
    """
    if hasattr(frame, "detach"):  # a tensor, also of bfloat16, which NumPy has not
        frame = frame.detach().cpu()
        frame = frame.float() if frame.is_floating_point() else frame
    with reported("a frame must be an array (of pairs with times, LiveRecording makes frames)", BadConfig, ValueError):
        values: NDArray[Any] = np.ma.filled(np.asanyarray(frame), 0)
    check_size(values.shape, camera)
    check_metres(values)
    return np.array(values, np.float32, order="C")  # drivers write the next frame into the same array


def _in_steps(trained: int, needed: int) -> int:
    """Side of a view, pixels: that of the trained camera's image, and as many times `STEP` as are needed."""
    return trained - (trained - needed) // STEP * STEP


@cache
def compiled_loops() -> Any:
    """The compiled loops over pixels, in a module that needs numba."""
    return import_module("bodyseg_model.segmentation.pixel_loops")


class Turn(NamedTuple):
    """The mapping between the image planes of a frame's camera and of a view from the same point.

    camera_x, camera_y, camera_focal: principal point and focal length of the camera, pixels; view_x, view_y,
    view_focal: of the view, rotated to the frame's right by an angle of that sine and cosine. sign: -1 if the frame
    shows left for right, else 1. A ray (x, y, 1) of the frame is (x cos - sin, y, x sin + cos) after the rotation.
    """

    camera_x: float
    camera_y: float
    camera_focal: float
    view_x: float
    view_y: float
    view_focal: float
    sine: float
    cosine: float
    sign: float


class Undistortion:
    """Maps frames of a camera with lens distortion to the frames that it would take without.

    A pixel gets the value of the frame's pixel that contains the point where the lens draws its centre, 0 where that
    lies outside the frame. Values are never interpolated: between a body and the wall behind it there is no surface.
    A range along the optical axis is the same in both frames.

    camera: the camera without distortion, of equal size, focal length and principal point.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = replace(camera, distortion=None)
        x, y, _ = np.moveaxis(self.camera.pixel_rays(), -1, 0)
        across, down = (camera.distortion or Distortion()).apply(x, y)
        column = np.floor(across * camera.focal_px + camera.centre_px[0])
        row = np.floor(down * camera.focal_px + camera.centre_px[1])
        inside = (row >= 0) & (row < camera.rows) & (column >= 0) & (column < camera.columns)
        self._outside = np.flatnonzero(~inside)
        self._source = np.where(inside, row * camera.columns + column, 0).astype(np.intp)

    def __call__(self, frame: NDArray[Any]) -> NDArray[Any]:
        """The frame [H, W], of any dtype, without distortion. Raises BadConfig for a frame of another size."""
        check_size(frame.shape, self.camera)
        ideal = frame.ravel().take(self._source)
        ideal.ravel()[self._outside] = 0
        return ideal
