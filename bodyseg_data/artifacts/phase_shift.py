"""Errors and losses of a sensor that projects shifted fringes, from their causes: cloth, light, distance and motion.

The sensor lights the scene with binary patterns (a Gray code, which counts fringes) and with N patterns of fringes that
are shifted by an Nth of a period each. Pattern n at a pixel is A + B cos(phi + 2 pi n / N), and the phase phi with the
count of its fringe gives the projector's column, so the range (Zhang, "High-speed 3D shape measurement with structured
light methods: A review", Optics and Lasers in Engineering 106, 2018). docs/explanation/noise.md has the
closed forms of `fringes.py`; tests compare them with the simulated patterns.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.artifact import Artifact, RangeImage, Scene
from bodyseg_data.artifacts.fringes import BEND_M, DRAWN, EDGE_M, MARGIN, REACH, Optics, decode, fill, sideways
from bodyseg_data.artifacts.noise import as_range
from bodyseg_data.artifacts.scratch import BLOCK
from bodyseg_data.core import BadConfig, Draws, bounded
from bodyseg_data.labels import PART_CLASSES, PART_COUNT
from bodyseg_data.machine import if_ready, loops
from bodyseg_data.rigs import Rig

_LOOPS: Final = "bodyseg_data.artifacts.sensor_loops"
OfRig = tuple[Optics, NDArray[np.float32], NDArray[np.float32]]


@dataclass(frozen=True)
class PhaseShift(Artifact):
    """Errors of ranges, and lost pixels, of phase shifting with a Gray code, for the rig's first projector.

    Drawn for each image, between their bounds: how fast limbs move, how bright other light is, and how light the coat
    is. Drawn for each part of the body: reflectances and patterns of skin, hair and clothes, and a rigid motion that is
    continuous where a part meets the next. A set without the 33 parts gets one garment and one rigid motion.

    phase_patterns: N, the number of fringe patterns. rate_hz: rate of all patterns.
    binary_patterns: number of patterns of the Gray code, which count 2**binary_patterns fringes over the projector's
    image; they are shown before the fringes, the finest last.
    signal_e: half the brightest of a fringe on a white surface that faces the projector at the rig's stand-off.
    read_noise_e: of a pixel of the camera. threshold_e: pixels of weaker fringes are lost. All three are in electrons.
    dimmest, brightest: bounds of other light, as a share of `signal_e`.
    gamma: of the projector, after its calibration. aperture_mm: diameter of its lens, focused on the stand-off.
    edge_fringes: half the width of a binary edge in the camera's image.
    jumps_found: share of jumps by one fringe that the sensor finds; it loses these pixels.
    slowest_m_s, fastest_m_s: bounds of the speed of hands and feet.
    darkest, lightest: bounds of the reflectance of cloth. patterned: share of garments with stripes, checks or prints.
    """

    name = "phase_shift"
    kind = "noise"
    version = 2
    purposes = ("fringe speed", "ambient light", "coat", "clothes", "motion", "fringe noise")
    drawn: ClassVar[Mapping[str, str]] = {
        "speed_m_s": "limbs {:.1f} m/s",
        "ambient": "other light {:.0%}",
        "coat": "coat reflects {:.0%}",
    }

    phase_patterns: int = bounded(5, 3, 16)
    binary_patterns: int = bounded(7, 1, 12)
    rate_hz: float = bounded(360.0, 1, 100_000)
    signal_e: float = bounded(5000.0, 0, 1e9, above=True)
    read_noise_e: float = bounded(20.0, 0, 1e6)
    threshold_e: float = bounded(160.0, 0, 1e9)
    dimmest: float = bounded(0.0, 0, 1000)
    brightest: float = bounded(0.5, 0, 1000, not_below="dimmest")
    gamma: float = bounded(1.05, 0.3, 4)
    aperture_mm: float = bounded(4.3, 0, 1000)
    edge_fringes: float = bounded(0.1, 0, 0.5)
    jumps_found: float = bounded(0.8, 0, 1)
    slowest_m_s: float = bounded(0.0, 0, 100)
    fastest_m_s: float = bounded(2.0, 0, 100, not_below="slowest_m_s")
    darkest: float = bounded(0.01, 0, 1)
    lightest: float = bounded(0.8, 0, 1, not_below="darkest")
    patterned: float = bounded(0.5, 0, 1)

    def draw(self, draws: Draws) -> dict[str, float]:
        """As `Artifact.draw`: "speed_m_s"; "ambient", a share of `signal_e`; and "coat", the coat's reflectance."""
        speed, light, coat = (draws.chance(purpose) for purpose in self.purposes[:3])
        return {
            "speed_m_s": self.slowest_m_s + (self.fastest_m_s - self.slowest_m_s) * speed * speed,
            "ambient": self.dimmest + (self.brightest - self.dimmest) * light,
            "coat": self.darkest + (self.lightest - self.darkest) * coat * coat,  # more cloth is dark than light
        }

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        """As `Artifact.apply`. Raises BadConfig for a rig whose camera and projector are at one point."""
        sample, (optics, x, y) = scene.sample, self.optics(scene.rig, image.drawn["ambient"])
        clean, parts = sample.range, scene.classes == PART_CLASSES
        times = np.float32(optics.finest + 1 - self.binary_patterns), np.float32((self.phase_patterns - 1) / 2)
        with if_ready:
            given = parts, *self._given(scene, image.drawn)
            loops(_LOOPS).apply(image.range, sample, given, x, y, optics, times, draws)
            return
        pixels = scene.pixels
        rows, columns = np.divmod(pixels, clean.shape[1])
        named = sample.labels.reshape(-1)[pixels]
        labels = np.minimum(named, PART_COUNT)
        weights = np.ones_like(pixels), columns, rows, clean.reshape(-1)[pixels]
        sums = np.stack([np.bincount(labels, weight, PART_COUNT + 1) for weight in weights]).astype(np.int64)
        look = tuple(self.looks(parts, sums, scene, image.drawn, draws)[:, labels])
        padded = np.pad(clean, MARGIN).astype(np.float32)
        rows_in, columns_in = rows + MARGIN, columns + MARGIN
        across, along = (0, 0, 0, -REACH, REACH), (0, -REACH, REACH, 0, 0)
        here, *beside = (padded[rows_in + down, columns_in + right] for down, right in zip(across, along, strict=True))
        x, y = x[columns], y[rows]
        # All pixels of one label that follow each other in a row move sideways as the middle one does.
        begins = np.ones(len(pixels), bool)
        begins[1:] = (np.diff(pixels) != 1) | (named[1:] != named[:-1]) | (columns[1:] == 0)
        edges = np.append(np.flatnonzero(begins), len(pixels))
        middle = ((edges[:-1] + edges[1:] - 1) // 2)[np.cumsum(begins) - 1]
        seen = []
        for time in times:
            along, down = sideways(here[middle], x[middle], y, look, optics, time)
            seen.append(padded[rows_in - down.astype(np.intp), columns_in - along.astype(np.intp)])
        bits = draws.pixels("fringe noise", len(pixels), np.uint32)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # at pixels that are lost
            steps, kept = decode(*[here, *beside, *seen, x, y, look, optics, bits])
        ranges = image.range.reshape(-1)
        before = ranges[pixels]
        ranges[pixels] = np.where((before > 0) & kept, as_range(before.astype(np.float32) + steps), 0)

    def optics(self, rig: Rig, ambient: float) -> OfRig:
        """Quantities that all pixels of a rig's image share, and the rays of columns and of rows, float32.

        ambient: other light, a share of `signal_e`. Behind the last column is room for a block.
        """
        optics, x, y = self._of_rig(rig)
        return optics._replace(ambient=np.float32(self.signal_e * ambient)), x, y

    @lru_cache(maxsize=64)  # noqa: B019 - artifacts of equal strengths are equal, and small
    def _of_rig(self, rig: Rig) -> OfRig:
        rotation, shift = rig.camera_to_projector()
        if not shift.any():
            raise BadConfig(f"rig {rig.name} has no baseline, which phase_shift needs")
        axis, count, bits = int(abs(shift[1]) > abs(shift[0])), self.phase_patterns, self.binary_patterns
        projector = rig.projector
        pitch = (projector.columns, projector.rows)[axis] / 2**bits  # width of a fringe, projector's pixels
        to_fringe = np.array([0.0, 0.0, projector.centre_px[axis]])
        to_fringe[axis] = projector.focal_px
        to_fringe /= pitch
        stand_off = rotation @ (0, 0, rig.stand_off_m) + shift
        camera, light, finest = rig.camera, -rotation.T @ shift, -(count + 1) / 2
        # A disc of diameter d dims fringes of period p by 1 - (pi d / p)^2 / 8, as exp(-t) does.
        blur = math.pi**2 / 8 * (self.aperture_mm / 1000 * projector.focal_px / pitch) ** 2
        found = np.clip(self.jumps_found, 1e-12, 1 - 1e-12)  # finite quantiles, beyond every draw
        values = (
            *(rig.range_step_m, camera.focal_px * rig.range_step_m / (2 * REACH), 2 * BEND_M / rig.range_step_m),
            *(to_fringe @ rotation, to_fringe @ shift, rotation[2], shift[2], light, light @ light),
            *(stand_off @ stand_off, 2.0**bits, 1 / stand_off[2], blur),
            *(self.signal_e, 0.0, self.read_noise_e**2, self.threshold_e, math.sqrt(2 / count)),
            *(1 / self.rate_hz, camera.focal_px / self.rate_hz, EDGE_M / rig.range_step_m, 1 / count),
            *(finest, finest - (bits - 1) / 2, self.edge_fringes, NormalDist().inv_cdf(found)),
        )
        shift = np.arange(count) / count
        weights = 2 / count * np.cos(2 * np.pi * shift), -2 / count * np.sin(2 * np.pi * shift)
        shown = np.stack((shift, count * shift - (count - 1) / 2, *weights), axis=1).astype(np.float32)
        x, y = (slopes.astype(np.float32) for slopes in camera.slopes)
        made = [tuple(np.asarray(each, np.float32)) if np.ndim(each) else np.float32(each) for each in values]
        optics = Optics(*[*made, tuple(_brightness(self.gamma)), tuple(map(tuple, shown))])
        return optics, np.pad(x, (0, BLOCK)), y

    def looks(
        self, parts: bool, sums: NDArray[np.int64], scene: Scene, drawn: Mapping[str, float], draws: Draws
    ) -> NDArray[np.float32]:
        """Cloth and motion of each label, float32 [19, 34]; the last column is of labels that are no part.

        Rows: two waves, each with its vector in turns a metre and its phase; weights of both and of their product;
        reflectance where their sum is positive, and elsewhere; velocity at the camera, m/s, and rotation, rad/s, in the
        camera's frame. sums: of pixels, their columns, rows and steps by label, [4, 34]. parts: labels are the 33 ones.
        """
        tables = np.zeros((PART_COUNT + 1, 19), np.float32)
        clothes, motion = (draws.pixels(purpose, count, np.uint32) for purpose, count in DRAWN.items())
        fill(parts, *self._given(scene, drawn), sums, clothes.reshape(6, 12), motion, tables)
        return tables.T

    def _given(self, scene: Scene, drawn: Mapping[str, float]) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """The arguments `place` and `cloth` of `fill`."""
        camera = scene.rig.camera
        place = scene.step_m, camera.focal_px, *camera.centre_px, scene.rig.stand_off_m
        cloth = drawn["coat"], self.darkest, self.lightest - self.darkest, self.patterned, drawn["speed_m_s"]
        return tuple(map(float, place)), tuple(map(float, cloth))


def _brightness(gamma: float) -> NDArray[np.float32]:
    """A fringe's brightness, (1/2 + cos(2 pi u) / 2)**gamma, less 1 and with a first harmonic of height 1, as a
    polynomial in u^2 for |u| <= 1/2: its factors, float32 [7].
    """
    phi = 2 * np.pi * (np.arange(4096) + 0.5) / 4096
    fringe = (0.5 + np.cos(phi) / 2) ** gamma
    height = 2 * np.mean(fringe * np.cos(phi))
    squares = (1 - np.cos(phi[:2048])) / 8  # Chebyshev's points, where the fit is best
    fitted = (0.5 + np.cos(2 * np.pi * np.sqrt(squares)) / 2) ** gamma / height - 1
    return np.polyfit(squares, fitted, 6)[::-1].astype(np.float32)
