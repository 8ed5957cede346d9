"""The legend: every class with its colour and number, in columns that fit."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from bodyseg_data.drawing import EMPTY, PAPER, colour_range, colour_shares, contact_sheet, draw_legend
from bodyseg_data.labels import PARTS33, LabelMap, classes_of, load_label_map, whole_map


@pytest.mark.parametrize("label_map", [PARTS33, load_label_map("itop15")])
@pytest.mark.parametrize("width", [230, 900])
def test_every_class_is_in_the_legend(label_map: LabelMap, width: int) -> None:
    legend = draw_legend(width, label_map)
    assert legend.width == width
    shown = {tuple(colour) for colour in np.asarray(legend).reshape(-1, 3).tolist()}
    assert {tuple(colour) for colour in label_map.colours.tolist()} <= shown


def test_ranges_are_light_near_and_dark_far_and_empty_where_there_is_none() -> None:
    ramp = np.array([[0, 0, 0], [100, 200, 50], [200, 0, 255]])
    shares = np.array([[-1.0, 0.0, 0.126, 0.5, 0.75, 1.0, 2.0]])
    expected = [[0, 0, 0], [0, 0, 0], [25, 50, 13], [100, 200, 50], [150, 100, 152], [200, 0, 255], [200, 0, 255]]
    assert colour_shares(shares, ramp)[0].tolist() == expected
    light, middle, dark = (contact_sheet._RAMP[place].tolist() for place in (0, 3, 6))
    for image in (np.array([[0, 1000, 2000, 3000]], np.uint16), np.array([[0, 1, 2, 3]], np.float32)):
        assert colour_range(image)[0].tolist() == [list(EMPTY), light, middle, dark]
        np.testing.assert_array_equal(colour_range(torch.tensor(image.astype(np.float32))), colour_range(image))
        assert colour_range(image, far=image[0, 2])[0].tolist() == [list(EMPTY), light, dark, dark]
        assert colour_range(image, near=image[0, 2])[0].tolist() == [list(EMPTY), light, light, dark]
    assert contact_sheet.span_text(np.array([[0, 1500, 4000]], np.uint16), 0.0005) == "0.75 to 2.00 m"
    assert contact_sheet.span_text(np.zeros((2, 2), np.uint16), 0.0005) == "nothing in view"


def inked(legend: Image.Image) -> int:
    """Columns of pixels that hold anything."""
    return int((np.asarray(legend) != PAPER).any(axis=(0, 2)).sum())


def test_a_long_name_is_cut() -> None:
    def named(name: str) -> Image.Image:
        return draw_legend(222, LabelMap("mine", ((name, ("Sellion",)),)))

    assert inked(named("nose")) < inked(named("the nose and more")) < 222
    assert inked(named("the nose " * 40)) < 222
    assert named("the nose " * 40).tobytes() == named("the nose " * 50).tobytes()


def test_numbers_of_three_digits_do_not_touch_their_colours() -> None:
    many = whole_map(classes_of(f"c{number}" for number in range(101)))
    between = np.asarray(draw_legend(222, many))[:, 16:20]
    assert (between == PAPER).all()


def test_letters_with_accents_are_drawn_without() -> None:
    def named(name: str) -> bytes:
        return draw_legend(222, LabelMap("mine", ((name, ("Sellion",)),))).tobytes()

    assert named("Hände, é") == named("Hande, e")
