"""One clean sample: its images, key, view and split."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.samples.sample import (
        FARTHEST_STEPS,
        FIELD_KINDS,
        HELD,
        MOST_FIELDS,
        READ_SPLITS,
        SHADOW_THRESHOLDS,
        SPLITS,
        OccluderName,
        ReadSplit,
        Sample,
        SampleInfo,
        Split,
        Value,
        Window,
        as_array,
        box_of,
        check_field_name,
        check_key,
        holds_motions,
        holds_postures,
        info_from_json,
        kind_of,
        metres,
        plain_value,
        shape_of,
        split_by_motion,
        split_by_order,
        steps,
    )
    from bodyseg_data.samples.views import View, ViewGrid, parse_choice, split_key
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
