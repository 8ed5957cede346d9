"""Any folder of meshes: where landmark files are looked for, how bodies are named, split and placed."""

from __future__ import annotations

import gzip
import re
from pathlib import Path

import numpy as np
import pytest
from people_on_disk import PERSON, VERTICES, turn, write_by_point, write_by_vertex, write_lnd, write_mesh

from bodyseg_data.bodies import BodyRef, about, collapsed, open_source
from bodyseg_data.bodies.source import key_name
from bodyseg_data.bodies.sources.folder import FolderBodies
from bodyseg_data.core import BadConfig, BadLandmarks
from bodyseg_data.samples import check_key


def touch(root: Path, *names: str) -> Path:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    return root


def test_subjects_meshes_and_splits(tmp_path: Path) -> None:
    names = (
        "one.ply",
        "ann/walk/b.obj.gz",
        "ann/a.ply",
        "train/bob/x.off",
        "Test/bob/x.off",
        "test/y.ply",
        "testing/z.ply",
    )
    touch(tmp_path, *names, "notes.txt", ".hidden/h.ply", "ann/._a.ply", "landmarks.json")
    source = open_source("folder", tmp_path)
    assert source.missing() == ()
    (tmp_path / "landmarks.json").unlink()
    (tmp_path / "ann" / "landmarks.json").touch()
    assert open_source("folder", tmp_path).missing() == tuple(
        f"landmarks of {name}" for name in ("one", "Test++bob++x", "test++y", "testing++z", "train++bob++x")
    )
    assert list(source.bodies()) == [
        BodyRef("folder", "one", "one", "one", "train"),
        BodyRef("folder", "bob", "Test++bob++x", "x", "test"),
        BodyRef("folder", "ann", "ann++a", "a", "train"),
        BodyRef("folder", "ann", "ann++walk++b", "b", "train"),
        BodyRef("folder", "y", "test++y", "y", "test"),
        BodyRef("folder", "testing", "testing++z", "z", "train"),
        BodyRef("folder", "bob", "train++bob++x", "x", "train"),
    ]


@pytest.mark.parametrize("kind", ["json", "lnd", "lnd.gz", "points", "LND"])
def test_a_mesh_has_its_own_landmarks_or_those_of_a_folder_above(tmp_path: Path, kind: str) -> None:
    reversed_vertices = (*VERTICES[:4], VERTICES[5], VERTICES[4], *VERTICES[6:])  # two swapped, to tell files apart
    points = PERSON.vertices[list(VERTICES)]
    write_mesh(tmp_path / "a" / "own.ply")
    own = tmp_path / "a" / f"own.{'json' if kind == 'points' else kind}"
    if kind == "json":
        write_by_vertex(own)
    elif kind == "points":
        write_by_point(own, points)
    else:
        write_lnd(own, points)
        if kind == "lnd.gz":
            own.write_bytes(gzip.compress(own.read_bytes()))
    write_mesh(tmp_path / "a" / "b" / "c" / "other.obj")
    write_by_vertex(tmp_path / "a" / "landmarks.json", reversed_vertices)
    write_by_vertex(tmp_path / "landmarks.json", VERTICES[::-1])
    given = write_by_vertex(tmp_path / "given.json", (*VERTICES[:31], VERTICES[32], VERTICES[31]))

    def found(landmarks: Path | None = None) -> list[list[int]]:
        source = FolderBodies(tmp_path, landmarks)
        return [source.build(ref).landmarks.tolist() for ref in source.bodies()]

    assert found() == [list(VERTICES), list(reversed_vertices)]
    assert found(given) == [list(VERTICES), [*VERTICES[:31], VERTICES[32], VERTICES[31]]]


def test_a_link_takes_no_mesh_from_the_folder_that_it_leads_to(tmp_path: Path) -> None:
    write_mesh(tmp_path / "test" / "ben" / "one.ply")
    (tmp_path / "latest").symlink_to("test/ben")
    (tmp_path / "chosen").mkdir()
    (tmp_path / "chosen" / "all").symlink_to("../test")
    assert [(body.subject, body.split) for body in FolderBodies(tmp_path).bodies()] == [("ben", "test")]


def test_landmarks_may_lie_in_a_folder_of_their_own(tmp_path: Path) -> None:
    write_mesh(tmp_path / "meshes" / "s" / "one.ply")
    write_mesh(tmp_path / "meshes" / "two.ply")
    marks = tmp_path / "marks"
    write_lnd(marks / "s" / "one.lnd", PERSON.vertices[list(VERTICES)])
    write_by_vertex(marks / "landmarks.json")
    write_by_vertex(tmp_path / "meshes" / "landmarks.json", VERTICES[::-1])  # not looked at
    source = FolderBodies(tmp_path / "meshes", marks)
    assert all(source.build(ref).landmarks.tolist() == list(VERTICES) for ref in source.bodies())


def test_meshes_that_share_landmarks_share_a_frame(tmp_path: Path) -> None:
    """So that a motion keeps its turns; a mesh with landmarks of its own faces the front."""
    turned = turn("z", "y")
    write_mesh(tmp_path / "walk" / "0.ply")
    write_mesh(tmp_path / "walk" / "1.ply", PERSON.vertices @ turned)
    write_by_vertex(tmp_path / "walk" / "landmarks.json")
    write_mesh(tmp_path / "zoe.ply", PERSON.vertices @ turned)
    write_by_vertex(tmp_path / "zoe.json")
    source = FolderBodies(tmp_path)
    built = {ref.mesh: source.build(ref).mesh.vertices for ref in source.bodies()}
    np.testing.assert_array_equal(built["walk++0"], PERSON.vertices)
    np.testing.assert_array_equal(built["walk++1"], PERSON.vertices @ turned)
    np.testing.assert_allclose(built["zoe"], PERSON.vertices, atol=1e-12)


def test_points_for_many_meshes_lie_on_the_first(tmp_path: Path) -> None:
    for number, height in enumerate((1.0, 0.9, 1.1)):
        write_mesh(tmp_path / f"{number}.ply", PERSON.vertices * height)
    write_by_point(tmp_path / "landmarks.json", PERSON.vertices[list(VERTICES)])
    source = FolderBodies(tmp_path)
    assert all(source.build(ref).landmarks.tolist() == list(VERTICES) for ref in source.bodies())


@pytest.mark.parametrize("unit", [1000, 1])
def test_points_for_many_meshes_tell_how_far_they_were_moved(tmp_path: Path, unit: float) -> None:
    """Also where a .lnd file is in metres."""
    for number in range(2):
        write_mesh(tmp_path / "meshes" / f"{number}.ply")
    points = PERSON.vertices[list(VERTICES)]
    points[0] += (0, 0.001, 0.004)
    given = write_lnd(tmp_path / "all.lnd", points, unit=unit)
    source = FolderBodies(tmp_path / "meshes", given)
    for ref in source.bodies():
        built = source.build(ref)
        assert built.landmarks.tolist() == list(VERTICES)
        assert re.fullmatch(r"landmarks snapped by up to (3\.\d|4\.\d) mm \(Sellion\) on 0\.ply", built.notes[-1])
        assert [note[:24] for note in built.notes[:-1]] == (["landmarks read as metres"] if unit == 1 else [])


@pytest.mark.parametrize("first", [True, False])
def test_the_points_of_one_mesh_may_be_those_of_all_others(tmp_path: Path, first: bool) -> None:
    own, other = ("a", "b") if first else ("b", "a")
    write_mesh(tmp_path / f"{own}.ply")
    write_mesh(tmp_path / f"{other}.ply", PERSON.vertices @ about(0.05))
    write_by_point(tmp_path / f"{own}.json", PERSON.vertices[list(VERTICES)])
    source = open_source("folder", tmp_path, tmp_path / f"{own}.json")
    bodies = {body.mesh: body for body in source.bodies()}
    for name in (own, other):  # in this order a process may build them
        np.testing.assert_array_equal(source.build(bodies[name]).landmarks, VERTICES)


def test_a_mesh_without_landmarks_is_named(tmp_path: Path) -> None:
    write_mesh(tmp_path / "a" / "one.ply")
    source = FolderBodies(tmp_path)
    with pytest.raises(BadLandmarks, match=r"one\.ply: no one\.json, one\.lnd or landmarks\.json in .*a "):
        source.fingerprint(source.bodies())


def test_a_folder_without_meshes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadConfig, match=r"needs meshes \(\.ply, \.obj, \.off\): found none in"):
        FolderBodies(touch(tmp_path, "notes.txt"))


def test_awkward_names_become_keys_of_their_own(tmp_path: Path) -> None:
    names = [
        "a.b",
        "a b",
        "a_b",
        "a+b",
        "a~b",
        "a%b",
        "a/b",
        "a++b",
        "ä",
        "a+2Fb",
        "x" * 90,
        "x" * 91,
        "a-b",
        "-",
        "%2E",
    ]
    keys = [key_name(name, 40) for name in names]
    assert len(set(keys)) == len(names) and max(map(len, keys)) <= 40
    for key in keys:
        check_key(key)
    assert key_name("train/ann/mesh_01-b", 40) == "train++ann++mesh_01-b"
    long = touch(tmp_path, f"{'long folder ' * 5}/{'long mesh ' * 8}.ply", "\udcff.ply")
    for body in FolderBodies(long).bodies():
        check_key(f"folder-{body.subject}-{body.mesh}-d215-a170")


def test_runs_of_names_are_collapsed() -> None:
    frames = [f"I_crane/meshes/mesh_{number:04d}.obj" for number in (0, 1, 2, 4, 9, 10)]
    assert collapsed(frames) == [
        "I_crane/meshes/mesh_0000.obj to mesh_0002.obj",
        "I_crane/meshes/mesh_0004.obj",
        "I_crane/meshes/mesh_0009.obj to mesh_0010.obj",
    ]
    assert collapsed(["a1", "b2", "c", "d", "e9", "e10", "f09", "f10"]) == [
        "a1",
        "b2",
        "c",
        "d",
        "e9 to e10",
        "f09 to f10",
    ]
    assert collapsed([]) == []
