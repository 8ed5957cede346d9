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
    if use_compiled():
        return float(_loops().value_at(values, share))
    if not len(values):
        return 0.0
    place = min(int(share * len(values)), len(values) - 1)
    return float(np.partition(values, place)[place])


def median(values: Values) -> float:
    """As `np.median` of finite values [N], at least one, to the same bits for float64."""
    if use_compiled():
        return float(_loops().median(np.asarray(values, np.float64)))  # a loop is loaded for every type of values
    middle = len(values) // 2
    lower, upper = (float(value) for value in np.partition(values, [middle - 1, middle])[[middle - 1, middle]])
    return upper if len(values) % 2 else (lower + upper) / 2


@cache
def _loops() -> Any:
    """The compiled loops, in a module that needs numba."""
    return import_module("bodyseg_model.segmentation.order_loops")
