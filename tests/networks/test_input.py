"""Input of the networks: centred ranges, averaged over squares, or cut into patches."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from kernel_forms import by_both

from bodyseg_model.networks.network import patches_of, relief_of, shrunk


def test_shrinking_averages_what_was_measured() -> None:
    relief = torch.tensor(
        [[[[4.0, 0.0, 7.0, 1.0], [2.0, 0.0, 0.0, 0.0]], [[1.0, 0.0, 1.0, 1.0], [1.0, 0.0, 0.0, 0.0]]]]
    )
    assert shrunk(relief, 2).tolist() == [[[[3.0, 4.0]], [[0.5, 0.5]]]]
    assert shrunk(torch.zeros(1, 2, 4, 4), 4).tolist() == [[[[0.0]], [[0.0]]]]


def test_a_body_of_many_pixels_fits_into_half_precision() -> None:
    range_m = 2.0 + torch.rand(1, 1, 300, 300, generator=torch.Generator().manual_seed(0))  # 225 km in all
    half = relief_of(range_m.half())
    assert half.dtype == torch.float16
    torch.testing.assert_close(half.float(), relief_of(range_m), atol=5e-3, rtol=0)


def bodies(rows: int, columns: int) -> torch.Tensor:
    """Two images, of which the second shows nothing."""
    draw = torch.Generator().manual_seed(3)
    range_m = 2.5 + 0.3 * torch.rand(2, 1, rows, columns, generator=draw)
    range_m[0] *= torch.rand(1, rows, columns, generator=draw) < 0.7
    range_m[1] = 0
    return range_m


@pytest.mark.parametrize("side", [2, 4, 16])
def test_patches_lie_as_torchs_own_function_lays_them(side: int) -> None:
    range_m = bodies(48, 32)
    values, measured = patches_of(range_m, side)
    assert values.is_contiguous(memory_format=torch.channels_last)
    assert torch.equal(values, F.pixel_unshuffle(relief_of(range_m), side))
    assert torch.equal(measured, F.avg_pool2d((range_m > 0).float(), side))


@pytest.mark.parametrize("bfloat16", [False, True])
@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (32, 16), (61, 47), (16, 33)])
def test_both_forms_of_patches_have_the_same_values(rows: int, columns: int, bfloat16: bool) -> None:
    range_m = bodies(rows, columns)
    range_m[0, 0, 0, 0] = -1.0  # not measured, either

    def cut() -> list[torch.Tensor]:
        with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
            values, measured = patches_of(range_m, 16)
        assert values.dtype == (torch.bfloat16 if bfloat16 else torch.float32)
        return [values, measured]

    for loops, plain in zip(*by_both(cut), strict=True):
        assert torch.equal(loops, plain)


def test_gradients_by_ranges_pass_through_patches() -> None:
    range_m = bodies(20, 20).requires_grad_()
    patches_of(range_m, 4).values.square().sum().backward()
    assert range_m.grad is not None and bool(range_m.grad[0].any())


@pytest.mark.filterwarnings("ignore:`torch.jit.trace` is deprecated", "ignore::torch.jit.TracerWarning")
def test_a_trace_holds_the_computation_and_not_what_its_example_gave() -> None:
    traced = torch.jit.trace(lambda range_m: tuple(patches_of(range_m, 16)), (bodies(48, 32),))  # type: ignore[no-untyped-call]
    other = bodies(61, 47)
    for found, wanted in zip(traced(other), patches_of(other, 16), strict=True):
        assert torch.equal(found, wanted)
