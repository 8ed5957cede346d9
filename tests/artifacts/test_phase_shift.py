"""Phase shifting against its referee: all patterns simulated pixel by pixel and decoded by the published formulas."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from kernel_forms import by_both
from numpy.typing import NDArray

from bodyseg_data import ShardWriter
from bodyseg_data.artifacts import Augmentation, MissingData, Scene, SensorModel, load_sensor_model
from bodyseg_data.artifacts.fringes import REACH, decode
from bodyseg_data.artifacts.phase_shift import PhaseShift
from bodyseg_data.core import BadConfig, Draws
from bodyseg_data.labels import PART_CLASSES
from bodyseg_data.loading import RangeImages
from bodyseg_data.rigs import load_rig
from bodyseg_data.samples import Sample, SampleInfo, metres

RIG: Final = load_rig("paper")
QUIET: Final = PhaseShift(
    signal_e=1e9, read_noise_e=0.0, threshold_e=1e7, brightest=0.3, gamma=1.0, aperture_mm=15.0, jumps_found=0.0
)
"""So much light that its noise is nothing."""
NO_NOISE: Final = np.uint32(127 | 128 << 8 | 127 << 16 | 128 << 24)

Floats = NDArray[np.float64]


class Wall:
    """Pixels that see a tilted wall of two reflectances in a checked pattern, which moves."""

    def __init__(self, artifact: PhaseShift, velocity_m_s: Any, tilt_deg: float, albedos: tuple[float, float]) -> None:
        random = np.random.default_rng(0)
        self.artifact, self.velocity = artifact, np.asarray(velocity_m_s, np.float64)
        x, y = random.uniform(-0.2, 0.2, 6000), random.uniform(-0.3, 0.3, 6000)
        self.rays = np.stack([x, y, np.ones_like(x)], axis=1)
        tilt = math.radians(tilt_deg)
        self.normal = np.array([-math.sin(tilt), 0.1, math.cos(tilt)]) / math.hypot(1, 0.1)
        self.rays = self.rays[self.is_lit(self.rays * self.range_at(self.rays, 0.0)[:, None])]
        self.range = self.range_at(self.rays, 0.0)
        self.points = self.rays * self.range[:, None]
        self.period_m, self.albedos = 0.05, albedos
        waves = np.abs(self.points[:, :2] / self.period_m % 1 - 0.5) < 0.25
        self.albedo = np.where(waves[:, 0] == waves[:, 1], *albedos)

    def range_at(self, rays: Floats, time_s: float) -> Floats:
        return self.normal @ (np.array([0, 0, 2.4]) + self.velocity * time_s) / (rays @ self.normal)

    def fringe(self, points: Floats) -> tuple[Floats, Floats]:
        """Place of points on the projector's image, in fringes, and their range from it."""
        seen = (points - RIG.projector.position_m) @ RIG.projector.axes.T
        column = RIG.projector.focal_px * seen[:, 0] / seen[:, 2] + RIG.projector.centre_px[0]
        return column * 2**self.artifact.binary_patterns / RIG.projector.columns, seen[:, 2]

    def is_lit(self, points: Floats) -> NDArray[np.bool_]:
        """Which points lie in the projector's frame."""
        place = self.fringe(points)[0] / 2**self.artifact.binary_patterns
        return np.asarray((place > 0) & (place < 1))

    def after(self, patterns: float) -> Floats:
        """What the pixels see some patterns later."""
        return self.rays * self.range_at(self.rays, patterns / self.artifact.rate_hz)[:, None]

    def fringe_after(self, patterns: float) -> Floats:
        return self.fringe(self.after(patterns))[0]

    def brightness(self, patterns: float = 0.0) -> tuple[Floats, Floats]:
        """Mean and half the height of fringes, electrons, as the projector lights them and as its lens blurs them."""
        points = self.after(patterns)
        to_light = RIG.projector.position_m - points
        away = np.linalg.norm(to_light, axis=1)
        stand_off = np.array([0, 0, RIG.stand_off_m])
        reference = np.linalg.norm(stand_off - RIG.projector.position_m)
        light = np.maximum(-(to_light @ self.normal) / away, 0) * (reference / away) ** 2
        mean = self.artifact.signal_e * self.albedo * light
        focus = RIG.projector.axes[2] @ (stand_off - RIG.projector.position_m)
        pitch_m = RIG.projector.columns / 2**self.artifact.binary_patterns / RIG.projector.focal_px
        disc = self.artifact.aperture_mm / 1000 * np.abs(1 / self.fringe(points)[1] - 1 / focus) / pitch_m
        return mean, mean * np.exp(-((math.pi * disc) ** 2) / 8)

    def images(self, random: np.random.Generator | None = None) -> Floats:
        """The images of N patterns, electrons, [N, pixels]; random: of noise in them."""
        artifact, count = self.artifact, self.artifact.phase_patterns
        wave = (1 + np.cos(np.linspace(0, 2 * np.pi, 4096, endpoint=False))) / 2
        first = 2 * np.mean(wave**artifact.gamma * (2 * wave - 1))
        images = np.empty((count, len(self.rays)))
        for pattern in range(count):
            time = pattern - (count - 1) / 2
            mean, amplitude = self.brightness(time)
            phi = 2 * np.pi * (self.fringe_after(time) + pattern / count)
            fringe = ((1 + np.cos(phi)) / 2) ** artifact.gamma / first
            images[pattern] = mean + amplitude * (fringe - 1) + artifact.brightest * artifact.signal_e * self.albedo
        if random is not None:
            noise = artifact.read_noise_e * random.standard_normal(images.shape)
            images = random.poisson(np.maximum(images, 0)) + noise
        return images

    def simulated(self, random: np.random.Generator | None = None) -> NDArray[np.complex128]:
        """Height and phase of the fringes in the images."""
        count = self.artifact.phase_patterns
        weights = 2 / count * np.exp(-2j * np.pi * np.arange(count) / count)
        return np.asarray(weights @ self.images(random), np.complex128)

    def decoded(self, random: np.random.Generator | None = None) -> tuple[Floats, NDArray[np.bool_]]:
        """What the sensor decodes, in fringes, and which pixels it loses; random: of noise in the images."""
        total = self.simulated(random)
        count, bits = self.artifact.phase_patterns, self.artifact.binary_patterns
        number = np.zeros(len(total), np.int64)
        before = np.zeros(len(total), np.int64)
        for bit in reversed(range(bits)):  # the coarsest pattern first
            place = np.floor(self.fringe_after(-(count + 1) / 2 - bit)).astype(np.int64)
            before ^= (place ^ place >> 1) >> bit & 1
            number |= before << bit
        return number + np.angle(total) / (2 * np.pi) % 1, np.abs(total) < self.artifact.threshold_e

    def by_artifact(self, bits: Any = NO_NOISE) -> tuple[Floats, NDArray[np.bool_], NDArray[np.float32]]:
        """The same of `fringes.decode`, and its errors of range, mm."""
        offset = REACH / RIG.camera.focal_px
        here, *beside = (
            (self.range_at(self.rays + np.array((along, down, 0.0)), 0.0) / RIG.range_step_m).astype(np.float32)
            for along, down in ((0, 0), (-offset, 0), (offset, 0), (0, -offset), (0, offset))
        )
        per_m = 1 / self.period_m
        look = (per_m, 0, 0, 0, 0, per_m, 0, 0, 0, 0, 1, *self.albedos, *self.velocity, 0, 0, 0)
        looks = tuple(np.full_like(here, each) for each in look)
        x, y = self.rays[:, :2].T.astype(np.float32)
        optics = self.artifact.optics(RIG, self.artifact.brightest)[0]
        error, kept = decode(*[here, *beside, here, here, x, y, looks, optics, np.broadcast_to(bits, here.shape)])
        made = self.range + error * RIG.range_step_m
        return self.fringe(self.rays * made[:, None])[0], ~kept, error * RIG.range_step_mm


@pytest.mark.parametrize(
    ("velocity", "tilt", "gamma"),
    [
        ((0, 0, 0), 0, 1.0),
        ((0, 0, 0), 30, 1.4),
        ((0, 0, 0.5), 20, 1.0),
        ((0.3, 0.2, 0.3), -25, 1.05),
        ((0, 0, 1.0), 0, 1.0),
        ((0, 0, -1.0), 20, 1.0),
        ((0, 0, 1.0), -20, 1.05),
    ],
)
def test_phases_are_those_of_the_simulated_patterns(velocity: Any, tilt: float, gamma: float) -> None:
    wall = Wall(replace(QUIET, gamma=gamma, aperture_mm=4.3), velocity, tilt, (0.3, 0.3))
    theirs, gone = wall.decoded()
    ours, lost, _ = wall.by_artifact()
    assert not gone.any() and not lost.any()
    off = ours - theirs
    assert np.abs(off - np.rint(off)).max() * 2 * np.pi < 1e-3
    assert np.mean(np.rint(off) != 0) < 0.003  # counts of fringes, but for pixels where a binary edge lies
    jumps = np.mean(np.rint(theirs - wall.fringe(wall.points)[0]) != 0)
    assert jumps == 0 if not any(velocity) else 0.1 < jumps < 0.5


def test_the_package_fringes_finds_the_same_phases_in_the_simulated_patterns() -> None:
    decoder = pytest.importorskip("fringes.decoder", reason="tools/install_rivals brings it", exc_type=ImportError)
    wall = Wall(replace(QUIET, gamma=1.05, aperture_mm=4.3), (0, 0, 1.0), 10, (0.3, 0.3))
    given = np.array([[wall.artifact.phase_patterns]]), np.array([[-1]]), 0.0
    _, heights, phases = decoder.temp_demod_numpy(wall.images()[:, None, :, None], *given)
    np.testing.assert_allclose(heights.ravel(), np.abs(wall.simulated()), rtol=1e-6)
    off = wall.by_artifact()[0] - phases.ravel() / (2 * np.pi)
    assert np.abs(off - np.rint(off)).max() * 2 * np.pi < 1e-3


def test_dark_far_grazing_and_fast_pixels_are_lost_as_in_the_simulation() -> None:
    shares = []
    for velocity, tilt, albedos in (
        ((0, 0, 0), 10, (0.3, 0.008)),
        ((0, 0, 0), -50, (0.03, 0.014)),
        ((0, 0, 1.2), 0, (0.04, 0.02)),
        ((0, 0, -1.2), 0, (0.04, 0.02)),
    ):
        wall = Wall(QUIET, velocity, tilt, albedos)
        gone, lost = wall.decoded()[1], wall.by_artifact()[1]
        assert np.mean(gone != lost) <= 0.01
        shares.append(gone.mean())
    assert all(0.05 < share < 0.9 for share in shares)


def test_ripple_and_modulation_have_their_figures() -> None:
    """Half the drift over sin(2 pi / 5) for slow motion; fast motion towards the shift is worse than away from it."""
    for speed, rel in ((0.05, 0.03), (-0.05, 0.03)):
        wall = Wall(QUIET, (0, 0, speed), 0, (0.3, 0.3))
        place = wall.fringe(wall.points)[0]
        error, drift = wall.by_artifact()[0] - place, np.abs(wall.fringe_after(1) - place)
        share = np.abs(error - np.rint(error)) / (drift / 2 / math.sin(2 * np.pi / 5))
        assert share.max() == pytest.approx(1, rel=rel)
    strengths = []
    for speed in (1.0, -1.0, 2.2, -2.2):
        wall = Wall(replace(QUIET, threshold_e=0.0), (0, 0, speed), 0, (0.3, 0.3))
        total = np.abs(wall.simulated()) / wall.brightness()[1]
        strengths.append(total.min())
    assert strengths == pytest.approx([0.36, 0.41, 0.0, 0.0], abs=0.01)


def test_noise_is_that_of_simulated_images() -> None:
    artifact = replace(PhaseShift(), brightest=0.3, gamma=1.0, jumps_found=0.0)
    for albedo in (0.1, 0.6):
        wall, random = Wall(artifact, (0, 0, 0), 15, (albedo, albedo)), np.random.default_rng(1)
        exact = wall.fringe(wall.points)[0]
        bits = random.integers(0, 2**32, len(exact), np.uint32)
        ours = wall.by_artifact(bits)[0] - exact
        theirs = wall.decoded(random)[0] - exact
        spreads = [np.std(off - np.rint(off)) * 2 * np.pi for off in (ours, theirs)]
        mean, amplitude = wall.brightness()
        sigma = np.sqrt(artifact.read_noise_e**2 + mean + 0.3 * artifact.signal_e * albedo)
        assert spreads == pytest.approx([np.sqrt(np.mean(0.4 * (sigma / amplitude) ** 2))] * 2, rel=0.05)


@pytest.mark.parametrize("rig_seed", [0, 7])
def test_both_forms_give_the_same_bits_for_any_strengths(figures_set: Path, rig_seed: int) -> None:
    sensor = load_sensor_model("paper_phase_shift").with_artifacts(
        PhaseShift(binary_patterns=6, fastest_m_s=9.0, jumps_found=0.0, dimmest=1.0, brightest=2.0, patterned=1.0)
    )
    images = RangeImages(figures_set, "all", sensor=sensor, seed=rig_seed)
    for index in range(0, 12, 3):
        ours, theirs = by_both(partial(images.image, index))
        np.testing.assert_array_equal(ours.range, theirs.range)


def test_both_forms_agree_at_borders_at_extremes_and_for_labels_of_no_part() -> None:
    draws, shape = np.random.default_rng(2), (40, 61)
    rig = replace(RIG, camera=replace(RIG.camera, rows=40, columns=61, centre_px=(30.0, 20.0)))
    near = np.round(2 / RIG.range_step_m) + draws.integers(-9, 10, shape)
    ranges = np.where(draws.random(shape) < 0.02, draws.choice([0, 1, 65_535], shape), near).astype(np.uint16)
    labels = np.where(ranges > 0, np.uint8([3, 20, 33, 254])[np.arange(shape[1]) // 5 % 4], 255).astype(np.uint8)
    sample = Sample("a", ranges, None, labels, ranges > 0, SampleInfo("train"))
    moving = PhaseShift(slowest_m_s=0.5, fastest_m_s=0.5, threshold_e=0, read_noise_e=1e4)
    sensor = SensorModel("moving", (MissingData(rates=(0.2,)), moving))
    ours, theirs = by_both(lambda: Augmentation(rig, "all", sensor=sensor)(sample).range)
    np.testing.assert_array_equal(ours, theirs)
    assert 0.1 < (ours > 0).mean() < 0.8 and (ours[:, [0, -1]] > 0).any()


def test_an_image_leaves_no_marks_for_a_smaller_one() -> None:
    """Of 315 pixels and 312, for whose marks there is equally much memory."""
    steps, labels = np.repeat(np.uint16([2400, 60_000]), (312, 3)), np.zeros(315, np.uint8)
    sensor = SensorModel("moving", (PhaseShift(slowest_m_s=0.5, fastest_m_s=0.5),))

    def last_of_two() -> Any:
        for rows, columns in ((15, 21), (12, 26)):
            rig = replace(RIG, camera=replace(RIG.camera, rows=rows, columns=columns, centre_px=(13.0, 7.5)))
            ranges, parts = (each[: rows * columns].reshape(rows, columns) for each in (steps, labels))
            sample = Sample("a", ranges, None, parts, ranges > 0, SampleInfo("train"))
            found = Augmentation(rig, "noise", sensor=sensor)(sample).range
        return found

    ours, theirs = by_both(last_of_two)
    np.testing.assert_array_equal(ours, theirs)
    assert ours.any()


def test_motion_is_continuous_where_parts_meet_and_clothes_cover_their_parts(figures_set: Path) -> None:
    images = RangeImages(figures_set)
    sample, artifact = images.clean(0), PhaseShift(slowest_m_s=2.0)
    scene, draws = Scene(sample, images.manifest.rig), Draws(0, 0, sample.key)
    labels = np.minimum(sample.labels[sample.range > 0], 33)
    rows, columns = np.nonzero(sample.range)
    sums = np.stack(
        [np.bincount(labels, each, 34) for each in (np.ones_like(rows), columns, rows, sample.range[rows, columns])]
    )
    drawn = artifact.draw(draws)
    looks = artifact.looks(True, sums.astype(np.int64), scene, drawn, draws)
    for garment in ([3, 9, 13, 20], [7, 25, 30], [0, 2, 21]):
        assert (looks[:13, garment] == looks[:13, garment[:1]]).all()
    assert looks[11, 3] == np.float32(drawn["coat"]) and (looks[13:, 33] == 0).all()
    assert np.abs(looks[13:16, 3] - looks[13:16, 14]).max() == 0  # the trunk is rigid
    one = artifact.looks(False, sums.astype(np.int64), scene, drawn, draws)
    assert (one == one[:, :1]).all() and np.linalg.norm(one[13:16, 0]) > 0


@pytest.mark.parametrize("fields", [{}, {"subset": "x"}])
def test_the_33_parts_are_told_by_the_classes_of_the_set(
    figures_set: Path, tmp_path: Path, fields: dict[str, str]
) -> None:
    images = RangeImages(figures_set, "noise", sensor=SensorModel("moving", (PhaseShift(slowest_m_s=2.0),)))
    sample, rig = images.clean(0), images.manifest.rig
    found = {}
    for name, classes in (("parts", PART_CLASSES), ("others", [f"class {number}" for number in range(33)])):
        with ShardWriter(tmp_path / name, rig=rig, classes=classes, projector="none") as out:
            ranges, facing = metres(sample.range, rig.range_step_m), sample.faces_projector
            out.write(key=sample.key, range_m=ranges, labels=sample.labels, facing=facing, fields=fields)
        written = RangeImages(tmp_path / name, "noise", sensor=images.augmentation.sensor)
        ours, theirs = by_both(partial(written.image, 0))
        assert np.array_equal(ours.range, theirs.range)
        found[name] = ours.range
    assert np.array_equal(found["parts"], images.image(0).range)
    assert not np.array_equal(found["others"], found["parts"])


def test_bad_strengths_and_rigs_are_refused(figures_set: Path) -> None:
    with pytest.raises(BadConfig, match="PhaseShift: darkest must be at most lightest, found 0.9 and"):
        PhaseShift(darkest=0.9)
    with pytest.raises(BadConfig, match="phase_patterns must be from 3 to 16, found 2"):
        PhaseShift(phase_patterns=2)
    with pytest.raises(BadConfig, match="has no baseline, which phase_shift needs"):
        PhaseShift().optics(replace(RIG, projector=RIG.camera), 0.0)
