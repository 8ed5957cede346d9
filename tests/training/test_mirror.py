"""Batches of which some images are mirrored."""

from __future__ import annotations

import torch
from kernel_forms import by_both

from bodyseg_model.training.augmentation import mirror, mirror_draws


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


def test_both_forms_have_the_same_bits() -> None:
    draw = torch.Generator().manual_seed(6)
    range_m = torch.rand(5, 1, 13, 8, generator=draw)
    labels = torch.randint(0, 34, (5, 13, 8), generator=draw).to(torch.uint8)
    labels[labels == 33] = 255
    chosen = torch.tensor([True, False, True, True, False])
    loops, plain = by_both(lambda: mirror(range_m, labels, chosen))
    assert torch.equal(loops[0], plain[0]) and torch.equal(loops[1], plain[1])
