"""The projector's range that is made of the camera's, beside one that is rendered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from open_sets import cell_rig

from bodyseg_data.artifacts import ShadowTest, seen_by_projectors
from bodyseg_data.artifacts.cast_shadow import _joined
from bodyseg_data.core import BadSample
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


@pytest.mark.parametrize("image", [np.ones((16, 21), np.uint16), np.ones((17, 20), np.uint16), np.ones((16, 20))])
def test_an_image_that_is_not_the_cameras_is_refused(image: np.ndarray) -> None:
    with pytest.raises(BadSample, match=r"^the camera range must be .* \(16, 20\)"):
        seen_by_projectors(image, cell_rig())


def test_two_projectors_stand_one_below_the_other() -> None:
    rig = cell_rig()
    second = replace(rig.projector, position_m=(-0.2, 0.0, 0.0), aims_at_m=(-0.2, 0.0, 1.0))
    camera, _ = slanted(rig)
    both = seen_by_projectors(camera, replace(rig, second_projector=second))
    assert both.shape == (32, 20)
    assert np.array_equal(both[:16], seen_by_projectors(camera, rig))
    assert np.array_equal(both[16:], seen_by_projectors(camera, replace(rig, projector=second)))


def scene(seed: int) -> tuple[np.ndarray, Rig]:
    """Boards at random ranges before a slanted wall, holes, and things of one pixel; no texel lies on an edge."""
    rig, draws = cell_rig(focal_px=30.0), np.random.default_rng(seed)
    image = slanted(rig)[0].astype(np.int64)
    rig = replace(rig, projector=replace(rig.projector, position_m=(0.2, 0.03, 0.02), aims_at_m=(0.1, 0.0, 2.0)))
    for _ in range(3):
        (top, bottom), (left, right) = (np.sort(draws.integers(0, side + 1, 2)) for side in image.shape)
        image[top:bottom, left:right] = draws.integers(600, 1_900) + 9 * np.arange(right - left)
    image[draws.random(image.shape) < 0.04] = 0
    image[draws.random(image.shape) < 0.02] = draws.choice([1, 600, 65_535])
    return image.astype(np.uint16), rig


def drawn_plainly(image: np.ndarray, rig: Rig) -> np.ndarray:
    """Nearest hit of every texel's ray with the triangles of neighbouring pixels on one surface; then their corners:
    where nothing is known, and, of pixels of no triangle, where they are nearer.
    """
    (rows, columns), device, step_m = image.shape, rig.projector, rig.range_step_m
    rotation, offset = rig.camera_to_projector()
    points = rig.camera.pixel_rays() * image[..., None] @ rotation.T + offset / step_m
    with np.errstate(divide="ignore", invalid="ignore"):
        at = points[..., :2] / points[..., 2:] * device.focal_px + device.centre_px - 0.5
    seen = (image > 0) & (points[..., 2] >= 1) & (points[..., 2] <= 65_535)
    edge = ShadowTest(rig).edge_steps
    below, beside = _joined(image, edge), _joined(image.T, edge).T
    texels = np.stack(np.meshgrid(np.arange(device.columns), np.arange(device.rows), indexing="xy"), -1)
    found, alone = np.full((device.rows, device.columns), np.inf), np.ones(image.shape, np.bool_)
    for row, column, half in np.ndindex(rows - 1, columns - 1, 2):
        corners = (row + half, column + half), (row + 1, column), (row, column + 1)
        if all(seen[each] for each in corners) and below[row, column + half] and beside[row + half, column]:
            origin, *ends = (at[each] for each in corners)
            shares = (texels - origin) @ np.linalg.inv(np.stack(ends) - origin)
            shares = np.stack([1 - shares.sum(-1), *np.moveaxis(shares, -1, 0)])
            away = 1 / np.tensordot([1 / points[each][2] for each in corners], shares, 1)
            found = np.minimum(found, np.where((shares >= 0).all(0), away, np.inf))
            for each in corners:
                alone[each] = False
    for each in np.argwhere(seen):
        x, y = np.rint(at[tuple(each)]).astype(int)
        if 0 <= x < device.columns and 0 <= y < device.rows:
            away = points[tuple(each)][2]
            if found[y, x] == np.inf or (alone[tuple(each)] and away < found[y, x]):
                found[y, x] = away
    return np.where(np.isfinite(found), found, 0)


@pytest.mark.parametrize("seed", range(6))
def test_triangles_are_drawn_as_by_a_plain_form(seed: int) -> None:
    image, rig = scene(seed)
    assert np.abs(seen_by_projectors(image, rig) - drawn_plainly(image, rig)).max() <= 0.51


def test_a_pole_of_one_pixel_hides_the_wall_behind() -> None:
    rig = cell_rig()
    image = slanted(rig)[0]
    image[:, 11] = 1_000
    assert np.count_nonzero(seen_by_projectors(image, rig) == 1_000) == len(image)
