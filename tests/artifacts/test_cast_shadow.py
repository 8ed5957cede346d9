"""The projector's range that is made of the camera's, beside one that is rendered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from open_sets import cell_rig

from bodyseg_data.artifacts import seen_by_projectors
from bodyseg_data.rigs import Rig


def slanted(rig: Rig, gap: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Steps of a plane z = 2 + x / 2 before camera and projector; gap: a hole in the camera's image."""
    images = []
    for device in (rig.camera, rig.projector):
        # z = 2 + (z rx + px) / 2
        z = (2 + device.position_m[0] / 2) / (1 - device.pixel_rays()[..., 0] / 2)
        images.append(np.rint(z / rig.range_step_m).astype(np.uint16))
    if gap:
        images[0][4:6, 5:7] = 0
    return images[0], images[1]


@pytest.mark.parametrize("focal_px", [18.0, 40.0])
def test_a_plane_is_seen_as_it_is_rendered(focal_px: float) -> None:
    rig = cell_rig(focal_px=focal_px)
    camera, projector = slanted(rig)
    made = seen_by_projectors(camera, rig)
    known = made > 0
    assert known.mean() > 0.5
    assert np.abs(made[known].astype(int) - projector[known]).max() <= 40  # single pixels stand half a texel off
    inside = known[1:-1, 2:-3]
    errors = np.abs(made[1:-1, 2:-3].astype(int) - projector[1:-1, 2:-3])[inside]
    assert np.quantile(errors, 0.9) <= 1


def test_what_the_camera_does_not_see_is_not_known() -> None:
    rig = cell_rig()
    assert not seen_by_projectors(np.zeros((16, 20), np.uint16), rig).any()
    whole, holed = (seen_by_projectors(slanted(rig, gap)[0], rig) for gap in (False, True))
    assert np.count_nonzero(holed) < np.count_nonzero(whole)


def test_two_projectors_stand_one_below_the_other() -> None:
    rig = cell_rig()
    second = replace(rig.projector, position_m=(-0.2, 0.0, 0.0), aims_at_m=(-0.2, 0.0, 1.0))
    camera, _ = slanted(rig)
    both = seen_by_projectors(camera, replace(rig, second_projector=second))
    assert both.shape == (32, 20)
    assert np.array_equal(both[:16], seen_by_projectors(camera, rig))
    assert np.array_equal(both[16:], seen_by_projectors(camera, replace(rig, projector=second)))
