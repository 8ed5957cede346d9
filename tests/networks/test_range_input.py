"""Input of the networks: centred ranges, averaged over squares."""

from __future__ import annotations

import torch

from bodyseg_model.networks.range_input import relief_of, shrunk


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
