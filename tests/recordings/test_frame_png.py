"""16-bit grey PNGs, and everything that is none."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
from pngs import RAMP, chunk, png

from bodyseg_data.core import BadConfig
from bodyseg_model.recordings.frames import parse_frame


@pytest.mark.parametrize(
    ("data", "found"),
    [
        (b"", "nothing at all"),
        (b"GIF89a" + bytes(50), "no PNG, nor one of the recordings: bags, MCAP, NPY, NPZ, TIFF, MKV"),
        (png(np.zeros((4, 4), np.uint8)), "8-bit grey"),
        (png(np.zeros((4, 4, 3), np.uint8)), "8-bit RGB"),
        (png(np.zeros((4, 4, 4), np.uint8)), "8-bit RGB with alpha"),
    ],
)
def test_a_frame_is_a_16_bit_grey_png(data: bytes, found: str) -> None:
    with pytest.raises(BadConfig) as caught:
        parse_frame(data)
    assert str(caught.value) == f"a frame must be a 16-bit grey PNG, found {found}"


def test_every_cut_through_a_png_is_noticed() -> None:
    whole = png(RAMP[:4, :5])
    for length in range(len(whole)):
        with pytest.raises(BadConfig):
            parse_frame(whole[:length])


def test_every_changed_byte_of_a_png_is_noticed() -> None:
    whole = png(RAMP[:4, :5])
    for place in range(len(whole)):
        data = bytearray(whole)
        data[place] ^= 0x10
        with pytest.raises(BadConfig):
            parse_frame(bytes(data))


def test_a_wrong_checksum_is_shown() -> None:
    whole = bytearray(png(RAMP[:4, :5]))
    whole[-1] ^= 0xFF
    with pytest.raises(BadConfig, match="found ae42607d instead of ae426082 for b'IEND'"):
        parse_frame(bytes(whole))


def test_sizes_beyond_reason_are_refused_before_memory_is_taken() -> None:
    header = struct.pack(">IIBBBBB", 1 << 30, 1 << 30, 16, 0, 0, 0, 0)
    data = png()[:8] + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")
    with pytest.raises(BadConfig, match="^a frame must have rows and columns, .* found 1073741824 x 1073741824$"):
        parse_frame(data)


@pytest.mark.parametrize("kind", [b"IDAT", b"tEXt"])
def test_a_png_begins_with_its_size(kind: bytes) -> None:
    data = png()[:8] + chunk(kind, b"x" * 30) + png()[8:]
    if kind == b"IDAT":
        with pytest.raises(BadConfig, match="^a PNG must begin with its size$"):
            parse_frame(data)
    else:
        np.testing.assert_array_equal(parse_frame(data), RAMP)


def test_a_png_without_pixels_is_refused() -> None:
    header = png()[8:33]
    with pytest.raises(BadConfig, match="^not a readable PNG"):
        parse_frame(png()[:8] + header + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b""))


def test_other_chunks_do_not_matter() -> None:
    bomb = chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(1 << 24))) + chunk(b"acTL", b"\xff" * 8)
    whole = png()
    np.testing.assert_array_equal(parse_frame(whole[:33] + bomb + whole[33:]), RAMP)
