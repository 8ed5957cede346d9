"""Random words and standard normals, compiled: the bits of NumPy's Philox and of `noise.normals`.

The words are those that `np.random.Philox(key=...).random_raw` gives, in half the time: Philox4x64-10 of Salmon et al.,
"Parallel random numbers: as easy as 1, 2, 3" (2011), with their constants.
"""

from importlib import import_module
from typing import Any, Final

import numpy as np
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from bodyseg_data.artifacts.constants import FIRST_SEGMENT, OFFSET_MASK, SEGMENT_SHIFT
from bodyseg_data.machine import compiled

_llvm: Any = import_module("llvmlite.ir")  # has no types

_MULTIPLIER_0: Final = np.uint64(0xD2E7470EE14C6C93)
_MULTIPLIER_1: Final = np.uint64(0xCA5A826395121157)
_WEYL_0: Final = np.uint64(0x9E3779B97F4A7C15)
_WEYL_1: Final = np.uint64(0xBB67AE8584CAA73B)
_NONE, _ONE, _WORDS = np.uint64(0), np.uint64(1), np.uint64(4)

_HALF: Final = np.float32(0.5)


def _multiply(typing: Any, a: Any, b: Any) -> Any:
    """The upper and lower 64 bits of a product: one instruction, which Python's arithmetic cannot ask for."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        wide, word = _llvm.IntType(128), _llvm.IntType(64)
        product = builder.mul(*(builder.zext(argument, wide) for argument in arguments))
        halves = builder.lshr(product, _llvm.Constant(wide, 64)), product
        return context.make_tuple(builder, signature.return_type, [builder.trunc(half, word) for half in halves])

    return types.UniTuple(types.uint64, 2)(types.uint64, types.uint64), generate


_product: Any = intrinsic(_multiply)


@compiled
def raw_words(key_0: Any, key_1: Any, first: Any, count: Any, words: Any) -> None:
    """Write at least `count` words from number `first` on, a multiple of four; words: uint64, room for the next one."""
    before = np.uint64(first // 4)
    for block in range(np.uint64((count + 3) // 4)):
        # NumPy counts before it draws, so its first block is number 1.
        a, b, c, d = before + block + _ONE, _NONE, _NONE, _NONE
        round_0, round_1 = key_0, key_1
        for _ in range(10):
            upper_0, lower_0 = _product(_MULTIPLIER_0, a)
            upper_1, lower_1 = _product(_MULTIPLIER_1, c)
            a, b, c, d = upper_1 ^ b ^ round_0, lower_1, upper_0 ^ d ^ round_1, lower_0
            round_0 += _WEYL_0
            round_1 += _WEYL_1
        offset = _WORDS * block
        words[offset] = a
        words[offset + np.uint64(1)] = b
        words[offset + np.uint64(2)] = c
        words[offset + np.uint64(3)] = d


def bits_of(stream: NDArray[np.uint64], count: int) -> NDArray[np.uint32]:
    """32 bits a pixel, as `Draws.pixels`, uint32 [count]."""
    words = np.empty(-(-count // 8) * 4, np.uint64)  # whole blocks of four words
    raw_words(stream[0], stream[1], 0, len(words), words)
    return words.view(np.uint32)[:count]


@compiled
def draw_normals(halves: Any, count: Any, segments: Any, segment_of: Any, normals: Any) -> None:
    """As `noise.normals`; segment_of: int32, room for as many."""
    for point in range(np.uint64(count)):
        quantile = np.float32(np.int32(halves[point] & np.uint32(0x7FFFFFFF))) + _HALF
        bits = np.float32(quantile).view(np.int32)
        segment_of[point] = np.int32(bits >> SEGMENT_SHIFT) - np.int32(FIRST_SEGMENT)
        normals[point] = np.float32(bits & np.int32(OFFSET_MASK))
    constant, linear, bend = segments[0], segments[1], segments[2]
    for point in range(np.uint64(count)):
        segment, along = np.uint64(segment_of[point]), normals[point]
        size = np.float32(constant[segment] + along * (linear[segment] + along * bend[segment]))
        # The sign as a bit: a branch on it, which is random, would take most of the time.
        sign = ~halves[point] & np.uint32(0x80000000)
        normals[point] = np.uint32(size.view(np.uint32) ^ sign).view(np.float32)
