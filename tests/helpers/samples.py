"""A sample of four pixels that breaks no rule."""

import numpy as np

from bodyseg_data.samples import Sample, SampleInfo, Split, Value


def body_info(
    pose: str = "standing", distance_cm: int = 215, azimuth_deg: int = 0, split: Split = "train", **others: Value
) -> SampleInfo:
    """The description of a sample of a body, with other values of some fields."""
    fields: dict[str, Value] = {"source": "open", "subset": "A", "subject": "A", "mesh": "posture-00", "pose": pose}
    fields |= {"distance_cm": distance_cm, "azimuth_deg": azimuth_deg, "pitch_deg": 0, "roll_deg": 0, "height_cm": 0}
    return SampleInfo(split, {**fields, "things": "", "hidden_pct": 0, **others})


GOOD = Sample(
    key="open-A-posture-00-d215-a000",
    range=np.array([[0, 21500], [1, 65535]], np.uint16),
    projector_range=np.array([[0, 7]], np.uint16),
    labels=np.array([[255, 0], [32, 5]], np.uint8),
    faces_projector=np.array([[False, True], [True, False]]),
    info=body_info(),
)
