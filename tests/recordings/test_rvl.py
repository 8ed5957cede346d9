"""RVL by hand-made bytes, by an encoder of its own, and what is refused of it."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pngs import RAMP
from rvl_encoder import encode_rvl

from bodyseg_data.core import BadConfig
from bodyseg_model.recordings.rvl import decode_rvl


def test_bytes_made_by_hand() -> None:
    """2 zeros, 3 others: 5 (+5 -> 10), 6 (+1 -> 2), 4 (-2 -> 3); 1 zero, 0 others.

    10 is 2 with another piece behind, 1: pieces 2, 3, a, 1, 2, 3, 1, 0.
    """
    data = struct.pack("<iiI", 3, 2, 0x23A12310)
    np.testing.assert_array_equal(decode_rvl(data), [[0, 0, 5], [6, 4, 0]])
    assert decode_rvl(data).dtype == np.uint16
    assert encode_rvl(np.array([[0, 0, 5], [6, 4, 0]], np.uint16)) == data


@pytest.mark.parametrize(
    "image",
    [
        RAMP,
        np.zeros((3, 5), np.uint16),
        np.full((3, 5), 65535, np.uint16),
        np.array([[0, 65535, 0, 1, 65535, 1, 0, 0]], np.uint16),
        np.random.default_rng(0).integers(0, 65536, (9, 7), np.uint16),
        np.random.default_rng(1).integers(0, 2, (31, 17), np.uint16) * 3000,
    ],
)
def test_images_come_back(image: NDArray[np.uint16]) -> None:
    np.testing.assert_array_equal(decode_rvl(encode_rvl(image)), image)


def test_damage_is_one_line() -> None:
    whole = encode_rvl(RAMP)
    for data, message in (
        (b"", "must begin with columns and rows"),
        (struct.pack("<ii", 84, 60), "must hold 5040 pixels, found 0"),
        (struct.pack("<ii", -1, 60), "1 to 4096 of each, found 60 x -1"),
        (struct.pack("<ii", 84, 5000), "found 5000 x 84"),
        (whole[: len(whole) // 2], "must hold 5040 pixels"),
        (struct.pack("<iiI", 84, 60, 0), "must hold 5040 pixels"),
        (struct.pack("<ii", 84, 60) + b"\xff" * 8 + bytes(4), "numbers of at most 32 bits"),
        (struct.pack("<ii", 84, 60) + b"\xff" * 8, "must hold 5040 pixels"),
    ):
        with pytest.raises(BadConfig) as caught:
            decode_rvl(data)
        assert message in str(caught.value)
    random = np.random.default_rng(0)
    for _ in range(200):
        data = bytearray(whole)
        data[random.integers(8, len(data))] ^= int(random.integers(1, 256))
        result: Any = None
        try:
            result = decode_rvl(bytes(data))
        except BadConfig:
            continue
        assert result.shape == RAMP.shape
