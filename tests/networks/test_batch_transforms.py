"""Batches cut to bodies and held before a mirror."""

from __future__ import annotations

import torch

from bodyseg_model.networks.batch_transforms import body_window, cut_to_bodies, mirror, mirror_draws


def test_chosen_images_are_mirrored() -> None:
    range_m = torch.tensor([[[[1.0, 2.0, 0.0]]], [[[3.0, 0.0, 4.0]]]])
    labels = torch.tensor([[[21, 0, 255]], [[22, 255, 3]]], dtype=torch.uint8)
    seen, named = mirror(range_m, labels, torch.tensor([True, False]))
    assert seen.tolist() == [[[[0.0, 2.0, 1.0]]], [[[3.0, 0.0, 4.0]]]]
    assert named.tolist() == [[[255, 0, 22]], [[22, 255, 3]]]
    assert named.dtype == torch.uint8


def test_draws_belong_to_samples() -> None:
    keys = [f"body-{number}" for number in range(400)]
    first, second = [0] * 400, [1] * 400
    drawn = mirror_draws(3, first, keys)
    assert torch.equal(mirror_draws(3, first, keys[::-1]), drawn.flip(0))
    mixed = mirror_draws(3, first[:200] + second[200:], keys)
    assert torch.equal(mixed, torch.cat([drawn[:200], mirror_draws(3, second, keys)[200:]]))
    assert 150 < int(drawn.sum()) < 250
    for other in (mirror_draws(4, first, keys), mirror_draws(3, second, keys)):
        assert 120 < int((other != drawn).sum()) < 280


def test_a_window_holds_every_body_with_a_margin() -> None:
    measured = torch.zeros(2, 90, 110, dtype=torch.bool)
    measured[0, 42, 77] = measured[1, 66, 33] = True
    assert body_window(measured, 10, 10) == (slice(30, 77), slice(20, 88))
    assert body_window(measured, 10) == (slice(32, 77), slice(23, 88))
    assert body_window(measured, 10, 32) == (slice(32, 77), slice(0, 88))
    assert body_window(measured, 32, 32) == (slice(0, 90), slice(0, 110))
    assert body_window(torch.zeros(2, 9, 11, dtype=torch.bool), 10) is None


def test_cutting_keeps_every_pixel_of_the_bodies() -> None:
    range_m = torch.zeros(1, 1, 60, 80)
    range_m[0, 0, 25:44, 33:46] = 2.5
    labels = torch.full((1, 60, 80), 255, dtype=torch.uint8)
    labels[0, 25:44, 33:46] = 5
    cut, named = cut_to_bodies(range_m, labels, 4, 4)
    assert cut.shape == (1, 1, 28, 22)
    assert torch.equal(cut, range_m[:, :, 20:48, 28:50])
    assert int((named == 5).sum()) == 19 * 13
    empty = torch.zeros(1, 1, 6, 8)
    assert cut_to_bodies(empty, labels, 4, 4)[0].shape == empty.shape
