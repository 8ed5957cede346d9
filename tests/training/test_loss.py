"""The loss: against the whole image's, computed plainly."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812

from bodyseg_model.networks import Network
from bodyseg_model.networks.compact import Compact, CompactSettings
from bodyseg_model.networks.fcn_alexnet import FcnAlexnet
from bodyseg_model.training.loss import NetworkWithLoss, SelectedPixels, part_weights


def batch(rows: int, columns: int) -> tuple[torch.Tensor, torch.Tensor]:
    draw = torch.Generator().manual_seed(1)
    labels = torch.randint(0, 33, (2, rows, columns), generator=draw).to(torch.uint8)
    labels[torch.rand(labels.shape, generator=draw) < 0.4] = 255
    return torch.where(labels == 255, 0.0, 2.0 + labels / 100)[:, None], labels


class PixelScores(Network):
    """Scores of its own for every pixel."""

    def __init__(self, rows: int, columns: int) -> None:
        super().__init__()
        self.kept = torch.randn(2, 33, rows, columns, generator=torch.Generator().manual_seed(2))

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        return self.kept


def test_the_loss_is_the_weighted_mean_surprise_of_each_image() -> None:
    range_m, labels = batch(6, 5)
    network, weights = PixelScores(6, 5), torch.rand(33) + 0.5
    loss, counts, _ = NetworkWithLoss(network, weights)(range_m, labels, torch.zeros(2))
    means = []
    for image, scores in zip(labels, network.kept, strict=True):
        sums = [0.0, 0.0]
        for row, column in itertools.product(range(6), range(5)):
            label = int(image[row, column])
            if label != 255:
                sums[0] += float(-weights[label] * scores[:, row, column].log_softmax(0)[label])
                sums[1] += float(weights[label])
        means.append(sums[0] / sums[1])
    assert float(loss) == pytest.approx(sum(means) / 2, rel=1e-5)
    assert int(counts.sum()) == int((labels != 255).sum())
    right = (network.kept.argmax(1) == labels) & (labels != 255)
    assert int(counts.trace()) == int(right.sum())


def test_looking_everywhere_in_turn_gives_the_loss_of_the_interpolated_image() -> None:
    """Of a network whose scores are coarser than the image, in sum over the body's pixels."""
    torch.manual_seed(0)
    network = Compact(CompactSettings(patch=8, widths=(4,), blocks=(0,))).eval()
    range_m, labels = batch(24, 16)
    with torch.no_grad():
        full = network(range_m)
        expected = F.cross_entropy(full, labels.long(), ignore_index=255, reduction="sum")
        total, seen = torch.zeros(()), 0
        for row, column in itertools.product(range(4), range(4)):
            place = torch.tensor([(row + 0.5) / 4, (column + 0.5) / 4])
            one = labels.clone()
            one[1] = 255  # one image alone, whose mean times its pixels is its sum
            two = labels.clone()
            two[0] = 255
            for part in (one, two):
                loss, counts, _ = NetworkWithLoss(network, torch.ones(33))(range_m, part, place)
                total += loss * 2 * counts.sum()
                seen += int(counts.sum())
    assert seen == int((labels != 255).sum())
    assert float(total) == pytest.approx(float(expected), rel=1e-4)


def test_an_image_without_a_body_costs_nothing() -> None:
    network = Compact(CompactSettings(patch=8, widths=(4,), blocks=(0,)))
    empty = torch.full((1, 16, 16), 255, dtype=torch.uint8)
    loss, counts, _ = NetworkWithLoss(network, torch.ones(33))(torch.zeros(1, 1, 16, 16), empty, torch.zeros(2))
    loss.backward()
    assert float(loss.detach()) == 0
    assert not counts.any()


@pytest.mark.parametrize(("step", "stride"), [(1, 1), (4, 4), (4, 8), (8, 4), (16, 1)])
def test_scores_at_pixels_are_those_of_the_interpolated_image(step: int, stride: int) -> None:
    """Also at the image's edges, where its outermost scores hold."""
    _, labels = batch(22, 35)
    scores = torch.randn(2, 33, -(-22 // step), -(-35 // step))
    full = F.interpolate(scores, scale_factor=step, mode="bilinear", align_corners=False)
    total = 0
    for row, column in itertools.product(range(stride), range(stride)):
        pixels = SelectedPixels.of(labels, row, column, stride)
        expected = full[pixels.image, :, pixels.row, pixels.column]
        torch.testing.assert_close(pixels.interpolated(scores, step), expected, atol=2e-6, rtol=1e-5)
        assert torch.equal(pixels.truth, labels[pixels.image, pixels.row, pixels.column].long())
        total += len(pixels.truth)
    assert total == int((labels != 255).sum())


def test_gradients_of_scores_at_pixels_are_those_of_the_interpolated_image() -> None:
    _, labels = batch(22, 35)
    scores = torch.randn(2, 33, 6, 9, requires_grad=True)
    pixels = SelectedPixels.of(labels, 1, 3, 4)
    full = F.interpolate(scores, scale_factor=4, mode="bilinear", align_corners=False)
    parts = pixels.interpolated(scores, 4), full[pixels.image, :, pixels.row, pixels.column]
    found, expected = (torch.autograd.grad(part.square().sum(), scores)[0] for part in parts)
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("stride", [1, 4, 8, 16])
def test_the_loss_may_select_more_or_fewer_pixels_than_there_are_scores(stride: int) -> None:
    network, weights = Compact(CompactSettings(patch=8, widths=(4,), blocks=(0,))).eval(), torch.rand(33) + 0.5
    range_m, labels = batch(24, 16)
    found = NetworkWithLoss(network, weights, stride)(range_m, labels, torch.tensor([0.5, 0.0]))
    row = max(4, stride) // 2
    truth = labels[:, row :: max(4, stride), :: max(4, stride)].long()
    with torch.no_grad():
        scores = network(range_m)[:, :, row :: max(4, stride), :: max(4, stride)]
    each = F.cross_entropy(scores, truth, weights, ignore_index=255, reduction="none").sum((1, 2))
    weight = torch.where(truth == 255, 0.0, weights[truth.clamp(max=32)]).sum((1, 2))
    assert float(found.loss.detach()) == pytest.approx(float((each / weight.clamp(min=1e-6)).mean()), rel=1e-4)


def test_rare_parts_weigh_more_and_a_mean_pixel_weighs_one() -> None:
    counts = np.full(33, 100)
    counts[3], counts[4] = 400, 0
    weights = part_weights(counts, 0.5).numpy()
    assert weights[0] / weights[3] == pytest.approx(2)
    assert weights[4] == weights[0]
    seen = np.maximum(counts, 100)
    assert (weights * seen).sum() / seen.sum() == pytest.approx(1, rel=1e-5)
    assert part_weights(counts, 0.0).tolist() == pytest.approx([1.0] * 33)


def test_of_scores_for_every_pixel_it_may_look_at_one_in_sixteen() -> None:
    """All the places together are the whole image, each pixel once."""
    range_m, labels = batch(8, 12)
    network = PixelScores(8, 12)
    counts = sum(
        NetworkWithLoss(network, torch.ones(33), loss_stride=4)(range_m, labels, torch.tensor([row, column]) / 4).counts
        for row, column in itertools.product(range(4), range(4))
    )
    assert torch.equal(counts, NetworkWithLoss(network, torch.ones(33))(range_m, labels, torch.zeros(2)).counts)


def test_the_papers_network_is_asked_only_for_the_pixels_looked_at() -> None:
    torch.manual_seed(0)
    network = FcnAlexnet(width=1 / 16).eval()
    range_m, labels = batch(50, 35)
    with torch.no_grad():
        whole = PixelScores(50, 35)
        whole.kept = network(range_m)
        for place in (torch.zeros(2), torch.tensor([0.3, 0.99])):
            loss, counts, _ = NetworkWithLoss(network, torch.ones(33), loss_stride=4)(range_m, labels, place)
            expected = NetworkWithLoss(whole, torch.ones(33), loss_stride=4)(range_m, labels, place)
            assert float(loss) == pytest.approx(float(expected.loss), rel=1e-5)
            assert torch.equal(counts, expected.counts)


def test_an_image_may_be_smaller_than_the_square_of_which_one_pixel_is_looked_at() -> None:
    range_m, labels = batch(2, 5)
    loss, counts, _ = NetworkWithLoss(PixelScores(2, 5), torch.ones(33), loss_stride=4)(
        range_m, labels, torch.tensor([0.9, 0.0])
    )
    assert float(loss) == 0 and not counts.any()
