"""`bench people`: reading annotated bodies, placing landmarks by them, intervals, and what the bench writes."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("anny")

from benches.landmarks.body_fit import Fit, fitted_points  # noqa: E402
from benches.landmarks.fitting_body import FittingBody  # noqa: E402
from benches.landmarks.proposal import FittedBody  # noqa: E402
from benches.model import chosen  # noqa: E402
from benches.model.people import bench, cross_person, intervals, landmarks  # noqa: E402
from benches.model.people import scores as view_scores  # noqa: E402
from benches.model.people.bodies import Annotated, annotated_bodies  # noqa: E402
from benches.model.people.intervals import interval, summed  # noqa: E402
from benches.model.people.landmarks import placed, ways_to_place  # noqa: E402
from benches.model.people.scores import accuracy, counted, packed_views, summary  # noqa: E402
from fitting_bodies import coarse_body, whole_body  # noqa: E402
from label_networks import Places  # noqa: E402
from shapes import ball  # noqa: E402
from small_rig import SMALL  # noqa: E402

from bodyseg_data.bodies.anny_people import POSTURES  # noqa: E402
from bodyseg_data.core import BadConfig, BadLandmarks  # noqa: E402
from bodyseg_data.labels import LANDMARKS, PARTS  # noqa: E402
from bodyseg_data.meshes import (  # noqa: E402
    Mesh,
    load_landmark_file,
    partition,
)

MOVED = LANDMARKS.index("Rt. Acromion")
CARD = {"recipe": {"steps": 3, "batch_size": 16, "accumulate": 2}}


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Views of a sixteenth of the paper's pixels."""
    monkeypatch.setattr(view_scores, "load_rig", lambda: SMALL)


@pytest.fixture
def body() -> FittingBody:
    return coarse_body()


def known_fit(body: FittingBody, pose: str, scale: float) -> Fit:
    zeros = [torch.zeros(count).double() for count in (len(body.deviation), len(body.head_shapes))]
    return Fit(body.start(dict(POSTURES)[pose]), torch.zeros(3).double(), torch.tensor(scale).double(), *zeros)


def annotations(body: FittingBody) -> np.ndarray[Any, Any]:
    """The open body's vertices, but both shoulders moved to vertices some centimetres away."""
    vertices = body.landmark_vertices.copy()
    rest = body.mesh.vertices
    for label, across in ((MOVED, -1), (PARTS[MOVED].mirror, 1)):
        wanted = rest[vertices[label]] + (across * 0.04, -0.03, 0)
        vertices[label] = body.skin[np.linalg.norm(rest[body.skin] - wanted, axis=1).argmin()]
    return vertices


def write(folder: Path, name: str, mesh: Mesh, points: np.ndarray[Any, Any]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    rows = [" ".join(f"{value:.6f}" for value in vertex) for vertex in mesh.vertices]
    rows += [f"3 {a} {b} {c}" for a, b, c in mesh.faces]
    (folder / f"{name}.off").write_text("\n".join(["OFF", f"{len(mesh.vertices)} {len(mesh.faces)} 0", *rows, ""]))
    table = dict(zip(LANDMARKS, points.tolist(), strict=True)) | {"Crotch": [0.0, 0.0, 0.0]}
    (folder / f"{name}_landmarks.json").write_text(json.dumps(table))


def test_people_and_poses_follow_from_names_and_folders(tmp_path: Path) -> None:
    mesh = ball()
    for name in ("a", "b", "c", "d"):
        write(tmp_path, name, mesh, mesh.vertices[:33])
    (tmp_path / "unannotated.off").write_text((tmp_path / "a.off").read_text())
    for name in ("x", "y"):
        write(tmp_path / "ann", name, mesh, mesh.vertices[:33])
    bodies = annotated_bodies(tmp_path, 2)
    assert [(one.name, one.person, one.pose) for one in bodies] == [
        ("a", "person 0", "pose 0"),
        ("b", "person 0", "pose 1"),
        ("c", "person 1", "pose 0"),
        ("d", "person 1", "pose 1"),
        ("x", "ann", "pose 0"),
        ("y", "ann", "pose 1"),
    ]
    np.testing.assert_allclose(bodies[0].points, mesh.vertices[:33], atol=1e-6)


def test_folders_that_cannot_be_measured_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadConfig, match="needs meshes with landmarks: NAME_landmarks.json, found none in"):
        annotated_bodies(tmp_path, 10)
    write(tmp_path, "a", ball(), ball().vertices[:33])
    for text, message in (("{}", "'Sellion', 'Nuchale'"), ("x", "'points' must be a table")):
        (tmp_path / "a_landmarks.json").write_text(text)
        with pytest.raises(BadLandmarks, match=f"a_landmarks.json: .*{message}"):
            annotated_bodies(tmp_path, 10)


def test_an_interval_holds_the_mean_and_narrows_with_more_groups() -> None:
    draws = np.random.default_rng(0).normal(0.7, 0.1, 64)

    def mean(sums: np.ndarray[Any, Any]) -> float:
        return float(sums[0] / sums[1])

    for count in (16, 64):
        some = draws[:count]
        found = interval([np.array([value, 1.0]) for value in some], mean)
        assert found is not None and found[0] < some.mean() < found[1]
        assert found[1] - found[0] == pytest.approx(2 * 1.96 * some.std() / count**0.5, rel=0.15)
    assert interval([np.array([0.5, 1.0])], mean) is None
    assert interval([np.array([0.5, 1.0])] * 3, mean) == [0.5, 0.5]


def test_arrays_are_added_up_by_name() -> None:
    found = summed({("a", 1): np.array([1]), ("b", 1): np.array([2]), ("a", 2): np.array([4])}, lambda key: key[0])
    assert {name: array.tolist() for name, array in found.items()} == {"a": [5], "b": [2]}


def test_an_accuracy_has_the_interval_of_its_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(intervals, "_DRAWS", 200)
    right, wrong = np.zeros((33, 33), np.int64), np.zeros((33, 33), np.int64)
    right[0, 0] = right[1, 1] = 10
    wrong[0, 0] = wrong[1, 2] = 10
    counts = {("p", "one", "a"): right, ("p", "two", "b"): wrong, ("q", "one", "c"): right, ("q", "two", "d"): wrong}
    found = summary(counts)
    assert accuracy(right) == 1 and accuracy(wrong) == 0.5
    assert (found["images"], found["accuracy"]) == (4, 0.75)
    assert found["interval"] == [0.5, 1]  # two poses: each may be drawn twice


@pytest.mark.usefixtures("quick_geodesics")
def test_what_the_bench_finds_on_bodies_with_known_landmarks(
    body: FittingBody, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fits, true = {}, annotations(body)
    for name, pose, scale in (("one", "standing", 1.0), ("two", "a_pose", 1.1)):
        fit = known_fit(body, pose, scale)
        vertices = fitted_points(body, fit, body.whole)[0]
        fits[name] = fit
        write(tmp_path, name, Mesh(name, vertices, body.mesh.faces), vertices[true])
    monkeypatch.setattr(landmarks, "fit_body", lambda body, mesh: FittedBody(mesh, body, fits[mesh.name], 0.06))
    monkeypatch.setattr(chosen, "load_network", lambda path: SimpleNamespace(network=Places(0, 10)))
    monkeypatch.setattr(landmarks, "partition", partial(partition, method="edges"))  # six times, of 13 718 vertices
    monkeypatch.setattr(intervals, "_DRAWS", 50)
    monkeypatch.setattr(bench, "fitting_body", lambda: body)
    steps: list[tuple[int, int]] = []
    figures = bench.bench_people(
        str(tmp_path), views=1, poses=1, progress=lambda done, total: steps.append((done, total))
    )
    assert (figures["bodies"], figures["people"], figures["network"]) == (2, 2, "shipped")
    assert steps[-1] == (6, 6)
    found = figures["landmarks"]
    shipped, placed_by_all, placed_by_other = (found[name] for name in ("shipped", "all_people", "other_people"))
    errors = 1000 * np.linalg.norm(body.mesh.vertices[true] - body.mesh.vertices[body.landmark_vertices], axis=1)
    # Less what so coarse a surface costs each way.
    assert shipped["mean_mm"] - placed_by_all["mean_mm"] == pytest.approx(1.05 * errors.mean(), rel=0.2)
    for better in (placed_by_all, placed_by_other):
        assert better["mean_mm"] < 0.5 * shipped["mean_mm"]
        assert better["wrong_surface"] < 0.5 * shipped["wrong_surface"]
    of_fits = {way: labels["accuracy"] for way, labels in figures["labels_of_fits"].items()}
    assert 0.9 < of_fits["shipped"] < min(of_fits["all_people"], of_fits["other_people"]) <= 1
    assert figures["labels_of_fits"]["shipped"]["images"] == 2
    for variant in ("all", "none"):
        scores = figures["scores"][variant]
        assert scores["images"] == 2 and 0 < scores["accuracy"] < 0.5
        assert scores["calibration_error"] > 0.5  # this network is always sure
        assert 0 < scores["gross_errors"]["beyond_60_mm"] < scores["gross_errors"]["beyond_30_mm"] < 1


def test_placed_landmarks_are_the_same_left_and_right(
    body: FittingBody, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = known_fit(body, "t_pose", 1.0)
    mesh = Mesh("one", fitted_points(body, fit, body.whole)[0], body.mesh.faces)
    points = mesh.vertices[annotations(body)]
    points[MOVED] += (0.01, 0.02, 0)  # on one side alone
    write(tmp_path, "one", mesh, points)
    monkeypatch.setattr(landmarks, "fit_body", lambda body, mesh: FittedBody(mesh, body, fit, 0.0))
    vertices = placed([landmarks.fitted_to(body, one) for one in annotated_bodies(tmp_path, 1)])
    rest = body.mesh.vertices[vertices]
    mirror = [part.mirror for part in PARTS]
    np.testing.assert_allclose(rest[mirror] * (-1, 1, 1), rest, atol=0.004)


def test_landmarks_placed_by_a_persons_other_poses_are_theirs(
    body: FittingBody, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = known_fit(body, "t_pose", 1.0)
    mesh = Mesh("a", fitted_points(body, fit, body.whole)[0], body.mesh.faces)
    moved = mesh.vertices[annotations(body)]
    for name, points in (("a", mesh.vertices[body.landmark_vertices]), ("b", moved)):
        write(tmp_path, name, mesh, points)
    monkeypatch.setattr(landmarks, "fit_body", lambda body, mesh: FittedBody(mesh, body, fit, 0.0))
    monkeypatch.setattr(landmarks, "partition", partial(partition, method="edges"))
    fits = [landmarks.fitted_to(body, one) for one in annotated_bodies(tmp_path, 2)]
    ways = ways_to_place(fits, body)
    assert set(ways) == {"shipped", "all_people", "same_person"}  # there is no other person
    (of_a, (a,)), (of_b, (b,)) = ways["same_person"]
    assert (a.of.name, b.of.name) == ("a", "b")
    rest = body.mesh.vertices  # an annotation comes back to its vertex or the one beside it
    np.testing.assert_allclose(rest[of_a], rest[annotations(body)], atol=0.004)
    np.testing.assert_allclose(rest[of_b], rest[body.landmark_vertices], atol=0.004)


@pytest.fixture
def two_people(body: FittingBody, tmp_path: Path) -> Path:
    for who, pose in (("ann", "standing"), ("bob", "a_pose")):
        vertices = fitted_points(body, known_fit(body, pose, 1.0), body.whole)[0]
        write(tmp_path / who, who, Mesh(who, vertices, body.mesh.faces), vertices[body.landmark_vertices])
    return tmp_path


@pytest.mark.usefixtures("quick_geodesics")
def test_networks_are_scored_on_people_who_did_not_place_their_labels(
    two_people: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    networks = {"by-ann": Places(0, 20), "by-bob": Places(0, 12)}
    monkeypatch.setattr(
        cross_person, "load_network", lambda path: SimpleNamespace(network=networks[path.name], card=CARD)
    )
    monkeypatch.setattr(intervals, "_DRAWS", 50)
    steps: list[tuple[int, int]] = []
    found = cross_person.bench_cross_person(
        str(two_people), [Path("by-ann"), Path("by-bob")], 2, 1, lambda done, total: steps.append((done, total))
    )
    assert found["networks"] == {who: {"run": f"by-{who}", "images": 96} for who in ("ann", "bob")}
    assert steps[-1] == (8, 8)
    keys = packed_views(annotated_bodies(two_people, 1), 2, tmp_path / "again")
    crossed, own = found["cross_person"], found["in_sample"]
    for who, other, network in (("ann", "bob", networks["by-ann"]), ("bob", "ann", networks["by-bob"])):
        answers = counted(network, tmp_path / "again", keys, "all", lambda *_: None)
        scores = {each: answers.of({each}).to_json() for each in (who, other)}
        assert crossed["placed_by"][who]["accuracy"] == scores[other]["accuracy"]
        assert own["placed_by"][who]["gross_errors"] == scores[who]["gross_errors"]
        assert scores["ann"]["gross_errors"] != scores["bob"]["gross_errors"]
    gain = found["in_sample_gain"]
    assert gain["points"] == pytest.approx(own["accuracy"] - crossed["accuracy"], abs=2e-4) and gain["points"] != 0
    assert gain["interval"] is None, "they took one pose"
    for both in (crossed, own):
        ways = [way["accuracy"] for way in both["placed_by"].values()]
        assert both["images"] == 4 and both["accuracy"] == pytest.approx(sum(ways) / 2, abs=1e-4)
        shares = [way["gross_errors"]["beyond_30_mm"] for way in both["placed_by"].values()]
        assert min(shares) <= both["gross_errors"]["beyond_30_mm"] <= max(shares)


def test_landmarks_wander_by_what_the_lengths_of_bones_do() -> None:
    still = np.random.default_rng(0).normal(size=(33, 3))
    along = still[LANDMARKS.index("Nuchale")] - still[LANDMARKS.index("Sellion")]
    along /= np.linalg.norm(along)
    bodies = []
    for mm in (-3, 0, 3):
        points = still.copy()
        points[LANDMARKS.index("Nuchale")] += mm / 1000 * along
        bodies.append(
            Annotated("a", "ann", f"pose {mm}", Path("a.off"), ball(), points + mm)
        )  # where they stand is all one
    found = cross_person.wander_mm([*bodies, replace(bodies[0], person="bob")])
    assert set(found) == set(cross_person.BONES)
    assert found["skull"] == {"ann": 3.0} and found["breastbone"] == {"ann": 0.0}


def test_cross_person_needs_a_network_for_each_of_several_people(tmp_path: Path) -> None:
    for who in ("ann", "bob"):
        write(tmp_path / who, who, ball(), ball().vertices[:33])
    with pytest.raises(BadConfig, match="--runs, a network trained on the landmarks of each, found 2 and 1"):
        cross_person.bench_cross_person(str(tmp_path), [Path("a")])
    with pytest.raises(BadConfig, match="found 1 and 1"):
        cross_person.bench_cross_person(str(tmp_path / "ann"), [Path("a")])


@pytest.mark.parametrize("person", [0, 1])
def test_landmarks_of_single_people_fit_the_open_body(person: int) -> None:
    body = whole_body()
    file = Path(cross_person.__file__).with_name(f"placed_by_{person}.json")
    vertices = load_landmark_file(file).for_mesh(body.mesh)
    assert isinstance(vertices, np.ndarray) and set(vertices) <= {*body.skin}
    rest, mirror = body.mesh.vertices[vertices], [part.mirror for part in PARTS]
    np.testing.assert_allclose(rest[mirror] * (-1, 1, 1), rest, atol=0.004)
    away = np.linalg.norm(rest - body.mesh.vertices[body.landmark_vertices], axis=1)
    assert 0 < away.mean() < 0.02 and away.max() < 0.06  # of the shipped ones, which both people placed
