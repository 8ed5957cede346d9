"""The MIT sequences: trees laid out like theirs, whole and in part, and real frames where there are some."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from people_on_disk import PERSON, VERTICES, obj, turn, write_by_vertex, write_mesh
from shapes import ball

from bodyseg_data.bodies import Body, BodyRef, collapsed, open_source
from bodyseg_data.bodies.source import MeshOptions
from bodyseg_data.bodies.sources.paper import MIT_MESHES as MESHES
from bodyseg_data.bodies.sources.paper import MIT_SEQUENCES, MitBodies
from bodyseg_data.core import BadConfig, BadLandmarks, BadMesh
from bodyseg_data.labels import LANDMARKS

FACING = turn("z", "y")  # I_crane begins facing -x
COUNTS = {
    "I_crane": 175,
    "I_jumping": 150,
    "I_march": 250,
    "I_squat": 250,
    "D_bouncing": 175,
    "D_handstand": 175,
    "D_march": 250,
    "D_squat": 250,
}


def frame(root: Path, sequence: str, number: int, suffix: str = ".obj") -> Path:
    return root / sequence / "meshes" / f"mesh_{number:04d}{suffix}"


def write(root: Path, sequence: str, number: int, vertices: NDArray[np.float64] = PERSON.vertices @ FACING) -> Path:
    return write_mesh(frame(root, sequence, number), vertices)


def touch(root: Path, sequence: str, *numbers: int) -> None:
    for number in numbers:
        frame(root, sequence, number).parent.mkdir(parents=True, exist_ok=True)
        frame(root, sequence, number).touch()


def first(source: MitBodies) -> Body:
    return source.build(source.bodies()[0])


@pytest.fixture
def labelled(tmp_path: Path) -> Path:
    """A folder with landmarks for both subjects, of the person that the tests write."""
    for subject in "BC":
        write_by_vertex(tmp_path / f"landmarks_{subject}.json")
    return tmp_path


def test_a_complete_set_has_the_papers_frames(tmp_path: Path) -> None:
    """Nothing is in the files: counting must not read them."""
    for sequence, count in COUNTS.items():
        touch(tmp_path, sequence, *range(count))
    lacking = "landmarks_C.json (for D_bouncing, D_handstand, D_march, D_squat)"
    assert open_source("mit", tmp_path).missing() == (lacking,)
    (tmp_path / "landmarks_C.json").touch()
    source = open_source("mit", tmp_path)
    bodies = source.bodies()
    assert source.missing() == () and len(bodies) == len(MESHES) == 1675
    assert [sum(body.subset == subset for body in bodies) for subset in "BC"] == [825, 850]
    for sequence, count in COUNTS.items():
        frames = [body for body in bodies if body.mesh.startswith(sequence)]
        assert [body.mesh for body in frames] == [f"{sequence}_{number:04d}" for number in range(count)]
        assert {body.split for body in frames} == {"test" if sequence in ("I_jumping", "D_squat") else "train"}


def test_sequences_and_frames_come_in_a_fixed_order(tmp_path: Path) -> None:
    touch(tmp_path, "D_squat", 1)
    touch(tmp_path, "I_march", 10, 2, 250)  # the last is beyond the sequence's end
    touch(tmp_path, "I_jumping", 0)
    touch(tmp_path, "D_march", 0)
    touch(tmp_path, "I_walking", 0)  # not one of the paper's
    (tmp_path / "I_march" / "meshes" / "notes.obj").touch()
    found = MitBodies(tmp_path).bodies()
    assert list(found) == [
        BodyRef("B", "B", "I_jumping_0000", "jumping", "test"),
        BodyRef("B", "B", "I_march_0002", "march", "train"),
        BodyRef("B", "B", "I_march_0010", "march", "train"),
        BodyRef("C", "C", "D_march_0000", "march", "train"),
        BodyRef("C", "C", "D_squat_0001", "squat", "test"),
    ]


def test_missing_frames_are_named(tmp_path: Path) -> None:
    for sequence, count in COUNTS.items():
        if sequence != "I_squat":
            touch(tmp_path, sequence, *(number for number in range(count) if not 3 <= number <= 5))
    (tmp_path / "landmarks_C.json").touch()
    found = collapsed(MitBodies(tmp_path).missing())
    assert found[:2] == [f"{name}/meshes/mesh_0003.obj to mesh_0005.obj" for name in ("I_crane", "I_jumping")]
    assert "I_squat/meshes/mesh_0000.obj to mesh_0249.obj" in found and len(found) == 8


@pytest.mark.parametrize("make", [lambda root: None, lambda root: touch(root, "I_walking", 0)])
def test_a_folder_without_sequences_is_refused(tmp_path: Path, make: Callable[[Path], object]) -> None:
    make(tmp_path)
    with pytest.raises(BadConfig, match="found none in") as error:
        MitBodies(tmp_path)
    assert "I_crane" in str(error.value) and str(tmp_path) in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(BadConfig, match="'mit' reads a folder, found none at"):
        open_source("mit", tmp_path / "absent")


@pytest.mark.parametrize("suffix", [".obj", ".obj.gz", ".ply", ".off"])
def test_a_frame_keeps_its_vertices_and_is_turned_to_the_front(labelled: Path, suffix: str) -> None:
    write_mesh(frame(labelled, "I_crane", 5, suffix), PERSON.vertices @ FACING)
    body = first(MitBodies(labelled))
    assert body.mesh.name == "I_crane_0005"
    np.testing.assert_array_equal(body.mesh.vertices, PERSON.vertices)
    np.testing.assert_array_equal(body.mesh.faces, PERSON.faces)
    assert body.landmarks.tolist() == list(VERTICES)


def test_a_sequence_keeps_one_frame_and_each_begins_at_the_front(labelled: Path) -> None:
    round_he_goes = [FACING, turn("x", "y"), turn("-z", "y")]
    for number, towards in enumerate(round_he_goes):
        write(labelled, "I_march", number, PERSON.vertices @ towards)
        write(labelled, "D_march", number, PERSON.vertices @ round_he_goes[-1 - number])
    source = MitBodies(labelled)
    built = [source.build(ref).mesh.vertices for ref in source.bodies()]
    for march in (round_he_goes, round_he_goes[::-1]):
        for towards in march:
            np.testing.assert_array_equal(built.pop(0), PERSON.vertices @ towards @ march[0].T)


def test_a_handstand_stays_one(labelled: Path) -> None:
    upside_down = PERSON.vertices @ turn("x", "-y")
    write(labelled, "D_handstand", 100, upside_down)
    vertices = first(MitBodies(labelled)).mesh.vertices
    place = dict(zip(LANDMARKS, vertices[list(VERTICES)], strict=True))
    assert place["Sellion"][1] < place["Lt. Digit II"][1]


BROKEN = {
    "a NaN": (b"v nan 1 0", "coordinates must be finite.*at vertex 0"),
    "no number": (b"v 0 one 0", "line 1 is not OBJ"),
    "a cut vertex": (b"v 0.1 1", "line 1 is not OBJ: three numbers must follow 'v', found 2"),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_broken_files_are_refused_by_name(labelled: Path, fault: str) -> None:
    line, message = BROKEN[fault]
    path = write(labelled, "I_squat", 3)
    path.write_bytes(line + path.read_bytes()[path.read_bytes().index(b"\n") :])
    with pytest.raises(BadMesh, match=message) as error:
        first(MitBodies(labelled))
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_bodies_of_no_human_size_or_inside_out_are_refused(labelled: Path) -> None:
    path = write(labelled, "I_squat", 3, PERSON.vertices @ FACING * 4)
    with pytest.raises(BadMesh, match=r"mesh_0003\.obj: .* at its largest: found .* 6\.8 "):
        first(MitBodies(labelled))
    path.write_bytes(obj(PERSON.vertices @ FACING, PERSON.faces[:, ::-1]))
    with pytest.raises(BadMesh, match=r"must point outwards.*mesh_0003\.obj"):
        first(MitBodies(labelled))
    write(labelled, "I_squat", 3, PERSON.vertices @ FACING * 1000)
    np.testing.assert_allclose(first(MitBodies(labelled)).mesh.vertices, PERSON.vertices, atol=1e-9)
    with pytest.raises(BadMesh, match="which would fit in mm"):
        first(MitBodies(labelled, options=MeshOptions(units="m")))


def test_a_file_that_vanished_is_refused(labelled: Path) -> None:
    path = write(labelled, "I_squat", 3)
    source = MitBodies(labelled)
    path.unlink()
    for use in (source.build, lambda body: source.fingerprint([body])):
        with pytest.raises(BadMesh, match=r"cannot read .*mesh_0003\.obj: No such file"):
            use(source.bodies()[0])


def test_another_mans_topology_is_refused(tmp_path: Path) -> None:
    write_mesh(frame(tmp_path, "I_squat", 3), ball().vertices, ball().faces)
    with pytest.raises(BadLandmarks, match=r"landmarks mit_I .* 10002 vertices .*mesh_0003\.obj"):
        first(MitBodies(tmp_path))


def test_landmarks_of_subject_c_are_the_users(tmp_path: Path) -> None:
    root = tmp_path / "mit"
    write(root, "D_bouncing", 0)
    write(root, "D_march", 0)
    source = MitBodies(root)
    for use in (source.build, lambda body: source.fingerprint(source.bodies())):
        with pytest.raises(BadLandmarks, match=r"none for subject C \(D_bouncing, .*: put landmarks_C\.json"):
            use(source.bodies()[0])
    given = write_by_vertex(tmp_path / "marks" / "landmarks_C.json")
    for landmarks in (given, given.parent):
        assert first(MitBodies(root, landmarks)).landmarks.tolist() == list(VERTICES)
    write_by_vertex(root / "landmarks_C.json", VERTICES[::-1])
    assert first(MitBodies(root)).landmarks.tolist() == list(VERTICES[::-1])
    assert first(MitBodies(root, given)).landmarks.tolist() == list(VERTICES)


def test_a_file_is_not_taken_for_subject_b(tmp_path: Path) -> None:
    write(tmp_path, "I_crane", 0)
    given = write_by_vertex(tmp_path / "mine.json")
    with pytest.raises(BadConfig, match=r"file is for subject C .* found none of its frames"):
        MitBodies(tmp_path, given)


def test_bodies_of_other_sources_are_refused(tmp_path: Path) -> None:
    touch(tmp_path, "I_crane", 0)
    with pytest.raises(BadConfig, match="no body 'posture-00'"):
        MitBodies(tmp_path).build(BodyRef("A", "A", "posture-00", "standing", "train"))


def test_real_frames(mit_folder: Path) -> None:
    source = MitBodies(mit_folder)
    crane = [body for body in source.bodies() if body.pose == "crane"]
    assert crane and {body.split for body in crane} == {"train"}
    gaps = {name for name in source.missing() if name.startswith("I_crane")}
    assert len(crane) + len(gaps) == MIT_SEQUENCES["B"]["I_crane"]
    first = source.build(crane[0])
    assert crane[0].mesh == "I_crane_0000"
    assert first.mesh.vertices.shape == (10002, 3) and first.mesh.faces.shape == (20000, 3)
    assert 1.7 < np.ptp(first.mesh.vertices[:, 1]) < 1.95
    place = dict(zip(LANDMARKS, first.mesh.vertices[first.landmarks], strict=True))
    for left in (name for name in LANDMARKS if name.startswith("Lt.")):
        # The man stands upright, so that his left is on the left however wide the pair is apart.
        assert place[left][0] > place[left.replace("Lt.", "Rt.")][0], left
    assert place["Sellion"][2] > place["Nuchale"][2] + 0.1
    assert place["Sellion"][1] > place["Substernale"][1] > place["Lt. Digit II"][1]
    # One mesh in all frames: the surface is carried along, so faces and landmarks are the same.
    last = source.build(crane[-1])
    np.testing.assert_array_equal(last.mesh.faces, first.mesh.faces)
    np.testing.assert_array_equal(last.landmarks, first.landmarks)
    assert np.abs(last.mesh.vertices - first.mesh.vertices).max() > 0.3
    # What is found is what is so: metres, y up.
    np.testing.assert_array_equal(
        MitBodies(mit_folder, options=MeshOptions("m", "y")).build(crane[-1]).mesh.vertices, last.mesh.vertices
    )
