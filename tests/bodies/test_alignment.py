"""Units and axes: every one of the 24 ways a file may hold a body, in every unit, and what cannot be told."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray
from people_on_disk import PERSON, VERTICES, turn

from bodyseg_data.bodies import metres_a_unit
from bodyseg_data.bodies.alignment import Alignment, find_alignment, upright_rotation
from bodyseg_data.bodies.source import MeshOptions
from bodyseg_data.core import BadConfig, BadMesh
from bodyseg_data.labels import LANDMARKS
from bodyseg_data.meshes import METRES

Floats = NDArray[np.float64]

AXES = [sign + name for sign in ("", "-") for name in "xyz"]
TURNS = [(left, up) for left, up in itertools.product(AXES, AXES) if left[-1] != up[-1]]
BODY = PERSON.vertices
LIST = list(VERTICES)


def test_there_are_24_turns() -> None:
    matrices = {tuple(turn(*axes).astype(int).ravel().tolist()) for axes in TURNS}
    assert len(matrices) == 24 and all(round(np.linalg.det(turn(*axes))) == 1 for axes in TURNS)


@pytest.mark.parametrize("up", AXES)
def test_a_scene_whose_axis_points_up_is_turned_not_mirrored(up: str) -> None:
    rotation = upright_rotation(up)  # type: ignore[arg-type]
    assert any(np.array_equal(rotation, turn(*axes)) for axes in TURNS if axes[1] == up)


@pytest.mark.parametrize(("left", "up"), TURNS)
@pytest.mark.parametrize("unit", ["m", "cm", "mm"])
def test_every_turn_and_unit_is_found(left: str, up: str, unit: str) -> None:
    file = BODY @ turn(left, up) / METRES[unit]
    found = find_alignment(file, file[LIST], "auto", "auto", "a.ply")
    assert found.scale == METRES[unit]
    np.testing.assert_array_equal(found.rotation, turn(left, up))
    np.testing.assert_allclose(found.apply(file), BODY, atol=1e-12)
    given = find_alignment(file, file[LIST], unit, up, "a.ply")  # type: ignore[arg-type]
    assert str(given) == str(found) and given.lean_deg == found.lean_deg < 10


def leaning(degrees: float, about: int = 0) -> Floats:
    """The body bent stiffly forwards (about x), to its right (about z), or turned round (about y)."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    others = [axis for axis in range(3) if axis != about]
    rotation = np.eye(3)
    rotation[np.ix_(others, others)] = [[c, -s], [s, c]]
    moved: Floats = BODY @ rotation.T
    return moved


@pytest.mark.parametrize("about", [0, 1, 2])
@pytest.mark.parametrize("degrees", [-30, -15, 15, 30])
def test_posture_is_kept(about: int, degrees: float) -> None:
    body = leaning(degrees, about)
    found = find_alignment(body, body[LIST], "auto", "auto", "a.ply")
    np.testing.assert_array_equal(found.rotation, np.eye(3))
    np.testing.assert_array_equal(found.apply(body), body)
    moved = body + np.array([3.0, -4.0, 5.0])
    aside = find_alignment(moved, moved[LIST], "auto", "auto", "a.ply")
    assert aside.lean_deg == pytest.approx(found.lean_deg), "wherever the body stands"
    if about != 1:
        assert found.lean_deg == pytest.approx(abs(degrees), abs=10)


def test_landmarks_may_be_in_another_unit() -> None:
    found = find_alignment(BODY * 1000, BODY[LIST], "auto", "auto", "a.ply")
    assert found.scale == 0.001 and np.array_equal(found.rotation, np.eye(3))


def test_a_lying_body_needs_its_up_axis() -> None:
    body = leaning(90)
    found = find_alignment(body, body[LIST], "auto", "y", "a.ply")
    np.testing.assert_array_equal(found.rotation, np.eye(3))
    assert found.lean_deg > 80
    on_its_side = leaning(90, 2)  # the shoulders lie along the axis that points up: any turn about it will do
    for up in AXES:
        rotation = find_alignment(on_its_side, on_its_side[LIST], "auto", up, "a.ply").rotation  # type: ignore[arg-type]
        assert round(np.linalg.det(rotation)) == 1


def test_a_body_between_the_axes_is_refused() -> None:
    body = leaning(45)
    with pytest.raises(BadMesh, match=r"a\.ply: the trunk points along .* --up"):
        find_alignment(body, body[LIST], "auto", "auto", "a.ply")
    find_alignment(body, body[LIST], "auto", "y", "a.ply")


def test_coordinates_that_are_not_finite_stay_where_they_are() -> None:
    placed = Alignment(0.5, turn("z", "y"), 0.0).apply(np.array([[np.nan, 2.0, np.inf]]))
    np.testing.assert_array_equal(placed, [[np.inf, 1.0, np.nan]])


@pytest.mark.parametrize(
    ("size", "units", "message"),
    [
        (
            67,
            "auto",
            r"the body is .* 67 .*0\.67 m if in cm or 1\.7 m if in in; .*--units",
        ),
        (30, "auto", r"the body is .* 30 .*that is 0\.762 m if in in; .*--units"),
        (4, "auto", r"at its largest: found .* 4 .*, which fits in no unit"),
        (0.0, "auto", "fits in no unit"),
        (1700, "m", r"at its largest, found .* 1700 .* m, which would fit in mm"),
        (70, "m", "which would fit in cm or in"),
        (4, "mm", "found .* 4 .* mm$"),
    ],
)
def test_a_unit_that_cannot_be_is_refused(size: float, units: str, message: str) -> None:
    surface = BODY / 1.7 * size
    with pytest.raises(BadMesh, match=message) as error:
        metres_a_unit(surface, units, "b.obj")  # type: ignore[arg-type]
    assert str(error.value).startswith("b.obj: ") and "\n" not in str(error.value)


def test_inches_are_read_when_given() -> None:
    assert metres_a_unit(BODY / 0.0254, "in", "a.ply") == 0.0254


@pytest.mark.parametrize(("units", "up"), [("feet", "y"), ("m", "up"), ("", "y")])
def test_unknown_units_and_axes_are_refused(units: str, up: str) -> None:
    with pytest.raises(BadConfig, match="must be 'auto' or "):
        MeshOptions(units, up)  # type: ignore[arg-type]


def test_the_landmarks_of_the_test_person_lie_where_they_should() -> None:
    place = dict(zip(LANDMARKS, BODY[LIST], strict=True))
    assert len(set(LIST)) == len(LANDMARKS)
    assert place["Lt. Acromion"][0] > 0 > place["Rt. Acromion"][0]
    assert place["Sellion"][2] > 0 > place["Nuchale"][2]
