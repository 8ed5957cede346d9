"""Checks of the parameters of transforms."""

from __future__ import annotations

from typing import Any

from bodyseg_data.core.errors import BadConfig, check_int
from bodyseg_data.core.rigs.camera import MAX_SIDE


def check_number(transform: str, field: str, value: Any, low: float, high: float) -> None:
    """Raise BadConfig unless a parameter is a number from `low` to `high`."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise BadConfig(f"transform {transform!r}: {field} must be a number from {low:g} to {high:g}, found {value!r}")


def check_size(transform: str, rows: Any, columns: Any) -> None:
    """Raise BadConfig unless rows and columns are whole numbers that the sides of an image may have."""
    for field, value in (("rows", rows), ("columns", columns)):
        if check_int(f"transform {transform!r}: {field}", value, 1) > MAX_SIDE:
            raise BadConfig(f"transform {transform!r}: {field} must be at most {MAX_SIDE}, found {value!r}")
