"""From a frame to labels and back to its own pixels, and what is made of them: flicker, pictures."""

from __future__ import annotations

import io
import os
import re
import signal
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from label_networks import Places
from numpy.typing import NDArray
from PIL import Image

from bodyseg_data.core import BadConfig, MissingLibrary, Stopwatch
from bodyseg_data.drawing import draw_legend
from bodyseg_data.labels import BACKGROUND, PARTS33, classes_of, load_label_map, whole_map
from bodyseg_data.labels.label_map import COLOURS
from bodyseg_data.rigs import Camera
from bodyseg_model.segmentation import (
    Background,
    FrameLabeller,
    Preview,
    Segmenter,
    SequenceSummary,
    draw_overlay,
    find_bodies,
    flicker,
    pictures,
)
from bodyseg_model.segmentation.pictures import MOST_FRAMES
from bodyseg_model.segmentation.segmenter import STAGES
from bodyseg_model.segmentation.sequence_summary import STAGES as ALL_STAGES
from bodyseg_model.segmentation.sequence_summary import flicker_shares

LENS = Camera(60, 80, 100.0, (40.0, 30.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
KEEP = Background("keep")


pytestmark = pytest.mark.usefixtures("one_thread", "near_is_person")


def standing(x: int, z: float, height: int = 40, width: int = 12) -> NDArray[np.float32]:
    """A frame with a block from column x on."""
    frame = np.zeros((60, 80), np.float32)
    frame[10 : 10 + height, x : x + width] = z
    return frame


def test_labels_come_back_to_the_pixels_that_they_are_of() -> None:
    frame = standing(34, 2.0)  # in the middle of the frame, so that the view is not turned
    network = Places(axis=0, step=11)
    result = Segmenter(network, LENS, KEEP)(frame)
    scale = 757.5757 / 2.5 / (100 / 2.0)
    (body,) = result.bodies
    assert body.scale == pytest.approx(scale, rel=1e-6)
    assert (body.median_range_m, body.turn_rad) == pytest.approx((2.0, 0.0))
    np.testing.assert_array_equal(body.pixels, np.flatnonzero(frame))
    np.testing.assert_array_equal(result.labels == BACKGROUND, frame == 0)
    # The block's rows in the paper's image, and the view's first row there: 640 rows with the block in their middle.
    edges = 320 + (np.array([10, 50]) - 30) * scale
    first = (np.floor(edges[0]) + np.ceil(edges[1]) - 640) // 2
    expected = np.minimum((np.floor(edges[0] + (np.arange(40) + 0.5) * scale) - first) // 11, 32)
    np.testing.assert_array_equal(result.labels[10:50, 34:46], np.repeat(expected[:, None], 12, axis=1))


def test_a_segmenter_and_its_results_print_in_one_line() -> None:
    segmenter = Segmenter(Places(axis=0, step=11), LENS, KEEP)
    assert repr(segmenter) == (
        "Segmenter(Places on cpu, 60 x 80 pixels, focal length 100 px, Background(mode='keep', near_m=0.4, far_m=6.0))"
    )
    result = repr(segmenter(standing(34, 2.0)))
    assert result.startswith("Segmentation(bodies=(LabelledBody(median_range_m=2.0, turn_rad=") and "\n" not in result


def test_the_network_sees_a_body_at_its_distance() -> None:
    network = Places(axis=0, step=11)
    Segmenter(network, LENS, KEEP)(standing(34, 4.0))
    (image,) = network.seen
    assert image.shape[:2] == (1, 1) and image.dtype == torch.float32
    assert torch.unique(image).tolist() == pytest.approx([0, 2.5])
    body = image[0, 0] > 0
    assert int(body.any(1).sum()) == pytest.approx(40 * 4 * 3.0303, abs=1)
    assert int(body.any(0).sum()) == pytest.approx(12 * 4 * 3.0303, abs=1)


def test_every_body_is_seen_by_itself_and_every_pixel_labelled_once() -> None:
    frame = standing(5, 2.0) + standing(40, 3.0, height=30)
    network = Places(axis=1, step=40)
    result = Segmenter(network, LENS)(frame)
    assert len(result.bodies) == sum(len(images) for images in network.seen) == 2
    pixels = np.concatenate([body.pixels for body in result.bodies])
    assert len(np.unique(pixels)) == len(pixels) == result.pixels == np.count_nonzero(frame)
    np.testing.assert_array_equal(result.labels != BACKGROUND, frame > 0)
    for body, z in zip(result.bodies, (3.0, 2.0), strict=True):
        assert body.median_range_m == pytest.approx(z, rel=0.05) and body.scale == pytest.approx(
            body.median_range_m * 3.0303, rel=1e-4
        )
        assert len(np.unique(result.labels.ravel()[body.pixels])) in (2, 3, 4)


def test_mirrored_frames_are_labelled_the_other_way_round() -> None:
    frame = standing(31, 2.5)
    plain, mirrored = (Segmenter(Places(1, 6), LENS, KEEP, mirrored=mirrored)(frame) for mirrored in (False, True))
    row, other = plain.labels[20, 31:43].astype(int), mirrored.labels[20, 31:43].astype(int)
    assert (np.diff(row) >= 0).all() and row[0] < row[-1]
    assert np.abs(row - other[::-1]).max() <= 1, "the two rasters are half a pixel apart"
    assert other[0] > other[-1]


def test_a_label_map_has_the_networks_classes() -> None:
    with pytest.raises(BadConfig, match="^the network must have the 14 classes of labels 'limbs14', found 33$"):
        Segmenter(Places(1, 6), LENS, KEEP, label_map=load_label_map("limbs14"))


def test_unsure_pixels_get_no_label_but_still_count() -> None:
    frame = standing(20, 2.0)
    frame[30:] += np.where(frame[30:] > 0, np.float32(0.2), np.float32(0))
    result = Segmenter(Places(0, 50, sure_m=2.55), LENS, KEEP, least_confidence=0.7)(frame)
    (body,) = result.bodies
    unsure = (body.pixels // 80) >= 30
    np.testing.assert_allclose(body.confidence[unsure], 0.525, atol=0.001)
    np.testing.assert_allclose(body.confidence[~unsure], 1, atol=1e-6)
    np.testing.assert_array_equal(result.labels.ravel()[body.pixels] == BACKGROUND, unsure)
    assert result.pixels == 480
    assert result.mean_confidence == pytest.approx(1 - unsure.mean() * 0.475, abs=0.001)


@pytest.mark.parametrize("frame", [np.zeros((60, 80), np.float32), standing(20, 9.0)], ids=["empty", "far"])
def test_where_nobody_is_nothing_is_labelled(frame: NDArray[np.float32]) -> None:
    network = Places(0, 10)
    result = Segmenter(network, LENS)(frame)
    assert (result.labels == BACKGROUND).all() and result.bodies == () and result.mean_confidence is None
    assert result.pixels == 0 and not network.seen


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1)])
def test_tiny_frames(shape: tuple[int, int]) -> None:
    lens = Camera(*shape, 100.0, (0.5, 0.5), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    result = Segmenter(Places(0, 10), lens, KEEP)(np.full(shape, 2.0, np.float32))
    assert (result.labels != BACKGROUND).all()
    assert Segmenter(Places(0, 10), lens)(np.full(shape, 2.0, np.float32)).bodies == ()


def test_a_body_that_touches_all_borders() -> None:
    frame = np.full((60, 80), 2.0, np.float32)
    frame[:5, :30] = 0
    assert (Segmenter(Places(0, 10), LENS, KEEP)(frame).labels != BACKGROUND).sum() == np.count_nonzero(frame)


def test_a_fork_labels_though_its_parent_has_computed_in_threads() -> None:
    segmenter, frame = Segmenter(Places(axis=0, step=11), LENS, KEEP), standing(34, 2.0)
    torch.set_num_threads(2)
    torch.ones(1 << 20).exp()  # from here on there are two
    child = os.fork()
    if child == 0:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(30)  # ends a hang
        torch.ones(1 << 20).exp()
        os._exit(len(segmenter(frame).bodies))
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 1


def test_every_stage_is_timed() -> None:
    result = Segmenter(Places(0, 10), LENS)(standing(20, 2.0))
    assert tuple(result.milliseconds) == STAGES
    assert all(spent > 0 for stage, spent in result.milliseconds.items() if stage != "video")
    assert result.milliseconds["video"] == 0, "frames are labelled one by one"


def test_the_examples_of_the_page_run(capsys: pytest.CaptureFixture[str]) -> None:
    page = Path(__file__).parents[2] / "docs" / "how-to" / "segment.md"
    blocks = re.findall(r"```python\n(.*?)```", page.read_text(), re.S)
    names: dict[str, Any] = {}
    exec("\n".join(blocks), names)
    assert len(blocks) == 3 and isinstance(names["label"], FrameLabeller)
    for answer in (names["result"], names["answer"]):
        assert answer.labels.shape == answer.confidence.shape == (480, 640)
        assert tuple(answer.milliseconds) == ("read", *STAGES)


def test_a_stopwatch_adds_up(monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter([1.0, 1.5, 2.0, 2.25])
    monkeypatch.setattr("bodyseg_data.core.progress.time.perf_counter", lambda: next(times))
    watch = Stopwatch(("a", "b"))
    for _ in range(2):
        with watch("b"):
            pass
    assert watch.milliseconds == {"a": 0.0, "b": 750.0}


def test_what_a_segmenter_refuses() -> None:
    with pytest.raises(BadConfig, match="^a confidence must be 0 to 1, found 70$"):
        Segmenter(Places(0, 10), LENS, least_confidence=70)
    with pytest.raises(BadConfig, match="^a frame must have .* 60 x 80, found 80 x 60$"):
        Segmenter(Places(0, 10), LENS)(np.zeros((80, 60), np.float32))


def test_what_is_found_is_what_is_labelled() -> None:
    frame = standing(5, 2.0) + standing(40, 3.0, height=30)
    found = find_bodies(frame, LENS, Background())
    for body, (pixels, person) in zip(Segmenter(Places(0, 10), LENS)(frame).bodies, found, strict=True):
        np.testing.assert_array_equal(body.pixels, pixels)
        assert body.person == person == pytest.approx(0.999, abs=1e-3)


# Flicker.


def test_flicker_counts_what_is_in_both_frames() -> None:
    none = BACKGROUND
    labels = np.array([[1, 1, 2, 3, none, none, 4]], np.uint8)
    later = np.array([[1, 2, 2, none, none, 5, 5]], np.uint8)
    ranges = np.array([[2.0, 2.0, 2.0, 2.0, 0.0, 0.0, 2.0]], np.float32)
    moved = ranges + np.array([[0.0, 0.019, 0.03, 0.0, 0.0, 2.0, 0.5]], np.float32)
    frames: list[Any] = [SimpleNamespace(labels=labels, range_m=ranges), SimpleNamespace(labels=later, range_m=moved)]
    change = flicker(*frames)
    assert change == {"shared": 4, "changed": 2, "still": 2, "still_changed": 1}
    assert flicker_shares(change) == {"shared_pixels": 4, "changed": 0.5, "still_pixels": 2, "still_changed": 0.5}
    assert flicker_shares(change + Counter(shared=4))["changed"] == 0.25
    nothing = {"shared_pixels": 0, "changed": None, "still_pixels": 0, "still_changed": None}
    assert flicker_shares(Counter()) == nothing


def summed(*frames: NDArray[np.float32], axis: int = 0) -> SequenceSummary:
    summary = SequenceSummary()
    segmenter = Segmenter(Places(axis, 11), LENS)
    for number, frame in enumerate(frames):
        result = segmenter(frame)
        times = {stage: float(100 if number == 0 else number) for stage in ALL_STAGES}
        summary.add(result, times)
    return summary


def test_a_summary_is_of_all_frames() -> None:
    frames = [
        standing(34, 2.0),
        standing(34, 2.0),
        np.zeros((60, 80), np.float32),
        standing(5, 2.0) + standing(40, 3.0),
    ]
    report: dict[str, Any] = summed(*frames).to_json()
    assert (report["frames"], report["frames_with_people"], report["people"]) == (4, 3, 4)
    assert report["pixels"] == report["labelled"] == sum(int(np.count_nonzero(frame)) for frame in frames)
    assert report["mean_confidence"] == pytest.approx(1, abs=1e-4)
    assert [frame["people"] for frame in report["each"]] == [1, 1, 0, 2]
    first = report["each"][0]
    assert first["flicker"] is None
    assert first["bodies"] == [
        {
            "pixels": 480,
            "box": [10, 34, 50, 46],
            "range_m": 2.0,
            "turn_deg": 0.0,
            "scale": 6.0606,
            "mean_confidence": 1.0,
            "person": 0.9997,
        }
    ]
    assert report["each"][1]["flicker"]["changed"] == report["flicker"]["changed"] == 0.0
    assert report["each"][2]["flicker"]["shared_pixels"] == 0
    # Frames 1, 2 and 3 count: 1, 2 and 3 ms.
    assert report["ms"]["network"] == {"mean": 2.0, "sd": 0.82, "p95": 2.9}
    assert report["ms"]["frame"]["mean"] == 2.0 * (len(ALL_STAGES) - 1), "writing is beside the next frame"
    assert report["ms"]["first_frame_counted"] is False


def test_the_mean_of_all_frames_is_not_that_of_rounded_ones() -> None:
    found, summary = Segmenter(Places(0, 11), LENS)(standing(34, 2.0)), SequenceSummary()
    (body,) = found.bodies
    for sure in (0.50004, 0.50004, 0.50014):
        alike = replace(body, confidence=np.full(len(body.pixels), sure, np.float32))
        summary.add(replace(found, bodies=(alike,)), dict.fromkeys(ALL_STAGES, 1.0))
    assert summary.mean_confidence == pytest.approx(1.50022 / 3, abs=1e-7)
    assert summary.to_json()["mean_confidence"] == 0.5001


def test_a_summary_of_one_frame_or_of_nobody() -> None:
    alone = summed(standing(20, 2.0)).to_json()
    assert alone["ms"]["first_frame_counted"] is True and alone["ms"]["read"]["mean"] == 100.0
    nobody = summed(np.zeros((60, 80), np.float32)).to_json()
    assert nobody["mean_confidence"] is None and nobody["each"][0]["mean_confidence"] is None


def test_labels_that_change_are_flicker() -> None:
    shifted = summed(standing(20, 2.0), standing(23, 2.0), axis=1).to_json()["flicker"]
    assert shifted["shared_pixels"] == shifted["still_pixels"] == 9 * 40
    assert shifted["changed"] > 0.5


# Pictures.


def test_an_overlay_shows_parts_unknown_and_room() -> None:
    frame = np.zeros((6, 8), np.float32)
    frame[:, :2], frame[1:5, 3:7], frame[1:5, 7] = 4.0, 2.0, 2.5
    labels = np.full(frame.shape, BACKGROUND, np.uint8)
    labels[1:5, 3:5] = 7
    labels[1:5, 7] = 7
    picture = draw_overlay(frame, labels, [np.flatnonzero((frame > 0) & (frame < 3))])
    assert picture.dtype == np.uint8 and picture.shape == (6, 8, 3)
    np.testing.assert_array_equal(picture[2, 3], COLOURS[7])
    assert (picture[2, 7].astype(int) < COLOURS[7]).all(), "farther is darker"
    np.testing.assert_allclose(picture[2, 7], 0.55 * COLOURS[7], atol=1)
    unknown, room, empty = picture[2, 5], picture[2, 0], picture[0, 4]
    assert len(set(unknown)) == len(set(room)) == 1
    assert unknown[0] > 130 > 100 > room[0] > empty.max()


def test_overlays_have_the_colours_of_their_table() -> None:
    draws = np.random.default_rng(6)
    frame = np.where(draws.random((50, 70)) < 0.9, draws.uniform(0.5, 5, (50, 70)), 0).astype(np.float32)
    labels = draws.integers(0, 40, frame.shape).astype(np.uint8)  # some are of no class
    bodies = np.array_split(np.flatnonzero((frame > 0) & (frame < 3)), 2)
    picture, table, expected = draw_overlay(frame, labels, bodies), pictures._table(PARTS33), []
    flat = frame.ravel()
    for pixels, group in ((np.arange(flat.size), None), *((body, labels.ravel()[body]) for body in bodies)):
        some = np.sort(flat[pixels])
        near, far = (some[some > 0][int(share * (some > 0).sum())] for share in (0.02, 0.98))
        depth = np.clip((flat[pixels] - near) * np.float32(127 / float(far - near)) + np.float32(0.5), 0, 127)
        row = 0 if group is None else 1 + np.minimum(group, 33).astype(int)
        expected.append(np.where(flat[pixels, None] > 0, table[row, depth.astype(int)], table[-1, 0]))
    whole = expected[0]
    for pixels, colours in zip(bodies, expected[1:], strict=True):
        whole[pixels] = colours
    np.testing.assert_array_equal(picture.reshape(-1, 3), whole)


def test_what_is_no_range_is_drawn_as_not_measured() -> None:
    frame, labels = np.full((20, 30), 2.0, np.float32), np.full((20, 30), 4, np.uint8)
    frame[:, 15:] = 3.5
    frame[0, :4] = 0
    bodies = [np.arange(60)]
    expected = draw_overlay(frame, labels, bodies)
    frame[0, :4] = np.nan, np.inf, -np.inf, -1
    np.testing.assert_array_equal(draw_overlay(frame, labels, bodies), expected)


def test_without_numba_one_line_says_which_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(
        MissingLibrary, match=r"^labelling frames needs the package 'numba': pip install 'bodyseg\[segment\]' "
    ):
        Segmenter(Places(0, 10), Camera(50, 70, 60.0, (35.0, 25.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)))


def test_an_overlay_of_nothing() -> None:
    nothing = np.zeros((3, 4), np.float32)
    picture = draw_overlay(nothing, np.full((3, 4), BACKGROUND, np.uint8), [])
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) == 1


def test_a_preview_plays_all_frames_at_its_rate() -> None:
    preview = Preview(30)
    for label in (3, 9, 20):
        labels = np.full((700, 500), label, np.uint8)
        preview.add(draw_overlay(np.full((700, 500), 2.0, np.float32), labels, [np.arange(350000)]))
    with Image.open(io.BytesIO(preview.to_gif())) as animation:
        assert (getattr(animation, "n_frames"), animation.size) == (3, (167, 234))  # noqa: B009  not in its type
        assert animation.info["duration"] == 30 and animation.info["loop"] == 0
        for number, label in enumerate((3, 9, 20)):
            animation.seek(number)
            colour = np.asarray(animation.convert("RGB"))[100, 100].astype(int)
            assert np.abs(colour - COLOURS[label]).max() <= 2


def test_a_preview_has_an_end() -> None:
    preview = Preview(10)
    for number in range(MOST_FRAMES + 5):  # equal frames would be one
        preview.add(np.full((2, 2, 3), 255 * (number % 2), np.uint8))
    with Image.open(io.BytesIO(preview.to_gif())) as animation:
        assert getattr(animation, "n_frames") == MOST_FRAMES  # noqa: B009  not in its type


@pytest.mark.parametrize("rate", [0, -1, 51, float("nan"), float("inf")])
def test_rates_that_no_preview_has(rate: float) -> None:
    with pytest.raises(BadConfig, match="^a preview shows 0.1 to 50 frames per second, found"):
        Preview(rate)


def test_a_preview_has_the_colours_of_its_classes() -> None:
    limbs = load_label_map("limbs14")
    preview = Preview(10, limbs)
    for label in range(14):
        frame, labels = np.full((8, 8), 2.0, np.float32), np.full((8, 8), label, np.uint8)
        preview.add(draw_overlay(frame, labels, [np.arange(64)], limbs))
    with Image.open(io.BytesIO(preview.to_gif())) as animation:
        for label in range(14):
            animation.seek(label)
            colour = np.asarray(animation.convert("RGB"))[4, 4].astype(int)
            assert np.abs(colour - limbs.colours[label]).max() <= 2
    for classes in (43, 254):  # of which a palette does not hold all brightnesses
        many = whole_map(classes_of([f"class {number}" for number in range(classes)]))
        preview = Preview(10, many)
        labels = np.full((8, 8), classes - 1, np.uint8)
        preview.add(draw_overlay(frame, labels, [np.arange(64)], many))
        with Image.open(io.BytesIO(preview.to_gif())) as animation:
            assert np.abs(np.asarray(animation.convert("RGB"))[4, 4] - many.colours[-1].astype(int)).max() <= 2
    unknown = draw_overlay(frame, np.full((8, 8), 20, np.uint8), [np.arange(64)], limbs)[4, 4]
    assert len(set(unknown.tolist())) == 1, "a label of no class is grey"


def test_the_legend_has_every_colour() -> None:
    found = {tuple(colour) for colour in np.asarray(draw_legend(900, PARTS33)).reshape(-1, 3)}
    assert {tuple(colour) for colour in COLOURS} <= found
