from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from samples import GOOD

from bodyseg_data.core import BadSample
from bodyseg_data.samples import SHADOW_THRESHOLDS, Sample, SampleInfo, View, check_key, info_from_json, shape_of, steps
from bodyseg_data.samples.sample import ShadowThresholds


def test_a_good_sample_passes() -> None:
    GOOD.check()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: replace(s, key="a.b"), "a sample key must be"),
        (lambda s: replace(s, range=s.range.astype(np.int32)), r"range must be uint16 \[H, W\], found int32"),
        (lambda s: replace(s, labels=s.labels[0]), r"labels must be uint8 \[H, W\], found uint8 \(2,\)"),
        (lambda s: replace(s, projector_range=s.projector_range[:0]), r"projector_range must be .*\(0, 2\)"),
        (lambda s: replace(s, labels=s.labels[:1]), "must have one shape"),
        (lambda s: replace(s, labels=np.full_like(s.labels, 3)), "labels must be 255 exactly where range is 0"),
        (lambda s: replace(s, range=np.ones_like(s.range)), "labels must be 255 exactly where range is 0"),
        (lambda s: replace(s, labels=s.labels + np.uint8(33) * (s.range > 1)), "labels must be 0 to 32, found 38"),
        (lambda s: replace(s, faces_projector=s.range == 0), "background cannot face the projector"),
        (lambda s: replace(s, faces_second=s.range == 0), "background cannot face the projector"),
        (lambda s: replace(s, faces_second=s.range[:1] > 0), r"must have one shape, found .*\(1, 2\)$"),
        (lambda s: replace(s, faces_second=s.labels), r"faces_second must be bool \[H, W\], found uint8"),
    ],
)
def test_broken_samples_are_refused(change: Callable[[Sample], Sample], message: str) -> None:
    with pytest.raises(BadSample, match=message):
        change(GOOD).check()


def test_a_surface_without_a_class_has_a_range_and_no_label() -> None:
    replace(GOOD, labels=np.array([[255, 0], [254, 5]], np.uint8)).check()
    with pytest.raises(BadSample, match="labels must be 255 exactly where range is 0"):
        replace(GOOD, labels=np.array([[254, 0], [254, 5]], np.uint8)).check()
    with pytest.raises(BadSample, match="labels must be 0 to 4, found 5"):
        replace(GOOD, labels=np.array([[255, 0], [254, 5]], np.uint8)).check(classes=5)
    replace(GOOD, labels=np.array([[255, 253], [254, 5]], np.uint8)).check(classes=254)


def test_planes_are_images_of_integers_as_large_as_the_range() -> None:
    replace(GOOD, planes={"instances": np.ones((2, 2), np.uint16)}).check()
    with pytest.raises(BadSample, match=r"plane 'instances' must be uint8 or uint16, as large: int32"):
        replace(GOOD, planes={"instances": np.ones((2, 2), np.int32)}).check()


def test_a_description_has_any_fields() -> None:
    info = SampleInfo("test", {"robot": "r1", "reach_mm": 80, "lux": 0.5, "holds": True, "pose_m": (1.0, 2.0)})
    assert info_from_json(json.loads(json.dumps(info.to_json())), "k") == info
    assert (info.robot, info.get("lux"), info.get("age", 7), info.view) == ("r1", 0.5, 7, None)
    assert info.with_fields(lux=1.5).lux == 1.5 and info.lux == 0.5
    with pytest.raises(AttributeError, match="no field 'age'"):
        _ = info.age
    assert GOOD.info.view == View(215, 0) and GOOD.info.with_fields(roll_deg=3).view == View(215, 0, roll_deg=3)
    assert pickle.loads(pickle.dumps(info)) == info


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"Robot": "r1"},
            r"a lower-case name like 'subject', none of \('split', 'key', 'fields', 'view', 'get'\), found 'Robot'",
        ),
        ({"key": "r1"}, "a field must have a lower-case name"),
        ({"robot": None}, "field 'robot' must be text, a whole number, a number, true or false, or a tuple of numbers"),
        ({"lux": float("nan")}, "field 'lux' must hold finite numbers"),
        ({"lux": (1.0, 2)}, "field 'lux' must hold finite numbers"),
        ({"count": 2**53}, r"field 'count' must be below 2\*\*53"),
        ({"robot": "a\n"}, "field 'robot' must be text that can be printed"),
        ({f"x{number}": 1 for number in range(65)}, "a description has at most 64 fields, found 65"),
    ],
)
def test_fields_that_are_none(fields: Any, message: str) -> None:
    with pytest.raises(BadSample, match=message):
        SampleInfo("train", fields)


def test_another_split_is_refused() -> None:
    with pytest.raises(BadSample, match="k: 'split' must be one of train, test, found 'val'"):
        info_from_json({"split": "val"}, "k")
    with pytest.raises(BadSample, match="k: the description must be an object with a 'split'"):
        info_from_json([], "k")


@pytest.mark.parametrize("key", ["", "a.b", "a/b", "../a", "a b", "ä", "x" * 81, "a\n"])
def test_keys_that_readers_of_tars_would_split_are_refused(key: str) -> None:
    with pytest.raises(BadSample, match="a sample key must be"):
        check_key(key)


def test_ranges_become_steps() -> None:
    metres = np.array([0.0, 2.15, 2.15004, 2.15006, 0.00001, 6.5535])
    assert steps(metres, 1e-4, "x").tolist() == [0, 21500, 21500, 21501, 1, 65535]
    assert steps(metres, 1e-3, "x").tolist() == [0, 2150, 2150, 2150, 1, 6553]
    assert steps(np.array([65.5354]), 1e-3, "x").tolist() == [65535]


@pytest.mark.parametrize("metres", [6.55356, -0.1, float("nan"), float("inf")])
def test_ranges_that_do_not_fit_are_refused_and_never_wrap_around(metres: float) -> None:
    images: NDArray[np.float32] = np.array([[1.0, metres]], np.float32)
    with pytest.raises(BadSample, match="x: a range must be 0 to 6.5535 m, 65535 steps of 0.1 mm, found"):
        steps(images, 1e-4, "x")


def test_thresholds_are_counted_in_stored_steps() -> None:
    for step_mm, expected in ((0.1, (60, 200)), (0.25, (24, 80)), (1, (6, 20)), (2, (3, 10)), (10, (1, 2))):
        step_m = step_mm / 1000
        assert SHADOW_THRESHOLDS.in_steps(step_m) == expected
    gap, edge = ShadowThresholds(surface_gap_m=0.00126, edge_m=0.1).in_steps(1e-4)
    assert (gap, edge) == (13, 1000)
    assert gap.dtype == edge.dtype == np.float32
    assert ShadowThresholds(0.001, 0.002).in_steps(0.01) == (1, 1)


def test_a_sample_is_shown_in_a_line() -> None:
    assert repr(GOOD) == f"Sample('{GOOD.key}', camera 2 x 2, projector 1 x 2, {GOOD.info})"
    assert repr(replace(GOOD, projector_range=None)) == f"Sample('{GOOD.key}', camera 2 x 2, projector no, {GOOD.info})"
    assert shape_of(np.zeros((3, 4))) == "3 x 4"
