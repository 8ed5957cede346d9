"""The legend: every class with its colour and number, in columns that fit."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from bodyseg_data.drawing import PAPER, draw_legend
from bodyseg_data.labels import PARTS33, LabelMap, classes_of, load_label_map, whole_map


@pytest.mark.parametrize("label_map", [PARTS33, load_label_map("itop15")])
@pytest.mark.parametrize("width", [230, 900])
def test_every_class_is_in_the_legend(label_map: LabelMap, width: int) -> None:
    legend = draw_legend(width, label_map)
    assert legend.width == width
    shown = {tuple(colour) for colour in np.asarray(legend).reshape(-1, 3).tolist()}
    assert {tuple(colour) for colour in label_map.colours.tolist()} <= shown


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
