"""The paper's reference [21] as a baseline: a random forest of depth differences.

Shotton et al., "Real-time human pose recognition in parts from single depth images", CVPR 2011: every pixel walks down
a few trees by itself; each split compares the ranges at two offsets from it, and the leaves' distributions over the
parts are averaged. scikit-learn grows the trees; they are walked by a compiled loop, which reads only the pixels
that a pixel's own path needs.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any, Final, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, Draws, MissingLibrary
from bodyseg_data.labels import BACKGROUND, PART_COUNT
from bodyseg_data.loading import RangeImages
from bodyseg_data.machine import compiled
from bodyseg_data.samples import metres
from bodyseg_model.networks import Network, check_range_images

FAR_M: Final = np.float32(10.0)
"""Range where nothing was measured: "a large positive constant value", though one that float32 subtracts well."""

SHOTTONS_IMAGES: Final = 900_000
"""300 000 for each of three trees."""


@dataclass(frozen=True)
class ForestScale:
    """Size of a forest, and of its training data. The default takes two minutes of one core, and 1.1 GB.

    images: the first ones of the training's first epoch. pixels: of each, spread evenly over the parts that it shows.
    candidates: pairs of offsets, drawn once for all trees; tried: how many of them at each split. reach: of the offsets
    in rows and in columns, pixels at 1 m. trees, depth: Shotton's. leaf: pixels that a leaf holds at least.
    """

    images: int = 2000
    pixels: int = 200
    candidates: int = 400
    tried: int = 60
    reach: float = 300.0
    trees: int = 3
    depth: int = 20
    leaf: int = 5
    window: int = 11


def smoothed(range_m: NDArray[np.float32], window: int) -> NDArray[np.float32]:
    """Mean of the measured ranges in the square of `window` pixels around each pixel, [H, W]; 0 if none was measured.

    Not in Shotton et al., whose sensor lost few pixels: where half of them are missing, every other probe would hit a
    hole.
    """
    image = torch.from_numpy(range_m)
    sums = torch.stack([image, (image > 0).to(image.dtype)])
    for size in ((window, 1), (1, window)):
        sums = F.avg_pool2d(sums, size, 1, (size[0] // 2, size[1] // 2))
    least = 0.5 / window**2  # of one measured pixel half, since sums of rounded shares may be less than one
    found: NDArray[np.float32] = torch.where(sums[1] > least, sums[0] / sums[1].clamp(min=least), 0).numpy()
    return found


def draw_offsets(scale: ForestScale, seed: int) -> NDArray[np.float32]:
    """Pairs of offsets (u, v), float32 [candidates, 4]: u's rows and columns, v's rows and columns, pixels at 1 m.

    v is the pixel itself in every other pair.
    """
    draws = Draws(seed, 0, "").generator("forest offsets").uniform(-scale.reach, scale.reach, (scale.candidates, 4))
    draws[::2, 2:] = 0
    return draws.astype(np.float32)


def depth_differences(
    range_m: NDArray[np.float32], pixels: NDArray[np.int64], offsets: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Equation (1) of Shotton et al., d(x + u / d(x)) - d(x + v / d(x)), float32 [pixels, offsets].

    range_m: [H, W], metres, 0 where nothing was measured. pixels: indices x in the flat image, where something was.
    d of what was not measured, or lies outside of the image, is FAR_M.
    """
    height, width = range_m.shape
    padded = np.zeros((height + 1, width + 1), np.float32)  # one row and column more, for pixels outside the image
    padded[:height, :width] = range_m
    padded[padded == 0] = FAR_M
    rows, columns = (each[:, None] for each in np.divmod(pixels, width))
    depth = range_m.ravel()[pixels][:, None]

    def probe(down: NDArray[np.float32], right: NDArray[np.float32]) -> NDArray[np.float32]:
        row, column = rows + _steps(down, depth), columns + _steps(right, depth)
        row[(row < 0) | (row >= height)] = height
        column[(column < 0) | (column >= width)] = width
        return padded[row, column]

    return probe(offsets[:, 0], offsets[:, 1]) - probe(offsets[:, 2], offsets[:, 3])


def _steps(offset: NDArray[np.float32], depth: NDArray[np.float32]) -> NDArray[np.int64]:
    """Whole pixels, halves up."""
    steps: NDArray[np.int64] = np.floor(offset / depth + np.float32(0.5)).astype(np.int64)
    return steps


class Trees(NamedTuple):
    """All trees of a forest in common arrays.

    nodes: float32 [N, 4], the offsets that a split compares. thresholds: float64 [N]. children: int32 [N, 2], the next
    node if the difference is at most the threshold, and if not; -1 and the leaf's number in a leaf. leaves: float32
    [L, 33]. roots: int32 [trees].
    """

    nodes: NDArray[np.float32]
    thresholds: NDArray[np.float64]
    children: NDArray[np.int32]
    leaves: NDArray[np.float32]
    roots: NDArray[np.int32]


class DepthForest(Network):
    """Range image -> logarithms of the parts' probabilities: used as any other network.

    window: see `smoothed`.
    """

    def __init__(self, trees: Trees, window: int = 1) -> None:
        super().__init__()
        self.trees, self.window = trees, window

    @property
    def learned(self) -> int:
        """Number of learned parameters: the pair and threshold of every split, and the leaves' distributions."""
        leaves = self.trees.leaves
        return 2 * (len(self.trees.nodes) - len(leaves)) + leaves.size

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        """Logarithms of probabilities, float32 [B, 33, H, W], of range images in metres, float32 [B, 1, H, W].

        They are 0 where nothing was measured. Raises BadConfig for any other shape, MissingLibrary
        without numba.
        """
        check_range_images(range_m)
        images = range_m[:, 0].numpy()
        found = np.zeros((*images.shape, PART_COUNT), np.float32)
        for image, scores in zip(images, found, strict=True):
            pixels = np.flatnonzero(image)
            shares = self.probabilities(smoothed(image, self.window), pixels)
            scores.reshape(-1, PART_COUNT)[pixels] = torch.from_numpy(shares).log_().numpy()
        return torch.from_numpy(found).permute(0, 3, 1, 2)

    def probabilities(self, range_m: NDArray[np.float32], pixels: NDArray[np.int64]) -> NDArray[np.float32]:
        """Probabilities of the parts at measured pixels of the flat image, float32 [pixels, 33], by torch's threads."""
        found = np.zeros((len(pixels), PART_COUNT), np.float32)
        threads = torch.get_num_threads()
        shares = np.array_split(pixels, threads), np.array_split(found, threads)
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(lambda here, into: _compiled_walk()(range_m, here, *self.trees, FAR_M, into), *shares))
        return found


def walk(
    range_m: Any, pixels: Any, nodes: Any, thresholds: Any, children: Any, leaves: Any, roots: Any, far: Any, found: Any
) -> None:
    """Add the mean of each pixel's leaves to found, float32 [pixels, 33]. Compiled where it is used."""
    height, width = range_m.shape
    half, share = np.float32(0.5), np.float32(1) / np.float32(len(roots))
    for index in range(len(pixels)):
        row, column = pixels[index] // width, pixels[index] % width
        depth = range_m[row, column]
        for root in roots:
            node = root
            while children[node, 0] >= 0:
                difference = np.float32(0)
                for end in range(2):
                    there = row + int(np.floor(nodes[node, 2 * end] / depth + half))
                    across = column + int(np.floor(nodes[node, 2 * end + 1] / depth + half))
                    seen = far
                    if 0 <= there < height and 0 <= across < width and range_m[there, across] > 0:
                        seen = range_m[there, across]
                    difference = seen if end == 0 else difference - seen
                node = children[node, 0] if difference <= thresholds[node] else children[node, 1]
            leaf = children[node, 1]
            for part in range(leaves.shape[1]):
                found[index, part] += share * leaves[leaf, part]


@cache
def _compiled_walk() -> Any:
    return compiled(walk, "the forest")


def fit_forest(images: RangeImages, scale: ForestScale, seed: int = 0) -> DepthForest:
    """A forest grown on pixels of `images` as their epoch shows them, on one processor.

    Raises BadConfig for fewer images than the scale asks for, MissingLibrary without scikit-learn.
    """
    if len(images) < scale.images:
        raise BadConfig(f"a forest of {scale.images} training images needs as many, found {len(images)}")
    ensemble = _ensemble()
    offsets = draw_offsets(scale, seed)
    features = np.empty((scale.images * scale.pixels, scale.candidates), np.float32)
    labels = np.empty(len(features), np.uint8)
    filled = 0
    for index in images.order(images.epoch)[: scale.images].tolist():
        image = images.image(index)
        chosen = _spread_over_parts(image.labels, scale.pixels, Draws(seed, 0, image.key).generator("forest pixels"))
        here = slice(filled, filled + len(chosen))
        features[here] = depth_differences(smoothed(metres(image.range, images.step_m), scale.window), chosen, offsets)
        labels[here] = image.labels.ravel()[chosen]
        filled = here.stop
    forest = ensemble.RandomForestClassifier(
        scale.trees,
        max_depth=scale.depth,
        max_features=scale.tried,
        min_samples_leaf=scale.leaf,
        random_state=int(Draws(seed, 0, "").generator("forest trees").integers(2**31)),
        n_jobs=1,
    )
    forest.fit(features[:filled], labels[:filled])
    return from_sklearn(forest, offsets, scale.window)


def from_sklearn(forest: Any, offsets: NDArray[np.float32], window: int = 1) -> DepthForest:
    """The trees of a fitted RandomForestClassifier whose features are the differences at `offsets`."""
    nodes, thresholds, children, leaves, roots = [], [], [], [], []
    first = first_leaf = 0
    for estimator in forest.estimators_:
        tree = estimator.tree_
        is_leaf = tree.children_left < 0
        nodes.append(offsets[np.where(is_leaf, 0, tree.feature)])
        thresholds.append(tree.threshold)
        below = np.stack([tree.children_left, tree.children_right], axis=1) + first
        below[is_leaf] = np.stack([np.full(is_leaf.sum(), -1), first_leaf + np.arange(is_leaf.sum())], axis=1)
        children.append(below.astype(np.int32))
        share = np.zeros((is_leaf.sum(), PART_COUNT), np.float32)
        share[:, forest.classes_] = tree.value[is_leaf, 0] / tree.value[is_leaf, 0].sum(axis=1, keepdims=True)
        leaves.append(share)
        roots.append(first)
        first += len(is_leaf)
        first_leaf += len(share)
    join = np.concatenate
    trees = Trees(join(nodes), join(thresholds), join(children), join(leaves), np.array(roots, np.int32))
    return DepthForest(trees, window).eval()


def _spread_over_parts(labels: NDArray[np.uint8], count: int, draws: np.random.Generator) -> NDArray[np.int64]:
    """At most `count` indices into the flat image, equally many of every part as far as it has them: [N], rising.

    Shotton et al. choose pixels so "to ensure a roughly even distribution across body parts".
    """
    flat = labels.ravel()
    body = draws.permutation(np.flatnonzero(flat != BACKGROUND))
    by_part = body[np.argsort(flat[body], kind="stable")]
    parts, first = np.unique(flat[by_part], return_index=True)
    within = np.arange(len(by_part)) - np.repeat(first, np.diff([*first, len(by_part)]))
    return np.sort(by_part[within < count // max(1, len(parts))])


def _ensemble() -> Any:
    try:
        return import_module("sklearn.ensemble")
    except ImportError as error:
        message = f"the forest needs the package 'scikit-learn': pip install scikit-learn ({error})"
        raise MissingLibrary(message) from error
