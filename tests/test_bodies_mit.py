"""The MIT sequences: small made-up trees of OBJ files, and real frames where there are some."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from shapes import ball, figure

from bodyseg_data.bodies import BodyRef, open_source
from bodyseg_data.bodies import mit as mit_module
from bodyseg_data.bodies.mit import MitBodies
from bodyseg_data.errors import BadConfig, BadLandmarks, BadMesh
from bodyseg_data.landmarks import LandmarkSet
from bodyseg_data.mesh import Mesh
from bodyseg_data.parts import LANDMARKS

FIGURE = figure()


def obj_text(vertices: NDArray[np.float64], faces: NDArray[np.int32], face_form: str = "{}") -> str:
    """OBJ text, with the lines that other programs add and this one passes over."""
    lines = ["# made for a test", "o body", *("v {!r} {!r} {!r}".format(*map(float, vertex)) for vertex in vertices)]
    lines += ["f " + " ".join(face_form.format(corner + 1) for corner in face) for face in faces]
    return "\n".join([*lines, "s off", ""])


def write(root: Path, sequence: str, number: str, text: str) -> Path:
    path = root / sequence / "meshes" / f"mesh_{number}.obj"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def turned_away(mesh: Mesh) -> NDArray[np.float64]:
    """A mesh of the body frame as the sequences hold it, facing -x."""
    x, y, z = mesh.vertices.T
    return np.stack([-z, y, x], axis=1)


GOOD = obj_text(turned_away(FIGURE), FIGURE.faces)


@pytest.fixture
def landmarks_of_figure(monkeypatch: pytest.MonkeyPatch) -> LandmarkSet:
    """Landmarks for the small figure, in place of the real man's."""
    landmarks = LandmarkSet(
        "figure", "figure", len(FIGURE.vertices), len(FIGURE.faces), tuple(range(0, 2 * len(LANDMARKS), 2))
    )
    names: list[str] = []

    def load(name: str) -> LandmarkSet:
        names.append(name)
        assert name == "mit_I"
        return landmarks

    monkeypatch.setattr(mit_module, "load_landmarks", load)
    return landmarks


def test_sequences_and_frames_come_in_a_fixed_order(tmp_path: Path) -> None:
    for sequence, number in (
        ("D_squat", "0001"),
        ("I_march", "0010"),
        ("I_march", "0002"),
        ("I_jumping", "0000"),
        ("D_march", "0000"),
    ):
        write(tmp_path, sequence, number, GOOD)
    write(tmp_path, "I_walking", "0000", GOOD)  # not one of the paper's
    (tmp_path / "I_march" / "meshes" / "notes.obj").write_text("")
    found = MitBodies(tmp_path).bodies()
    assert list(found) == [
        BodyRef("B", "B", "I_jumping_0000", "jumping", "test"),
        BodyRef("B", "B", "I_march_0002", "march", "train"),
        BodyRef("B", "B", "I_march_0010", "march", "train"),
        BodyRef("C", "C", "D_march_0000", "march", "train"),
        BodyRef("C", "C", "D_squat_0001", "squat", "test"),
    ]
    assert open_source("mit", tmp_path).bodies() == found


@pytest.mark.parametrize("make", [lambda root: None, lambda root: write(root, "I_walking", "0000", GOOD)])
def test_a_folder_without_sequences_is_refused(tmp_path: Path, make: Callable[[Path], object]) -> None:
    make(tmp_path)
    with pytest.raises(BadConfig, match="found none in") as error:
        MitBodies(tmp_path)
    assert "I_crane" in str(error.value) and str(tmp_path) in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(BadConfig, match="found none in"):
        MitBodies(tmp_path / "absent")


@pytest.mark.parametrize("face_form", ["{}", "{}/7", "{}//7", "{}/7/7"])
def test_a_frame_keeps_its_vertices_and_is_turned_to_the_front(
    tmp_path: Path, landmarks_of_figure: LandmarkSet, face_form: str
) -> None:
    write(tmp_path, "I_crane", "0005", obj_text(turned_away(FIGURE), FIGURE.faces, face_form))
    source = MitBodies(tmp_path)
    body = source.build(source.bodies()[0])
    assert body.mesh.name == "I_crane_0005"
    np.testing.assert_array_equal(body.mesh.vertices, FIGURE.vertices)
    np.testing.assert_array_equal(body.mesh.faces, FIGURE.faces)
    assert body.landmarks.tolist() == list(landmarks_of_figure.vertices)


def _with_vertex(line: str) -> str:
    lines = GOOD.split("\n")
    lines[2] = line
    return "\n".join(lines)


def _with_face(line: str) -> str:
    return GOOD.replace("\ns off", f"\n{line}\ns off")


BROKEN = {
    "a NaN": (_with_vertex("v nan 1 0"), "coordinates must be finite.*at vertex 0"),
    "an infinity": (_with_vertex("v 0 inf 0"), "coordinates must be finite"),
    "no number": (_with_vertex("v 0 one 0"), "plain triangles: could not convert"),
    "a cut vertex": (_with_vertex("v 0.1 1"), "line 3: three numbers must follow 'v', found 2"),
    "a square": (_with_face("f 1 2 3 4"), "three numbers must follow 'f', found 4"),
    "a lone f": (_with_face("f"), "three numbers must follow 'f', found 0"),
    "a corner that is no number": (_with_face("f 1 2 x"), "plain triangles: invalid literal"),
    "a corner beyond the vertices": (_with_face("f 1 2 99999"), "faces must use vertices 0 to"),
    "a corner 0": (_with_face("f 0 1 2"), "faces must use vertices 0 to"),
    "an enormous corner": (_with_face("f 1 2 99999999999999999999"), "plain triangles"),
    "an empty file": ("", "needs vertices and faces, found 0 and 0"),
    "no faces": (GOOD[: GOOD.index("\nf ")], "needs vertices and faces, found .* and 0"),
    "inside out": (obj_text(turned_away(FIGURE), FIGURE.faces[:, ::-1]), "inside out"),
    "millimetres": (obj_text(turned_away(FIGURE) * 1000, FIGURE.faces), "at its largest, found 1.69e\\+03 m"),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_broken_files_are_refused_by_name(tmp_path: Path, landmarks_of_figure: LandmarkSet, fault: str) -> None:
    text, message = BROKEN[fault]
    path = write(tmp_path, "I_squat", "0003", text)
    source = MitBodies(tmp_path)
    with pytest.raises(BadMesh, match=message) as error:
        source.build(source.bodies()[0])
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_bytes_that_are_not_text_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path, "I_squat", "0003", "")
    path.write_bytes(b"v 0 0 \xff\n")
    source = MitBodies(tmp_path)
    with pytest.raises(BadMesh, match="not an OBJ file"):
        source.build(source.bodies()[0])


def test_a_file_that_vanished_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, "I_squat", "0003", GOOD)
    source = MitBodies(tmp_path)
    path.unlink()
    with pytest.raises(BadMesh, match=r"cannot read .*mesh_0003\.obj: No such file"):
        source.build(source.bodies()[0])


def test_another_mans_topology_is_refused(tmp_path: Path) -> None:
    mesh = ball()
    write(tmp_path, "I_squat", "0003", obj_text(mesh.vertices, mesh.faces))
    source = MitBodies(tmp_path)
    with pytest.raises(BadLandmarks, match="10002 vertices"):
        source.build(source.bodies()[0])


def test_subject_c_has_no_landmarks(tmp_path: Path) -> None:
    write(tmp_path, "D_bouncing", "0000", GOOD)
    source = MitBodies(tmp_path)
    with pytest.raises(BadLandmarks, match="found none for subject C .* at mesh D_bouncing_0000"):
        source.build(source.bodies()[0])


def test_bodies_of_other_sources_are_refused(tmp_path: Path) -> None:
    write(tmp_path, "I_crane", "0000", GOOD)
    with pytest.raises(BadConfig, match="no body 'posture-00'"):
        MitBodies(tmp_path).build(BodyRef("A", "A", "posture-00", "standing", "train"))


def test_real_frames(mit_folder: Path) -> None:
    source = MitBodies(mit_folder)
    crane = [body for body in source.bodies() if body.pose == "crane"]
    assert crane and {body.split for body in crane} == {"train"}
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
