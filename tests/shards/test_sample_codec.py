from __future__ import annotations

import contextlib
import io
import json
import struct
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import zstandard
from folders import GOLDEN
from hypothesis import assume, given
from hypothesis import strategies as st
from kernel_forms import FORMS, computed_by
from numpy.typing import NDArray
from PIL import Image
from pngs import chunk
from samples import body_info
from strategies import same, samples

from bodyseg_data.core import BadSample
from bodyseg_data.samples import Sample
from bodyseg_data.shards import CODECS, CodecName, check_checksums, encode_sample, read_chunks, read_header
from bodyseg_data.shards.codecs.bodyseg_images import _is_smooth, decode_images, encode_images
from bodyseg_data.shards.codecs.png import decode_png, encode_png
from bodyseg_data.shards.codecs.residuals import decode_copies, encode_copies, unzigzag, zigzag
from bodyseg_data.shards.earlier import split_label_bytes
from bodyseg_data.shards.sample_codec import decode_sample

INFO = body_info(azimuth_deg=40)


def ramp_sample() -> Sample:
    """Every 16-bit value once: a decoder that clips or shifts cannot hide."""
    ranges = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    labels = (np.arange(65536) % 33).astype(np.uint8).reshape(256, 256)
    labels[0, 0] = 255
    facing = (ranges % 3 == 1) & (ranges > 0)
    return Sample("open-A-posture-00-d215-a040", ranges, ranges[::-1].copy(), labels, facing, INFO)


def figure_images() -> tuple[Any, Any, Any, Any]:
    """Two limbs of a smooth body, its labels, facing, and something before the projector."""
    rows, columns = np.mgrid[0:90, 0:70]
    ranges = (21000 + 7 * rows + 3 * columns + (rows - 40) ** 2 // 9).astype(np.uint16)
    ranges[(np.abs(columns - 20) > 9) & (np.abs(columns - 45) > rows // 6)] = 0
    ranges[:5] = ranges[80:] = 0
    labels = np.where(ranges > 0, np.where(rows + columns % 3 > 50, 7, 31), 255).astype(np.uint8)
    facing = ((ranges > 0) & (columns > 44)).astype(np.uint8)
    occluder = np.where((rows > 20) & (rows < 40) & (columns > rows), 19456, 0).astype(np.uint16)
    return ranges, labels, facing, occluder


@pytest.mark.parametrize("choice", FORMS)
@pytest.mark.parametrize("codec", CODECS)
def test_every_value_of_16_bits_survives(codec: CodecName, choice: str) -> None:
    sample = ramp_sample()
    sample.check()
    with computed_by(choice):
        assert same(decode_sample(sample.key, encode_sample(sample, codec)), sample)


@pytest.mark.parametrize("length", [254, 255, 256, 511, 70_001])
def test_runs_whose_length_takes_several_bytes_survive(length: int) -> None:
    ranges = np.repeat(np.uint16([0, 9_000, 20_000, 0, 30_000]), (3, length, length + 258, 260, 2)).reshape(1, -1)
    ranges = np.resize(ranges, (-(-ranges.size // 8000), min(8000, ranges.size)))
    labels = np.where(ranges > 0, ranges // 1000, 255).astype(np.uint8)
    sample = Sample("a", ranges, ranges.copy(), labels, ranges == 9_000, INFO)
    members = encode_sample(sample)
    for choice in FORMS:
        with computed_by(choice):
            assert same(decode_sample(sample.key, members), sample)
    with computed_by("compiled"):
        into = decode_sample(sample.key, members, out=(np.empty_like(ranges), np.empty_like(labels)))
    assert same(into, sample)
    assert into.edges is not None, "NumPy's form decodes what the loop refuses"


@given(sample=samples(), codec=st.sampled_from(list(CODECS)))
def test_any_sample_survives(sample: Sample, codec: CodecName) -> None:
    assume(codec != "png" or sample.projector_range is None or sample.projector_range.size > 1)  # one pixel is none
    sample.check()
    members = encode_sample(sample, codec)
    for choice in FORMS:
        with computed_by(choice):
            assert same(decode_sample(sample.key, members), sample)


@given(sample=samples(projectors=2), codec=st.sampled_from(list(CODECS)), into=st.booleans(), projector=st.booleans())
def test_any_sample_of_two_projectors_survives(sample: Sample, codec: CodecName, into: bool, projector: bool) -> None:
    assume(codec != "png" or sample.projector_range is None or sample.projector_range.size > 1)  # one pixel is none
    sample.check()
    members = encode_sample(sample, codec)
    for choice in FORMS:
        out = (np.full(sample.range.shape, 3, np.uint16), np.full(sample.range.shape, 5, np.uint8)) if into else None
        with computed_by(choice):
            decoded = decode_sample(sample.key, members, projector=projector, out=out, projectors=2)
        if into and (choice, codec) == ("compiled", "bsi"):
            assert decoded.edges is not None, "the loop refuses it"
        for field in ("range", "labels", "faces_projector", "faces_second"):
            assert np.array_equal(getattr(decoded, field), getattr(sample, field))
        assert decoded.info == sample.info
        assert decoded.projector_range is None or same(decoded, sample)
        assert (decoded.projector_range is not None) == projector


@pytest.mark.parametrize("codec", CODECS)
def test_a_second_facing_bit_is_refused_where_there_is_one_projector(codec: CodecName) -> None:
    sample = ramp_sample()
    stored = encode_sample(replace(sample, faces_second=sample.range > 0), codec)
    with pytest.raises(BadSample, match="the rig has fewer projectors than the facing bits tell of"):
        decode_sample(sample.key, stored).check()


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("choice", FORMS)
def test_254_classes_and_surfaces_of_none(codec: CodecName, choice: str) -> None:
    labels = np.arange(256, dtype=np.uint8).reshape(16, 16)
    ranges = np.where(labels == 255, 0, labels.astype(np.uint16) + 1000).astype(np.uint16)
    sample = Sample("k", ranges, ranges, labels, (labels % 2 > 0) & (ranges > 0), INFO)
    members = encode_sample(sample, codec)
    with computed_by(choice):
        assert same(decode_sample("k", members), sample)
        shown = decode_sample("k", members, unlabelled=255).labels
    assert np.array_equal(shown, np.where(labels == 254, 255, labels))


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("choice", FORMS)
def test_a_sample_may_have_no_projector_range(codec: CodecName, choice: str) -> None:
    sample = replace(ramp_sample(), projector_range=None)
    with computed_by(choice):
        decoded = decode_sample(sample.key, encode_sample(sample, codec))
    assert decoded.projector_range is None and np.array_equal(decoded.range, sample.range)


@pytest.mark.parametrize("choice", FORMS)
def test_a_projector_range_as_rendered_takes_no_more_than_the_camera_s(choice: str) -> None:
    """One that was not reduced to what the shadow test needs is stored as slopes."""
    ranges, labels, facing, _ = figure_images()
    runs, slopes = (len(encode_images(ranges, labels, facing, each)) for each in (None, ranges))
    assert slopes - runs < runs
    for stored, kind in ((ranges, 2), (ranges // 64 * 64, 1), (np.zeros_like(ranges), 1)):
        assert struct.unpack_from("<H", encode_images(ranges, labels, facing, stored), 44) == (kind,)
    with computed_by(choice):
        found = decode_images(encode_images(ranges, labels, facing, ranges[::-1]), projector=True)
    assert found.occluder is not None and np.array_equal(found.occluder, ranges[::-1])
    assert found.texels is not None and np.array_equal(found.texels, np.flatnonzero(ranges[::-1]))


def test_planes_are_decoded_by_name() -> None:
    planes = {"instances": np.array([[1, 300], [300, 65535]], np.uint16), "material": np.eye(2, dtype=np.uint8)}
    sample = Sample(
        "k", np.ones((2, 2), np.uint16), None, np.eye(2, dtype=np.uint8), np.eye(2) > 0, INFO, planes=planes
    )
    for codec in CODECS:
        members = encode_sample(sample, codec)
        assert decode_sample("k", members).planes.keys() == planes.keys()
        assert decode_sample("k", members, planes=["material"]).planes.keys() == {"material"}
        assert decode_sample("k", members, planes=()).planes == {}
        name = next(member for member in members if "instances" in member)
        with pytest.raises(BadSample, match=f"k: {name}: "):
            decode_sample("k", {**members, name: members[name][:-1]})


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("choice", FORMS)
def test_the_projectors_range_is_read_only_if_it_is_wanted(codec: CodecName, choice: str) -> None:
    sample = ramp_sample()
    with computed_by(choice):
        decoded = decode_sample(sample.key, encode_sample(sample, codec), projector=False)
    assert decoded.projector_range is None
    assert np.array_equal(decoded.range, sample.range) and np.array_equal(decoded.labels, sample.labels)
    with pytest.raises(BadSample, match="the projector's range is needed, the sample was read without it"):
        decoded.occluder_range()


def test_labels_that_contradict_the_range_cannot_be_stored() -> None:
    ranges, labels, _, occluder = figure_images()
    sample = Sample("k", ranges, occluder, np.full_like(labels, 3), ranges < 0, INFO)
    with pytest.raises(BadSample, match="k: labels must be 255 exactly where range is 0"):
        encode_sample(sample)


@pytest.mark.parametrize("choice", FORMS)
def test_the_stored_bytes_are_pinned(choice: str) -> None:
    """A change of these bytes is a change of format and needs another magic."""
    images = figure_images()
    stored = (GOLDEN / "figure.bsi").read_bytes()
    with computed_by(choice):
        decoded = decode_images(stored, projector=True)
    for image, expected in zip(decoded[:4], images, strict=True):
        assert image is not None and image.dtype == expected.dtype and np.array_equal(image, expected)
    assert stored[:4] == b"BSI3" and struct.unpack_from("<I", stored, 4) == (zlib.crc32(stored[8:]),)
    encoded = encode_images(*images)
    assert encoded[8:40] == stored[8:40] and encoded[44:78] == stored[44:78]  # zstd's own bytes may change


@pytest.mark.parametrize("choice", FORMS)
def test_images_of_earlier_formats_are_read_for_good(choice: str) -> None:
    stored = (GOLDEN / "figure_2.bsi").read_bytes()
    assert stored[:4] == b"BSI2"
    with computed_by(choice):
        decoded = decode_images(stored, projector=True)
    for image, expected in zip(decoded[:4], figure_images(), strict=True):
        assert image is not None and image.dtype == expected.dtype and np.array_equal(image, expected)


def test_label_bytes_of_earlier_formats() -> None:
    stored = np.array([0, 32, 32 | 0x40, 0x40, 0x80 | 5, 62, 62 | 0xC0, 255], np.uint8)
    labels, facing = split_label_bytes(stored)
    assert labels.tolist() == [0, 32, 32, 0, 5, 254, 254, 255]
    assert facing.tolist() == [0, 0, 1, 1, 2, 0, 3, 0]


def test_a_reader_written_from_the_format_alone_agrees() -> None:
    """A pixel at a time, as docs/reference/shard_format.md has it."""
    images = figure_images()
    decoded = _by_the_book(encode_images(*images))
    for image, expected in zip(decoded, images, strict=True):
        assert np.array_equal(image, expected)


def _by_the_book(data: bytes) -> tuple[Any, Any, Any, Any]:
    rows, columns, top, left, height, width, *counts = struct.unpack_from("<6H6I", data, 8)
    runs, long, starts, pixels, escapes, frame = counts
    numbers = iter(zstandard.ZstdDecompressor().decompress(data[78 : 78 + frame]))

    def row(count: int, planes: int = 1) -> list[int]:
        found = [[next(numbers) for _ in range(count)] for _ in range(planes)]
        return [sum(plane[i] << 8 * place for place, plane in enumerate(found)) for i in range(count)]

    values, faced, lengths, longs = row(runs), row(runs), row(runs), row(long, 4)
    firsts, steps, large = row(starts, 2), row(pixels - starts), row(escapes, 2)
    assert next(numbers, None) is None
    ranges, labels = np.zeros((rows, columns), np.uint16), np.full((rows, columns), 255, np.uint8)
    facing = np.zeros((rows, columns), np.uint8)
    place, previous, above = 0, 0, [0] * width
    inside = False
    for value, face, length in zip(values, faced, lengths, strict=True):
        for _ in range(longs.pop(0) if length == 255 else length):
            y, x = divmod(place, width)
            if value == 255:
                inside = False
            elif not inside:
                coded, inside = firsts.pop(0), True
                here = previous = (previous + (coded >> 1 if coded % 2 == 0 else -(coded >> 1) - 1)) % 65536
            else:
                coded = steps.pop(0)
                coded = large.pop(0) if coded == 255 else coded
                above[x] += coded >> 1 if coded % 2 == 0 else -(coded >> 1) - 1
                here = (here + above[x]) % 65536
            if value != 255:
                ranges[top + y, left + x], labels[top + y, left + x] = here, value
                facing[top + y, left + x] = face
            place += 1
    assert not (firsts or steps or large or longs)
    kind, rows, columns, top, left, height, width, runs, long, *others = struct.unpack_from("<H6H5I", data, 44)
    assert kind == 1 and others == [0, 0, 0]
    numbers = iter(zstandard.ZstdDecompressor().decompress(data[78 + frame :]))
    values, lengths, longs = row(runs, 2), row(runs), row(long, 4)
    occluder = np.zeros((rows, columns), np.uint16)
    flat: list[int] = []
    for value, length in zip(values, lengths, strict=True):
        flat += [value] * (longs.pop(0) if length == 255 else length)
    occluder[top : top + height, left : left + width] = np.reshape(flat, (height, width))
    return ranges, labels, facing, occluder


def test_small_differences_of_either_sign_become_small_numbers() -> None:
    changes = np.array([0, -1, 1, -2, 2, -32768, 32767]).astype(np.uint16)
    assert zigzag(changes).tolist() == [0, 1, 2, 3, 4, 65535, 65534]
    every = np.arange(65536, dtype=np.uint16)
    assert np.array_equal(unzigzag(zigzag(every)), every)


def test_png_members_open_in_any_image_tool() -> None:
    sample = ramp_sample()
    members = encode_sample(sample, "png")
    assert sorted(members) == ["facing.png", "json", "labels.png", "projector.png", "range.png"]
    picture = np.asarray(Image.open(io.BytesIO(members["range.png"])))
    assert np.array_equal(picture, sample.range)


def _frame(numbers: bytes) -> bytes:
    return zstandard.ZstdCompressor().compress(numbers)


_CAMERA = {"rows": 4, "columns": 4, "top": 0, "left": 0, "height": 1, "width": 4}
_CAMERA |= {"runs": 2, "long": 0, "starts": 1, "pixels": 3, "escapes": 0}
_PROJECTOR = {"kind": 1, "rows": 3, "columns": 2, "top": 0, "left": 0, "height": 0, "width": 0, "runs": 0, "long": 0}
_PROJECTOR |= {"starts": 0, "pixels": 0, "escapes": 0}
# Runs of 3 and 1, the first facing; one first range, two steps.
_NUMBERS = bytes([5, 255, 1, 0, 3, 1, 8, 0, 2, 2])


def _images(
    numbers: bytes = _NUMBERS, frame: bytes | None = None, occluder: bytes | None = None, **changes: int
) -> bytes:
    """A file whose header says what it likes, with the right checksum; p_ is for the projector's fields."""
    camera = _CAMERA | {name: value for name, value in changes.items() if name in _CAMERA}
    projector = _PROJECTOR | {name[2:]: value for name, value in changes.items() if name.startswith("p_")}
    first = _frame(numbers) if frame is None else frame
    header = struct.pack("<6H6I", *camera.values(), len(first)) + struct.pack("<H6H5I", *projector.values())
    checked = header + first + (_frame(b"") if occluder is None else occluder)
    return b"BSI3" + struct.pack("<I", zlib.crc32(checked)) + checked


def test_the_hand_made_file_is_sound() -> None:
    ranges, labels, facing, occluder, *_ = decode_images(_images(), projector=True)
    assert ranges.tolist()[0] == [4, 5, 6, 0]
    assert labels.tolist()[0] == [5, 5, 5, 255] and facing.tolist()[0] == [1, 1, 1, 0]
    assert occluder is not None and occluder.shape == (3, 2) and not occluder.any()


@pytest.mark.parametrize("choice", FORMS)
@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "have a header of 78 bytes, found 0"),
        (b"BSI1" + _images()[4:], "start with b'BSI3', found b'BSI1'"),
        (_images()[:-1], "altered: CRC-32 [0-9a-f]{8} expected, found [0-9a-f]{8}"),
        (_images(rows=0), "side is 1 to 8192 pixels, found 0 x 4"),
        (_images(rows=60000, columns=60000), "side is 1 to 8192 pixels, found 60000 x 60000"),
        (_images(top=4), "box of 1 x 4 at 4, 0 does not fit 4 x 4"),
        (_images(left=1), "box of 1 x 4 at 0, 1 does not fit 4 x 4"),
        (_images(runs=5), "1 x 4 pixels cannot have 5 runs"),
        (_images(long=1), "cannot have 2 runs .1 long."),
        (_images(starts=2), "cannot have 2 runs .0 long. and 2 stretches"),
        (_images(pixels=5), "stretches of 5 pixels"),
        (_images(escapes=4), "4 escaped"),
        (_images(height=2), "runs of 4 pixels do not fill 2 x 4"),
        (_images(bytes([5, 255, 0, 0, 3, 2, 8, 0, 2, 2])), "runs of 5 pixels do not fill 1 x 4"),
        (_images(bytes([5, 255, 0, 0, 4, 0, 8, 0, 2, 2])), "runs of 4 pixels do not fill 1 x 4"),
        (_images(bytes([5, 255, 0, 0, 255, 1, 8, 0, 2, 2])), "1 numbers are escaped, found 0"),
        (_images(bytes([5, 6, 0, 0, 3, 1, 8, 0, 2, 2])), "1 stretches of 4 pixels of body, found 1 first ranges and 2"),
        (_images(bytes([255, 5, 0, 0, 3, 1, 8, 0, 2, 2])), "1 stretches of 1 pixels of body"),
        (_images(bytes([255, 255, 0, 0, 3, 1, 8, 0, 2, 2])), "0 stretches of 0 pixels of body, found 1 first"),
        (_images(bytes([5, 255, 0, 0, 3, 1, 8, 0, 2, 255])), "1 numbers are escaped, found 0"),
        (_images(pixels=2), "9 bytes of numbers expected, the frame claims 10"),
        (_images(frame=b"junk that is no frame"), "zstd cannot decode"),
        (_images(frame=_frame(_NUMBERS)[:-2]), "zstd cannot decode"),
        (_images(bytes(1 << 27)), "10 bytes of numbers expected, the frame claims 134217728"),
        (_images(p_rows=9000), "side is 1 to 8192 pixels, found 9000 x 2"),
        (_images(p_height=4), "box of 4 x 0 at 0, 0 does not fit 3 x 2"),
        (_images(p_runs=1), "0 x 0 pixels cannot have 1 runs"),
        (_images(p_height=1, p_width=2, p_runs=1, occluder=_frame(bytes([1, 2, 3]))), "runs of 3 pixels do not fill"),
        (_images(occluder=b""), "zstd cannot decode"),
        (_images(bytes([5, 255, 4, 0, 3, 1, 8, 0, 2, 2])), "facing must be bits 0 and 1, and 0 on background"),
        (_images(bytes([5, 255, 0, 1, 3, 1, 8, 0, 2, 2])), "facing must be bits 0 and 1, and 0 on background"),
        (_images(p_kind=3), "the projector's range is stored in the ways 0 to 2, found 3"),
        (_images(p_kind=2, p_runs=1), "0 x 0 pixels cannot have 1 runs"),
    ],
)
def test_bytes_that_are_no_images_are_refused(data: bytes, message: str, choice: str) -> None:
    with computed_by(choice), pytest.raises(ValueError, match=message):
        decode_images(data, projector=True)


def test_the_projectors_frame_is_left_alone_if_it_is_not_wanted() -> None:
    ranges, _, _, occluder, *_ = decode_images(_images(occluder=b"junk"), projector=False)
    assert ranges.any() and occluder is None


def spoiled(data: bytes, generator: np.random.Generator, edits: int) -> bytes:
    """Some bytes replaced, the checksum made right."""
    edited = bytearray(data)
    for place in generator.integers(8, len(data), edits):
        edited[place] = generator.integers(256)
    edited[4:8] = struct.pack("<I", zlib.crc32(edited[8:]))
    return bytes(edited)


def test_whatever_the_bytes_both_decoders_agree_or_refuse() -> None:
    """Also on numbers that no encoder makes: compiled code must stay within its arrays, whatever it is given."""
    generator = np.random.default_rng(0)
    data = encode_images(*figure_images())
    frame = struct.unpack_from("<I", data, 40)[0]
    numbers = bytearray(zstandard.ZstdDecompressor().decompress(data[78 : 78 + frame]))
    read = 0
    for number in range(400):
        if number % 2:
            given = spoiled(data, generator, int(generator.integers(1, 4)))
        else:
            edited = bytearray(numbers)
            for place in generator.integers(0, len(edited), 3):
                edited[place] = generator.choice((0, 1, 254, 255, int(generator.integers(256))))
            given = _reframed(data, bytes(edited), frame)
        answers = [_answer(given, choice) for choice in FORMS]
        assert answers[0] == answers[1]
        read += isinstance(answers[0], list)
    assert 20 < read < 380


def _reframed(data: bytes, numbers: bytes, frame: int) -> bytes:
    other = _frame(numbers)
    checked = data[8:40] + struct.pack("<I", len(other)) + data[44:78] + other + data[78 + frame :]
    return data[:4] + struct.pack("<I", zlib.crc32(checked)) + checked


def _answer(data: bytes, choice: str) -> list[bytes] | str:
    with computed_by(choice):
        try:
            return [image.tobytes() for image in decode_images(data, projector=True)[:4] if image is not None]
        except ValueError as error:
            return str(error)


def test_any_flipped_bit_is_seen() -> None:
    data = encode_images(*figure_images())
    generator = np.random.default_rng(0)
    for place in [*range(70), *generator.integers(0, len(data), 200).tolist()]:
        edited = bytearray(data)
        edited[place] ^= 1 << int(generator.integers(8))
        with pytest.raises(ValueError, match="start with|altered"):
            decode_images(bytes(edited), projector=True)


@given(cut=st.integers(0, 400), place=st.integers(0, 400), value=st.integers(1, 255))
def test_a_damaged_png_decodes_to_an_image_or_is_refused_but_never_surprises(cut: int, place: int, value: int) -> None:
    data = bytearray(encode_png(np.arange(400, dtype=np.uint16).reshape(20, 20)))
    data[place % len(data)] ^= value
    with contextlib.suppress(ValueError):
        assert decode_png(bytes(data[: len(data) - cut])).dtype in (np.uint8, np.uint16)


def test_a_png_that_claims_a_huge_image_is_refused_before_it_is_opened() -> None:
    data = bytearray(encode_png(np.zeros((4, 4), np.uint16)))
    data[16:24] = struct.pack(">II", 20_000, 20_000)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    with pytest.raises(ValueError, match="side is 1 to 8192 pixels, found 20000 x 20000"):
        decode_png(bytes(data))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: b"GIF89a" + data, "a PNG must begin with its signature"),
        (lambda data: data[:-1], "a PNG must be whole, found it cut off after [0-9]+ bytes"),
        (lambda data: data[:8], "a PNG must be whole, found it cut off after 8 bytes"),
        (lambda data: data[:8] + data[33:], "a PNG must begin with its size"),
        (lambda data: data[:8] + b"\0\0\0\0" + data[12:16] + data[29:], "a PNG must begin with its size"),
        (lambda data: data[:33] + data[8:], "it holds IHDR, IDAT and IEND alone, found b'IHDR IHDR IDAT IEND'"),
        (lambda data: data + b"more", "nothing follows its end, found 4 bytes"),
    ],
)
def test_a_png_is_header_pixels_and_end_and_nothing_else(change: Callable[[bytes], bytes], message: str) -> None:
    with pytest.raises(ValueError, match=f"^not a readable PNG: {message}$"):
        decode_png(change(encode_png(np.zeros((4, 4), np.uint16))))


def test_chunks_of_a_png_have_their_checksums() -> None:
    chunks = read_chunks(encode_png(np.zeros((4, 5), np.uint16)))
    assert [chunk.name for chunk in chunks] == [b"IHDR", b"IDAT", b"IEND"]
    check_checksums(chunks)
    assert read_header(chunks[0]) == (4, 5, 16, 0)


def test_a_png_of_another_filter_or_size_is_refused() -> None:
    image = np.arange(20, dtype=np.uint16).reshape(4, 5)
    whole = _filtered_png(image, np.zeros(4, int))
    garbled = whole[:33] + chunk(b"IDAT", b"no stream") + whole[-12:]
    short = whole[:33] + chunk(b"IDAT", zlib.compress(bytes(43))) + whole[-12:]
    for wrong in (_filtered_png(image, np.array([0, 0, 5, 0])), garbled, short):
        with pytest.raises(ValueError, match="^not a readable PNG: "):
            decode_png(wrong)


def test_an_interlaced_png_is_read() -> None:
    image = np.arange(1, dtype=np.uint8).reshape(1, 1)  # one pixel is the same interlaced
    whole = bytearray(_filtered_png(image, np.zeros(1, int)))
    whole[28] = 1
    whole[29:33] = struct.pack(">I", zlib.crc32(whole[12:29]))
    assert decode_png(bytes(whole)).tolist() == [[0]]


def _filtered_png(image: NDArray[Any], kinds: NDArray[Any]) -> bytes:
    """A grey PNG whose rows have these filters, by the definition of each byte."""
    step = image.dtype.itemsize
    rows = image.astype(image.dtype.newbyteorder(">")).view(np.uint8).reshape(len(image), -1).astype(int)
    filtered = bytearray()
    for number, kind in enumerate(kinds):
        filtered.append(int(kind))
        for i in range(rows.shape[1]):
            a = rows[number, i - step] if i >= step else 0
            b = rows[number - 1, i] if number else 0
            c = rows[number - 1, i - step] if number and i >= step else 0
            nearest = min((abs(b - c), 0, a), (abs(a - c), 1, b), (abs(a + b - 2 * c), 2, c))[2]
            expected = (0, a, b, (a + b) // 2, nearest, 0)[kind]
            filtered.append((int(rows[number, i]) - int(expected)) % 256)
    header = struct.pack(">IIBBBBB", image.shape[1], image.shape[0], 8 * step, 0, 0, 0, 0)
    chunks = (b"IHDR", header), (b"IDAT", zlib.compress(bytes(filtered))), (b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(name, data) for name, data in chunks)


def test_threads_may_decode_at_once() -> None:
    sample = ramp_sample()
    members = encode_sample(sample)
    with ThreadPoolExecutor(8) as executor:
        decoded = list(executor.map(lambda _: decode_sample(sample.key, members), range(200)))
    assert all(same(one, sample) for one in decoded)


def _members(codec: CodecName = "bsi", **changes: bytes | None) -> dict[str, bytes]:
    members = {**encode_sample(ramp_sample(), codec), **changes}
    return {name: data for name, data in members.items() if data is not None}


@pytest.mark.parametrize(
    ("members", "message"),
    [
        (_members(json=None), "a sample has the members bsi, json or facing.png, json, labels.png, .*, found bsi$"),
        (_members(bsi=None), "found json$"),
        ({}, "found none$"),
        (_members("png", **{"range.png": None}), "found facing.png, json, labels.png, projector.png$"),
        (_members(**{"range.png": b""}), "found bsi, json, range.png$"),
        (_members(**{"extra.bsi": b""}), "found bsi, extra.bsi, json$"),
        ({"json": b"{}", "gif": b""}, "found gif, json$"),
        (
            _members("png", **{"labels.png": _members("png")["range.png"]}),
            "labels.png: must be uint8, found uint16",
        ),
        (_members(bsi=b"x"), "bsi: images have a header"),
        (_members(json=b"{"), "json: "),
        (_members(json=b"[" * 100_000), "json: "),
        (_members(json=b"[]"), "the description must be an object with a 'split'"),
        (_members(json=json.dumps({"source": "open"}).encode()), "the description must be an object with a 'split'"),
    ],
)
def test_broken_members_are_refused_by_name(members: dict[str, bytes], message: str) -> None:
    with pytest.raises(BadSample, match=f"^k: .*{message}"):
        decode_sample("k", members)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("distance_cm", None, "field 'distance_cm' must be text, a whole number, .*, found None"),
        ("Azimuth", 1, "a field must have a lower-case name"),
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
        decode_png(buffer.getvalue())


@pytest.mark.parametrize("choice", FORMS)
@given(first=samples(), second=samples())
def test_decoding_into_arrays_gives_the_same_images_and_says_where_they_hold_anything(
    choice: str, first: Sample, second: Sample
) -> None:
    with computed_by(choice):
        for sample in (first, second, first):  # whatever the one before has left behind
            stored = encode_sample(sample)
            out = np.full(sample.range.shape, 7, np.uint16), np.full(sample.range.shape, 7, np.uint8)
            decoded = decode_sample(sample.key, stored, out=out)
            assert decoded.range is out[0]
            assert decoded.labels is out[1]
            assert same(replace(decoded, edges=None, texels=None), decode_sample(sample.key, stored))
            assert decoded.texels is not None
            assert np.array_equal(decoded.texels, np.flatnonzero(sample.projector_range))
            if choice == "compiled":
                assert decoded.edges is not None
                begin, end = decoded.edges.reshape(-1, 2).T
                assert (begin < end).all()
                assert (begin[1:] >= end[:-1]).all()
                held = [np.arange(*edges) for edges in zip(begin, end, strict=True)]
                assert np.array_equal(np.concatenate([*held, np.zeros(0, int)]), np.flatnonzero(sample.range))


@pytest.mark.parametrize("choice", FORMS)
def test_damaged_samples_leave_nothing_behind_in_the_next_one(choice: str) -> None:
    """A thread keeps its occluder range: texels of a sample that was refused half-way must not stay."""
    generator = np.random.default_rng(1)
    ranges, labels, facing, occluder = figure_images()
    data = encode_images(ranges, labels, facing, occluder)
    end = 78 + struct.unpack_from("<I", data, 40)[0]
    numbers = zstandard.ZstdDecompressor().decompress(data[end:])
    refused = 0
    with computed_by(choice):
        for _ in range(60):
            edited = bytearray(numbers)
            for place in generator.integers(0, len(edited), 2):
                edited[place] = generator.choice((0, 1, 254, 255))
            checked = data[8:end] + _frame(bytes(edited))
            out = np.full(ranges.shape, 7, np.uint16), np.full(ranges.shape, 7, np.uint8)
            try:
                decode_images(data[:4] + struct.pack("<I", zlib.crc32(checked)) + checked, True, out)
            except ValueError:
                refused += 1
            decoded = decode_images(data, True, out)
            for image, expected in zip(decoded[:4], figure_images(), strict=True):
                assert np.array_equal(image, expected)
            assert decoded.texels is not None
            assert np.array_equal(decoded.texels, np.flatnonzero(occluder))
    assert 10 < refused < 60


@pytest.mark.parametrize("choice", FORMS)
def test_what_is_written_to_a_threads_occluder_range_is_in_no_other_sample(choice: str) -> None:
    ranges, labels, facing, occluder = figure_images()
    data = encode_images(ranges, labels, facing, occluder)
    out = np.empty_like(ranges), np.empty_like(labels)
    with computed_by(choice):
        kept, apart = decode_images(data, True, out), decode_images(data, True)
        assert kept.occluder is not None and apart.occluder is not None
        apart.occluder[...] = 1
        assert np.array_equal(kept.occluder, occluder)
        kept.occluder[...] = 1
        again = decode_images(data, True, out)
    assert again.occluder is kept.occluder and np.array_equal(again.occluder, occluder)


def test_the_description_of_a_sample_in_given_arrays_is_parsed_when_it_is_asked_for() -> None:
    sample = ramp_sample()
    stored = encode_sample(sample)
    out = np.empty_like(sample.range), np.empty_like(sample.labels)
    assert decode_sample(sample.key, stored, out=out).info == INFO
    copied = replace(decode_sample(sample.key, stored, out=out), labels=sample.labels)
    assert same(copied, sample)
    damaged = decode_sample(sample.key, stored | {"json": b"{"}, out=out)
    for _ in range(2):
        with pytest.raises(BadSample, match=f"^{sample.key}: json: "):
            _ = damaged.info


@pytest.mark.parametrize("codec", CODECS)
def test_arrays_that_do_not_fit_are_left_alone(codec: CodecName) -> None:
    sample = ramp_sample()
    stored = encode_sample(sample, codec)
    shape = sample.range.shape
    wrong = np.zeros((2, 2), np.uint16), np.zeros(shape, np.uint8)
    striped = np.zeros((shape[0], 2 * shape[1]), np.uint16)[:, ::2], np.zeros(shape, np.uint8)
    for out in (wrong, striped):
        assert same(replace(decode_sample(sample.key, stored, out=out), edges=None, texels=None), sample)
        assert not out[0].any()
        assert not out[1].any()


@pytest.mark.usefixtures("either_form")
def test_planes_of_many_regions_come_back_and_damage_is_refused() -> None:
    codec, random = CODECS["bsi"], np.random.default_rng(0)
    for shape in ((1, 1), (1, 9), (7, 1), (23, 31), (40, 64)):
        for cells in (1, 2, 5):
            few = random.integers(0, 65536, (-(-shape[0] // cells), -(-shape[1] // cells))).astype(np.uint16)
            plane = np.repeat(np.repeat(few, cells, 0), cells, 1)[: shape[0], : shape[1]]
            data = codec.encode_plane(plane)["bsp"]
            assert data[:4] == b"BSP2"
            np.testing.assert_array_equal(codec.decode_plane(data), plane)
    assert codec.encode_plane(np.zeros((64, 64), np.uint16))["bsp"][:4] == b"BSP1"
    new, left, above = 2, 1, 0
    wrong = (
        ([above, above], 0, "edge cannot equal"),
        ([left, above], 0, "edge"),
        ([new, new], 1, "2 pixels have a number"),
    )
    for (first, second), count, message in wrong:
        with pytest.raises(ValueError, match=message):
            decode_copies(np.array([first + 3 * second], np.uint8), np.zeros(2 * count, np.uint8), (1, 2))
    with pytest.raises(ValueError, match="five pixels take 0 to 242, found 243"):
        decode_copies(np.array([243], np.uint8), np.zeros(0, np.uint8), (1, 2))


def test_regions_take_a_number_each_and_projectors_ranges_the_shorter_form() -> None:
    rows = np.repeat(np.arange(1, 13, dtype=np.uint16)[:, None], 20, axis=1)
    for plane, numbers in ((rows, 12), (np.ascontiguousarray(rows.T), 12), (np.full((12, 20), 7, np.uint16), 1)):
        packed, stored = encode_copies(plane)
        assert (len(packed), len(stored)) == (-(-plane.size // 5), 2 * numbers)
    down, across = np.indices((60, 80))
    exact = (20000 + 3 * across + 5 * down).astype(np.uint16)
    reduced = (64 * (100 + across + down)).astype(np.uint16)
    assert _is_smooth(exact) and not _is_smooth(reduced), "multiples of powers of two"
    assert not _is_smooth((20001 + 2 * (across // 8)).astype(np.uint16)), "of few changes"
    assert not _is_smooth(np.zeros_like(exact))
