"""Networks that segment range images into body parts: training, evaluation, segmentation of frames, stability."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import bodyseg_data

if TYPE_CHECKING:
    __version__: str


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return bodyseg_data.__version__  # one distribution
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
