"""Bodies turned, zoomed and cut."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from kernel_forms import by_both

from bodyseg_data.core import BadConfig
from bodyseg_model.training import GeometricAugmentation
from bodyseg_model.training.augmentation import _moved, _source_map, placed

KEYS = [f"body-{number}" for number in range(60)]
EPOCHS = [0] * len(KEYS)


def bodies(rows: int = 60, columns: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    """A block in the middle of each image, ranges and labels both telling where a pixel came from."""
    labels = torch.full((len(KEYS), rows, columns), 255, dtype=torch.uint8)
    range_m = torch.zeros(len(KEYS), 1, rows, columns)
    for row in range(20, 40):
        labels[:, row, 12:28] = row - 20
        range_m[:, 0, row, 12:28] = 2 + row / 100
    return range_m, labels


def test_no_placement_leaves_a_batch_alone() -> None:
    range_m, labels = bodies()
    seen, named = placed(GeometricAugmentation(), range_m, labels, 0, EPOCHS, KEYS)
    assert seen is range_m
    assert named is labels


def test_range_and_label_of_a_pixel_stay_together_and_none_is_made_up() -> None:
    range_m, labels = bodies()
    seen, named = placed(
        GeometricAugmentation(roll_deg=30, zoom=0.3, stretch=0.2, cut=0.5), range_m, labels, 1, EPOCHS, KEYS
    )
    assert named.dtype == torch.uint8
    assert torch.equal(named == 255, seen[:, 0] == 0)
    body = named != 255
    assert torch.equal(seen[:, 0][body], range_m[0, 0, 20:40, 12][named[body].long()])


def test_sizes_stay_within_what_was_asked_for() -> None:
    range_m = torch.zeros(len(KEYS), 1, 240, 160)
    range_m[:, :, 80:160, 48:112] = 2
    labels = torch.where(range_m[:, 0] > 0, 0, 255).to(torch.uint8)
    seen, _ = placed(GeometricAugmentation(zoom=0.25, stretch=0.3), range_m, labels, 2, EPOCHS, KEYS)
    heights = (seen[:, 0] > 0).any(2).sum(1) / 80
    widths = (seen[:, 0] > 0).any(1).sum(1) / 64
    for sizes, most in ((heights, 1.25), (widths / heights, 1.3)):
        assert 1 / most - 0.03 <= sizes.min() < 1 / most + 0.05
        assert most - 0.05 < sizes.max() <= most + 0.03
        assert 0.3 < (sizes < 1).float().mean() < 0.7


def test_a_turn_keeps_lengths() -> None:
    """In an image that is not square, too: the block stays as large, and its longest diagonal as long."""
    range_m, labels = bodies()
    seen, _ = placed(GeometricAugmentation(roll_deg=40), range_m, labels, 3, EPOCHS, KEYS)
    areas = (seen[:, 0] > 0).sum((1, 2)) / (20 * 16)
    assert (areas - 1).abs().max() < 0.04
    for image in seen[:10, 0]:
        places = torch.nonzero(image > 0).float()
        assert torch.cdist(places, places).max() == pytest.approx(math.hypot(19, 15), abs=1.6)
    down = (seen[:, 0] > 2).float() * (seen[:, 0] - 2.3)  # ranges grow downwards: where they do now tells the turn
    lean = (down * torch.arange(39.0, -40, -2)).sum((1, 2)) / (down * torch.arange(59.0, -60, -2)[:, None]).sum((1, 2))
    turns = torch.rad2deg(torch.atan(lean))
    assert -41 < turns.min() < -30 and 30 < turns.max() < 41


def test_a_bust_keeps_the_upper_part_of_the_body() -> None:
    range_m, labels = bodies()
    seen, named = placed(GeometricAugmentation(bust=0.5), range_m, labels, 5, EPOCHS, KEYS)
    heights = (seen[:, 0] > 0).any(2).sum(1)
    assert torch.equal(named == 255, seen[:, 0] == 0)
    assert 0.3 < (heights < 20).float().mean() < 0.7
    assert heights.min() >= 7
    assert heights[heights < 20].max() <= 16
    assert (seen[:, 0, 20] > 0).any(1).all()
    empty = torch.zeros_like(range_m), torch.full_like(labels, 255)
    assert torch.equal(placed(GeometricAugmentation(bust=1.0), *empty, 5, EPOCHS, KEYS)[1], empty[1])


def test_a_cut_hides_one_side_at_most_half_way() -> None:
    range_m, labels = torch.full((60, 1, 20, 20), 2.0), torch.zeros(60, 20, 20, dtype=torch.uint8)
    seen, _ = placed(GeometricAugmentation(cut=1.0), range_m, labels, 4, EPOCHS, KEYS)
    sides = set()
    for image in seen[:, 0] > 0:
        hidden = torch.nonzero(~image)
        assert len(hidden) <= 200
        for name, edge in (
            ("top", ~image[0]),
            ("bottom", ~image[-1]),
            ("left", ~image[:, 0]),
            ("right", ~image[:, -1]),
        ):
            if bool(edge.all()) and len(hidden):
                sides.add(name)
    assert sides == {"top", "bottom", "left", "right"}


def test_draws_belong_to_samples() -> None:
    range_m, labels = bodies()
    move = GeometricAugmentation(roll_deg=20, zoom=0.2)
    seen, _ = placed(move, range_m, labels, 5, EPOCHS, KEYS)
    backwards, _ = placed(move, range_m, labels, 5, EPOCHS, KEYS[::-1])
    assert torch.equal(backwards, seen.flip(0))
    assert not torch.equal(placed(move, range_m, labels, 5, [1] * 60, KEYS)[0], seen)
    assert not torch.equal(placed(move, range_m, labels, 6, EPOCHS, KEYS)[0], seen)


@pytest.mark.parametrize(("name", "value"), [("roll_deg", -1), ("zoom", 1.5), ("stretch", math.nan), ("cut", 2)])
def test_bad_strengths_are_refused(name: str, value: float) -> None:
    with pytest.raises(BadConfig, match=f"{name} must be from 0 to"):
        GeometricAugmentation(**{name: value})


def test_pixels_are_taken_from_where_torchs_sampler_takes_them() -> None:
    """But for positions halfway between two pixels."""
    draw = torch.Generator().manual_seed(4)
    range_m = torch.rand(3, 1, 61, 47, generator=draw)
    labels = torch.randint(0, 33, (3, 61, 47), generator=draw).to(torch.uint8)
    placements = ((0.1, 1.2, 0.9), (-0.4, 0.7, 1.0), (0.0, 1.0, 1.3))
    maps = torch.tensor([_source_map(*placement, 61, 47) for placement in placements])
    seen, named = _moved(range_m, labels, maps)

    affine = torch.cat([maps, torch.zeros(3, 2, 1)], 2)
    grid = F.affine_grid(affine, [3, 1, 61, 47], align_corners=False)
    pair = torch.cat([range_m, labels[:, None] + 1.0], 1)
    expected = F.grid_sample(pair, grid, mode="nearest", padding_mode="zeros", align_corners=False)
    places = ((grid + 1) * torch.tensor([47, 61]) - 1) / 2
    clear = ((places % 1 - 0.5).abs() > 1e-4).all(3)
    assert clear.float().mean() > 0.9
    assert torch.equal(seen[:, 0][clear], expected[:, 0][clear])
    assert torch.equal(named[clear], torch.where(expected[:, 1] == 0, 255, expected[:, 1] - 1).to(torch.uint8)[clear])


def test_both_forms_have_the_same_bits() -> None:
    range_m, labels = bodies(61, 47)
    move = GeometricAugmentation(roll_deg=40, zoom=0.3, stretch=0.2, cut=0.3)
    loops, plain = by_both(lambda: placed(move, range_m, labels, 7, EPOCHS, KEYS))
    assert torch.equal(loops[0], plain[0]) and torch.equal(loops[1], plain[1])
