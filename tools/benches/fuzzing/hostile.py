"""Inputs made to break readers: bytes, JSON and images spoiled so that they get past the outer checks.

Every maker is a function of a random generator; the same generator gives the same input.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator, Sequence
from copy import deepcopy
from functools import lru_cache
from typing import Any, Final, TypeVar

import zstandard
from numpy.random import Generator

from bodyseg_data.rigs import MAX_SIDE
from bodyseg_data.shards import SIGNATURE, read_chunks

_T = TypeVar("_T")

ZSTD_MAGIC: Final = b"\x28\xb5\x2f\xfd"
_BYTES: Final = (0, 1, 2, 0x20, 0x7F, 0x80, 0xFE, 0xFF)
_SIDES: Final = (0, 1, 2, 3, 7, 8, 255, 256, 4096, 8191, 8192, 8193, 32767, 32768, 65535)
_PNG_KINDS: Final = ((1, 2, 4, 8, 16, 3), (0, 2, 3, 4, 6, 1), (0, 9), (0,), (0, 1))  # as a header lists them
_BOMB: Final = 1 << 24
_VALUES: Final[tuple[Any, ...]] = (
    *(None, True, False, 0, -1, 1, 3.5, 1e308, float("nan"), float("inf"), -float("inf"), 1 << 31, 1 << 63, 1 << 64),
    *(10**400, -(10**4000), "", "x", "\x00", "\n\x1b[31m", "\ud800", "../../etc/passwd", "/etc/passwd", "é" * 300),
    *([], {}, [[]], {"": None}, [0] * 300, "y" * 100_000),
)


def one_of(items: Sequence[_T], generator: Generator) -> _T:
    """One of the items, all equally likely."""
    return items[int(generator.integers(len(items)))]


def spoiled(data: bytes, generator: Generator) -> bytes:
    """`data` with one to four edits: bits, bytes, runs lost, doubled, moved, zeroed or random, or its end lost."""
    edited = bytearray(data)
    for _ in range(int(generator.integers(1, 5))):
        if not edited:
            break
        offset, length = int(generator.integers(len(edited))), int(generator.integers(1, 65))
        match int(generator.integers(9)):
            case 0:
                edited[offset] ^= 1 << int(generator.integers(8))
            case 1:
                edited[offset] = int(generator.choice(_BYTES))
            case 2:
                del edited[offset : offset + length]
            case 3:
                edited[offset:offset] = generator.bytes(length)
            case 4:
                edited[offset:offset] = edited[offset : offset + length]
            case 5:
                edited[offset : offset + length] = bytes(len(edited[offset : offset + length]))
            case 6:
                edited[offset : offset + length] = generator.bytes(len(edited[offset : offset + length]))
            case 7:
                run = edited[offset : offset + length]
                del edited[offset : offset + length]
                other = int(generator.integers(len(edited) + 1))
                edited[other:other] = run
            case _:
                del edited[offset:]
    return bytes(edited)


def hostile_image(valid: bytes, generator: Generator) -> bytes:
    """An image file of any codec with zstd frames: spoiled, mostly with the right checksum, or with other frames."""
    match int(generator.integers(8)):
        case 0:
            return valid
        case 1:
            return spoiled(valid, generator)
        case 2 | 3:
            return _checksum_set(spoiled(valid, generator), valid)
        case 4 | 5:
            return _checksum_set(_other_numbers(valid, generator), valid)
        case 6:
            return _checksum_set(_other_frame(valid, generator), valid)
        case _:
            return generator.bytes(int(generator.integers(200)))


def _other_frame(valid: bytes, generator: Generator) -> bytes:
    """One of the zstd frames replaced."""
    starts = [offset for offset in range(len(valid)) if valid.startswith(ZSTD_MAGIC, offset)]
    if not starts:
        return valid
    number = int(generator.integers(len(starts)))
    end = [*starts[1:], len(valid)][number]
    return valid[: starts[number]] + hostile_frame(valid[starts[number] : end], generator) + valid[end:]


def _other_numbers(valid: bytes, generator: Generator) -> bytes:
    """Some of the numbers of the header replaced."""
    edited = bytearray(valid)
    header = max(valid.find(ZSTD_MAGIC), 16)
    for _ in range(int(generator.integers(1, 4))):
        offset = 2 * int(generator.integers(2, header // 2 - 1))
        near = edited[offset] + int(generator.integers(-2, 3))
        number = int(generator.choice(_SIDES)) if generator.integers(2) else near
        struct.pack_into("<H", edited, offset, number % 65536)
    return bytes(edited)


def hostile_frame(frame: bytes, generator: Generator) -> bytes:
    """A zstd frame that claims, repeats or hides something."""
    zeros = zstandard.ZstdCompressor(write_content_size=bool(generator.integers(2)))
    match int(generator.integers(9)):
        case 0:
            return frame + frame
        case 1:  # a skippable frame, of which readers of zstd take no notice
            return struct.pack("<II", 0x184D2A50, 8) + bytes(8) + frame
        case 2:
            return frame + generator.bytes(16)
        case 3:
            return zeros.compress(bytes(_BOMB))
        case 4:  # the header's flags: sizes, checksum, dictionary
            return frame[:4] + generator.bytes(1) + frame[5:]
        case 5:  # a content size of eight bytes, whatever it is
            return ZSTD_MAGIC + b"\xe0" + struct.pack("<Q", 1 << int(generator.integers(64))) + frame[6:]
        case 6:
            parts = zstandard.ZstdCompressor().compressobj()  # without a content size
            return parts.compress(bytes(64)) + parts.flush()
        case 7:
            dictionary = zstandard.ZstdCompressionDict(bytes(range(256)) * 4)
            return zstandard.ZstdCompressor(dict_data=dictionary).compress(bytes(range(200)))
        case _:
            return ZSTD_MAGIC + spoiled(frame[4:], generator)


def hostile_png(valid: bytes, generator: Generator) -> bytes:
    """A PNG: spoiled with right chunk checksums, of every kind of pixel, or a bomb."""
    match int(generator.integers(9)):
        case 0:
            return valid
        case 1:
            return spoiled(valid, generator)
        case 2 | 3:
            return _png([(name, spoiled(data, generator)) for name, data in _chunks(valid)])
        case 4:  # another header over the same pixels
            sides = [int(side) for side in generator.choice(_SIDES, 2)]
            kinds = [int(generator.choice(kinds)) for kinds in _PNG_KINDS]
            return _png([(b"IHDR", struct.pack(">IIBBBBB", *sides, *kinds)), *_chunks(valid)[1:]])
        case 5:  # far more pixels than the header has room for
            return _png([_chunks(valid)[0], (b"IDAT", _bomb()), (b"IEND", b"")])
        case 6:
            first, *rest = _chunks(valid)
            extra = [_extra_chunk(generator) for _ in range(int(generator.integers(1, 4)))]
            return _png([first, *extra, *rest])
        case 7:
            return one_of(_foreign_pngs(), generator)
        case _:
            return SIGNATURE + generator.bytes(int(generator.integers(100)))


def _extra_chunk(generator: Generator) -> tuple[bytes, bytes]:
    deflated = _bomb()
    chunks = (
        (b"zTXt", b"k\0\0" + deflated),
        (b"iTXt", b"k\0\1\0\0\0" + deflated),
        (b"iCCP", b"k\0\0" + deflated),
        (b"acTL", struct.pack(">II", int(generator.choice(_SIDES)), 0)),
        (b"fcTL", generator.bytes(26)),
        (b"fdAT", generator.bytes(30)),
        (b"PLTE", generator.bytes(int(generator.integers(10)))),
        (b"tRNS", generator.bytes(int(generator.integers(4)))),
        (b"eXIf", generator.bytes(20)),
        (b"IHDR", struct.pack(">IIBBBBB", 40_000, 40_000, 16, 0, 0, 0, 0)),
        (bytes(generator.integers(65, 91, 4).tolist()), generator.bytes(12)),
    )
    return one_of(chunks, generator)


@lru_cache(maxsize=1)
def _bomb() -> bytes:
    return zlib.compress(bytes(_BOMB), 1)


def _chunks(png: bytes) -> list[tuple[bytes, bytes]]:
    """Name and content of every chunk."""
    return [(chunk.name, chunk.whole[8:-4]) for chunk in read_chunks(png)]


def _png(chunks: list[tuple[bytes, bytes]]) -> bytes:
    whole = [
        len(data).to_bytes(4, "big") + name + data + zlib.crc32(name + data).to_bytes(4, "big") for name, data in chunks
    ]
    return SIGNATURE + b"".join(whole)


@lru_cache(maxsize=1)
def _foreign_pngs() -> list[bytes]:
    """PNGs that are sound, and not what the package stores: colours, palettes, alpha, one bit, interlaced, animated."""
    from PIL import Image

    found = []
    for mode in ("1", "L", "LA", "P", "RGB", "RGBA", "I;16"):
        buffer = io.BytesIO()
        Image.new(mode, (9, 7)).save(buffer, "PNG")
        found.append(buffer.getvalue())
    buffer = io.BytesIO()
    frames = [Image.new("L", (9, 7), shade) for shade in (0, 90, 180)]
    frames[0].save(buffer, "PNG", save_all=True, append_images=frames[1:])
    found.append(buffer.getvalue())
    for depth, colour, interlaced in ((16, 6, 0), (16, 2, 0), (16, 4, 1), (16, 0, 1), (8, 0, 1), (4, 0, 0), (2, 3, 0)):
        header = struct.pack(">IIBBBBB", 16, 16, depth, colour, 0, 0, interlaced)
        pixels = (b"IDAT", zlib.compress(bytes(16 * (1 + 16 * 8))))
        palette = [(b"PLTE", bytes(12))] if colour == 3 else []
        found.append(_png([(b"IHDR", header), *palette, pixels, (b"IEND", b"")]))
    return found


def declared_bytes(member: str, data: bytes) -> int:
    """The bytes of arrays that an image file declares in its header; 0 if the format does not allow so many."""
    if member.endswith("png"):
        sizes = [struct.unpack_from(">II", data, 16)] if len(data) >= 24 else []
    else:  # camera and projector, or a plane (docs/reference/shard_format.md)
        places = {b"BSP1": (10,), b"BSI2": (8, 44)}.get(data[:4], (8, 46))
        sizes = [struct.unpack_from("<HH", data, at) for at in places] if len(data) >= places[-1] + 4 else []
    return sum(4 * rows * columns for rows, columns in sizes if max(rows, columns) <= MAX_SIDE)


def _checksum_set(data: bytes, valid: bytes) -> bytes:
    """`data` with the checksum that an image carries made right, found by where `valid` has its own."""
    offset = _checksum_offset(valid)
    if offset is None or len(data) < offset + 4:
        return data
    return data[:offset] + zlib.crc32(data[offset + 4 :]).to_bytes(4, "little") + data[offset + 4 :]


@lru_cache(maxsize=64)
def _checksum_offset(valid: bytes) -> int | None:
    """Offset of a CRC-32 of all bytes that follow it; None if there is none."""
    for offset in range(min(32, len(valid) - 4)):
        if int.from_bytes(valid[offset : offset + 4], "little") == zlib.crc32(valid[offset + 4 :]):
            return offset
    return None


def hostile_tree(tree: Any, generator: Generator) -> Any:
    """A copy of plain JSON with one to three nodes replaced, left out, added, doubled or nested deeply."""
    changed = deepcopy(tree)
    for _ in range(int(generator.integers(1, 4))):
        nodes = list(_containers(changed))
        node = one_of(nodes, generator) if nodes else None
        value = deepcopy(one_of(_VALUES, generator))
        if generator.integers(20) == 0:
            value = _nested(int(generator.choice((20, 100, 250))))
        if not node:
            return value
        if isinstance(node, list):
            key: Any = int(generator.integers(len(node)))
        else:
            key = one_of(list(node), generator)
        match int(generator.integers(4)):
            case 0 | 1:
                node[key] = value
            case 2:
                del node[key]
            case _ if isinstance(node, list):
                node.insert(key, node[key])
            case _:
                node[f"{key}{generator.choice(('', 'x', 'é'))}"] = value
    return changed


def hostile_json(text: str, generator: Generator) -> bytes:
    """JSON text spoiled as bytes, nested beyond reason, with keys given twice or in another encoding."""
    match int(generator.integers(6)):
        case 0:
            return text.replace('":', '": 1, "again":', 1).replace("again", text[2:8], 1).encode("utf-8", "replace")
        case 1:
            if generator.integers(2):
                return one_of((b"[", b'{"a":'), generator) * int(generator.choice((10, 990, 20_000)))
            depth = int(generator.integers(900, 1005))  # about as deep as can be read
            return text.replace("[", "[" * (depth + 1) + "]" * depth + ",", 1).encode("utf-8", "replace")
        case 2:
            return text.encode(str(generator.choice(("utf-16", "utf-32", "utf-8-sig", "utf-7"))), "replace")
        case 3:
            digits = b"9" * int(generator.choice((400, 5000)))
            return spoiled(text.encode("utf-8", "replace"), generator).replace(b"1", digits, 1)
        case _:
            return spoiled(text.encode("utf-8", "replace"), generator)


def _containers(tree: Any) -> Iterator[Any]:
    if isinstance(tree, dict | list) and tree:
        yield tree
        for value in tree.values() if isinstance(tree, dict) else tree:
            yield from _containers(value)


def _nested(depth: int) -> Any:
    tree: Any = 0
    for _ in range(depth):
        tree = [tree]
    return tree
