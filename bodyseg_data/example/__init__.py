"""A set of shards that ships with the package."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.example.shipped import example_set

__getattr__, __all__ = lazy_door(
    __name__,
    {
        "shipped": "example_set",
    },
)
