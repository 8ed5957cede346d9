from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from people_on_disk import PERSON, VERTICES

from bodyseg_data.core import BadLandmarks
from bodyseg_data.labels import LANDMARKS
from bodyseg_data.meshes import Mesh, partition, separate

RIGHT, LEFT = LANDMARKS.index("Rt. Dactylion"), LANDMARKS.index("Lt. Dactylion")
GAP_M = 0.004
RINGS, AROUND = 120, 12


def touching_arms() -> tuple[Mesh, NDArray[np.int64]]:
    """A bent tube whose ends nearly touch, as hands do, and 33 landmarks along it: the right ones on one half, the left
    ones on the other, both fingertips on the right end.
    """
    radius, thick = 0.4, 0.05
    end = GAP_M / 2 / radius
    turns = np.linspace(end, 2 * np.pi - end, RINGS)
    spokes = np.arange(AROUND) * 2 * np.pi / AROUND
    out = radius + thick * np.cos(spokes)
    rings = np.stack(
        [
            np.cos(turns)[:, None] * out,
            np.broadcast_to(thick * np.sin(spokes), (RINGS, AROUND)),
            np.sin(turns)[:, None] * out,
        ],
        axis=2,
    )
    caps = [[radius * np.cos(turn), 0, radius * np.sin(turn)] for turn in turns[[0, -1]]]
    vertices = np.concatenate([rings.reshape(-1, 3), caps])
    faces = []
    for ring in range(RINGS - 1):
        for spoke in range(AROUND):
            a, b = ring * AROUND + spoke, ring * AROUND + (spoke + 1) % AROUND
            faces += [[a, b, a + AROUND], [b, b + AROUND, a + AROUND]]
    last = (RINGS - 1) * AROUND
    for spoke in range(AROUND):
        after = (spoke + 1) % AROUND
        faces += [[RINGS * AROUND, after, spoke], [RINGS * AROUND + 1, last + spoke, last + after]]
    sides = {"Rt.": iter(range(4, 60, 4)), "Lt.": iter(range(115, 60, -4))}
    landmarks = []
    for number, name in enumerate(LANDMARKS):
        ring = next(sides[name[:3]]) if name[:3] in sides else 59
        landmarks.append(ring * AROUND + number % AROUND)
    landmarks[RIGHT] = landmarks[LEFT] = RINGS * AROUND
    for name, ring in (("Rt. Radial Styloid", 3), ("Lt. Radial Styloid", RINGS - 4)):
        landmarks[LANDMARKS.index(name)] = ring * AROUND
    mesh = Mesh("arms", vertices, np.array(faces))
    return mesh, np.array(landmarks)


@pytest.mark.parametrize(("end", "stays", "moves"), [(0, RIGHT, LEFT), (1, LEFT, RIGHT)])
def test_where_hands_touch_the_landmark_on_the_other_hand_moves_to_its_own(end: int, stays: int, moves: int) -> None:
    mesh, vertices = touching_arms()
    shared = RINGS * AROUND + end
    vertices[[RIGHT, LEFT]] = shared
    points = mesh.vertices[vertices].copy()
    points[[RIGHT, LEFT], 2] = 0  # in the middle of the gap
    found, (note,) = separate(mesh, vertices, points, "here")
    assert found[stays] == shared
    assert found[moves] == RINGS * AROUND + 1 - end, "the end of its own arm, just across the gap"
    assert note == (f"{LANDMARKS[moves]} moved by {1000 * GAP_M:.1f} mm: it was in one place with {LANDMARKS[stays]}")
    others = np.setdiff1d(np.arange(33), [moves])
    np.testing.assert_array_equal(found[others], vertices[others])
    parts = partition(mesh, found)
    assert parts.labels[0] == RIGHT and parts.labels[(RINGS - 1) * AROUND] == LEFT, "each end has its own part"


def test_landmarks_are_separated_beside_a_piece_that_no_path_reaches() -> None:
    mesh, vertices = touching_arms()
    corners = np.eye(4, 3) * 0.03 + (0.35, 0.3, 0)
    apart = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [0, 2, 3]]) + len(mesh.vertices)
    both = Mesh("both", np.concatenate([mesh.vertices, corners]), np.concatenate([mesh.faces, apart]))
    found, notes = separate(both, vertices, mesh.vertices[vertices], "here")
    alone, its_notes = separate(mesh, vertices, mesh.vertices[vertices], "here")
    np.testing.assert_array_equal(found, alone)
    assert notes == its_notes


def test_on_one_surface_the_second_moves_towards_its_own_limb() -> None:
    vertices = np.array(VERTICES)
    middle = np.linalg.norm(PERSON.vertices - (0, 0.75, 0.15), axis=1)
    middle[vertices] = np.inf
    vertices[[RIGHT, LEFT]] = shared = int(middle.argmin())
    found, notes = separate(PERSON, vertices, PERSON.vertices[vertices], "here")
    assert found[RIGHT] == shared and len(notes) == 1
    assert PERSON.vertices[found[LEFT], 0] > PERSON.vertices[shared, 0], "left is x > 0"
    edge = PERSON.faces[(PERSON.faces == shared).any(axis=1)]
    assert found[LEFT] in edge and found[LEFT] not in VERTICES
    again, _ = separate(PERSON, vertices, PERSON.vertices[vertices], "here")
    np.testing.assert_array_equal(found, again)
    labels = partition(PERSON, found).labels
    assert labels[found[LEFT]] == LEFT and labels[shared] == RIGHT


def test_different_vertices_in_one_place_are_separated_too() -> None:
    mesh, vertices = touching_arms()
    moved = mesh.vertices.copy()
    moved[RINGS * AROUND + 1] = moved[RINGS * AROUND]
    touching = Mesh("arms", moved, mesh.faces)
    vertices[LEFT] = RINGS * AROUND + 1
    found, notes = separate(touching, vertices, moved[vertices], "here")
    assert len(notes) == 1
    assert np.linalg.norm(moved[found[RIGHT]] - moved[found[LEFT]]) > 1e-3
    partition(touching, found)


def test_landmarks_apart_stay_as_they_are() -> None:
    vertices = np.array(VERTICES)
    found, notes = separate(PERSON, vertices, PERSON.vertices[vertices], "here")
    assert found is vertices and notes == ()


def test_three_in_one_place_and_no_room_are_refused() -> None:
    vertices = np.array(VERTICES)
    vertices[[4, 9]] = vertices[2]
    with pytest.raises(BadLandmarks, match="^here: at most two .* found 'Supramenton', 'Rt. Thel.*', 'Cervicale' at"):
        separate(PERSON, vertices, PERSON.vertices[vertices], "here")
    vertices = np.array(VERTICES)
    shared = vertices[RIGHT]
    ring = np.setdiff1d(PERSON.faces[(PERSON.faces == shared).any(axis=1)], [shared])
    reach = np.linalg.norm(PERSON.vertices[ring] - PERSON.vertices[shared], axis=1).max()
    near = np.flatnonzero(np.linalg.norm(PERSON.vertices - PERSON.vertices[shared], axis=1) <= reach * 1.001)
    near = np.setdiff1d(near, [shared])
    assert len(near) < 30
    rest = [index for index in range(33) if index not in (RIGHT, LEFT)]
    vertices[rest] = np.concatenate([near, np.setdiff1d(np.arange(100, 640), [*near, shared])])[: len(rest)]
    vertices[LEFT] = shared
    with pytest.raises(
        BadLandmarks, match=r"^here: 'Rt\. Dactylion' and 'Lt\. Dactylion' are at vertex .* no free vertex"
    ):
        separate(PERSON, vertices, PERSON.vertices[vertices], "here")
