"""The small network: shapes, sizes of images, and what must not change its answer."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from benches.model.chosen import parameters

from bodyseg_data.core import BadConfig
from bodyseg_model.networks import build, predict, predict_each
from bodyseg_model.networks.compact import Compact, CompactSettings, _mean_over_body, _spread
from bodyseg_model.networks.network import MEASURES, metric_patches

SMALL = CompactSettings(patch=8, widths=(6, 8), blocks=(1, 1))


def network(settings: CompactSettings = SMALL) -> Compact:
    torch.manual_seed(5)
    made = Compact(settings)
    for layer in made.modules():
        if isinstance(layer, torch.nn.BatchNorm2d):  # as if it had been trained
            layer.running_mean.normal_()  # type: ignore[union-attr]
            layer.running_var.uniform_(0.5, 2)  # type: ignore[union-attr]
    return made.eval()


def figure(rows: int, columns: int, seed: int = 0) -> torch.Tensor:
    draw = torch.Generator().manual_seed(seed)
    range_m = 2.5 + 0.3 * torch.rand(1, 1, rows, columns, generator=draw)
    return range_m * (torch.rand(1, 1, rows, columns, generator=draw) < 0.7)


@pytest.mark.parametrize("patch", [2, 4, 8, 16])
@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (3, 50), (16, 16), (37, 61), (160, 83)])
def test_any_image_gets_scores_of_its_own_size(patch: Any, rows: int, columns: int) -> None:
    made = network(CompactSettings(patch, (4, 6), (0, 1)))
    with torch.no_grad():
        assert made(figure(rows, columns)).shape == (1, 33, rows, columns)
        assert made.scores(figure(rows, columns)).shape == (1, 33, -(-rows // 4), -(-columns // 4))


def test_the_default_has_at_most_two_million_parameters() -> None:
    assert parameters(Compact()) <= 2_000_000


def test_distance_does_not_enter() -> None:
    made, near = network(), figure(40, 24)
    far = torch.where(near > 0, near + 1.0, 0.0)
    with torch.no_grad():
        torch.testing.assert_close(made(near), made(far), atol=1e-4, rtol=1e-4)


def test_a_pixel_that_is_missing_differs_from_one_that_is_near() -> None:
    made, range_m = network(), torch.full((1, 1, 32, 32), 2.0)
    holed = range_m.clone()
    holed[0, 0, 10:20, 10:20] = 0
    with torch.no_grad():
        assert not torch.allclose(made(range_m), made(holed), atol=1e-3)


def test_the_answer_lies_where_the_body_is() -> None:
    """Moving the body by one patch moves the answer by as much: nothing is a pixel off."""
    made = network(CompactSettings(8, (6, 8), (1, 1), context=False))
    range_m = torch.zeros(1, 1, 320, 320)
    range_m[:, :, 144:176, 144:176] = figure(32, 32) + 2.0
    moved = range_m.roll((16, 32), (2, 3))
    with torch.no_grad():
        torch.testing.assert_close(
            made(range_m)[..., 128:192, 128:192], made(moved)[..., 144:208, 160:224], atol=1e-4, rtol=1e-4
        )


def test_full_scores_are_the_coarse_ones_at_the_middles_of_cells() -> None:
    made, range_m = network(), figure(48, 40)
    with torch.no_grad():
        full, small = made(range_m), made.scores(range_m)
    # A cell's middle lies between four pixels; away from the edge, scores are linear there.
    middle = (full[..., 1::4, 1::4] + full[..., 2::4, 1::4] + full[..., 1::4, 2::4] + full[..., 2::4, 2::4]) / 4
    expected = small * 49 / 64  # (7 / 8)^2 from the cell itself, the rest from its neighbours
    for down in (-1, 0, 1):
        for across in (-1, 0, 1):
            share = {(0, 0): 0.0}.get((down, across), (1 / 16 if down else 7 / 8) * (1 / 16 if across else 7 / 8))
            expected = expected + share * small.roll((down, across), (2, 3))
    torch.testing.assert_close(middle[..., 1:-1, 1:-1], expected[..., 1:-1, 1:-1], atol=1e-4, rtol=1e-4)


def test_settings_make_the_same_network_again() -> None:
    made = network()
    again = build("compact", made.settings)
    again.load_state_dict(made.state_dict())
    with torch.no_grad():
        assert torch.equal(made(figure(20, 20)), again.eval()(figure(20, 20)))


def test_weights_belong_to_a_seed() -> None:
    settings = {"patch": 16, "widths": [4], "blocks": [0]}
    one, same, other = (build("compact", settings, seed).get_parameter("head.weight") for seed in (1, 1, 2))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"patch": 3}, "patch must be 2 or 4 or 8 or 16, found 3"),
        ({"widths": []}, "widths must be 1 to 6 numbers from 1 to 2048, found ()"),
        ({"widths": [0, 4, 4, 4]}, "widths must be 1 to 6 numbers"),
        ({"blocks": [1]}, "blocks must be numbers from 0 to 32, one for each of"),
        ({"depth": 3}, "settings of compact that it does not take"),
        ({"focal_px": -1.0}, "focal_px must be 0, or 1 to 1e6 with a shrink of 1, found -1.0 and 1"),
        ({"focal_px": 525.0, "shrink": 2}, "focal_px must be 0, or 1 to 1e6 with a shrink of 1"),
    ],
)
def test_bad_settings_are_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(BadConfig) as caught:
        build("compact", settings)
    assert message in str(caught.value)


def test_only_range_images_are_taken() -> None:
    with pytest.raises(BadConfig, match=r"range images must be \[B, 1, H, W\], found \[1, 2, 8, 8\]"):
        network()(torch.zeros(1, 2, 8, 8))


def test_predictions_name_a_part_at_every_pixel_of_the_body_and_nowhere_else() -> None:
    range_m = torch.zeros(2, 1, 70, 50)
    range_m[0, 0, 20:61, 7:30] = figure(41, 23)[0, 0]
    labels, confidence = predict(network(), range_m)
    assert labels.dtype == torch.uint8
    assert torch.equal(labels == 255, range_m[:, 0] == 0)
    assert torch.equal(confidence == 0, range_m[:, 0] == 0)
    assert labels[range_m[:, 0] > 0].max() < 33
    assert confidence.max() <= 1 + 1e-6


def test_predictions_are_the_likeliest_part_of_interpolated_scores() -> None:
    made, range_m = network(), torch.cat([figure(41, 30), figure(41, 30, seed=1)])
    with torch.no_grad():
        likely = made(range_m).softmax(1)
    labels, confidence = predict(made, range_m)
    body = range_m[:, 0] > 0
    assert torch.equal(labels[body].long(), likely.argmax(1)[body])
    torch.testing.assert_close(confidence[body], likely.amax(1)[body])


def test_images_of_several_sizes_are_labelled_as_each_alone() -> None:
    made, seen = network(), [figure(*size, seed=seed) for seed, size in enumerate([(41, 30), (64, 30), (41, 30)])]
    together = predict_each(made, [image[0, 0].numpy() for image in seen])
    for image, (labels, confidence) in zip(seen, together, strict=True):
        alone = predict(made, image)
        assert np.array_equal(labels, alone.labels[0].numpy())
        np.testing.assert_allclose(confidence, alone.confidence[0].numpy(), atol=1e-5)
    assert predict_each(made, []) == []


def test_an_empty_image_has_no_parts() -> None:
    labels, confidence = predict(network(), torch.zeros(1, 1, 9, 9))
    assert (labels == 255).all()
    assert not confidence.any()


def test_predicting_needs_a_network_that_is_not_being_trained() -> None:
    with pytest.raises(BadConfig, match="evaluation mode"):
        predict(network().train(), figure(8, 8))


@pytest.mark.parametrize("lost", [torch.nan, torch.inf, -1.0])
def test_pixels_as_drivers_write_them_where_nothing_was_measured_are_refused(lost: float) -> None:
    range_m = figure(8, 8)
    range_m[0, 0, 0, 0] = lost
    with pytest.raises(BadConfig, match="^range images must be finite, and 0 where nothing was measured, found "):
        predict(network(), range_m)


@pytest.mark.parametrize("unit", [0.001, 0.0001])
def test_ranges_in_steps_or_millimetres_are_refused(unit: float) -> None:
    with pytest.raises(BadConfig, match="^range images must be in metres, found nothing nearer than "):
        predict(network(), figure(8, 8) / unit)
    sky, hills = torch.zeros(2, 1, 1, 140, 9)
    sky[..., :70, :] = 1000
    hills[..., :70, :] = torch.linspace(100, 600, 70)[:, None]
    far = sky * torch.linspace(1, 2, 140)[:, None]
    far[..., 1, 4] = 2  # someone is nearer
    for image in (sky, hills, far):
        assert (predict(network(), image).labels[0, :70] < 255).all()


def test_a_network_sees_whole_images_whatever_else_is_in_the_batch() -> None:
    made = network()
    range_m = torch.zeros(2, 1, 400, 420)
    range_m[0, :, 150:230, 170:220] = figure(80, 50)
    range_m[1, :, 10:390, 20:400] = figure(380, 380, seed=1)
    with torch.no_grad():
        whole = made(range_m).argmax(1)
    body = range_m[:, 0] > 0
    assert torch.equal(predict(made, range_m).labels[body].long(), whole[body])
    assert torch.equal(predict(made, range_m[:1]).labels, predict(made, range_m).labels[:1])


def test_the_body_is_what_context_is_the_mean_of() -> None:
    x = torch.randn(2, 3, 4, 5)
    measured = (torch.rand(2, 1, 15, 20, generator=torch.Generator().manual_seed(0)) < 0.3).float()
    expected = torch.zeros(2, 3)
    for image in range(2):
        total = 0.0
        for row in range(4):
            for column in range(5):
                cell = measured[image, 0, 4 * row : 4 * row + 4, 4 * column : 4 * column + 4]
                expected[image] += x[image, :, row, column] * cell.mean()
                total += float(cell.mean())
        expected[image] /= total
    torch.testing.assert_close(_mean_over_body(x, measured, 4)[:, :, 0, 0], expected)
    assert not _mean_over_body(x, torch.zeros(2, 1, 15, 20), 4).any()


@pytest.mark.parametrize("shrink", [2, 4])
@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (3, 50), (37, 61), (160, 83)])
def test_a_shrunk_image_gets_scores_of_its_own_size(shrink: Any, rows: int, columns: int) -> None:
    made = network(CompactSettings(4, (4, 6), (0, 1), shrink=shrink))
    with torch.no_grad():
        assert made(figure(rows, columns)).shape == (1, 33, rows, columns)
        assert made.scores(figure(rows, columns)).shape == (1, 33, -(-rows // 4), -(-columns // 4))


@pytest.mark.parametrize("side", [1, 2, 4])
def test_scores_lie_as_torchs_own_function_lays_them(side: int) -> None:
    cells = torch.randn(2, 3 * side**2, 5, 4)
    assert torch.equal(_spread(cells.requires_grad_(), side), F.pixel_shuffle(cells, side))


ROOM = CompactSettings(patch=8, widths=(6, 8), blocks=(1, 1), context=False, focal_px=100.0, classes=2)


def room(rows: int, columns: int) -> torch.Tensor:
    draw = torch.Generator().manual_seed(3)
    image = 0.5 + 4 * torch.rand(2, 1, rows, columns, generator=draw)
    image *= torch.rand(2, 1, rows, columns, generator=draw) < 0.8
    image[:, :, :9, :17] = 0  # patches without a range
    image[0, 0, 2, 3] = 0.2  # but for one of a single pixel, which is near
    return image


def test_a_metric_patch_says_where_it_is_and_what_it_measures() -> None:
    plane = torch.full((1, 1, 16, 24), 2.0)
    plane[0, 0, 9, 1] = 2.05
    plane[0, 0, 8:, 16:] = 0
    values, share = metric_patches(plane, 8, 100.0)
    assert values.shape == (1, 2 * 64 + MEASURES, 2, 3) and share.flatten().tolist() == [1, 1, 1, 1, 1, 0]
    assert values[0, 8 + 1, 1, 0] == pytest.approx(0.5 * 63 / 64, rel=1e-4)  # 0.05 m over the mean, in units of 0.1
    mean = 2 + 0.05 / 64
    x, y = -8 / 100, 4 / 100  # of the middle of the cell below on the left
    expected = [mean / 3 - 1, 1 / mean, x * mean / 2, y * mean / 2, 1, x, y]
    assert values[0, 128:, 1, 0].tolist() == pytest.approx(expected, rel=1e-5)
    assert values[0, :128, 1, 2].abs().max() == 0 and values[0, 128:133, 1, 2].abs().max() == 0


@pytest.mark.parametrize(("rows", "columns"), [(37, 61), (8, 8), (480, 640)])
def test_loops_cut_the_metric_patches_of_torch(rows: int, columns: int) -> None:
    from bodyseg_model.networks import patch_loops  # needs numba

    image = room(rows, columns)
    expected = metric_patches(image.requires_grad_(), 8, 100.0)  # gradients are asked for: PyTorch's operations
    cut, share = torch.empty_like(expected.values).permute(0, 2, 3, 1), torch.empty_like(expected.measured[:, 0])
    found = cut.contiguous()
    metres, settings = image.detach()[:, 0].numpy(), (np.zeros(1, np.float32), np.float32(0), 8, np.float32(100))
    patch_loops.cut_patches(metres, *settings, found.numpy(), share.numpy())
    assert torch.allclose(found.permute(0, 3, 1, 2), expected.values.detach(), atol=2e-5)
    assert torch.equal(share, expected.measured[:, 0].detach())


def test_a_network_of_rooms_tells_near_from_far() -> None:
    made = network(ROOM)
    with torch.no_grad():
        near, far = (made(torch.full((1, 1, 40, 48), metres)) for metres in (1.0, 3.0))
    assert near.shape == (1, 2, 40, 48) and not torch.allclose(near, far, atol=1e-3)
    assert build("compact", made.settings).settings == made.settings
