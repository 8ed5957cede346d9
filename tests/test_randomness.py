from __future__ import annotations

import numpy as np
import pytest

from bodyseg_data.errors import BadConfig
from bodyseg_data.randomness import check_seed, generator, permutation


def test_a_draw_belongs_to_seed_epoch_key_and_purpose() -> None:
    identities = [(0, 0, "a", "noise"), (1, 0, "a", "noise"), (0, 1, "a", "noise"), (0, 0, "b", "noise")]
    identities += [(0, 0, "a", "missing data"), (0, 0, "an", "oise"), (0, 0, "", "anoise"), (10, 0, "a", "noise")]
    draws = {generator(*identity).bytes(16) for identity in identities}
    assert len(draws) == len(identities)
    assert generator(0, 0, "a", "noise").bytes(16) in draws


def test_the_bits_are_pinned() -> None:
    """Data sets described by a seed must stay what they were: a change here is a change of format."""
    assert generator(7, 3, "open-A-posture-00-d215-a000", "noise").bytes(8).hex() == "61e5be079441ccec"
    normals = generator(7, 3, "k", "noise").standard_normal(3, np.float32)
    assert normals.tolist() == [-0.7626180648803711, -1.1424444913864136, -0.29927387833595276]
    assert permutation(8, 7, 3).tolist() == [3, 4, 2, 7, 1, 6, 5, 0]


def test_neighbouring_keys_are_uncorrelated() -> None:
    a, b = (generator(0, 0, key, "noise").standard_normal(20_000) for key in ("k-a000", "k-a001"))
    assert abs(np.corrcoef(a, b)[0, 1]) < 5 / np.sqrt(20_000)


@pytest.mark.parametrize("count", [0, 1, 2, 1000])
def test_an_order_is_a_permutation_that_differs_by_epoch_and_seed(count: int) -> None:
    order = permutation(count, 0, 0)
    assert sorted(order.tolist()) == list(range(count))
    if count > 2:
        assert not np.array_equal(order, permutation(count, 0, 1))
        assert not np.array_equal(order, permutation(count, 1, 0))
        assert not np.array_equal(order, np.arange(count))
    assert np.array_equal(order, permutation(count, 0, 0))


@pytest.mark.parametrize("seed", [-1, 2**63, 1.5, True, "0"])
def test_a_seed_must_be_a_whole_number(seed: object) -> None:
    with pytest.raises(BadConfig, match="a seed must be a whole number"):
        check_seed(seed)  # type: ignore[arg-type]  # on purpose
