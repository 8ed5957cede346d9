"""People of whole frames as the network that labels them sees them, with their true labels: images to train it on."""

from collections.abc import Iterator
from itertools import product
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig
from bodyseg_data.labels import BACKGROUND, UNLABELLED
from bodyseg_data.machine import required
from bodyseg_data.rigs import Camera, Rig
from bodyseg_model.networks import Network
from bodyseg_model.segmentation.finder import Background, find_bodies
from bodyseg_model.segmentation.views import view_body

_LEAST: Final = 300  # pixels of somebody in a view, from which parts can be told


class CutPerson(NamedTuple):
    """What a network sees of somebody. range_m: float32 [H, W], metres, 0 where nothing is measured or somebody else
    is; labels: uint8 [H, W], 254 on surfaces of no class, 255 where `range_m` is 0.
    """

    range_m: NDArray[np.float32]
    labels: NDArray[np.uint8]


def cut_people(
    range_m: NDArray[np.float32],
    labels: NDArray[np.uint8],
    camera: Camera,
    rig: Rig,
    finder: Network | None = None,
    larger: tuple[int, int] | None = None,
) -> Iterator[CutPerson]:
    """Yield the people in a frame, the largest first, as `Segmenter` shows them to a network that is trained for `rig`:
    what the finder takes for somebody and is so for at least half, in an image of the rig's camera.

    range_m, camera, finder: as of `find_bodies`. labels: uint8 [H, W], true classes of people's parts, 254 on other
    surfaces, 255 where nothing was measured. A pixel has the label of the frame's nearest pixel. A view larger than the
    image, as of who lies, is yielded in as few windows as hold all of them. larger: rows and columns of the image; only
    people who are larger than the camera's are then yielded. Raises as `find_bodies`; MissingLibrary without SciPy.
    """
    required("scipy", "cutting people out of frames", "segment")
    from scipy.ndimage import distance_transform_edt

    own_size = rig.camera.rows, rig.camera.columns
    rows, columns = larger or own_size
    for found in find_bodies(range_m, camera, Background(), finder):
        own = labels.ravel()[found.pixels]
        if 2 * np.count_nonzero(own < UNLABELLED) < len(own):
            continue
        try:
            view = view_body(range_m, found.pixels, camera, rig)
        except BadConfig:  # of a size that no network sees
            continue
        seen: NDArray[np.uint8] = np.full(view.range_m.shape, BACKGROUND, np.uint8)
        seen.ravel()[view.view_pixels] = own
        nearest = distance_transform_edt(seen == BACKGROUND, return_distances=False, return_indices=True)
        seen = np.where(view.range_m > 0, seen[tuple(nearest)], BACKGROUND)
        spare = [max(0, wanted - there) for wanted, there in zip((rows, columns), seen.shape, strict=True)]
        around = [(each // 2, each - each // 2) for each in spare]  # of views that `larger` images hold
        seen_m, seen = np.pad(view.range_m, around), np.pad(seen, around, constant_values=BACKGROUND)
        shown = seen != BACKGROUND
        down, across = shown.any(axis=1), shown.any(axis=0)
        if larger and len(_windows(down, own_size[0])) * len(_windows(across, own_size[1])) == 1:
            continue
        for window in product(_windows(down, rows), _windows(across, columns)):
            if np.count_nonzero(seen[window] < UNLABELLED) >= _LEAST:
                yield CutPerson(seen_m[window], seen[window])


def _windows(shown: NDArray[np.bool_], part: int) -> list[slice]:
    """Parts of the lines of a view that hold all those shown: the middle, or as few as can be, evenly spaced."""
    first, last = map(int, np.flatnonzero(shown)[[0, -1]])
    length = last + 1 - first
    more = (length - 1) // part  # windows beside the first
    if not more:
        starts = [(len(shown) - part) // 2]
    else:
        starts = [first + (length - part) * number // more for number in range(more + 1)]
    return [slice(start, start + part) for start in starts]
