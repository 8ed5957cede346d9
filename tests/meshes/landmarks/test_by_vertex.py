"""Landmark sets: those that ship are valid and symmetric, and every broken file is refused by name."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benches.data.surface.areas import part_areas
from shapes import ball

from bodyseg_data.bodies import open_source
from bodyseg_data.core import BadLandmarks
from bodyseg_data.labels import LANDMARKS, PARTS
from bodyseg_data.meshes import LandmarkSet, Mesh, load_landmark_file, load_landmarks, partition
from bodyseg_data.meshes.landmarks import LANDMARKS_FORMAT, parse_landmarks
from bodyseg_data.packing import Packing

PAIRS = [part.label for part in PARTS if part.side == "right"]


def tree(**changes: Any) -> dict[str, Any]:
    """A valid set for `ball(subdivisions=3)`, with changes."""
    table = {name: 5 * label for label, name in enumerate(LANDMARKS)}
    whole = {"format": "bodyseg landmarks 1", "topology": "a ball", "vertex_count": 642, "face_count": 1280}
    return {**whole, "landmarks": table, **changes}


def without(table: dict[str, Any], *keys: str) -> dict[str, Any]:
    return {key: value for key, value in table.items() if key not in keys}


def test_vertices_come_in_the_order_of_parts_whatever_the_order_in_the_file() -> None:
    table = tree()["landmarks"]
    shuffled = {name: table[name] for name in sorted(table)}
    assert list(shuffled) != list(LANDMARKS)
    found = parse_landmarks(json.dumps(tree(landmarks=shuffled)), "here").for_mesh(ball(subdivisions=3))
    assert found.dtype == np.int64
    np.testing.assert_array_equal(found, 5 * np.arange(33))


def test_a_file_is_read_by_path(tmp_path: Path) -> None:
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(tree()), encoding="utf-8")
    landmarks = load_landmark_file(path)
    assert isinstance(landmarks, LandmarkSet)
    assert (landmarks.source, landmarks.topology) == (str(path), "a ball")


TABLE = tree()["landmarks"]
BROKEN = {
    "no format": (without(tree(), "format"), "'format' must be 'bodyseg landmarks 1'"),
    "other format": (tree(format="bodyseg landmarks 2"), "'format' must be 'bodyseg landmarks 1'"),
    "a list": ([1, 2], "must hold a JSON object, found list"),
    "missing key": (without(tree(), "face_count"), "number 'face_count' is missing"),
    "unknown key": (tree(colour="red"), "unknown 'colour'"),
    "topology": (tree(topology=3), "'topology' must be text, found 3"),
    "vertex count": (tree(vertex_count=0), "'Sellion' must be a vertex, 0 to -1, found 0"),
    "face count": (tree(face_count=1.5), "'face_count' must be a whole number, found 1.5"),
    "no table": (tree(landmarks=[1, 2]), r"'landmarks' must be a table, found \[1, 2\]"),
    "missing landmark": (
        tree(landmarks=without(TABLE, "Sellion", "Lt. PSIS")),
        "landmark 'Sellion', 'Lt. PSIS' is missing",
    ),
    "misspelt landmark": (
        tree(landmarks={**without(TABLE, "Lt. PSIS"), "Lt. PSISS": 3}),
        r"landmark 'Lt\. PSIS' \(misspelt as 'Lt\. PSISS'\?\) is missing",
    ),
    "three at a vertex": (
        tree(landmarks={**TABLE, "Lt. PSIS": TABLE["Sellion"], "Nuchale": TABLE["Sellion"]}),
        "at most two landmarks may share a vertex, found 'Sellion', 'Nuchale', 'Lt. PSIS' at 0",
    ),
    "out of range": (
        tree(landmarks={**TABLE, "Nuchale": 642}),
        "'Nuchale' must be a vertex, 0 to 641, found 642",
    ),
    "negative": (tree(landmarks={**TABLE, "Nuchale": -1}), "'Nuchale' must be a vertex, .* found -1"),
    "truth value": (tree(landmarks={**TABLE, "Nuchale": True}), "'Nuchale' must be a finite number, found 'True'"),
    "fraction": (tree(landmarks={**TABLE, "Nuchale": 5.5}), "'Nuchale' must be a whole number, found 5.5"),
}


@pytest.mark.parametrize(("broken", "message"), BROKEN.values(), ids=BROKEN)
def test_a_broken_set_is_refused_with_its_file_and_landmark(tmp_path: Path, broken: Any, message: str) -> None:
    path = tmp_path / "broken.json"
    path.write_text(json.dumps(broken), encoding="utf-8")
    with pytest.raises(BadLandmarks, match=message) as caught:
        load_landmark_file(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "not json", "[" * 100_000, '{"x": 1, "x": 2}'])
def test_text_that_is_not_json_is_refused(text: str) -> None:
    with pytest.raises(BadLandmarks, match="landmarks here is not JSON"):
        parse_landmarks(text, "here")


def test_a_file_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadLandmarks, match=r"cannot read .*absent\.json"):
        load_landmark_file(tmp_path / "absent.json")
    (tmp_path / "bytes.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(BadLandmarks, match=r"bytes\.json is not JSON"):
        load_landmark_file(tmp_path / "bytes.json")


@pytest.mark.parametrize("name", ["opn", "", "../open", "open/"])
def test_an_unknown_name_lists_the_sets_there_are(name: str) -> None:
    with pytest.raises(BadLandmarks, match=f"called {name!r}: give mit_I or open$"):
        load_landmarks(name)


@pytest.mark.parametrize("change", [{"vertex_count": 643}, {"face_count": 1279}])
def test_a_mesh_of_another_topology_is_refused(change: dict[str, int]) -> None:
    landmarks = parse_landmarks(json.dumps(tree(**change)), "here")
    with pytest.raises(BadLandmarks, match=r"landmarks here .*\(a ball\), found 642 and 1280 in mesh b"):
        landmarks.for_mesh(ball(subdivisions=3, name="b"))


def test_a_landmark_beside_the_surface_is_refused() -> None:
    whole = ball(subdivisions=3)
    mesh = Mesh("b", np.concatenate([whole.vertices, [[0.0, 0.0, 0.0]]]), whole.faces)
    landmarks = LandmarkSet("here", "a ball", 643, 1280, (642, *range(32)))
    with pytest.raises(BadLandmarks, match="no face of .* uses that of 'Sellion'"):
        landmarks.for_mesh(mesh)


def test_shipped_sets_are_valid() -> None:
    for name, vertices, faces in (("open", 13718, 27420), ("mit_I", 10002, 20000)):
        landmarks = load_landmarks(name)
        assert (landmarks.vertex_count, landmarks.face_count) == (vertices, faces)
        assert len(set(landmarks.vertices)) == 33


@pytest.fixture(scope="module")
def standing() -> tuple[Mesh, np.ndarray[Any, np.dtype[np.int64]]]:
    pytest.importorskip("anny")
    source = open_source("open")
    body = source.build(source.bodies()[0])
    return body.mesh, body.landmarks


def test_the_open_body_has_its_own_left_and_right_and_front_and_back(standing: Any) -> None:
    mesh, landmarks = standing
    places = mesh.vertices[landmarks] - mesh.centre
    for part in PARTS:
        x = places[part.label, 0]
        assert {"left": x > 0.02, "right": x < -0.02, "middle": abs(x) < 0.01}[part.side], part.landmark
    # A point on the front looks to the front.
    normals = np.zeros_like(mesh.vertices)
    for corner in range(3):
        np.add.at(normals, mesh.faces[:, corner], mesh.normals)
    for part in PARTS:
        z = normals[landmarks[part.label], 2]
        assert {"front": z > 0, "back": z < 0, "both": True}[part.face], part.landmark


def test_open_bodies_are_labelled_by_the_landmarks_of_a_file(standing: Any, tmp_path: Path) -> None:
    mesh, landmarks = standing
    shipped = load_landmarks("open")
    nose, brow = landmarks[LANDMARKS.index("Sellion")], landmarks[LANDMARKS.index("Nuchale")]
    file = tmp_path / "mine.json"
    exchanged = tuple({nose: brow, brow: nose}.get(vertex, vertex) for vertex in shipped.vertices)
    file.write_text(replace(shipped, vertices=tuple(map(int, exchanged))).to_json())
    source, plain = open_source("open", landmarks=file), open_source("open")
    refs = source.bodies()[:1]
    body = source.build(refs[0])
    assert np.array_equal(body.mesh.vertices, mesh.vertices) and body.landmarks.tolist() == list(exchanged)
    own = body.partition("edges").labels
    assert (own[nose], own[brow]) == (LANDMARKS.index("Nuchale"), LANDMARKS.index("Sellion"))
    assert source.fingerprint(refs) != plain.fingerprint(refs)
    assert Packing("open", landmarks=file).opened().fingerprint(refs) == source.fingerprint(refs)
    file.write_text(shipped.to_json())
    assert Packing("open", landmarks=file).opened("again").fingerprint(refs) == plain.fingerprint(refs)


def test_landmarks_of_other_meshes_are_refused_for_open_bodies(tmp_path: Path) -> None:
    file = tmp_path / "mine.json"
    points = {name: [0.0, 0.0, 0.0] for name in LANDMARKS}
    for text, message in (
        (load_landmarks("mit_I").to_json(), "are for meshes of 10002 .* found 13718 and 27420 in bodies of 'wide'"),
        (
            json.dumps({"format": LANDMARKS_FORMAT, "units": "m", "points": points}),
            "'wide' needs them by vertex",
        ),
        ("{", "mine.json is not JSON"),
    ):
        file.write_text(text)
        with pytest.raises(BadLandmarks, match=message):
            open_source("wide", landmarks=file)
    with pytest.raises(BadLandmarks, match="cannot read .*absent.json"):
        open_source("open", landmarks=tmp_path / "absent.json")


@pytest.mark.parametrize("place", ["an eye", "the tongue", "the mouth"])
def test_landmarks_of_open_bodies_lie_on_the_skin(place: str, tmp_path: Path) -> None:
    shipped, file = load_landmarks("open"), tmp_path / "mine.json"
    vertex = {"an eye": 13574, "the tongue": 13348, "the mouth": 525}[place]
    file.write_text(replace(shipped, vertices=(vertex, *shipped.vertices[1:])).to_json())
    with pytest.raises(BadLandmarks) as refused:
        open_source("everyday", landmarks=file)
    rule = "must lie on the skin, not on an eye or inside the head"
    assert str(refused.value) == f"landmarks {file}: 'Sellion' {rule}, found vertex {vertex}"


def test_the_open_body_is_symmetric(standing: Any) -> None:
    mesh, landmarks = standing
    places = mesh.vertices[landmarks]
    other = [PARTS[label].mirror for label in PAIRS]
    np.testing.assert_allclose(places[PAIRS], places[other] * (-1, 1, 1), atol=5e-4)


def test_landmarks_of_the_open_body_stand_in_anatomical_order(standing: Any) -> None:
    mesh, landmarks = standing
    height = dict(zip(LANDMARKS, mesh.vertices[landmarks, 1] / np.ptp(mesh.vertices[:, 1]), strict=True))
    # Shares of the stature, as annotated on people who stand, with room for the person.
    for name, share in (
        ("Sellion", 0.93),
        ("Supramenton", 0.88),
        ("Cervicale", 0.85),
        ("Suprasternale", 0.79),
        ("Rt. Acromion", 0.795),
        ("Rt. Axilla, Post.", 0.735),
        ("Rt. Thelion/Bustpoint", 0.71),
        ("Substernale", 0.67),
        ("10th Rib Midspine", 0.655),
        ("Rt. ASIS", 0.56),
        ("Rt. Trochanterion", 0.52),
        ("Rt. Femoral Lateral Epicn", 0.29),
        ("Rt. Lateral Malleolus", 0.045),
        ("Rt. Digit II", 0.01),
    ):
        assert height[name] == pytest.approx(share, abs=0.02), name


def test_parts_of_the_open_body_are_neither_tiny_nor_huge(standing: Any) -> None:
    mesh, landmarks = standing
    shares = part_areas(mesh, partition(mesh, landmarks).labels)
    assert shares.min() >= 0.008 and shares.max() <= 0.053
    for right in PAIRS:
        assert shares[right] == pytest.approx(shares[PARTS[right].mirror], abs=0.003), LANDMARKS[right]


def test_the_mit_set_fits_real_frames(mit_folder: Path) -> None:
    landmarks = load_landmarks("mit_I")
    for frame in ("0000", "0090", "0120"):
        mesh = _frame(mit_folder / "I_crane" / "meshes" / f"mesh_{frame}.obj")
        shares = part_areas(mesh, partition(mesh, landmarks.for_mesh(mesh)).labels)
        # Crumpled trouser legs have more surface than legs.
        assert shares.min() >= 0.006 and shares.max() <= 0.066
        if frame == "0000":  # upright; in the others one leg is lifted and its clothes stretch
            for right in PAIRS:
                assert shares[right] == pytest.approx(shares[PARTS[right].mirror], abs=0.007), LANDMARKS[right]


def test_the_mit_subject_has_his_own_left_and_right(mit_folder: Path) -> None:
    mesh = _frame(mit_folder / "I_crane" / "meshes" / "mesh_0000.obj")
    places = mesh.vertices[load_landmarks("mit_I").for_mesh(mesh)]
    middle = places[[part.label for part in PARTS if part.side == "middle"]].mean(axis=0)
    front = places[LANDMARKS.index("Sellion")] - places[LANDMARKS.index("Nuchale")]
    left = np.cross((0.0, 1.0, 0.0), front / np.linalg.norm(front))
    for part in PARTS:
        if part.side != "middle":
            way = (places[part.label] - middle) @ left
            assert way > 0.01 if part.side == "left" else way < -0.01, part.landmark


def _frame(path: Path) -> Mesh:
    """The shape alone; these tests need no body frame."""
    vertices, faces = [], []
    for line in path.read_text(encoding="utf-8").splitlines():
        kind, *values = line.split() or [""]
        if kind == "v":
            vertices.append([float(value) for value in values[:3]])
        elif kind == "f":
            faces.append([int(value.split("/")[0]) - 1 for value in values])
    return Mesh(path.stem, np.array(vertices), np.array(faces))


def test_a_mark_at_the_beginning_of_a_file_does_not_matter(tmp_path: Path) -> None:
    marked = tmp_path / "marked.json"
    marked.write_bytes(b"\xef\xbb\xbf" + load_landmarks("open").to_json().encode())
    read = load_landmark_file(marked)
    assert isinstance(read, LandmarkSet) and read.vertices == load_landmarks("open").vertices


def test_other_names_are_ignored_and_two_landmarks_may_share_a_vertex() -> None:
    given = tree(landmarks={"Crotch": -5, **TABLE, "Lt. PSIS": TABLE["Sellion"], "Lt. Elbow": 3})
    landmarks = parse_landmarks(json.dumps(given), "here")
    assert landmarks.ignored == ("Crotch", "Lt. Elbow")
    assert landmarks.vertices[LANDMARKS.index("Lt. PSIS")] == TABLE["Sellion"]
    assert parse_landmarks(landmarks.to_json(), "here").vertices == landmarks.vertices
