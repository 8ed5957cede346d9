"""The 33 parts, and label maps that join them to fewer classes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.labels.label_map import (
        BACKGROUND,
        LANDMARKS,
        MIRRORED_LABELS,
        PART_COUNT,
        PARTS,
        PARTS33,
        LabelMap,
        Part,
        colour_labels,
        label_map_from_json,
        label_map_names,
        load_label_map,
        looked_up,
    )
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
