"""Order statistics of many values, such as their median: compiled where that is possible."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.kernels import use_compiled

Values = NDArray[np.float32] | NDArray[np.float64]


def value_at(values: Values, share: float) -> float:
    """The value below which a share of finite values [N] lies, one of them; 0 without any."""
    if not len(values):
        return 0.0
    return _selected(values, min(int(share * len(values)), len(values) - 1))


def median(values: Values) -> float:
    """As `np.median` of finite values [N], at least one, to the same bits for float64."""
    middle = len(values) // 2
    upper = _selected(values, middle)
    return upper if len(values) % 2 else (_selected(values, middle - 1) + upper) / 2


def _selected(values: Values, place: int) -> float:
    """The value at a place of the sorted values."""
    if use_compiled():
        return float(_loops().select(values, place))
    return float(np.partition(values, place)[place])


@cache
def _loops() -> Any:
    """The compiled loops, in a module that needs numba."""
    return import_module("bodyseg_model.segmentation.order_loops")
