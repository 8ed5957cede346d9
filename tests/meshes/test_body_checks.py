"""Meshes that are no body alone, or a mirrored one: refused by their landmarks, in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benches.landmarks.proposal import joined
from numpy.typing import NDArray
from people_on_disk import PERSON, VERTICES, obj, write_by_point, write_by_vertex, write_mesh

from bodyseg_data.bodies import open_source
from bodyseg_data.core import BadMesh
from bodyseg_data.labels import LANDMARKS
from bodyseg_data.meshes import Mesh, check_body, cuboid

POINTS = PERSON.vertices[list(VERTICES)]
LOW = float(PERSON.vertices[:, 1].min()) - 0.001
MIRROR = np.diag([-1.0, 1.0, 1.0])
Floats = NDArray[np.float64]


def checked(vertices: Floats, faces: NDArray[np.int32], points: Floats = POINTS) -> None:
    check_body(vertices, faces, points, "it")


def beside(vertices: Floats, faces: NDArray[np.int32]) -> tuple[Floats, NDArray[np.int32]]:
    """The person and something else in one mesh."""
    count = len(PERSON.vertices)
    return np.concatenate([PERSON.vertices, vertices]), np.concatenate([PERSON.faces, faces + count]).astype(np.int32)


def square(side: float, height: float, steps: int = 1) -> tuple[Floats, NDArray[np.int32]]:
    """A level square around the person's axis, of `steps` x `steps` squares."""
    at = np.linspace(-side / 2, side / 2, steps + 1)
    x, z = np.meshgrid(at, at)
    number = np.arange((steps + 1) ** 2).reshape(steps + 1, -1)
    a, b, c, d = (each.ravel() for each in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([a, d, c], axis=1)])
    return np.stack([x.ravel(), np.full(x.size, height), z.ravel()], axis=1), faces.astype(np.int32)


def soup(vertices: Floats, faces: NDArray[np.int32]) -> tuple[Floats, NDArray[np.int32]]:
    return vertices[faces].reshape(-1, 3), np.arange(faces.size, dtype=np.int32).reshape(-1, 3)


def turned(degrees: float) -> Floats:
    """A rotation about the axis to the front, then about the vertical one."""
    a, b = np.radians(degrees), np.radians(50)
    about_z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    both: Floats = about_y @ about_z
    return both


@pytest.mark.parametrize("degrees", [0, 90, 180])
def test_a_body_in_any_posture_passes_and_its_mirror_image_does_not(degrees: float) -> None:
    turn = turned(degrees).T
    checked(PERSON.vertices @ turn, PERSON.faces, POINTS @ turn)
    with pytest.raises(BadMesh, match="it: with the trunk upright .* the mesh is mirrored"):
        checked(PERSON.vertices @ MIRROR @ turn, PERSON.faces[:, ::-1], POINTS @ MIRROR @ turn)


@pytest.mark.parametrize("side", [0.6, 2.0])
@pytest.mark.parametrize("loose", [False, True])
@pytest.mark.parametrize("steps", [1, 6])
def test_a_plate_under_the_feet(side: float, loose: bool, steps: int) -> None:
    vertices, faces = beside(*square(side, LOW, steps))
    with pytest.raises(BadMesh, match="a flat piece of .* without a landmark under it: take the floor"):
        checked(*(soup(vertices, faces) if loose else (vertices, faces)))


def test_a_turntable_and_a_wall() -> None:
    table = cuboid((0.6, 0.1, 0.6), (0.0, LOW - 0.05, 0.0))
    with pytest.raises(BadMesh, match="under it"):
        checked(*beside(table.vertices, table.faces))
    plate = cuboid((0.45, 0.02, 0.45), (0.0, LOW - 0.01, 0.0))
    vertices, faces = beside(plate.vertices, plate.faces)
    with pytest.raises(BadMesh, match="under it"):
        checked(vertices / 2, faces, POINTS / 2)  # of a doll
    wall = cuboid((2.0, 2.0, 0.02), (0.0, 1.0, -0.6))
    with pytest.raises(BadMesh, match="a flat piece of 2 x 2 m without a landmark: take"):
        checked(*beside(wall.vertices, wall.faces))


def test_what_people_wear_and_hold_passes() -> None:
    for size, centre in (
        ((0.1, 0.03, 0.28), (0.1, 0.0, 0.05)),  # a sole
        ((0.35, 0.02, 0.35), (0.0, 1.7, 0.0)),  # the brim of a hat
        ((0.8, 1.0, 0.1), (0.0, 1.0, -0.2)),  # a mattress on the back
        ((0.05, 0.05, 0.05), (1.5, 1.0, 0.0)),  # nothing: a scrap of a scan
    ):
        piece = cuboid(size, centre)
        checked(*beside(piece.vertices, piece.faces))
    skirt = cuboid((0.7, 0.9, 0.7), (0.0, 0.45, 0.0))
    checked(*beside(skirt.vertices, skirt.faces))


@pytest.mark.parametrize("metres", [0.9, 3.0])
def test_another_person_in_the_mesh(metres: float) -> None:
    """Whom no landmark reaches would get the labels of the nearest surface."""
    with pytest.raises(BadMesh, match="found a piece of .* m without a landmark and apart from it: take the other"):
        checked(*beside(PERSON.vertices + np.array([metres, 0, 0]), PERSON.faces))


def test_a_loose_face_of_two_places_far_apart_is_no_plate() -> None:
    ends = np.array([[0.5, 0.2, 0.1], [0.1, 0.9, 0.3]])
    checked(*beside(ends, np.array([[0, 1, 1]], np.int32)))


def grown_together(height: float, with_vertex: int) -> tuple[Floats, NDArray[np.int32]]:
    """The person and a level square that has the middle in common."""
    floor, faces = square(1.6, height, 16)
    joined = len(PERSON.vertices) + int(np.linalg.norm(floor - (0, height, 0), axis=1).argmin())
    faces = faces + len(PERSON.vertices)
    faces[faces == joined] = with_vertex
    return np.concatenate([PERSON.vertices, floor]), np.concatenate([PERSON.faces, faces])


def test_a_floor_that_has_grown_together_with_the_feet_and_no_tray() -> None:
    with pytest.raises(BadMesh, match="m2 of level surface at its bottom, away from all landmarks"):
        checked(*grown_together(LOW, int(PERSON.vertices[:, 1].argmin())))
    checked(*grown_together(1.1, VERTICES[LANDMARKS.index("Rt. Dactylion")]))


@pytest.mark.parametrize("fault", ["chest", "belly"])
def test_chest_and_belly_tell_a_mirror_image_together(fault: str) -> None:
    """As of somebody who bends or twists: one of the two is a little behind."""
    front = {"chest": ("Suprasternale", "Substernale"), "belly": ("Rt. ASIS", "Lt. ASIS")}[fault]
    back = {"chest": ("Cervicale", "10th Rib Midspine"), "belly": ("Rt. PSIS", "Lt. PSIS")}[fault]
    points = POINTS.copy()
    for own, other in zip(front, back, strict=True):
        points[LANDMARKS.index(own)] = POINTS[LANDMARKS.index(other)] - (0, 0.1, 0.01)
    checked(PERSON.vertices, PERSON.faces, points)
    with pytest.raises(BadMesh, match="the mesh is mirrored"):
        checked(PERSON.vertices @ MIRROR, PERSON.faces[:, ::-1], points @ MIRROR)


def test_a_body_that_is_a_small_part_of_its_mesh() -> None:
    with pytest.raises(BadMesh, match="a trunk is 0.1 m long at least, found"):
        checked(PERSON.vertices / 10, PERSON.faces, POINTS / 10)


@pytest.mark.parametrize("by_vertex", [True, False])
def test_sources_refuse_a_mirrored_body(tmp_path: Path, by_vertex: bool) -> None:
    write_mesh(tmp_path / "a.ply", PERSON.vertices @ MIRROR, PERSON.faces[:, ::-1])
    if by_vertex:
        write_by_vertex(tmp_path / "a.json")
    else:
        write_by_point(tmp_path / "a.json", POINTS @ MIRROR)
    refused(tmp_path, "the mesh is mirrored")


@pytest.mark.parametrize("upwards", [True, False])
def test_sources_refuse_a_floor(tmp_path: Path, upwards: bool) -> None:
    """Which of its sides is the outside makes no difference."""
    for side, why in ((2.0, "without a landmark under it"), (4.0, "is a floor or a wall in the mesh")):
        floor, faces = square(side, LOW)
        write_mesh(tmp_path / "a.ply", *beside(floor, faces if upwards else faces[:, ::-1]))
        write_by_point(tmp_path / "a.json", POINTS)
        refused(tmp_path, why)


def refused(folder: Path, why: str) -> None:
    source = open_source("folder", folder)
    for ask in (source.check, source.build):
        with pytest.raises(BadMesh, match=rf"a\.ply: .*{why}"):
            ask(source.bodies()[0])


def test_landmarks_by_coordinate_fit_loose_triangles(tmp_path: Path) -> None:
    """The same parts as those of the mesh whose triangles have common vertices."""
    write_mesh(tmp_path / "whole.obj")
    (tmp_path / "loose.obj").write_bytes(obj(*soup(PERSON.vertices, PERSON.faces)))
    for name in ("whole", "loose"):
        write_by_point(tmp_path / f"{name}.json", POINTS)
    source = open_source("folder", tmp_path)
    loose, whole = (source.build(ref) for ref in source.bodies())
    labels = [body.partition().corners(body.mesh) for body in (loose, whole)]
    assert (labels[0] == labels[1]).mean() > 0.95  # some vertices are as near to two landmarks


def test_landmarks_are_proposed_on_the_surface_of_loose_triangles() -> None:
    loose = Mesh("loose", *soup(PERSON.vertices, PERSON.faces))
    whole, kept = joined(loose)
    assert len(whole.vertices) == len(PERSON.vertices)
    assert np.array_equal(whole.vertices, loose.vertices[kept])
    assert np.array_equal(whole.vertices[whole.faces], loose.vertices[loose.faces])
    assert joined(PERSON)[0] is PERSON
