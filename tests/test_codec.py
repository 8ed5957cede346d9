from __future__ import annotations

import contextlib
import io
import json
import struct
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from PIL import Image
from strategies import same, samples

from bodyseg_data.codec import (
    CODECS,
    FACING_BIT,
    BsiCodec,
    CodecName,
    decode_sample,
    encode_sample,
    image_codec,
    split_labels,
)
from bodyseg_data.errors import BadConfig, BadSample
from bodyseg_data.sample import Sample, SampleInfo

GOLDEN = Path(__file__).parent / "golden"
INFO = SampleInfo("open", "A", "A", "posture-00", "standing", 215, 40, "train")


def ramp_sample() -> Sample:
    """Every 16-bit value once: a decoder that clips or shifts cannot hide."""
    ranges = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    labels = (np.arange(65536) % 33).astype(np.uint8).reshape(256, 256)
    labels[0, 0] = 255
    facing = (ranges % 3 == 1) & (ranges > 0)
    return Sample("open-A-posture-00-d215-a040", ranges, ranges[::-1].copy(), labels, facing, INFO)


@pytest.mark.parametrize("codec", CODECS)
def test_every_value_of_16_bits_survives(codec: CodecName) -> None:
    sample = ramp_sample()
    sample.check()
    assert same(decode_sample(sample.key, encode_sample(sample, codec)), sample)


@given(sample=samples(), codec=st.sampled_from(CODECS))
def test_any_sample_survives(sample: Sample, codec: CodecName) -> None:
    sample.check()
    assert same(decode_sample(sample.key, encode_sample(sample, codec)), sample)


@given(data=st.data(), kind=st.sampled_from([np.uint8, np.uint16]))
def test_any_image_survives(data: st.DataObject, kind: type[np.uint8 | np.uint16]) -> None:
    image = data.draw(arrays.arrays(kind, st.tuples(st.integers(1, 40), st.integers(1, 40)), fill=st.just(0)))
    background = data.draw(st.sampled_from([0, 255]))
    decoded = BsiCodec().decode(BsiCodec().encode(image, background))
    assert decoded.dtype == image.dtype
    assert np.array_equal(decoded, image)


def test_the_stored_bytes_are_pinned() -> None:
    """A change of these bytes is a change of format and needs another magic."""
    image = np.zeros((40, 30), np.uint16)
    image[5:25, 3:20] = 21000 + np.add.outer(np.arange(20) * 7, np.arange(17) * 3)
    stored = (GOLDEN / "plane.bsi").read_bytes()
    assert np.array_equal(BsiCodec().decode(stored), image)
    magic, crc32, *fields = struct.unpack_from("<4sIBBHHHHHH", stored)
    assert (magic, crc32) == (b"BSI1", zlib.crc32(stored[8:]))
    assert fields == [2, 0, 40, 30, 5, 3, 20, 17]
    assert BsiCodec().encode(image, 0)[8:22] == stored[8:22]


def test_png_members_open_in_any_image_tool() -> None:
    sample = ramp_sample()
    members = encode_sample(sample, "png")
    assert sorted(members) == ["json", "labels.png", "projector.png", "range.png"]
    picture = np.asarray(Image.open(io.BytesIO(members["range.png"])))
    assert np.array_equal(picture, sample.range)


def test_the_facing_bit_leaves_labels_and_background_alone() -> None:
    stored = np.array([[0, 32, 32 | FACING_BIT, FACING_BIT, 255]], np.uint8)
    labels, facing = split_labels(stored)
    assert labels.tolist() == [[0, 32, 32, 0, 255]]
    assert facing.tolist() == [[False, False, True, True, False]]


def _image(**changes: int | bytes) -> bytes:
    """An image whose header says what it likes, with the right checksum."""
    fields = {"size": 2, "background": 0, "rows": 4, "columns": 4, "top": 0, "left": 0, "height": 2, "width": 2}
    payload = changes.pop("payload", zstandard.ZstdCompressor().compress(bytes(8)))
    assert isinstance(payload, bytes)
    checked = struct.pack("<BBHHHHHH", *(fields | changes).values()) + payload
    return b"BSI1" + struct.pack("<I", zlib.crc32(checked)) + checked


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "has a header of 22 bytes, found 0"),
        (b"PNG1" + _image()[4:], "starts with b'BSI1', found b'PNG1'"),
        (_image()[:-1], "altered: CRC-32 [0-9a-f]{8} expected, found [0-9a-f]{8}"),
        (_image(size=4), "1 or 2 bytes a pixel, found 4"),
        (_image(rows=0), "side is 1 to 8192 pixels, found 0 x 4"),
        (_image(rows=60000, columns=60000), "side is 1 to 8192 pixels, found 60000 x 60000"),
        (_image(top=3), "crop of 2 x 2 at 3, 0 does not fit 4 x 4"),
        (_image(height=4, width=4), "4 x 4 pixels has 32 bytes, the frame claims 8"),
        (_image(payload=b"junk that is no frame"), "zstd cannot decode"),
        (_image(payload=zstandard.ZstdCompressor().compress(bytes(8))[:-2]), "zstd cannot decode"),
        (_image(payload=zstandard.ZstdCompressor().compress(bytes(1 << 27))), "the frame claims 134217728"),
    ],
)
def test_bytes_that_are_no_image_are_refused(data: bytes, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BsiCodec().decode(data)


def test_any_flipped_bit_of_an_image_is_seen() -> None:
    data = BsiCodec().encode(ramp_sample().range[:40, :40].copy(), 0)
    generator = np.random.default_rng(0)
    for place in [*range(30), *generator.integers(0, len(data), 200).tolist()]:
        spoiled = bytearray(data)
        spoiled[place] ^= 1 << int(generator.integers(8))
        with pytest.raises(ValueError, match="starts with|altered"):
            BsiCodec().decode(bytes(spoiled))


@given(cut=st.integers(0, 400), place=st.integers(0, 400), value=st.integers(1, 255))
def test_a_damaged_png_decodes_to_an_image_or_is_refused_but_never_surprises(cut: int, place: int, value: int) -> None:
    data = bytearray(image_codec("png").encode(np.arange(400, dtype=np.uint16).reshape(20, 20), 0))
    data[place % len(data)] ^= value
    with contextlib.suppress(ValueError):
        assert image_codec("png").decode(bytes(data[: len(data) - cut])).dtype in (np.uint8, np.uint16)


def test_a_png_that_claims_a_huge_image_is_refused_before_it_is_opened() -> None:
    data = bytearray(image_codec("png").encode(np.zeros((4, 4), np.uint16), 0))
    data[16:24] = struct.pack(">II", 20_000, 20_000)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    with pytest.raises(ValueError, match="side is 1 to 8192 pixels, found 20000 x 20000"):
        image_codec("png").decode(bytes(data))


def test_threads_may_decode_at_once() -> None:
    sample = ramp_sample()
    members = encode_sample(sample)
    with ThreadPoolExecutor(8) as executor:
        decoded = list(executor.map(lambda _: decode_sample(sample.key, members), range(200)))
    assert all(same(one, sample) for one in decoded)


def _members(**changes: bytes | None) -> dict[str, bytes]:
    members = {**encode_sample(ramp_sample()), **changes}
    return {name: data for name, data in members.items() if data is not None}


@pytest.mark.parametrize(
    ("members", "message"),
    [
        (_members(json=None), "a sample has json, range, projector and labels in one codec"),
        (_members(**{"range.bsi": None}), "in one codec, found"),
        (_members(**{"range.bsi": None, "range.png": b""}), "in one codec, found"),
        (_members(**{"extra.bsi": b""}), "in one codec, found"),
        ({"json": b"{}", "range.gif": b"", "projector.gif": b"", "labels.gif": b""}, "no codec is called 'gif'"),
        (
            _members(**{"labels.bsi": encode_sample(ramp_sample())["range.bsi"]}),
            "labels.bsi: must be uint8, found uint16",
        ),
        (_members(**{"range.bsi": b"x"}), "range.bsi: an image has a header"),
        (_members(json=b"{"), "json: "),
        (_members(json=b"[" * 100_000), "json: "),
        (_members(json=b"[]"), "the description must have exactly"),
        (_members(json=json.dumps({"source": "open"}).encode()), "the description must have exactly"),
    ],
)
def test_broken_members_are_refused_by_name(members: dict[str, bytes], message: str) -> None:
    with pytest.raises(BadSample, match=f"^k: .*{message}"):
        decode_sample("k", members)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("distance_cm", "215", "'distance_cm' must be int, found '215'"),
        ("azimuth_deg", True, "'azimuth_deg' must be int, found True"),
        ("split", "val", "'split' must be one of train, test, found 'val'"),
    ],
)
def test_broken_descriptions_are_refused_by_field(field: str, value: object, message: str) -> None:
    members = encode_sample(ramp_sample())
    tree = {**json.loads(members["json"]), field: value}
    with pytest.raises(BadSample, match=message):
        decode_sample("k", {**members, "json": json.dumps(tree).encode()})


def test_a_png_of_colours_is_refused() -> None:
    buffer = io.BytesIO()
    Image.new("RGB", (4, 4)).save(buffer, "PNG")
    with pytest.raises(ValueError, match="must be 8- or 16-bit greyscale, found mode RGB"):
        image_codec("png").decode(buffer.getvalue())


def test_unknown_codecs_are_refused() -> None:
    with pytest.raises(BadConfig, match="must be one of bsi, png, found 'jpg'"):
        image_codec("jpg")
