"""SCAPE: a folder laid out as its owners give it out, whole and in part."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from people_on_disk import PERSON, VERTICES, person, turn, write_by_point, write_by_vertex, write_lnd, write_mesh

from bodyseg_data.bodies import Body, BodyRef, open_source
from bodyseg_data.bodies.source import MeshOptions
from bodyseg_data.bodies.sources.paper import ScapeBodies
from bodyseg_data.core import BadConfig, BadLandmarks, BadMesh

NUMBERS = [number for number in range(72) if number != 51]
TURN = turn("x", "z")


def complete(folder: Path) -> Path:
    """All 71 names and the landmarks', with nothing in the files: counting must not read them."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "landmarks.json").touch()
    for number in NUMBERS:
        (folder / f"mesh{number:03d}.ply").touch()
    return folder


def first(source: ScapeBodies) -> Body:
    return source.build(source.bodies()[0])


def test_a_complete_set_has_71_meshes_split_57_to_14(tmp_path: Path) -> None:
    source = open_source("scape", complete(tmp_path))
    bodies = source.bodies()
    assert source.name == "scape" and source.missing() == ()
    assert [body.mesh for body in bodies] == [f"mesh{number:03d}" for number in NUMBERS]
    assert {(body.subset, body.subject) for body in bodies} == {("A", "A")}
    assert [body.split for body in bodies] == ["train"] * 57 + ["test"] * 14
    (tmp_path / "landmarks.json").unlink()
    assert ScapeBodies(tmp_path).missing() == ("landmarks.json",)


def test_a_part_keeps_the_split_of_the_whole_and_names_what_is_missing(tmp_path: Path) -> None:
    complete(tmp_path)
    for number in (0, 3, 56, 57):
        (tmp_path / f"mesh{number:03d}.ply").unlink()
    source = ScapeBodies(tmp_path)
    assert source.missing() == ("mesh000.ply", "mesh003.ply", "mesh056.ply", "mesh057.ply")
    splits = {body.mesh: body.split for body in source.bodies()}
    # Number 57 is the 57th mesh, since 51 does not exist.
    assert len(splits) == 67 and splits["mesh055"] == "train" and splits["mesh058"] == "test"


def test_forms_and_other_files(tmp_path: Path) -> None:
    for name in ("mesh001.obj", "MESH002.OFF.gz", "mesh003.ply.gz", "mesh3.off", "mesh004.obj", "mesh004.ply"):
        (tmp_path / name).touch()
    for name in ("mesh051.ply", "mesh072.ply", "mesh1.txt", "notes.ply", "._mesh005.ply", "mesh.ply"):
        (tmp_path / name).touch()
    assert [body.mesh for body in ScapeBodies(tmp_path).bodies()] == ["mesh001", "mesh002", "mesh003", "mesh004"]
    write_by_vertex(tmp_path / "landmarks.json")
    write_mesh(tmp_path / "mesh004.ply")
    (tmp_path / "mesh004.obj").write_bytes(b"not read")
    source = ScapeBodies(tmp_path)
    with pytest.raises(BadMesh, match=r"mesh001\.obj"):
        first(source)  # the first one decides how all are placed


@pytest.mark.parametrize("name", ["mesh000.ply", "mesh000.obj", "mesh000.off", "mesh000.ply.gz"])
def test_a_mesh_keeps_its_vertices_and_is_placed(tmp_path: Path, name: str) -> None:
    write_mesh(tmp_path / name, PERSON.vertices @ TURN * 1000)
    write_by_vertex(tmp_path / "landmarks.json")
    body = first(ScapeBodies(tmp_path))
    np.testing.assert_allclose(body.mesh.vertices, PERSON.vertices, atol=1e-9)
    np.testing.assert_array_equal(body.mesh.faces, PERSON.faces)
    assert body.landmarks.tolist() == list(VERTICES) and body.notes == ()


def test_a_source_prints_in_one_line(tmp_path: Path) -> None:
    write_mesh(tmp_path / "mesh000.ply", PERSON.vertices)
    assert repr(ScapeBodies(tmp_path)) == "ScapeBodies(name='scape', bodies=1, missing=71)"


def test_all_postures_are_placed_alike(tmp_path: Path) -> None:
    """By the first that stands upright, even if others lie down or the first does."""
    lying = PERSON.vertices @ turn("x", "-z")  # his trunk points along -z in the body frame
    for number, vertices in enumerate((lying, PERSON.vertices, lying, PERSON.vertices @ turn("-x", "y"))):
        write_mesh(tmp_path / f"mesh{number:03d}.ply", vertices @ TURN)
    write_by_vertex(tmp_path / "landmarks.json")
    source = ScapeBodies(tmp_path, options=MeshOptions(up="z"))
    built = [source.build(ref).mesh.vertices for ref in source.bodies()]
    for found, vertices in zip(built, (lying, PERSON.vertices, lying, PERSON.vertices @ turn("-x", "y")), strict=True):
        np.testing.assert_array_equal(found, vertices)


def test_a_mesh_between_the_axes_does_not_decide(tmp_path: Path) -> None:
    half = np.array([[1, 0, 0], [0, 0.5**0.5, -(0.5**0.5)], [0, 0.5**0.5, 0.5**0.5]])
    write_mesh(tmp_path / "mesh000.ply", PERSON.vertices @ half.T @ TURN)
    write_by_vertex(tmp_path / "landmarks.json")
    with pytest.raises(BadMesh, match=r"mesh000\.ply: the trunk points along"):
        first(ScapeBodies(tmp_path))
    write_mesh(tmp_path / "mesh001.ply", PERSON.vertices @ TURN)
    np.testing.assert_allclose(first(ScapeBodies(tmp_path)).mesh.vertices, PERSON.vertices @ half.T, atol=1e-12)


@pytest.mark.parametrize("kind", ["vertex", "point", "lnd", "given", "folder"])
def test_one_landmark_file_serves_all_meshes(tmp_path: Path, kind: str) -> None:
    meshes, elsewhere = tmp_path / "meshes", tmp_path / "elsewhere"
    for number, height in ((0, 1.7), (1, 1.5)):
        write_mesh(meshes / f"mesh{number:03d}.ply", person(height_m=height).vertices @ TURN)
    points = PERSON.vertices[list(VERTICES)] @ TURN
    given = None
    if kind == "vertex":
        write_by_vertex(meshes / "landmarks.json")
    elif kind == "point":
        write_by_point(meshes / "landmarks.json", points)
    elif kind == "lnd":
        write_lnd(meshes / "landmarks.lnd", points)
    else:
        given = write_by_vertex(elsewhere / "landmarks.json")
        given = given.parent if kind == "folder" else given
    source = ScapeBodies(meshes, given)
    for ref, height in zip(source.bodies(), (1.7, 1.5), strict=True):
        body = source.build(ref)
        np.testing.assert_allclose(body.mesh.vertices, person(height_m=height).vertices, atol=1e-12)
        assert body.landmarks.tolist() == list(VERTICES)


def test_the_fingerprint_follows_whatever_shapes_the_bodies(tmp_path: Path) -> None:
    for number in (0, 1):
        write_mesh(tmp_path / f"mesh{number:03d}.ply", PERSON.vertices @ TURN)
    write_by_vertex(tmp_path / "landmarks.json")

    def fingerprint(**options: str) -> str:
        source = ScapeBodies(tmp_path, options=MeshOptions(**options))  # type: ignore[arg-type]
        return source.fingerprint(source.bodies()[1:])

    whole = fingerprint()
    assert fingerprint() == whole and len({whole, fingerprint(up="z"), fingerprint(units="m")}) == 3
    write_mesh(tmp_path / "mesh000.ply", PERSON.vertices @ turn("-x", "z"))  # which decides how the other is turned
    turned = fingerprint()
    write_by_vertex(tmp_path / "landmarks.json", VERTICES[::-1])
    relabelled = fingerprint(up="z")
    write_mesh(tmp_path / "mesh001.ply", person(height_m=1.6).vertices)
    assert len({whole, turned, relabelled, fingerprint(up="z")}) == 4


def test_what_is_not_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(BadConfig, match=r"'scape' needs mesh000\.ply to mesh071\.ply .* found none in"):
        ScapeBodies(tmp_path)
    with pytest.raises(BadConfig, match="'scape' reads a folder, found none at"):
        open_source("scape", tmp_path / "absent")
    with pytest.raises(BadConfig, match="'scape' reads a folder, found a file at"):
        open_source("scape", write_mesh(tmp_path / "mesh000.ply"))
    with pytest.raises(BadConfig, match="landmarks are a file or a folder, found neither at"):
        ScapeBodies(tmp_path, tmp_path / "absent.json")
    with pytest.raises(BadConfig, match="units must be 'auto' or"):
        ScapeBodies(tmp_path, options=MeshOptions(units="feet"))  # type: ignore[arg-type]
    source = ScapeBodies(tmp_path)
    for use in (source.build, lambda body: source.fingerprint([body])):
        with pytest.raises(BadLandmarks, match=r"found none for the meshes in .*: put landmarks\.json there"):
            use(source.bodies()[0])
    with pytest.raises(BadConfig, match="the source 'scape' has no body 'mesh001'"):
        source.build(BodyRef("A", "A", "mesh001", "posture", "train"))


def test_another_topology_is_refused_by_name(tmp_path: Path) -> None:
    write_mesh(tmp_path / "mesh000.ply", PERSON.vertices, PERSON.faces[:-1])
    write_by_vertex(tmp_path / "landmarks.json")
    with pytest.raises(BadLandmarks, match=r"642 vertices and 1280 faces .*found 642 and 1279 in .*000"):
        first(ScapeBodies(tmp_path))


def test_a_broken_mesh_is_refused_with_its_file(tmp_path: Path) -> None:
    write_mesh(tmp_path / "mesh000.ply")
    path = write_mesh(tmp_path / "mesh001.ply", PERSON.vertices, PERSON.faces[:, ::-1])
    write_by_vertex(tmp_path / "landmarks.json")
    source = ScapeBodies(tmp_path)
    with pytest.raises(BadMesh, match="must point outwards") as error:
        source.build(source.bodies()[1])
    assert str(path) in str(error.value) and "\n" not in str(error.value)
