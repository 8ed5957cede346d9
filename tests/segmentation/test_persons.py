"""Persons, points, parts and joints of labelled frames, against loops that a reader can check."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from label_networks import Places
from small_rig import SMALL

from bodyseg_data.core import BadConfig
from bodyseg_data.labels import BACKGROUND, LANDMARKS, PARTS33, LabelMap, load_label_map
from bodyseg_data.rigs import Camera
from bodyseg_model.networks import Trained
from bodyseg_model.segmentation import FrameLabeller
from bodyseg_model.segmentation.joints import (
    JOINTS,
    MOST_ERROR_M,
    JointMap,
    code_of,
    feature_points,
    joint_map_from_json,
    shipped_joint_map,
)
from bodyseg_model.segmentation.segmenter import LabelledBody, Segmentation

CAMERA = Camera(12, 16, 20.0, (7.5, 6.5), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
SHAPE = CAMERA.rows, CAMERA.columns
Image = np.ndarray[Any, Any]


def answer_of(
    labels: Image,
    range_m: Image,
    persons: Image,
    confidence: Image | None = None,
    mirrored: bool = False,
    label_map: LabelMap | None = PARTS33,
) -> Segmentation:
    """An answer in which each person's pixels are as `persons` says: 0 for nobody."""
    sure = np.ones(labels.shape, np.float32) if confidence is None else confidence
    found = [np.flatnonzero(persons == number) for number in range(1, persons.max() + 1)]
    bodies = tuple(LabelledBody(pixels, 1.0, 0.0, 1.0, sure.ravel()[pixels]) for pixels in found)
    return Segmentation(labels, bodies, {}, range_m, CAMERA, mirrored=mirrored, label_map=label_map)


def drawn(seed: int, mirrored: bool = False) -> Segmentation:
    draws = np.random.default_rng(seed)
    labels = draws.choice(np.array([0, 3, 17, 32, 254, BACKGROUND], np.uint8), SHAPE)
    range_m = draws.uniform(0.5, 4.0, SHAPE).astype(np.float32)
    range_m[draws.random(SHAPE) < 0.2] = draws.choice([0, np.nan, np.inf, -1])
    return answer_of(labels, range_m, draws.integers(0, 4, SHAPE), draws.random(SHAPE, np.float32), mirrored)


def point_of(answer: Segmentation, row: int, column: int) -> Image:
    z = float(answer.range_m[row, column])
    side = -1 if answer.mirrored else 1
    x = side * (column + 0.5 - CAMERA.centre_px[0]) / CAMERA.focal_px
    return np.array([x * z, (row + 0.5 - CAMERA.centre_px[1]) / CAMERA.focal_px * z, z])


def slow_parts(answer: Segmentation, near: tuple[float, ...]) -> list[tuple[Any, ...]]:
    rows = []
    for person in range(1, len(answer.bodies) + 1):
        for part in range(BACKGROUND):
            seen = (answer.persons == person) & (answer.labels == part) & (answer.range_m > 0) & (answer.range_m < 1e9)
            if not seen.any():
                continue
            places = np.argwhere(seen)
            points = np.array([point_of(answer, *place) for place in places])
            away = np.linalg.norm(points - near, axis=1)
            box = [[places[:, axis].min(), places[:, axis].max() + 1] for axis in (0, 1)]
            sure = answer.confidence[seen].mean()
            area = (points[:, 2] ** 2).sum() / CAMERA.focal_px**2
            rows.append(
                (person, part, len(places), area, *box, points.mean(0), points[away.argmin()], away.min(), sure)
            )
    return rows


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32), st.booleans(), st.sampled_from([(0.0, 0.0, 0.0), (0.3, -0.2, 1.5)]))
def test_parts_are_those_of_a_loop(seed: int, mirrored: bool, near: tuple[float, float, float]) -> None:
    answer = drawn(seed, mirrored)
    parts, slow = answer.parts(near), slow_parts(answer, near)
    assert len(parts) == len(slow)
    for number, name in enumerate(parts.dtype.names or ()):
        np.testing.assert_allclose(parts[name], [row[number] for row in slow], rtol=1e-5, atol=1e-6, err_msg=name)


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 2**32))
def test_points_are_those_of_all_people_with_a_range(seed: int) -> None:
    answer = drawn(seed)
    points = answer.points()
    places = [divmod(pixel, SHAPE[1]) for body in answer.bodies for pixel in body.pixels.tolist()]
    places = [place for place in places if 0 < answer.range_m[place] < np.inf]
    assert len(points) == len(places) and BACKGROUND in points["label"], "unlabelled ones too"
    for name, image in (("label", answer.labels), ("person", answer.persons), ("confidence", answer.confidence)):
        np.testing.assert_array_equal(points[name], [image[place] for place in places])
    found = np.stack([points[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(found, [point_of(answer, *place) for place in places], rtol=1e-5, atol=1e-6)


def test_one_answer_gives_one_set_of_bytes() -> None:
    """They are sent as messages, with those between fields."""
    answer = drawn(3)
    found = set()
    for number in range(20):  # is left in memory that is used again
        _ = [np.full(answer.parts().nbytes, number, np.uint8) for _ in range(20)]
        found.add((answer.parts().tobytes(), answer.points().tobytes()))
    assert len(found) == 1


def test_persons_are_numbered_as_bodies_are() -> None:
    answer = drawn(1)
    assert answer.persons.dtype == np.uint16 and answer.persons.max() == len(answer.bodies) == 3
    for number, body in enumerate(answer.bodies, start=1):
        np.testing.assert_array_equal(np.flatnonzero(answer.persons == number), body.pixels)


def test_frames_without_people_labels_or_ranges_have_no_parts() -> None:
    nobody, everybody = np.zeros(SHAPE, int), np.ones(SHAPE, int)
    for labels, range_m, persons in (
        (np.full(SHAPE, BACKGROUND, np.uint8), np.zeros(SHAPE, np.float32), nobody),
        (np.full(SHAPE, BACKGROUND, np.uint8), np.ones(SHAPE, np.float32), everybody),
        (np.zeros(SHAPE, np.uint8), np.full(SHAPE, np.nan, np.float32), everybody),
    ):
        answer = answer_of(labels, range_m, persons)
        assert len(answer.parts()) == 0 and answer.parts().dtype.names
        assert answer.joints().shape == (len(answer.bodies), len(JOINTS))
        assert np.isnan(answer.joints()["position_m"]).all() and np.isinf(answer.joints()["error_m"]).all()
    assert len(answer.points()) == 0


def test_one_pixel_is_a_part_and_more_than_255_people_keep_apart() -> None:
    persons = np.zeros(SHAPE, int)
    persons.ravel()[:180] = np.arange(1, 181)
    labels = np.full(SHAPE, 7, np.uint8)
    answer = answer_of(labels, np.ones(SHAPE, np.float32), persons)
    answer = Segmentation(labels, answer.bodies * 2, {}, answer.range_m, CAMERA)
    parts = answer.parts()
    assert parts["person"].tolist() == [*range(1, 361)] and (parts["pixels"] == 1).all()
    np.testing.assert_array_equal(parts["centroid_m"], parts["nearest_m"])
    assert (np.diff(parts["rows"]) == 1).all() and (np.diff(parts["columns"]) == 1).all()


@pytest.mark.parametrize("near", [(0.0, 0.0), (0.0, np.nan, 1.0), (0.0, 0.0, np.inf)])
def test_a_point_has_three_finite_coordinates(near: tuple[float, ...]) -> None:
    with pytest.raises(BadConfig, match="a point must have three finite coordinates, metres, found"):
        drawn(0).parts(near)


@pytest.mark.usefixtures("near_is_person")
def test_mirrored_and_turned_cameras_see_the_same_points() -> None:
    """A block, seen by a camera whose driver mirrors, and by one that lies on its side."""
    camera = Camera(60, 80, 100.0, (37.0, 31.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    frame = np.full((60, 80), 4.0, np.float32)
    frame[10:52, 30:42] = 2.0

    def seen(frame: Image, camera: Camera, **options: Any) -> Any:
        trained = Trained(Places(0, 5), {"rig": SMALL.to_json()})
        return FrameLabeller(trained, **options)(frame, camera)

    upright = seen(frame, camera)
    flipped = Camera(60, 80, 100.0, (80 - 37.0, 31.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    mirrored = seen(np.ascontiguousarray(frame[:, ::-1]), flipped, mirrored=True)
    np.testing.assert_array_equal(mirrored.labels[:, ::-1], upright.labels)
    np.testing.assert_allclose(mirrored.parts()["centroid_m"], upright.parts()["centroid_m"], atol=1e-6)
    turned = seen(np.ascontiguousarray(np.rot90(frame)), camera.turned(-1), turned=90)
    x, y, z = upright.parts()["centroid_m"].T  # in the frame of the camera on its side, up is to the left
    np.testing.assert_allclose(turned.parts()["centroid_m"].T, [y, -x, z], atol=1e-6)
    assert turned.range_m.shape == (80, 60) and turned.camera == camera.turned(-1)


def slow_features(answer: Segmentation, codes: Image, least: tuple[int, int]) -> Image:
    found = np.full((len(answer.bodies), len(codes), 3), np.nan)
    persons = answer.persons
    for person in range(len(answer.bodies)):
        for number, code in enumerate(codes):
            pair, points = tuple(divmod(int(code), 256)), []
            for place in np.argwhere(persons == person + 1):
                ends = [tuple(place)] if pair[0] == pair[1] else [tuple(place + step) for step in ((0, 1), (1, 0))]
                for end in ends:
                    both = [tuple(place), end]
                    if any(np.greater_equal(end, SHAPE)) or persons[end] != person + 1:
                        continue
                    z = [answer.range_m[each] for each in both]
                    named = tuple(sorted(int(answer.labels[each]) for each in both)) == pair
                    if named and all(0 < each < np.inf for each in z) and abs(z[0] - z[1]) < 0.05:
                        points.append(np.mean([point_of(answer, *each) for each in both], axis=0))
            if len(points) >= least[pair[0] != pair[1]]:
                found[person, number] = np.mean(points, axis=0)
    return found


def test_features_are_those_of_a_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    draws = np.random.default_rng(52)  # borders at the first pixel, and where the first person's pixels end, too
    labels = draws.choice(np.array([0, 3, 17, 254, BACKGROUND], np.uint8), SHAPE, p=[0.3, 0.3, 0.2, 0.1, 0.1])
    range_m = draws.uniform(1.0, 1.1, SHAPE).astype(np.float32)
    range_m[draws.random(SHAPE) < 0.1] = np.nan
    persons = np.where(np.arange(labels.size).reshape(SHAPE) < 104, 1, 2) * (draws.random(SHAPE) < 0.9)
    answer = answer_of(labels, range_m, persons)
    codes = np.array([code_of(0), code_of(17), code_of(3, 0), code_of(17, 3), code_of(5), code_of(5, 0)])
    assert code_of(0, 3) == code_of(3, 0)
    found = feature_points(answer, codes)
    np.testing.assert_allclose(found, slow_features(answer, codes, (8, 4)), atol=1e-6)
    assert np.isfinite(found[:, :3]).all() and np.isnan(found[:, 4:]).all()


def known_map(moments: Image) -> JointMap:
    """A map whose 15 joints lie 5 cm behind two features."""
    codes = np.array([code_of(0), code_of(0, 3)])
    features, behind = np.tile([0, 1], (15, 1)), np.full((15, 2), 0.05)
    return JointMap(codes, features, behind, np.tile(moments, (15, 1, 1)))


def test_weights_are_of_least_variance_for_what_is_seen() -> None:
    """By hand: two guesses of variances 1 and 4 cm² that err alone count 4 to 1; the mean errs by 0.8 cm²."""
    points = np.array([[[0.0, 0, 2], [0, 0.5, 0]], [[np.nan] * 3, [0, 0.5, 0]], [[np.nan] * 3] * 2])
    places, errors, seen = known_map(np.diag([1e-4, 4e-4]))(points)
    np.testing.assert_allclose(places[0, 7], [0, 0.2 * 0.55, 0.8 * 2.05], atol=1e-8)
    np.testing.assert_allclose(places[1, 0], [0, 0.55, 0], atol=1e-8)
    assert np.isnan(places[2]).all()
    np.testing.assert_allclose(errors[:, 0], [np.sqrt(0.8e-4), 0.02, np.inf], rtol=1e-4)
    np.testing.assert_array_equal(seen[:, 3], [2, 1, 0])
    far, errors, _ = known_map(np.diag([1.1 * MOST_ERROR_M**2] * 2))(points)
    assert np.isnan(far[1]).all() and np.isfinite(far[0]).all() and np.isfinite(errors[1]).all()


def test_the_map_that_ships_is_a_table_of_known_features() -> None:
    shipped = shipped_joint_map()
    assert shipped.features.shape == shipped.behind_m.shape and len(shipped.features) == len(JOINTS) == 15
    assert (np.linalg.eigvalsh(shipped.moments_m2) > 0).all()
    names = {tuple({*divmod(int(code), 256)}) for code in shipped.codes}
    assert all(0 <= part < 33 for each in names for part in each)
    wrist = shipped.codes[shipped.features[JOINTS.index("right_wrist")]]
    assert code_of(LANDMARKS.index("Rt. Radial Styloid")) in wrist


def test_joints_are_of_the_33_parts_alone() -> None:
    limbs = load_label_map("limbs14")
    for label_map, found in ((limbs, "labels 'limbs14'"), (None, "others")):
        answer = answer_of(*(np.ones(SHAPE, kind) for kind in (np.uint8, np.float32, int)), label_map=label_map)
        assert answer.parts()["pixels"].tolist() == [SHAPE[0] * SHAPE[1]]
        with pytest.raises(BadConfig, match=f"joints are found from the 33 parts alone, found {found}"):
            answer.joints()


def test_a_map_comes_back_from_its_table() -> None:
    joint = {"features": [["Sellion"], ["Sellion", "Nuchale"]], "behind_mm": [80, 60], "moments_mm2": [100, 20, 400]}
    read = joint_map_from_json({"joints": [joint] * 15})  # type: ignore[dict-item]
    np.testing.assert_array_equal(read.codes[read.features[4]], [code_of(0), code_of(0, 1)])
    np.testing.assert_allclose(read.behind_m[2], [0.08, 0.06])
    np.testing.assert_allclose(read.moments_m2[14], [[1e-4, 2e-5], [2e-5, 4e-4]])
