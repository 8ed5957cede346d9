"""CAESAR: a scan and a .lnd file a subject, in one folder or in several, some of them broken."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest
from people_on_disk import PERSON, VERTICES, person, turn, write_by_vertex, write_lnd, write_mesh

from bodyseg_data.bodies import Body, BodyRef, open_source
from bodyseg_data.bodies.source import MeshOptions
from bodyseg_data.bodies.sources.paper import CaesarBodies
from bodyseg_data.core import BadConfig, BadLandmarks, BadMesh

TURN = turn("-x", "z")  # as scanners hold people: millimetres, z up
POINTS = PERSON.vertices[list(VERTICES)] @ TURN


def write_subject(folder: Path, name: str = "csr0001a", landmarks: str | None = None) -> None:
    write_mesh(folder / f"{name}.ply", PERSON.vertices @ TURN * 1000)
    write_lnd(folder / (landmarks or f"{name}.lnd"), POINTS)


def first(source: CaesarBodies) -> Body:
    return source.build(source.bodies()[0])


def complete(folder: Path, count: int = 583) -> Path:
    """As many empty files as there are: counting must not read them."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        (folder / f"csr{number:04d}a.ply").touch()
        (folder / f"csr{number:04d}a.lnd").touch()
    return folder


def test_a_complete_set_has_583_people_split_467_to_116(tmp_path: Path) -> None:
    source = open_source("caesar", complete(tmp_path))
    bodies = source.bodies()
    assert source.missing() == () and len(bodies) == 583
    assert bodies[0] == BodyRef("people", "csr0000a", "csr0000a", "standing", "train")
    assert [body.split for body in bodies] == ["train"] * 467 + ["test"] * 116
    assert len({body.subject for body in bodies}) == 583


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    complete(tmp_path, 580)
    (tmp_path / "csr0007a.lnd").unlink()
    assert CaesarBodies(tmp_path).missing() == ("csr0007a.lnd", "subject 581", "subject 582", "subject 583")


def test_more_than_the_papers_people_are_refused(tmp_path: Path) -> None:
    complete(tmp_path, 584)
    with pytest.raises(BadConfig, match="583 subjects, found 584 in .* --source folder"):
        CaesarBodies(tmp_path)


@pytest.mark.parametrize(
    "mesh", ["csr0001a.ply", "CSR0001A.PLY", "csr0001a.obj", "csr0001a.off.gz", "scans/csr0001a.ply"]
)
@pytest.mark.parametrize("landmarks", ["csr0001a.lnd", "CSR0001A.LND", "marks/deep/csr0001a.lnd"])
def test_scan_and_landmarks_are_placed_together(tmp_path: Path, mesh: str, landmarks: str) -> None:
    write_mesh(tmp_path / mesh, PERSON.vertices @ TURN * 1000)
    write_lnd(tmp_path / landmarks, POINTS)
    body = first(CaesarBodies(tmp_path))
    np.testing.assert_allclose(body.mesh.vertices, PERSON.vertices, atol=1e-9)
    assert body.landmarks.tolist() == list(VERTICES)
    assert len(body.notes) == 1 and re.fullmatch(r"landmarks snapped by up to 0\.0 mm \(.+\)", body.notes[0])


def test_every_subject_is_placed_by_itself(tmp_path: Path) -> None:
    write_subject(tmp_path)
    other = turn("y", "x")
    write_mesh(tmp_path / "csr0002a.ply", PERSON.vertices @ other)
    write_lnd(tmp_path / "csr0002a.lnd", PERSON.vertices[list(VERTICES)] @ other)
    source = CaesarBodies(tmp_path)
    for ref in source.bodies():
        np.testing.assert_allclose(source.build(ref).mesh.vertices, PERSON.vertices, atol=1e-9)


def test_only_standing_scans_are_read(tmp_path: Path) -> None:
    for name in ("csr0001a", "csr0001b", "csr0001c", "csr0002b", "it3c"):
        (tmp_path / f"{name}.ply").touch()
    assert [body.mesh for body in CaesarBodies(tmp_path).bodies()] == ["csr0001a", "csr0002b", "it3c"]


def test_names_become_keys_without_colliding(tmp_path: Path) -> None:
    for name in ("a.1", "a 1", "a+1", "a_1", "a-1"):
        (tmp_path / f"{name}.ply").touch()
    assert [body.mesh for body in CaesarBodies(tmp_path).bodies()] == ["a+201", "a+2B1", "a-1", "a+2E1", "a_1"]


def test_doubled_files_are_refused(tmp_path: Path) -> None:
    write_subject(tmp_path)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "CSR0001A.obj").touch()
    with pytest.raises(BadConfig, match="one mesh, found csr0001a in .* and in .*other"):
        CaesarBodies(tmp_path)


def test_doubled_landmarks_are_refused_unless_one_is_beside_the_mesh(tmp_path: Path) -> None:
    write_mesh(tmp_path / "csr0001a.ply", PERSON.vertices @ TURN)
    for folder in ("x", "y"):
        write_lnd(tmp_path / folder / "csr0001a.lnd", POINTS)
    with pytest.raises(BadConfig, match=r"found .*x/csr0001a\.lnd and .*y/csr0001a\.lnd for "):
        CaesarBodies(tmp_path)
    write_lnd(tmp_path / "csr0001a.lnd", POINTS)
    assert first(CaesarBodies(tmp_path)).landmarks.tolist() == list(VERTICES)
    assert first(CaesarBodies(tmp_path, tmp_path / "x")).landmarks.tolist() == list(VERTICES)


def test_one_file_by_vertex_serves_fitted_templates(tmp_path: Path) -> None:
    for number, height in ((1, 1.7), (2, 1.5)):
        write_mesh(tmp_path / "meshes" / f"csr{number:04d}a.obj", person(height_m=height).vertices @ TURN)
    given = write_by_vertex(tmp_path / "all.json")
    source = CaesarBodies(tmp_path / "meshes", given)
    assert source.missing()[0] == "subject 003"
    for ref, height in zip(source.bodies(), (1.7, 1.5), strict=True):
        np.testing.assert_allclose(source.build(ref).mesh.vertices, person(height_m=height).vertices, atol=1e-12)


@pytest.mark.usefixtures("pymeshlab")
def test_a_scan_is_repaired_and_says_so(tmp_path: Path) -> None:
    """Faces turned over: `Mesh` refuses them, and with its landmarks by coordinate the scan can be mended."""
    faces = PERSON.faces.copy()
    faces[::7] = faces[::7, ::-1]
    write_mesh(tmp_path / "csr0001a.ply", PERSON.vertices @ TURN * 1000, faces)
    write_lnd(tmp_path / "csr0001a.lnd", POINTS)
    with pytest.raises(BadMesh, match=r"neighbouring faces must agree, .*; --pymeshlab repairs most scans\)$"):
        first(CaesarBodies(tmp_path))
    source = CaesarBodies(tmp_path)
    with pytest.raises(BadMesh, match="--pymeshlab repairs most scans"):  # before the first view is rendered
        source.check(source.bodies()[0])
    body = first(CaesarBodies(tmp_path, options=MeshOptions(pymeshlab=True)))
    assert len(body.notes) == 2 and body.notes[0].startswith("repaired: neighbouring faces must agree")
    near = body.mesh.vertices[body.landmarks] - PERSON.vertices[list(VERTICES)]
    assert np.abs(near).max() < 1e-5 and body.mesh.signed_volume() > 0


@pytest.mark.usefixtures("pymeshlab")
def test_stray_vertices_do_not_matter(tmp_path: Path) -> None:
    vertices = np.concatenate([PERSON.vertices @ TURN * 1000, [[np.nan] * 3, [1e6, 0, 0]]])
    write_mesh(tmp_path / "csr0001a.ply", vertices)
    write_lnd(tmp_path / "csr0001a.lnd", POINTS)
    body = first(CaesarBodies(tmp_path, options=MeshOptions(pymeshlab=True)))
    assert len(body.mesh.vertices) == len(PERSON.vertices) and "coordinates must be finite" in body.notes[0]


def test_landmarks_off_the_surface_are_noted(tmp_path: Path) -> None:
    write_mesh(tmp_path / "csr0001a.ply", PERSON.vertices @ TURN * 1000)
    off = POINTS.copy()
    off[0] = (PERSON.vertices[VERTICES[0]] + (0, 0.005, 0.019)) @ TURN
    write_lnd(tmp_path / "csr0001a.lnd", off)
    notes = first(CaesarBodies(tmp_path)).notes
    assert len(notes) == 1 and re.fullmatch(r"landmarks snapped by up to (19|20)\.\d mm \(Sellion\)", notes[0])
    off[0] = (PERSON.vertices[VERTICES[0]] + (0, 0, 0.1)) @ TURN
    write_lnd(tmp_path / "csr0001a.lnd", off)
    with pytest.raises(BadLandmarks, match=r"within 3 cm of the surface, found 'Sellion' .* cm off"):
        first(CaesarBodies(tmp_path))


def test_landmarks_in_metres_are_understood(tmp_path: Path) -> None:
    write_mesh(tmp_path / "csr0001a.ply", PERSON.vertices @ TURN * 1000)
    write_lnd(tmp_path / "csr0001a.lnd", POINTS, unit=1)
    body = first(CaesarBodies(tmp_path))
    assert body.landmarks.tolist() == list(VERTICES)
    assert body.notes[0] == "landmarks read as metres: as millimetres they are a thousandth of the body"
    assert body.notes[1].startswith("landmarks snapped by up to 0.1 mm (")  # the file has four decimals


def test_subjects_that_cannot_be_labelled_are_named_before_anything_is_rendered(tmp_path: Path) -> None:
    for number in range(1, 9):
        write_subject(tmp_path, f"csr{number:04d}a")
    for number in range(2, 5):
        (tmp_path / f"csr{number:04d}a.lnd").unlink()
    write_lnd(tmp_path / "csr0006a.lnd", POINTS, {"Lt. PSIS": None})
    write_lnd(tmp_path / "csr0007a.lnd", POINTS, {"Rt. Acromion": "Rt. Acromio", "Cervicale": "Cervical"})
    source = CaesarBodies(tmp_path)
    with pytest.raises(BadLandmarks, match=r"subject csr0002a: no csr0002a\.lnd anywhere in"):
        source.fingerprint(source.bodies())
    with pytest.raises(BadLandmarks, match=r"subject csr0006a: .*csr0006a\.lnd: 'Lt. PSIS' missing"):
        source.fingerprint([source.bodies()[5]])
    with pytest.raises(BadLandmarks, match=r"subject csr0006a: .*'Lt. PSIS' missing"):
        source.build(source.bodies()[5])
    assert source.build(source.bodies()[6]).landmarks.tolist() == list(VERTICES)
    good = [source.bodies()[0], source.bodies()[6]]
    assert source.fingerprint(good) == CaesarBodies(tmp_path).fingerprint(good)


def test_an_empty_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadConfig, match="'caesar' needs one mesh .* a subject: found none in"):
        CaesarBodies(tmp_path)


def test_exchanged_sides_are_seen(tmp_path: Path) -> None:
    """Right for left turns a body back to front, and every label with it."""
    write_subject(tmp_path)
    file = tmp_path / "csr0001a.lnd"
    names = {"Rt.": "Lt.", "Lt.": "Rt."}
    file.write_text(re.sub("|".join(names), lambda match: names[match[0]], file.read_text()))
    message = r"with the trunk upright .* \(or right and left landmarks are exchanged\)"
    with pytest.raises(BadMesh, match=rf"csr0001a\.ply: {message}"):
        first(CaesarBodies(tmp_path))


def test_links_to_folders_are_followed_once_and_pipes_are_no_files(tmp_path: Path) -> None:
    write_subject(tmp_path / "disk")
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "linked").symlink_to(tmp_path / "disk")
    (tmp_path / "disk" / "round").symlink_to(tmp_path / "data")
    os.mkfifo(tmp_path / "data" / "csr0002a.ply")
    (tmp_path / "data" / "csr0003a.ply").symlink_to("/dev/zero")
    source = CaesarBodies(tmp_path / "data")
    assert [body.subject for body in source.bodies()] == ["csr0001a"]
    assert first(source).landmarks.tolist() == list(VERTICES)
