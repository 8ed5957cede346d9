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
from functools import lru_cache, partial
from statistics import NormalDist
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.artifact import Artifact, RangeImage, Scene, bounded
from bodyseg_data.artifacts.constants import FAR
from bodyseg_data.artifacts.fringes import BEND_M, CHAIN, EDGE_M, REACH, Optics, decode, fill
from bodyseg_data.artifacts.noise import as_range, drawn_bits, normals
from bodyseg_data.artifacts.scratch import BLOCK
from bodyseg_data.core import BadConfig, Draws
from bodyseg_data.labels import PART_COUNT
from bodyseg_data.machine import if_ready, loops
from bodyseg_data.rigs import Rig

_LOOPS: Final = "bodyseg_data.artifacts.phase_loops"


@dataclass(frozen=True)
class PhaseShift(Artifact):
    """Range and losses of phase shifting with a Gray code, for the rig's first projector.

    Of an image are drawn: how fast limbs move and how bright other light is, between their bounds, and how light the
    coat is, from `darkest` to `lightest`. What stays the same over a part of the body is drawn with them: reflectances
    and patterns of skin, hair and clothes, and a motion that is rigid for each part and continuous where a part meets
    the next. A sample without the 33 parts gets one garment and one rigid motion.

    phase_patterns: N; binary_patterns: those of the Gray code, which count 2**binary_patterns fringes over the
    projector's image, finest last and before the fringes; rate_hz: of all patterns. signal_e: half the brightest of a
    fringe on a white surface that faces the projector at the rig's stand-off, electrons; read_noise_e: of a camera's
    pixel, electrons; threshold_e: pixels whose fringes are weaker are lost, electrons. dimmest, brightest: other light,
    a share of signal_e. gamma: of the projector, after its calibration. aperture_mm: diameter of its lens, which is
    focused on the stand-off. edge_fringes: half the width of a binary edge in the camera's image. jumps_found: share of
    jumps by one fringe that the sensor finds, and loses. slowest_m_s, fastest_m_s: of hands and feet. darkest,
    lightest: reflectance of cloth; patterned: share of garments with stripes, checks or prints.
    """

    name = "phase_shift"
    kind = "noise"
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
    brightest: float = bounded(0.5, 0, 1000)
    gamma: float = bounded(1.05, 0.3, 4)
    aperture_mm: float = bounded(4.3, 0, 1000)
    edge_fringes: float = bounded(0.1, 0, 0.5)
    jumps_found: float = bounded(0.8, 0, 1)
    slowest_m_s: float = bounded(0.0, 0, 100)
    fastest_m_s: float = bounded(2.0, 0, 100)
    darkest: float = bounded(0.01, 0, 1)
    lightest: float = bounded(0.8, 0, 1)
    patterned: float = bounded(0.5, 0, 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        for low, high in (("dimmest", "brightest"), ("slowest_m_s", "fastest_m_s"), ("darkest", "lightest")):
            if getattr(self, low) > getattr(self, high):
                found = f"{low} {getattr(self, low)} and {high} {getattr(self, high)}"
                raise BadConfig(f"phase_shift must satisfy {low} <= {high}, found {found}")

    def draw(self, draws: Draws) -> dict[str, float]:
        """As `Artifact.draw`: "speed_m_s"; "ambient", a share of `signal_e`; "coat", its reflectance."""
        speed, light, coat = (draws.chance(purpose) for purpose in self.purposes[:3])
        return {
            "speed_m_s": self.slowest_m_s + (self.fastest_m_s - self.slowest_m_s) * speed * speed,
            "ambient": self.dimmest + (self.brightest - self.dimmest) * light,
            "coat": self.darkest + (self.lightest - self.darkest) * coat * coat,  # more cloth is dark than light
        }

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        """As `Artifact.apply`. Raises BadConfig for a rig whose camera and projector are at one point."""
        optics, clean = self.optics(scene.rig, image.drawn["ambient"]), scene.sample.range
        _, x, y = self._of_rig(scene.rig)
        looks_of = partial(self.looks, "subset" in scene.sample.info.fields, scene=scene, drawn=image.drawn)
        edge = np.float32(EDGE_M / scene.step_m)
        times = np.float32(optics.finest + 1 - self.binary_patterns), np.float32((self.phase_patterns - 1) / 2)
        with if_ready:
            loops(_LOOPS).apply(image.range, scene.sample, x, y, looks_of, optics, draws, edge, times)
            return
        pixels = scene.pixels
        rows, columns = np.divmod(pixels, clean.shape[1])
        labels = np.minimum(scene.sample.labels.reshape(-1)[pixels], PART_COUNT)
        here = clean.reshape(-1)[pixels]
        weights = (np.ones_like(here), columns, rows, here)
        sums = np.stack([np.bincount(labels, weight, PART_COUNT + 1) for weight in weights]).astype(np.int64)
        looks = looks_of(sums, draws=draws)
        bits = draws.pixels("fringe noise", len(pixels), np.uint32)
        padded = np.pad(clean, REACH).astype(np.float32)
        padded[padded == 0] = FAR
        at = [padded[rows + REACH + down, columns + REACH + along] for down, along in _NEIGHBOURS]
        steps, kept, along, down = decode(
            at[0], at[1], at[2], at[3], at[4], x[columns], y[rows], tuple(looks[:, labels]), optics, normals(bits), bits
        )
        for time in times:
            row, column = rows - np.rint(down * time).astype(np.intp), columns - np.rint(along * time).astype(np.intp)
            inside = (row >= 0) & (row < clean.shape[0]) & (column >= 0) & (column < clean.shape[1])
            seen = np.where(inside, clean[np.where(inside, row, 0), np.where(inside, column, 0)], 0)
            kept *= (seen > 0) & (np.abs(seen.astype(np.float32) - here.astype(np.float32)) <= edge)
        ranges = image.range.reshape(-1)
        before = ranges[pixels]
        ranges[pixels] = np.where((before > 0) & (kept > 0), as_range(before.astype(np.float32) + steps), 0)

    def optics(self, rig: Rig, ambient: float) -> Optics:
        """What is the same for all pixels of a rig's image; ambient: other light, a share of `signal_e`."""
        return self._of_rig(rig)[0]._replace(ambient=np.float32(self.signal_e * ambient))

    @lru_cache(maxsize=8)  # noqa: B019 - of an artifact, whose strengths are its identity
    def _of_rig(self, rig: Rig) -> tuple[Optics, NDArray[np.float32], NDArray[np.float32]]:
        """Optics in the dark, and the rays of columns and of rows; behind the last column is room for a block."""
        rotation, shift = rig.camera_to_projector()
        if not shift.any():
            raise BadConfig(f"rig {rig.name} has no baseline, which phase_shift needs")
        axis, patterns = int(abs(shift[1]) > abs(shift[0])), self.phase_patterns
        projector = rig.projector
        pitch = (projector.columns, projector.rows)[axis] / 2**self.binary_patterns  # of fringes, projector's pixels
        to_fringe = np.array([0.0, 0.0, projector.centre_px[axis]])
        to_fringe[axis] = projector.focal_px
        to_fringe /= pitch
        stand_off = rotation @ (0, 0, rig.stand_off_m) + shift
        camera, light = rig.camera, -rotation.T @ shift
        above, below = _harmonic(self.gamma, patterns + 1), _harmonic(self.gamma, patterns - 1)
        # A disc of diameter d dims fringes of period p by 1 - (pi d / p)^2 / 8, as exp(-t) does.
        blur = math.pi**2 / 8 * (self.aperture_mm / 1000 * projector.focal_px / pitch) ** 2
        found = math.inf if self.jumps_found == 1 else -math.inf
        values = (
            *(rig.range_step_m, camera.focal_px * rig.range_step_m / (2 * REACH), 2 * BEND_M / rig.range_step_m),
            *(*(to_fringe @ rotation), to_fringe @ shift, *rotation[2], shift[2]),
            *(*light, stand_off @ stand_off, 2.0**self.binary_patterns, 1 / stand_off[2], blur),
            *(self.signal_e, 0.0, self.read_noise_e**2, self.threshold_e),
            *(1 / patterns, math.cos(2 * math.pi / patterns), math.sin(2 * math.pi / patterns)),
            *(above + below, above - below, math.sqrt(2 / patterns)),
            *(1 / self.rate_hz, camera.focal_px / self.rate_hz, -(patterns + 1) / 2, self.edge_fringes),
            NormalDist().inv_cdf(self.jumps_found) if 0 < self.jumps_found < 1 else found,
        )
        x, y = (slopes.astype(np.float32) for slopes in camera.slopes)
        return Optics(*map(np.float32, values)), np.pad(x, (0, BLOCK)), y

    def looks(
        self, parts: bool, sums: NDArray[np.int64], scene: Scene, drawn: Mapping[str, float], draws: Draws
    ) -> NDArray[np.float32]:
        """Cloth and motion of each label, float32 [19, 34]; the last column is of labels that are no part.

        Rows: two waves, each with its vector in turns a metre and its phase; weights of both and of their product;
        reflectance where their sum is positive, and elsewhere; velocity at the camera, m/s, and rotation, rad/s, in the
        camera's frame. sums: of pixels, their columns, rows and steps by label, [4, 34]. parts: labels are the 33 ones.
        """
        camera, tables = scene.rig.camera, np.zeros((PART_COUNT + 1, 19), np.float32)
        place = scene.step_m, camera.focal_px, *camera.centre_px, scene.rig.stand_off_m
        cloth = drawn["coat"], self.darkest, self.lightest - self.darkest, self.patterned, drawn["speed_m_s"]
        clothes = drawn_bits(draws, "clothes", 6 * 12).reshape(6, 12)
        motion = drawn_bits(draws, "motion", 6 * len(CHAIN) + 6)
        given = parts, sums, tuple(map(float, place)), tuple(map(float, cloth)), clothes, motion, tables
        with if_ready:
            loops(_LOOPS).fill(*given)
            return tables.T
        fill(*given)
        return tables.T


_NEIGHBOURS: Final = ((0, 0), (0, -REACH), (0, REACH), (-REACH, 0), (REACH, 0))


def _harmonic(gamma: float, order: int) -> float:
    """A harmonic of (1/2 + cos(phi) / 2)**gamma over the first one (Liu et al., "Gamma model and its analysis for phase
    measuring profilometry", JOSA A 27, 2010).
    """
    return math.prod((gamma - k) / (gamma + k + 1) for k in range(1, order))
