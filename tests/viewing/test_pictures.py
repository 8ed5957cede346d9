"""Panels in lines, legends and facts as HTML, and saved pictures."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from bodyseg_data.drawing import EMPTY, PAPER
from bodyseg_data.labels import PARTS33, label_map_names, load_label_map
from bodyseg_model.viewing.page import picture_file
from bodyseg_model.viewing.pictures import (
    CONFIDENCE_LEGEND,
    KIND_LEGEND,
    WIDTH,
    Drawing,
    Layout,
    Panel,
    Points,
    class_image,
    class_legend,
    facts_html,
    legend_html,
    legible,
    luminance,
    share_image,
    sheet_of,
)
from bodyseg_model.viewing.recording_view import FLICKER_LEGEND


def test_panels_lie_side_by_side_at_one_size() -> None:
    layout = Layout.of(2, (40, 20))
    image = np.zeros((40, 20, 3), np.uint8)
    image[:20] = 200
    panels = [Panel("one", layout.reduced(image)), Panel("two", layout.reduced(np.full_like(image, 90)), "note")]
    picture = layout.draw([panels, panels[:1]])
    assert picture.shape[1] == WIDTH
    assert np.count_nonzero((picture == 200).all(-1)) == 2 * layout.rows // 2 * layout.width
    assert np.count_nonzero((picture == 90).all(-1)) >= layout.rows * layout.width
    columns = np.flatnonzero((picture == 90).all(-1).sum(0) >= layout.rows)
    assert columns[0] > np.flatnonzero((picture == 200).all(-1).any(0))[-1]


@pytest.mark.parametrize("further", ["", ", 12 ghosts, 5% in bands, waves of 3 mm"])
def test_words_of_a_sensors_draws_are_not_cut_off(further: str) -> None:
    layout = Layout.of(5, (40, 20))
    note = f"noise 2 mm, 0% missing, 13% in patches{further}"
    panel = Panel("all", np.zeros((layout.rows, layout.width, 3), np.uint8), note)
    picture = layout.draw([[panel] * 5])
    free = np.r_[:8, *(np.arange(left - 8, left) for left, *_ in layout.boxes(0)), WIDTH - 8 : WIDTH]
    assert (picture[:, free] == PAPER).all() and (picture[-8:] == PAPER).all()


def test_reduced_images_hold_pixels_of_the_image() -> None:
    image = np.arange(600 * 300).reshape(600, 300)
    small = Layout.of(5, (600, 300)).reduced(image)
    assert small.shape[0] < 600 and np.isin(small, image).all() and (np.diff(small[:, 0]) > 0).all()


def test_shares_go_from_red_to_green() -> None:
    image = share_image(np.array([[0, 0.5, 1, 1]], np.float32), np.array([[True, True, True, False]]))[0]
    assert [tuple(pixel) for pixel in image.tolist()] == [(196, 40, 52), (236, 196, 76), (38, 150, 96), EMPTY]


def test_kinds_have_the_colours_of_their_legend() -> None:
    kinds = np.array([[0, 1, 2, 3, 4, 255, 255]], np.uint8)
    measured = np.array([[True, True, True, True, True, True, False]])
    image = class_image(kinds, measured, np.array([colour for _, colour in KIND_LEGEND], np.uint8))[0]
    assert [tuple(pixel) for pixel in image[:5].tolist()] == [colour for _, colour in KIND_LEGEND]
    assert tuple(image[5].tolist()) not in {tuple(image[6].tolist()), *(colour for _, colour in KIND_LEGEND)}


def test_names_cannot_become_html() -> None:
    assert legend_html((("a<b>", (1, 2, 3)),), 2).count("a&lt;b&gt;") == 1
    assert "rgb(1, 2, 3)" in legend_html((("a", (1, 2, 3)),), 2)
    assert facts_html(["<i>", "second"], "no & no").count("<i>") == 0
    assert "no &amp; no" in facts_html([], "no & no") and "color" not in facts_html(["fact"])
    assert class_legend(PARTS33)[0][0] == "0 Sellion" and class_legend(PARTS33)[32][0].startswith("32 ")


@pytest.mark.parametrize("name", label_map_names())
def test_colours_hold_on_the_white_page_and_in_black_images(name: str) -> None:
    label_map = load_label_map(name)
    shown = legible(label_map.colours)
    of_legend = [colour for legend in (KIND_LEGEND, CONFIDENCE_LEGEND, FLICKER_LEGEND) for _, colour in legend]
    assert [colour for _, colour in class_legend(label_map)] == [tuple(colour) for colour in shown.tolist()]
    for bright in luminance(np.array([*shown.tolist(), *of_legend])):
        assert 1.05 / (bright + 0.05) >= 1.6 and (bright + 0.05) / (luminance(np.array(EMPTY)) + 0.05) >= 1.6
    assert len({tuple(colour) for colour in shown.tolist()}) == len(label_map)
    extreme = legible(np.array([[255, 255, 255], [0, 0, 0], [120, 130, 140]], np.uint8))
    assert extreme[0, 0] < 215 and extreme[1, 0] > 50 and extreme[2].tolist() == [120, 130, 140]


def test_saved_pictures_have_the_panels_the_view_and_the_facts() -> None:
    picture, view = np.full((50, 60, 3), 10, np.uint8), np.full((100, 40, 3), 77, np.uint8)
    sheet = np.asarray(sheet_of(picture, view, ["name", "fact"]))
    assert np.count_nonzero((sheet == 10).all(-1)) == 50 * 60
    assert np.count_nonzero((sheet == 77).all(-1)) == 50 * 20
    points = Points(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
    drawing = Drawing(points, {}, picture, ("left/../1",), 0.01, 0, ())
    name, data = picture_file(drawing, view)
    assert name == "left____1.png"
    assert Image.open(io.BytesIO(data)).size[0] == 80
