"""Classes of sets, the 33 parts among them, and label maps that join them to fewer classes."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.labels.classes import (
        BACKGROUND,
        UNLABELLED,
        Classes,
        LabelClass,
        classes_from_json,
        classes_of,
        looked_up,
    )
    from bodyseg_data.labels.label_map import (
        NOWHERE,
        PARTS33,
        TEMPLATE,
        LabelMap,
        colour_labels,
        label_map_from_json,
        label_map_names,
        load_label_map,
        whole_map,
    )
    from bodyseg_data.labels.parts import LANDMARKS, PART_CLASSES, PART_COUNT, PARTS
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
