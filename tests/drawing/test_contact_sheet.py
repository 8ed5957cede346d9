"""Contact sheets show bodies at a size at which they can be judged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from samples import GOOD

from bodyseg_data.artifacts import VARIANTS, RangeImage, load_sensor_model
from bodyseg_data.drawing import Row, draw_sheet
from bodyseg_data.labels import PARTS33, LabelMap

BODY = (112, 116, 124)
"""Grey of pixels with a range and without a label."""


def sheet(columns: int, first: int, other: int | None = None, label: int = 255, of: LabelMap = PARTS33) -> Image.Image:
    """Sheet of samples of 100 rows, whose bodies fill 60 rows and 20 columns from `first` and `other` on."""
    rows = []
    for column in (first,) if other is None else (first, other):
        stored = np.zeros((100, columns), np.uint16)
        stored[20:80, column : column + 20] = 2000
        labels = np.where(stored, np.uint8(label), np.uint8(255))
        sample = replace(GOOD, range=stored, projector_range=stored, labels=labels)
        image = RangeImage(sample.key, stored, labels, {})
        rows.append(Row(sample, 0.001, dict.fromkeys(VARIANTS, image)))
    return draw_sheet(rows, "none", "title", load_sensor_model("paper"), of)


def body_pixels(picture: Image.Image) -> int:
    """Grey pixels of the two panels of labels of all rows."""
    return int((np.asarray(picture) == BODY).all(axis=-1).sum())


def test_panels_of_a_wide_camera_are_cropped_to_the_bodies_of_all_rows() -> None:
    # Of 100 x 400 pixels, 480 x 120 on the sheet, the margin leaves 70 x 30, and all 320 rows of a panel.
    assert body_pixels(sheet(400, 100)) == pytest.approx(2 * 60 * 20 * (320 / 70) ** 2, rel=0.05)
    both = sheet(400, 100, 180)  # 116 columns and 76 rows with the margin of 8
    assert body_pixels(both) == pytest.approx(2 * 2 * 60 * 20 * (320 / 76) ** 2, rel=0.05)


def test_panels_stay_whole_where_bodies_fill_them() -> None:
    assert body_pixels(sheet(50, 10)) == pytest.approx(2 * 60 * 20 * (320 / 100) ** 2, rel=0.01)
    assert body_pixels(sheet(400, 10, 370)) == pytest.approx(2 * 2 * 60 * 20 * (480 / 400) ** 2, rel=0.01)


def test_parts_that_a_label_map_leaves_out_are_not_drawn_as_nothing_measured() -> None:
    elbows = LabelMap("elbows", (("elbow", ("Rt. Olecranon", "Lt. Olecranon")),))
    assert body_pixels(sheet(50, 10, label=3, of=elbows)) == body_pixels(sheet(50, 10))
    assert body_pixels(sheet(50, 10, label=17, of=elbows)) == 0


def test_panels_of_an_empty_image_are_whole() -> None:
    empty = np.zeros((40, 400), np.uint16)
    labels = np.full(empty.shape, 255, np.uint8)
    row = Row(
        replace(GOOD, range=empty, projector_range=empty, labels=labels),
        0.001,
        dict.fromkeys(VARIANTS, RangeImage("k", empty, labels, {})),
    )
    assert body_pixels(draw_sheet([row], "none", "title", load_sensor_model("paper"))) == 0
