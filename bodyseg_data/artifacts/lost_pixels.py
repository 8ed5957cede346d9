"""Pixels lost together, as sensors lose them, in patches and stripes.

Missing data as in the paper (`missing_data.py`) is lost pixel by pixel. Here neighbouring pixels are lost: dark cloth
that returns no light, and bands of a body that moved between two fringe patterns. `SHAPES` lose exactly the given
share, to the nearest pixel, and a larger share of the same image and draws loses the same pixels and more.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.artifact import Artifact, RangeImage, Scene
from bodyseg_data.core import BadConfig, Draws, bounded, uniform
from bodyseg_data.labels import PART_CLASSES, PARTS
from bodyseg_data.rigs import Rig
from bodyseg_data.samples import Window, box_of

MOST_PATCHES: Final = 4
LONGEST: Final = 2.0
"""How many times as long as wide a patch may be, or as wide as long."""
FEWEST_STRIPES: Final = 2
MOST_STRIPES: Final = 12

_LABELS: Final = {part.landmark: part.label for part in PARTS}


def lost_patches(range_image: NDArray[np.uint16], share: float, generator: np.random.Generator) -> NDArray[np.bool_]:
    """Mark one to four ellipses around random pixels of the foreground, lost whole, bool [H, W].

    range_image: uint16 [H, W], 0 is background. share: of the foreground, 0 to 1; the ellipses grow until they hold it.
    """
    box = box_of(range_image)
    if box is None:
        return np.zeros(range_image.shape, np.bool_)
    inside = range_image[box]
    pixels = np.flatnonzero(inside != 0)  # searching booleans is five times faster
    count, *chances = (uniform(generator) for _ in range(1 + 3 * MOST_PATCHES))
    down, along = [], []
    for centre, length, size in np.reshape(chances, (MOST_PATCHES, 3))[: 1 + int(count * MOST_PATCHES)]:
        row, column = divmod(int(pixels[int(centre * len(pixels))]), inside.shape[1])
        half = np.exp2(size) * LONGEST ** (length - 0.5)  # half height; the half width has the inverse ratio
        other = np.exp2(size) / LONGEST ** (length - 0.5)
        down.append((((np.arange(inside.shape[0]) - row) / half) ** 2).astype(np.float32))
        along.append((((np.arange(inside.shape[1]) - column) / other) ** 2).astype(np.float32))
    nearest = np.add.outer(down[0], along[0])
    for rows, columns in zip(down[1:], along[1:], strict=True):
        np.minimum(nearest, np.add.outer(rows, columns), out=nearest)
    return _lose_first(range_image.shape, box, pixels, nearest.ravel().take(pixels), share)


def lost_stripes(range_image: NDArray[np.uint16], share: float, generator: np.random.Generator) -> NDArray[np.bool_]:
    """Mark two to twelve horizontal bands of one width, evenly over the foreground's height, lost whole, bool [H, W].

    As `lost_patches`; of a row that is lost in part, pixels are lost from the left.
    """
    lost = np.zeros(range_image.shape, np.bool_)
    box = box_of(range_image)
    if box is None:
        return lost
    inside = range_image[box] != 0
    count, offset = uniform(generator), uniform(generator)
    stripes = FEWEST_STRIPES + int(count * (MOST_STRIPES - FEWEST_STRIPES + 1))
    rows = np.arange(inside.shape[0])
    from_middle = np.abs((rows * stripes / inside.shape[0] + offset) % 1 - 0.5)
    order = np.argsort(from_middle, kind="stable")
    pixels = inside.sum(axis=1)[order]
    left = _rounded(share, int(pixels.sum()))
    before = np.cumsum(pixels) - pixels
    whole = before + pixels <= left
    gone = lost[box]
    gone[order[whole]] = inside[order[whole]]
    if not whole.all():
        last = int(np.argmin(whole))
        gone[order[last], np.flatnonzero(inside[order[last]])[: left - int(before[last])]] = True
    return lost


SHAPES: Final = {"patches": lost_patches, "stripes": lost_stripes}
"""Name -> what marks the pixels that are lost in that shape."""


@dataclass(frozen=True)
class Losses(Artifact):
    """Pixels lost in patches, in stripes, or not at all, each as likely; the paper has no such artifact.

    most: largest share of the foreground that is lost; the share of each image is drawn uniformly from 0 to it.
    """

    name = "losses"
    kind = "missing_data"
    version = 2
    purposes = ("losses",)

    most: float = bounded(0.0, 0, 1)

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        generator = draws.generator("losses")
        which, share = uniform(generator), uniform(generator)
        shapes = (None, *SHAPES.values())
        shape = shapes[int(which * len(shapes))]
        if shape is not None:
            image.range[shape(scene.sample.range, self.most * share, generator)] = 0


@dataclass(frozen=True)
class _ShareLost(Artifact):
    """Base of artifacts that lose a share of the body in one shape, drawn once an image, from `low` to `high`."""

    kind = "missing_data"

    low: float = bounded(0.0, 0, 1)
    high: float = bounded(0.2, 0, 1, not_below="low")

    def draw(self, draws: Draws) -> dict[str, float]:
        """As `Artifact.draw`: the share lost."""
        share = self.low + (self.high - self.low) * draws.chance(self.purposes[0])
        return dict.fromkeys(self.drawn, share)


@dataclass(frozen=True)
class PatchLoss(_ShareLost):
    """One to four whole patches lost, as dark cloth and hair are.

    The share of the body that is lost is drawn once an image, uniformly from `low` to `high`.
    parts: names of the parts that may be lost, as in `PARTS`; () for all. The share is then that of their pixels, and
    `apply` raises BadConfig for a set of other classes.
    """

    name = "patch_loss"
    purposes = ("patch share", "patch loss")
    drawn: ClassVar[Mapping[str, str]] = {"patch_share": "{:.0%} in patches"}

    parts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        for part in self.parts:
            if part not in _LABELS:
                raise BadConfig(f"parts must be names of the 33 parts, found {part!r}")

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        clean = scene.sample.range
        if self.parts and scene.classes != PART_CLASSES:
            raise BadConfig(f"patch_loss with 'parts' needs the 33 parts, found classes {scene.classes.name!r}")
        if self.parts:
            clean = np.where(np.isin(scene.sample.labels, [_LABELS[part] for part in self.parts]), clean, np.uint16(0))
        lost = lost_patches(clean, image.drawn["patch_share"], draws.generator("patch loss"))
        np.copyto(image.range, 0, where=lost)


@dataclass(frozen=True)
class StripeLoss(_ShareLost):
    """Two to twelve whole parallel stripes lost.

    The share of the body that is lost is drawn once an image, uniformly from `low` to `high`.
    along: "rows" for bands across the image, "columns" for bands down it. None for lines of one code of the rig's
    projector, at right angles to the line from camera to projector: columns for a projector beside the camera.
    """

    name = "stripe_loss"
    purposes = ("stripe share", "stripe loss")
    drawn: ClassVar[Mapping[str, str]] = {"stripe_share": "{:.0%} in stripes"}

    along: Literal["rows", "columns"] | None = None

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        clean, altered = scene.sample.range, image.range
        if (self.along or code_lines(scene.rig)) == "columns":
            clean, altered = np.ascontiguousarray(clean.T), altered.T
        altered[lost_stripes(clean, image.drawn["stripe_share"], draws.generator("stripe loss"))] = 0


def code_lines(rig: Rig) -> Literal["rows", "columns"]:
    """The direction in the camera's image that is nearest to lines of one code: at right angles to the baseline."""
    x, y, _ = rig.camera.axes @ np.subtract(rig.projector.position_m, rig.camera.position_m)
    return "columns" if abs(x) >= abs(y) else "rows"


def _lose_first(
    shape: tuple[int, ...], box: Window, pixels: NDArray[np.intp], values: NDArray[np.float32], share: float
) -> NDArray[np.bool_]:
    """Mark the share of the foreground with the lowest values, bool [H, W]; of equal pixels the first ones.

    pixels: those of the foreground, flat indices in the box, [N]; values: of each.
    """
    lost = np.zeros(shape, np.bool_)
    count = _rounded(share, len(pixels))
    if count:
        limit = np.partition(values, count - 1)[count - 1]
        gone = values <= limit
        if spare := np.count_nonzero(gone) - count:
            gone[np.flatnonzero(values == limit)[-spare:]] = False
        inside = np.zeros(lost[box].shape, np.bool_)
        inside.reshape(-1)[pixels] = gone
        lost[box] = inside
    return lost


def _rounded(share: float, pixels: int) -> int:
    return math.floor(share * pixels + 0.5)
