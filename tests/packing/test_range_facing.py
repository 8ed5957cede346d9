"""Facing found from the range image, held against that of the surface itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodyseg_data import RangeImages, example_set
from bodyseg_data.artifacts import lit_pixels, shadow_tests
from bodyseg_data.packing import range_facing
from bodyseg_data.packing.range_facing import facing_from_normals, facing_from_range
from bodyseg_data.rigs import Camera, Rig
from bodyseg_data.samples import metres

CAMERA = Camera(60, 80, 100.0, (40.0, 30.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
RIGS = [
    Rig("bench", 2.0, CAMERA, replace(CAMERA, position_m=(x, y, 0.1), aims_at_m=(0.0, 0.0, 2.0)))
    for x, y in ((1.0, 0.2), (-1.0, -0.2), (0.2, 1.0), (-0.2, -1.0))
]
"""Projectors to the right and left of the camera, below and above."""


def seen(normal: tuple[float, float, float], away: float) -> tuple[np.ndarray, np.ndarray]:
    """Range and normals of a plane before the camera, `away` along its axis; empty where it lies behind."""
    rays = CAMERA.pixel_rays()
    range_m = away * normal[2] / (rays @ normal)
    range_m = np.where((range_m > 0.5) & (range_m < 5), range_m, 0)
    return range_m, np.broadcast_to(normal, rays.shape)


def test_planes_are_exact_however_they_are_turned() -> None:
    """1 / z of a plane is linear in the image, so differences of neighbours are exact."""
    for number, rig in enumerate(RIGS):
        sides = set()
        for angle in np.linspace(-1.4, 1.4, 29):
            across, down = (float(np.sin(angle)), 0.1)[:: 1 if number < 2 else -1]
            range_m, normals = seen((across, down, -float(np.cos(angle))), 2.0)
            (exact,) = facing_from_normals(rig, range_m, normals)
            for dtype in (np.float32, np.float64):
                (found,) = facing_from_range(rig, range_m.astype(dtype))
                assert np.array_equal(found, exact)
            sides |= {bool(exact.any()), bool(exact[range_m > 0].all())}
        assert sides == {True, False}


@pytest.mark.parametrize("rig", RIGS)
def test_an_edge_does_not_turn_the_surfaces_beside_it(rig: Rig) -> None:
    range_m = np.full((60, 80), 3.0)
    range_m[20:40, 30:50] = 1.5
    range_m[50, 70] = 0.0
    range_m[:, :2] = 0
    (found,) = facing_from_range(rig, range_m)
    assert np.array_equal(found, range_m > 0)


def test_a_pixel_alone_lies_square_to_the_axis() -> None:
    range_m = np.zeros((60, 80))
    range_m[30, 40] = 2.0
    assert facing_from_range(RIGS[0], range_m)[0].sum() == 1


def test_on_bodies_few_bits_and_few_shadows_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    """On the set that ships: exact facing is stored there. docs/how-to/writing_shards.md gives shares like these."""
    images = RangeImages(example_set(), "none")
    rig = images.manifest.rig
    pixels = wrong = shadows = 0
    for index in range(0, len(images), max(1, len(images) // 8)):
        sample = images.clean(index)
        range_m = metres(sample.range, rig.range_step_m)
        (found,) = facing_from_range(rig, range_m)
        with monkeypatch.context() as patch:
            patch.setattr(range_facing, "_ROWS", 7)
            assert np.array_equal(facing_from_range(rig, range_m)[0], found), "rows do not depend on how many there are"
        measured = sample.range > 0
        lit = shadow_tests(rig)[0].lit(sample.range, sample.occluder_range(), found)
        pixels += int(measured.sum())
        wrong += int((found != sample.faces_projector)[measured].sum())
        shadows += int((lit != lit_pixels(rig, sample))[measured].sum())
    assert wrong < 0.0098 * pixels and shadows < 0.0073 * pixels
