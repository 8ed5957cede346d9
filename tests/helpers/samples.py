"""A sample of four pixels that breaks no rule."""

import numpy as np

from bodyseg_data.samples import Sample, SampleInfo

GOOD = Sample(
    key="open-A-posture-00-d215-a000",
    range=np.array([[0, 21500], [1, 65535]], np.uint16),
    projector_range=np.array([[0, 7]], np.uint16),
    labels=np.array([[255, 0], [32, 5]], np.uint8),
    faces_projector=np.array([[False, True], [True, False]]),
    info=SampleInfo("open", "A", "A", "posture-00", "standing", 215, 0, "train"),
)
