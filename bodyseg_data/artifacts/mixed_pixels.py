"""Mixed (flying) pixels, as times of flight have them: ranges between two surfaces that a pixel sees both of."""

from dataclasses import dataclass

import numpy as np

from bodyseg_data.artifacts.artifact import Artifact, RangeImage, Scene
from bodyseg_data.artifacts.noise import as_range
from bodyseg_data.core import Draws, bounded
from bodyseg_data.machine import if_ready, loops


@dataclass(frozen=True)
class MixedPixels(Artifact):
    """Mixed (flying) pixels: a pixel beside a farther surface gets a range between both, uniform over the gap.

    share: probability with which such a pixel is mixed. Labels stay: the pixel sees the body, too.
    jump_mm: a surface counts as farther if it is at least so many mm behind, in the pixel above, below, left or right.
    background_m: range, metres, of what lies behind the body, for the body's own silhouette. None if nothing is in
    reach of the sensor: then only edges before other parts of the body are mixed.
    least: the share of each image is drawn uniformly from `least` to `share`; None for `share` in every image.
    nearest_m: likewise the background's range, from `nearest_m` to `background_m`. No silhouette is mixed with a
    background that is not behind the body, so a small `nearest_m` also leaves images as they are.
    """

    name = "mixed_pixels"
    kind = "noise"
    purposes = ("mixed pixels", "mixed share", "mixed background")

    share: float = bounded(0.5, 0, 1, not_below="least")
    background_m: float | None = bounded(None, 0, 100, above=True, not_below="nearest_m")
    jump_mm: float = bounded(30.0, 0, 10_000, above=True)
    least: float | None = bounded(None, 0, 1)
    nearest_m: float | None = bounded(None, 0, 100, above=True)

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        share, wall_m = self.share, self.background_m or 0.0
        if self.least is not None:
            share = self.least + (self.share - self.least) * draws.chance("mixed share")
        if self.nearest_m is not None:
            wall_m = self.nearest_m + (wall_m - self.nearest_m) * draws.chance("mixed background")
        behind = round(wall_m / scene.step_m)
        with if_ready:
            sensor = loops("bodyseg_data.artifacts.sensor_loops")
            bits = sensor.bits_of(draws.stream("mixed pixels"), len(scene.pixels))
            flat, steps = image.range.reshape(-1), np.ascontiguousarray(scene.sample.range).reshape(-1)
            limits = share * 65536, behind, self.jump_mm, scene.step_m
            sensor.mix(flat, steps, image.range.shape[1], scene.pixels, bits, *limits)
            return
        # The upper 16 bits of a draw choose the pixels, the lower 16 give the position in the gap.
        bits = draws.pixels("mixed pixels", len(scene.pixels), np.uint32)
        clean = scene.sample.range.astype(np.int64)
        seen = np.pad(np.where(clean > 0, clean, behind), 1)
        neighbours = seen[:-2, 1:-1], seen[2:, 1:-1], seen[1:-1, :-2], seen[1:-1, 2:]
        farthest = np.maximum.reduce(neighbours).reshape(-1)[scene.pixels]
        gap = farthest - clean.reshape(-1)[scene.pixels]
        chosen = (bits >> np.uint32(16)) < share * 65536
        mixed = np.flatnonzero(chosen & (gap * scene.step_m * 1000 >= self.jump_mm))
        ranges, pixels = image.range.reshape(-1), scene.pixels[mixed]
        before = ranges[pixels]
        position = (bits[mixed] & np.uint32(0xFFFF)) / 65536
        ranges[pixels] = np.where(before > 0, as_range(before + gap[mixed] * position), 0)
