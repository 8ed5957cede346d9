"""People in a frame: the pixels that a small network, the finder, takes for people's, divided into people.

The finder sees the whole frame as a camera of its own focal length would take it. Its answer is divided on a grid of
every third pixel, about, by what is known of bodies: connected surfaces are pieces; a piece with several heads is of
several people, each of whom gets what is nearest along the surface; small pieces belong to a person in reach.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cache, lru_cache, partial
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, Checked
from bodyseg_data.labels import LabelMap
from bodyseg_data.machine import required
from bodyseg_data.rigs import Camera
from bodyseg_data.samples import box_of
from bodyseg_model.networks import FINDER, Network, Trained, check_network, device_of, load_network
from bodyseg_model.segmentation.views import BackgroundMode, compiled_loops

_PERSON: Final = 0  # of the finder's two classes
_SURE: Final = 3.0  # log odds of 95 %
_RAISED: Final = 1.1  # log odds added beside such a cell, so 25 % are 50 %: 0.4 points of recall for 0.3 of F1
_RAISED_CELLS: Final = 7  # side of the square around such a cell
_JUMP_M: Final = 0.1  # greatest difference of range between neighbours on one surface
_JUMP_SHARE: Final = 0.04  # the same beyond 2.5 m: sensors are coarser at a distance
_JUMP: Final = np.array([_JUMP_M, _JUMP_SHARE], np.float32)
_GAP_M: Final = 0.2  # widest gap that parts no surface: an arm's shadow falls on the trunk

_BODY_M2: Final = 0.04  # least visible surface of a person, as all areas as if it faced the camera
_BODY_M: Final = (0.25, 3.0)  # least and greatest of a person's width, height and depth, whichever is largest
_LOOSE_M2: Final = 0.12  # less, such as a forearm with its hand, joins a person beside whom it is
_LOOSE_M: Final = 1.0  # greatest width, height and depth of such a piece
_REACH_M: Final = (0.6, 0.3)  # before a person and behind: of a stretched arm only the hand may be seen
_BESIDE_M: Final = 0.1  # from the person's box in the image
_BELOW_M: Final = (0.35, 2.1)  # greatest distance in range, and height in all, of a person in two parts

_STEP_RAD: Final = 3 / 525  # between samples
_OWN_M2: Final = 0.1  # least surface of each of several people in one piece, square metres
_EDGE_M: Final = 0.02  # larger jumps part people who touch; grows by 0.3 of itself a metre of range
_ACROSS_EDGES: Final = 60.0  # a way along the surface is longer by this many times the jumps on it
_COARSE_M: Final = 0.018  # between samples among which heads are looked for
_LEVEL_M: Final = 0.1
_HEAD: Final = (0.08, 0.015, 0.11)  # least height, area and mean width of a head, metres
_NEW_M2: Final = 0.002  # least surface at which a top begins
_APART_M2: Final = 0.06  # least surface of what meets no other
_FREE_M: Final = 0.05  # half the width over a top in which there is nothing else
_ENLARGED: Final = 2.5  # from so many times on, nearest pixels would show as steps: at 8, a whole cell has one range
_FARTHEST_M: Final = 16.4  # beyond it, nothing is measured: as in recordings in floating point

Pixels = NDArray[np.intp]
Ranges = NDArray[np.float32]
Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Background(Checked):
    """Rule for what of a frame is labelled; all else is background, which is removed before a network labels the rest.

    mode: "people", the people whom the finder finds, within the limits; "limits", every pixel within the limits, as one
    body; "keep", every measured pixel, as one body, for frames whose background was removed before; "frame", whole
    frames as they stand, for networks that were trained on whole images of such a camera.
    near_m, far_m: the limits of range, metres. Raises BadConfig for another mode, or limits in the wrong order.
    """

    mode: BackgroundMode = "people"
    near_m: float = 0.4
    far_m: float = 6.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.near_m < self.far_m < float("inf"):
            raise BadConfig(
                "the near limit must be at least 0 m and less than the far one, found "
                f"{self.near_m:g} and {self.far_m:g} m"
            )

    @classmethod
    def usual(cls, label_map: LabelMap) -> Background:
        """The rule for a network of these classes: people, but whole frames for classes that are no parts of people."""
        return cls("people" if label_map.of_bodies else "frame")

    @classmethod
    def of_options(cls, mode: BackgroundMode, near_m: float | None, far_m: float | None) -> Background:
        """The rule that commands' options give; None for a limit's default. Raises BadConfig for a limit in vain."""
        given = {name: limit for name, limit in (("near_m", near_m), ("far_m", far_m)) if limit is not None}
        if given and mode in ("keep", "frame"):
            raise BadConfig(f"--near and --far limit what is kept: they contradict --background {mode}")
        return cls(mode, **given)

    def to_json(self) -> dict[str, Any]:
        """The mode, and the limits where they count, as summary.json has them."""
        return {"mode": self.mode} if self.mode in ("keep", "frame") else asdict(self)


class Found(NamedTuple):
    """A body of a frame. pixels: row * columns + column, int64 [N], ascending. person: mean probability over them that
    they show a person, 0 to 1, by the finder; None where none was asked.
    """

    pixels: Pixels
    person: float | None = None


def find_bodies(
    range_m: Ranges, camera: Camera, background: Background, finder: Network | None = None
) -> tuple[Found, ...]:
    """Find the bodies in a frame, the largest first; a pixel belongs to at most one.

    range_m: [H, W], metres along the optical axis, 0 = nothing measured, as are NaN, infinity and, but in the mode
    "frame", what lies beyond 16.4 m and the far limit, such as a simulated sky. camera: the one that took it, upright.
    finder: network of the mode "people", by default the one that ships. Raises BadConfig for a network that is no
    finder; MissingLibrary without SciPy, in that mode.
    """
    farthest = np.float32(np.inf if background.mode == "frame" else max(_FARTHEST_M, background.far_m))
    kept = np.where((range_m > 0) & (range_m < farthest), range_m, np.float32(0))
    near, far = np.float32(background.near_m), np.float32(background.far_m)
    within = kept > 0 if background.mode in ("keep", "frame") else (kept > 0) & (kept >= near) & (kept <= far)
    if background.mode != "people":
        pixels = np.flatnonzero(within)
        return (Found(pixels),) if len(pixels) else ()
    probability = view_of(shipped_finder().network if finder is None else finder, camera)(kept)
    people = part_people(kept, within & (probability > 0.5), camera)
    return tuple(Found(pixels, float(probability.ravel()[pixels].mean(dtype=np.float64))) for pixels in people)


@cache
def shipped_finder() -> Trained:
    """The finder that ships with the package."""
    return load_network(FINDER)


# What the finder sees.


class FinderView:
    """Shows a finder the frames of a camera, and brings its answers back to their pixels.

    network: of two classes, person and none, with the setting `focal_px`: the focal length, pixels, of the camera
    whose images it was trained on, with the principal point in their middle. A frame is resampled to that camera by
    nearest pixels, or linearly if it is enlarged by 2.5 and more, unless no pixel would be shifted by more than one.
    Raises BadConfig for another network.
    """

    def __init__(self, network: Network, camera: Camera) -> None:
        check_network(network)
        focal_px = network.settings.get("focal_px")
        if not focal_px or network.classes != 2:
            raise BadConfig(
                f"a finder of people needs 2 classes and the setting focal_px, found {network.classes} classes and "
                f"the settings {network.settings}"
            )
        self._network, scale = network, focal_px / camera.focal_px
        sides = (camera.rows, camera.centre_px[1]), (camera.columns, camera.centre_px[0])
        axes = [_resampled(side, centre, scale) for side, centre in sides]
        self._there, self._back, self._between = zip(*axes, strict=True)
        self._enlarged = scale >= _ENLARGED
        shifts = [np.abs(np.arange(len(there)) - there).max() for there in self._there]
        same = [len(there) for there in self._there] == [camera.rows, camera.columns]
        self._same = same and max(shifts) <= 1

    def __call__(self, range_m: Ranges) -> Ranges:
        """Probability of a person at every pixel of a frame, float32 [H, W]; 0 where nothing is measured (0)."""
        seen = range_m
        if not self._same:
            seen = np.pad(range_m, ((0, 1), (0, 1)))
            for axis in (0, 1):  # one after the other takes a third of the time of both at once
                between, there = self._between[axis], self._there[axis]
                seen = _interpolated(seen, between, axis) if self._enlarged else seen.take(there, axis)
        image = torch.from_numpy(np.ascontiguousarray(seen))
        with torch.inference_mode():
            scores = self._network.scores(image[None, None].to(device_of(self._network)))[0].float().cpu().numpy()
        found, odds = np.zeros(seen.shape, np.float32), scores[_PERSON] - scores[1 - _PERSON]
        loops, images = compiled_loops(), _scipy("scipy.ndimage")
        odds[images.maximum_filter(odds, _RAISED_CELLS) >= _SURE] += _RAISED
        likelier = images.uniform_filter((odds > 0).astype(np.float32), 2 * loops.AROUND + 1)
        loops.spread_odds(odds, np.abs(likelier - 0.5) > 0.49, image.numpy(), self._network.output_stride, found)
        if self._same:
            return found
        answer = np.zeros_like(range_m)
        loops.take_nearest(range_m, _JUMP, *self._back, seen, found, answer)
        return answer


view_of = lru_cache(maxsize=8)(FinderView)


def _resampled(side: int, centre: float, scale: float) -> tuple[Pixels, Pixels, Floats]:
    """Pixels along an axis: of the frame, at each of the resampled image, `side` for none; and the other way round.
    Then the places of the former in the frame, pixels from the middle of its first, -1 for none.
    """
    half = max(1, round(max(centre, side - centre) * scale))
    places = centre + (np.arange(2 * half) + 0.5 - half) / scale
    outside, there = (places < 0) | (places >= side), np.floor(places).astype(np.intp)
    back = np.floor(half + (np.arange(side) + 0.5 - centre) * scale).astype(np.intp)
    between = np.where(outside, -1.0, np.clip(places - 0.5, 0, side - 1))
    return np.where(outside, side, there), np.clip(back, 0, 2 * half - 1), between


def _interpolated(image: Ranges, places: Floats, axis: int) -> Ranges:
    """Ranges between pixels along an axis, that of the nearer pixel beside one that was not measured.

    image: with a last row and column of 0, which place -1 gets.
    """
    lower = np.floor(places).astype(np.intp)
    share = np.expand_dims((places - lower).astype(np.float32), 1 - axis)
    one, other = image.take(lower, axis), image.take(np.minimum(lower + 1, image.shape[axis] - 2), axis)
    found: Ranges = one + (other - one) * np.where((one > 0) & (other > 0), share, share.round())
    return found


# People apart.


class _Samples(NamedTuple):
    """Pixels of people, one of every few rows and columns, in reading order. rows, columns: on the grid of samples, int
    [N]. points: x, y, z along the camera's axes, metres, float64 [N, 3]. area_m2: as if each faced the camera, float64
    [N]. edges: pairs of neighbours on one surface, int [2, M].
    """

    rows: Pixels
    columns: Pixels
    points: Floats
    area_m2: Floats
    edges: Pixels

    @property
    def a_metre(self) -> float:
        """Samples a metre, at their median range."""
        return float(1 / np.sqrt(np.median(self.area_m2)))

    def some(self, chosen: Pixels) -> _Samples:
        """The samples with these numbers, in ascending order."""
        number = np.full(len(self.rows), -1)
        number[chosen] = np.arange(len(chosen))
        edges = number[self.edges]
        edges = edges[:, (edges >= 0).all(axis=0)]
        return _Samples(self.rows[chosen], self.columns[chosen], self.points[chosen], self.area_m2[chosen], edges)


def part_people(range_m: Ranges, people: Mask, camera: Camera) -> list[Pixels]:
    """Divide the pixels that show people, bool [H, W], all measured, into people: the pixels of each, ascending flat
    indices, the largest surface first. Pieces too small for a person that belong to nobody are left out.

    range_m: [H, W], metres. camera: the frame's, upright. Raises MissingLibrary without SciPy.
    """
    box = box_of(people)
    if box is None:
        return []
    top, left, step = box[0].start, box[1].start, max(1, round(_STEP_RAD * camera.focal_px))
    ranges = np.where(people[box], range_m[box], np.float32(0))
    grid = ranges[step // 2 :: step, step // 2 :: step]
    if not grid.any():
        return []
    first = top + step // 2 + 0.5 - camera.centre_px[1], left + step // 2 + 0.5 - camera.centre_px[0]
    samples = _sampled(grid, first, step, camera.focal_px)
    person = _persons(samples, _pieces(samples))
    whose = np.full(grid.shape, -1, np.int16)
    whose[samples.rows, samples.columns] = person
    down, across = (
        np.minimum(np.arange(size) // step, most - 1) for size, most in zip(ranges.shape, grid.shape, strict=True)
    )
    seen, of_pixels = np.where(whose < 0, np.float32(0), grid), np.full(people.shape, -1, np.int16)
    compiled_loops().take_nearest(ranges, _JUMP, down, across, seen, whose, of_pixels[box])
    area_m2 = np.bincount(person[person >= 0], samples.area_m2[person >= 0])
    return [np.flatnonzero(of_pixels == number) for number in np.argsort(-area_m2, kind="stable")]


def _sampled(grid: Ranges, first: tuple[float, float], step: int, focal_px: float) -> _Samples:
    """Samples where a grid of ranges is not 0. first: the grid's first row and column, pixels from the optical axis."""
    shown, number = grid > 0, np.full(grid.shape, -1)
    rows, columns = np.nonzero(shown)
    number[rows, columns] = np.arange(len(rows))
    z = grid[rows, columns].astype(np.float64)
    down = number.T[shown.T]  # column by column
    edges = [
        _neighbours(rows, columns, z, step / focal_px),
        down[_neighbours(columns[down], rows[down], z[down], step / focal_px)],
    ]
    x, y = ((first[axis] + step * places) / focal_px * z for axis, places in ((1, columns), (0, rows)))
    return _Samples(rows, columns, np.stack([x, y, z], axis=1), np.square(step * z / focal_px), np.hstack(edges))


def _neighbours(line: Pixels, place: Pixels, z: Floats, step: float) -> Pixels:
    """Pairs of samples, [2, M], in a line on one surface, at most `_GAP_M` or one sample apart. step: metres at 1 m."""
    apart, nearer = np.diff(place) - 1, np.minimum(z[1:], z[:-1])
    close = (apart <= 1) | (apart * step * nearer <= _GAP_M)
    one_surface = np.abs(np.diff(z)) <= np.maximum(nearer * _JUMP_SHARE, _JUMP_M)
    before = np.flatnonzero((line[1:] == line[:-1]) & close & one_surface)
    return np.stack([before, before + 1])


def _pieces(samples: _Samples) -> tuple[Pixels, Mask]:
    """The piece of every sample, from 0, int [N], each of one person; and which pieces were cut from others, bool."""
    graph = _graph(np.ones(samples.edges.shape[1]), samples)
    count, piece = _scipy("scipy.sparse.csgraph").connected_components(graph, directed=False)
    piece, cut = piece.astype(np.intp), [False] * count
    for number in np.flatnonzero(np.bincount(piece, samples.area_m2) >= 2 * _OWN_M2):
        own = np.flatnonzero(piece == number)
        head = _nearest_heads(samples.some(own))
        for other in range(1, head.max() + 1):
            piece[own[head == other]] = len(cut)
            cut.append(True)
    return piece, np.array(cut)


def _graph(lengths: Floats, samples: _Samples) -> Any:
    size = len(samples.rows)
    return _scipy("scipy.sparse").coo_array((lengths, tuple(samples.edges)), shape=(size, size)).tocsr()


def _nearest_heads(samples: _Samples) -> Pixels:
    """For every sample of a piece the number of the head nearest along the surface, int [N]; all 0 for one person."""
    a_metre, z = samples.a_metre, samples.points[:, 2]
    whose = np.zeros(len(z), np.intp)
    if np.ptp(samples.columns) < 0.3 * a_metre:
        return whose
    edge_m = _EDGE_M * (1 + 0.3 * float(np.median(z)))
    heads = _heads(samples, edge_m)
    if len(heads) < 2:
        return whose
    steps = np.diff(samples.points[samples.edges], axis=0)[0]
    lengths = np.linalg.norm(steps, axis=1) + _ACROSS_EDGES * np.maximum(np.abs(steps[:, 2]) - edge_m, 0)
    graph, dijkstra = _graph(lengths, samples), _scipy("scipy.sparse.csgraph").dijkstra
    while len(heads) > 1:
        _, _, source = dijkstra(graph, directed=False, indices=heads, min_only=True, return_predecessors=True)
        for number, head in enumerate(heads):
            whose[source == head] = number
        area_m2 = np.bincount(whose, samples.area_m2, minlength=len(heads))
        if area_m2.min() >= _OWN_M2:
            return whose
        del heads[int(area_m2.argmin())]
    return np.zeros(len(z), np.intp)


def _heads(samples: _Samples, edge_m: float) -> list[int]:
    """Samples that are tops of heads of a piece, whose surface jumps by more than `edge_m` where one body ends.

    Row by row from the top, surfaces begin, grow and meet. A surface is a head if it is wide enough where it meets one
    that began higher, or if it never meets another and has nothing of the piece above it.
    """
    label, thin = _scipy("scipy.ndimage").label, max(1, int(samples.a_metre * _COARSE_M))
    kept = (samples.rows % thin == 0) & (samples.columns % thin == 0)
    a_metre, numbers = samples.a_metre / thin, np.flatnonzero(kept)
    rows, columns = ((each[kept] - each.min()) // thin for each in (samples.rows, samples.columns))
    number = np.full((rows.max() + 1, columns.max() + 1), -1)
    number[rows, columns] = numbers
    z = np.full((number.shape[0] + 2, number.shape[1] + 2), 100.0)
    z[rows + 1, columns + 1] = samples.points[kept, 2]
    around = np.minimum(np.minimum(z[:-2, 1:-1], z[2:, 1:-1]), np.minimum(z[1:-1, :-2], z[1:-1, 2:]))
    whole, shown = (number >= 0) & (z[1:-1, 1:-1] - around < edge_m), number >= 0
    least_height, least_area, least_width = _HEAD
    tops, heads, level = dict[int, float](), list[int](), max(1, round(_LEVEL_M * a_metre))  # tops: first cell -> area
    for last in range(level, len(whole) + level, level):
        surfaces, count = label(whole[:last])  # of cells that touch at a side
        surface, together = surfaces.ravel(), dict[int, list[int]]()
        for top in sorted(tops):
            together.setdefault(int(surface[top]), []).append(top)
        for met in together.values():
            for top in met[1:]:
                height, area = (last - level - top // whole.shape[1]) / a_metre, tops[top]
                if height >= least_height and area >= least_area and area >= least_width * height:
                    heads.append(top)
        areas = np.bincount(surface) / a_metre**2
        # Surfaces are numbered in reading order of their first cells.
        first = np.searchsorted(np.maximum.accumulate(surface), np.arange(count + 1))
        began = [int(first[new]) for new in np.flatnonzero(areas >= _NEW_M2) if new and new not in together]
        tops = {top: float(areas[surface[top]]) for top in (*(met[0] for met in together.values()), *began)}
    side = max(1, int(_FREE_M * a_metre))
    for top, area in tops.items():
        row, column = divmod(top, whole.shape[1])
        beside = shown[:row, max(0, column - side) : column + side + 1]
        if area >= _APART_M2 and not beside.any():
            heads.append(top)
    return [int(number.ravel()[top]) for top in heads]


def _persons(samples: _Samples, pieces: tuple[Pixels, Mask]) -> Pixels:
    """The person of every sample, from 0, int [N]; -1 for nobody's."""
    piece, cut = pieces
    order = np.argsort(piece, kind="stable")
    starts = np.searchsorted(piece[order], np.arange(len(cut)))
    placed = np.column_stack([samples.rows, samples.columns, samples.points])[order]
    lowest, highest = np.minimum.reduceat(placed, starts), np.maximum.reduceat(placed, starts)
    area_m2, beside = np.bincount(piece, samples.area_m2), _BESIDE_M * samples.a_metre
    extents = (highest - lowest)[:, 2:].max(axis=1)
    sized = (area_m2 >= _BODY_M2) & (extents >= _BODY_M[0]) & (extents <= _BODY_M[1])
    loose = ~cut & (area_m2 < _LOOSE_M2) & (extents <= _LOOSE_M)
    person, bodies = np.full(len(cut), -1), list[tuple[Floats, Floats]]()
    for number in np.argsort(-area_m2, kind="stable"):
        low, high = lowest[number], highest[number]
        if person[number] >= 0 or not sized[number]:
            continue
        below = [] if cut[number] else [whose for whose, box in enumerate(bodies) if _one_above_other((low, high), box)]
        if below:
            person[number] = below[0]
            continue
        count = person[number] = len(bodies)
        bodies.append((low, high))
        overlaps = ((highest[:, :2] >= low[:2] - beside) & (lowest[:, :2] <= high[:2] + beside)).all(axis=1)
        near = (lowest[:, 4] >= low[4] - _REACH_M[0]) & (highest[:, 4] <= high[4] + _REACH_M[1])
        person[loose & (person < 0) & overlaps & near] = count
    return person[piece]


def _one_above_other(one: tuple[Floats, Floats], other: tuple[Floats, Floats]) -> bool:
    """True for boxes of two parts of a person whose middle is hidden: low and high rows, columns, x, y, z."""
    low, high = np.maximum(one[0], other[0]), np.minimum(one[1], other[1])
    narrower = min(one[1][2] - one[0][2], other[1][2] - other[0][2])
    apart = abs((one[0] + one[1] - other[0] - other[1])[4]) / 2
    height = max(one[1][3], other[1][3]) - min(one[0][3], other[0][3])
    return bool(
        high[0] <= low[0] and high[2] - low[2] >= narrower / 2 and apart <= _BELOW_M[0] and height <= _BELOW_M[1]
    )


_scipy = partial(required, feature="finding people", extra="segment")
