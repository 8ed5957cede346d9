"""Labels and confidences from coarse scores: the bits of a plain form, and the labels that torch gives."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from kernel_forms import computed_by
from numpy.typing import NDArray
from plain_labelling import label_in_numpy, powers_of_two
from toy_network import Toy

from bodyseg_model.networks import predict
from bodyseg_model.networks.labelling import _LEAST_PIXELS, label_pixels

Answer = tuple[NDArray[np.uint8], NDArray[np.float32]]


def made(height: int, width: int, classes: int, spread: float) -> NDArray[np.float32]:
    """Scores of neighbouring points are alike, as a network's are."""
    draws = np.random.default_rng(4).normal(size=(1, classes, height // 3 + 2, width // 3 + 2)).astype(np.float32)
    smooth = F.interpolate(torch.from_numpy(draws * np.float32(spread)), (height, width), mode="bicubic")
    return smooth[0].permute(1, 2, 0).contiguous().numpy()


def frame(rows: int, columns: int) -> NDArray[np.float32]:
    draws = np.random.default_rng(5).random((rows, columns))
    return np.where(draws < 0.7, 0.1 + 3 * draws, 0).astype(np.float32)


def labelled(scores: NDArray[np.float32], range_m: NDArray[np.float32], stride: int, threads: int) -> Answer:
    labels, confidence = np.full(range_m.shape, 255, np.uint8), np.zeros(range_m.shape, np.float32)
    label_pixels(scores[None], range_m[None], stride, labels[None], confidence[None], threads)
    return labels, confidence


@pytest.mark.parametrize("stride", [2, 3, 4, 8])
@pytest.mark.parametrize("spread", [1.0, 60.0])
def test_loops_give_the_bits_of_the_plain_form_and_torchs_labels(stride: int, spread: float) -> None:
    scores, range_m = made(19, 14, 7, spread), frame(19 * stride - 1, 14 * stride)  # the last row is cut
    scores[..., 6] = scores[..., 2]  # equal scores: the first class
    fast = labelled(scores, range_m, stride, 1)
    slow = np.full_like(fast[0], 255), np.zeros_like(fast[1])
    label_in_numpy(scores, range_m, stride, *slow)
    assert np.array_equal(slow[0], fast[0])
    assert np.array_equal(slow[1].view(np.uint32), fast[1].view(np.uint32))

    asked = torch.from_numpy(scores).permute(2, 0, 1)[None]
    full = F.interpolate(asked, scale_factor=stride, mode="bilinear", align_corners=False)[0].softmax(0)
    seen = range_m > 0
    expected, best = (found.numpy()[: seen.shape[0]] for found in (full.argmax(0), full.amax(0)))
    assert np.mean(fast[0][seen] != expected[seen]) <= 1e-3  # ties, rounded differently
    np.testing.assert_allclose(fast[1][seen], best[seen], atol=2e-4)
    assert (fast[0][~seen] == 255).all() and not fast[1][~seen].any()


def test_threads_change_no_bits() -> None:
    scores, range_m = made(100, 110, 33, 3.0), frame(398, 439)
    assert (range_m > 0).sum() >= 3 * _LEAST_PIXELS, "else fewer threads label"
    one, three = (labelled(scores, range_m, 4, threads) for threads in (1, 3))
    assert np.array_equal(one[0], three[0]) and np.array_equal(one[1], three[1])
    assert (one[0] != 255).sum() == (range_m > 0).sum()


def test_images_of_a_batch_are_labelled_as_alone() -> None:
    images = [(made(100, 90, 33, spread), frame(398, 359)) for spread in (3.0, 20.0, 1.0)]
    images[1][1][:200] = 0
    alone = [labelled(*image, 4, 1) for image in images]
    labels, confidence = np.full((3, 398, 359), 255, np.uint8), np.zeros((3, 398, 359), np.float32)
    scores, range_m = (np.stack(each) for each in zip(*images, strict=True))
    label_pixels(scores, range_m, 4, labels, confidence, 2)
    np.testing.assert_array_equal(labels, [each for each, _ in alone])
    np.testing.assert_array_equal(confidence, [each for _, each in alone])


def test_powers_of_two() -> None:
    powers = np.linspace(-120, 0, 5001, dtype=np.float32)
    np.testing.assert_allclose(powers_of_two(powers), np.exp2(powers.astype(np.float64)), rtol=4e-6)
    assert powers_of_two(np.float32([0, -1, -120])).tolist() == [1, 0.5, 2.0**-120]


def test_without_numba_torch_labels_alike() -> None:
    network, range_m = Toy().eval(), torch.from_numpy(frame(40, 40))[None, None]
    assert network.output_stride > 1
    loops = predict(network, range_m)
    with computed_by("numpy"):
        plain = predict(network, range_m)
    assert (loops.labels != plain.labels).float().mean() <= 1e-3  # ties, rounded differently
    torch.testing.assert_close(loops.confidence, plain.confidence, atol=2e-4, rtol=0)


def test_scores_that_are_not_finite_show_in_confidences() -> None:
    network, range_m = Toy().eval(), torch.full((1, 1, 40, 40), 2.0)
    assert torch.isfinite(predict(network, range_m).confidence).all()
    with torch.no_grad():
        network.layers[2].get_parameter("bias")[3] = float("nan")
    assert torch.isnan(predict(network, range_m).confidence).any()
