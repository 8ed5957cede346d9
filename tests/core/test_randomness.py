from __future__ import annotations

import numpy as np
import pytest

from bodyseg_data.artifacts.random_loops import raw_words
from bodyseg_data.core import BadConfig, Draws, check_seed, uniform
from bodyseg_data.loading.selection import permutation


def test_a_draw_belongs_to_seed_epoch_key_and_purpose() -> None:
    identities = [(0, 0, "a", "noise"), (1, 0, "a", "noise"), (0, 1, "a", "noise"), (0, 0, "b", "noise")]
    identities += [(0, 0, "a", "missing data"), (0, 0, "an", "oise"), (0, 0, "", "anoise"), (10, 0, "a", "noise")]
    for draw in (
        lambda *identity: Draws(*identity[:3]).generator(identity[3]).bytes(16),
        lambda *identity: Draws(*identity[:3]).stream(identity[3]).tobytes(),
        lambda *identity: Draws(*identity[:3]).chance(identity[3]),
    ):
        draws = {draw(*identity) for identity in identities}
        assert len(draws) == len(identities)
        assert draw(0, 0, "a", "noise") in draws


def test_the_bits_are_pinned() -> None:
    """Data sets described by a seed must stay what they were: a change here is a change of format."""
    assert Draws(7, 3, "open-A-posture-00-d215-a000").generator("noise").bytes(8).hex() == "61e5be079441ccec"
    noise = Draws(7, 3, "k")
    assert noise.pixels("noise", 3, np.uint32).tolist() == [2720071503, 2556194740, 1398818602]
    assert noise.pixels("noise", 5, np.uint16).tolist() == [65359, 41504, 28596, 39004, 18218]
    assert Draws(7, 3, "k").chance("sigma") == 0.901699977694218
    losses = Draws(2026, 0, "0").generator("losses")
    assert [uniform(losses), uniform(losses)] == [0.6944945298836965, 0.5809313731580426]
    assert permutation(8, 7, 3).tolist() == [3, 4, 2, 7, 1, 6, 5, 0]


def test_a_samples_draws_are_those_of_its_identity_in_any_order() -> None:
    draws, other = Draws(7, 3, "k"), Draws(7, 3, "k")
    generated, noise = draws.generator("losses").bytes(8), other.stream("noise").tolist()
    assert draws.pixels("noise", 5, np.uint16).tolist() == other.pixels("noise", 5, np.uint16).tolist()
    assert draws.chance("sigma") == other.chance("sigma")
    assert draws.stream("noise").tolist() == noise
    assert draws.generator("losses").bytes(8) == generated == other.generator("losses").bytes(8)


def test_neighbouring_keys_are_uncorrelated() -> None:
    a, b = (Draws(0, 0, key).generator("noise").standard_normal(20_000) for key in ("k-a000", "k-a001"))
    assert abs(np.corrcoef(a, b)[0, 1]) < 5 / np.sqrt(20_000)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 4, 5, 7, 8, 1001])
def test_pixels_get_the_raw_words_cut_up_from_their_low_end(count: int) -> None:
    own = Draws(0, 0, "k")
    words = [int(word) for word in np.random.Philox(key=own.stream("noise")).random_raw(max(count, 1))]
    for kind, bits in ((np.uint16, 16), (np.uint32, 32)):
        draws = own.pixels("noise", count, kind)
        assert draws.dtype == kind and len(draws) == count
        each = 64 // bits
        expected = [words[pixel // each] >> (bits * (pixel % each)) & (2**bits - 1) for pixel in range(count)]
        assert draws.tolist() == expected


@pytest.mark.parametrize("first", [0, 4, 512, 3000])
@pytest.mark.parametrize("count", [0, 1, 2, 3, 4, 5, 8, 9, 4001])
def test_the_compiled_generator_gives_numpys_raw_words(count: int, first: int) -> None:
    keys = [Draws(0, 0, f"k{number}").stream("noise") for number in range(20)]
    keys += [np.array(pair, np.uint64) for pair in ((0, 0), (2**64 - 1, 2**64 - 1), (0, 2**63), (1, 0))]
    for key in keys:
        words = np.full(count + 4, 77, np.uint64)
        raw_words(*key, np.int64(first), np.int64(count), words)
        assert np.array_equal(words[:count], np.random.Philox(key=key).random_raw(first + count)[first:])


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
