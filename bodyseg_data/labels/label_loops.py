"""Joining labels in place, compiled, eight pixels at a time: most of an image is background or within one part."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from bodyseg_data.machine import compiled

_BACKGROUND: Final = np.uint64(2**64 - 1)
_BYTE: Final = np.uint64(255)


def _join(labels: Any, words: Any, first: Any, table: Any) -> None:
    """Replace flat labels by their entries of `table`, uint64 [256].

    words: the labels from `first` on, eight in each, without those that fill no word.
    """
    for i in range(first):
        labels[i] = table[labels[i]]
    last = joined = _BACKGROUND
    for number in range(words.size):
        word = words[number]
        if word == _BACKGROUND:
            continue
        if word != last:
            last, joined = word, np.uint64(0)
            for byte in range(8):
                shift = np.uint64(8 * byte)
                joined |= table[(word >> shift) & _BYTE] << shift
        words[number] = joined
    for i in range(first + 8 * words.size, labels.size):
        labels[i] = table[labels[i]]


def _join_runs(labels: Any, edges: Any, table: Any) -> None:
    """Replace flat labels by their entries of `table` in runs; edges: where each begins and ends, in turn."""
    for run in range(edges.size // 2):
        for i in range(edges[2 * run], edges[2 * run + 1]):
            labels[i] = table[labels[i]]


join_runs: Any = compiled(_join_runs, "the compiled form of label maps")
join: Any = compiled(_join, "the compiled form of label maps")
