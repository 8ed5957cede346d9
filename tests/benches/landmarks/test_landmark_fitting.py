"""Proposed landmarks: near to where they belong, whatever the numbering and facing; and the command."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from PIL import Image
from shapes import ball, figure

torch = pytest.importorskip("torch")
pytest.importorskip("anny")

from benches.__main__ import main  # noqa: E402
from benches.data.surface.proposal import measure, shuffled  # noqa: E402
from benches.landmarks import proposal as proposal_module  # noqa: E402
from benches.landmarks.body_fit import LIMB_POSES, Fit, Matcher, fitted_points, fitted_surface, refine, surface_distance  # noqa: E402
from benches.landmarks.fitting_body import (  # noqa: E402  # noqa: E402
    FittingBody,
    SurfacePoints,
    farthest,
    mean_geodesic,
    sample_surface,
)
from benches.landmarks.proposal import Proposal, propose  # noqa: E402
from fitting_bodies import coarse_body, whole_body  # noqa: E402

from bodyseg_data.bodies import (  # noqa: E402
    Body,
    open_source,
)
from bodyseg_data.bodies.anny_people import (  # noqa: E402
    POSTURES,
    SUBJECT_A,
)
from bodyseg_data.core import BadMesh  # noqa: E402
from bodyseg_data.labels import LANDMARKS  # noqa: E402
from bodyseg_data.meshes import (  # noqa: E402
    LandmarkSet,
    Mesh,
    load_landmark_file,
)


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """As `propose` works: more threads only get into each other's way."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def body() -> FittingBody:
    return whole_body()


@pytest.fixture
def scan() -> FittingBody:
    """A standing body of few vertices, to read, draw and turn."""
    return coarse_body()


def about_y(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])


def fit_of(body: FittingBody, pose: str, **changes: torch.Tensor) -> Fit:
    zeros = {"move": 3, "angles": len(body.deviation), "shape": len(body.head_shapes)}
    values = {name: torch.zeros(count).double() for name, count in zeros.items()} | {
        "scale": torch.tensor(1.0).double()
    }
    return Fit(body.start(dict(POSTURES)[pose]), **(values | changes))


def test_the_fitting_body_moves_as_the_open_body_does(body: FittingBody) -> None:
    """Two poses of one person differ as those of the mean person do, but for the person's size and build."""
    source = open_source("open")
    refs = {ref.pose: ref for ref in reversed(source.bodies()) if ref.subset == "A"}
    for pose in ("t_pose", "deep_squat", "fencing"):
        built = source.build(refs[pose])
        wanted = built.mesh.vertices[built.landmarks]
        positions, normals = fitted_points(body, fit_of(body, pose), body.landmarks)
        wanted, positions = wanted - wanted.mean(axis=0), positions - positions.mean(axis=0)
        scale = np.linalg.norm(wanted) / np.linalg.norm(positions)
        assert abs(scale * 1.7 / SUBJECT_A.stature_m - 1) < 0.1
        error = np.linalg.norm(wanted - scale * positions, axis=1)
        assert np.median(error) < 0.03 and error.max() < 0.06, pose  # the mean person is of another build
        facing = built.mesh.vertex_normals[built.landmarks]
        assert np.median((facing * normals).sum(axis=1)) > 0.97


def test_refining_finds_a_pose_that_was_changed_a_little(body: FittingBody) -> None:
    wanted = fit_of(body, "a_pose", shape=torch.linspace(1, -1, len(body.head_shapes)).double())
    angles = (
        0.3 * body.deviation * torch.tensor([1.0, -1.0]).double().repeat(len(body.deviation))[: len(body.deviation)]
    )
    angles[:3] = torch.tensor([0.1, 0.2, 0.0])
    begun = fit_of(body, "a_pose", angles=angles, move=torch.tensor([0.03, -0.02, 0.04]).double())
    target = fitted_surface(body, wanted)
    stages = ((40, 0.1, 0.02), (30, 0.05, 0.01))
    found, other = refine(body, target, [begun, wanted], stages, 600)
    before, after = (
        np.linalg.norm(
            fitted_points(body, fit, body.landmarks)[0] - fitted_points(body, wanted, body.landmarks)[0], axis=1
        )
        for fit in (begun, found)
    )
    assert np.median(before) > 0.04
    assert np.median(after) < 0.01 and after.max() < 0.04
    assert surface_distance(target, fitted_surface(body, found)) < 0.3 * surface_distance(
        target, fitted_surface(body, begun)
    )
    assert surface_distance(target, fitted_surface(body, other)) < 0.01  # each fit by itself


def test_refining_again_gives_the_same_bits(body: FittingBody) -> None:
    target, begun = fitted_surface(body, fit_of(body, "a_pose")), fit_of(body, "standing")
    one, other = (refine(body, target, [begun], ((8, 0.1, 0.02),), 1000)[0] for _ in range(2))
    assert not torch.equal(one.angles, begun.angles)
    assert torch.equal(one.angles, other.angles) and torch.equal(one.move, other.move)


def test_matches_are_alike_in_place_direction_and_remoteness() -> None:
    def points(*rows: tuple[float, float, float]) -> SurfacePoints:
        positions, normals, remote = zip(*rows, strict=True)
        return SurfacePoints(
            np.array([(x, 0, 0) for x in positions], float),
            np.array([(0, 0, z) for z in normals], float),
            np.array(remote),
        )

    # x, normal along z, mean_geodesic
    surface = points((0.0, 1, 1.0), (0.1, -1, 1.0), (0.15, 1, 1.8))
    asked = points((0.09, 1, 1.0), (0.01, -1, 1.0), (0.02, 1, 1.8))
    assert Matcher(surface).match(asked).tolist() == [0, 1, 2]
    assert Matcher(surface).distance(surface) == 0
    assert Matcher(surface).distance(points((9.0, 1, 1.0))) == 0.25  # counted up to a limit


def test_points_are_spread_evenly_by_area() -> None:
    whole = ball(subdivisions=4)
    fine = whole.vertices[whole.faces[:, 0], 0] > 0.25  # one side in triangles a quarter the size
    mesh = Mesh("uneven", whole.vertices, np.concatenate([whole.faces[fine], whole.faces[~fine]]))
    points = sample_surface(mesh, 3000)
    np.testing.assert_allclose(np.linalg.norm(points.positions - whole.centre, axis=1), 0.5, atol=0.002)
    np.testing.assert_allclose(points.normals, (points.positions - whole.centre) / 0.5, atol=0.08)
    for axis in range(3):
        assert (points.positions[:, axis] > whole.centre[axis]).mean() == pytest.approx(0.5, abs=0.02)
    assert len(points.thinned(100).positions) == 100


def test_hands_and_feet_are_remote_in_every_posture() -> None:
    source = open_source("open")
    standing = source.build(source.bodies()[0])
    away = dict(zip(LANDMARKS, mean_geodesic(standing.mesh)[standing.landmarks], strict=True))
    assert away["Substernale"] < 0.9 < away["Rt. Olecranon"] < away["Rt. Radial Styloid"] < away["Rt. Dactylion"]
    assert away["Lt. Knee Crease"] < away["Lt. Digit II"]
    assert away["Rt. Dactylion"] == pytest.approx(away["Lt. Dactylion"], rel=0.05)
    squat = next(ref for ref in source.bodies() if ref.pose == "deep_squat")
    other = source.build(squat)
    np.testing.assert_allclose(mean_geodesic(other.mesh)[other.landmarks], list(away.values()), rtol=0.12)


def test_stray_pieces_and_doubled_vertices_leave_remoteness_as_it_is() -> None:
    whole = figure()  # five separate parts
    away = mean_geodesic(whole)
    assert np.isfinite(away).all()
    loose = whole.vertices[whole.faces].reshape(-1, 3)  # every triangle by itself
    np.testing.assert_allclose(
        mean_geodesic(Mesh("soup", loose, np.arange(len(loose)).reshape(-1, 3))), away[whole.faces].ravel(), rtol=0.05
    )


def test_farthest_points_are_far_from_each_other() -> None:
    line = np.stack([np.arange(101.0), np.zeros(101), np.zeros(101)], axis=1)
    assert farthest(line, 5).tolist() == [0, 100, 50, 25, 75]
    assert len(farthest(line[:3], 5)) == 3


Limits = tuple[float, float, float, float]
"""Most that a proposal may be off: median and worst, cm; share of the surface; median distance of the fit, m."""

SCANNED: Limits = (3.5, 10, 0.2, 0.03)
MODELLED: Limits = (1, 5, 0.05, 0.015)


@pytest.fixture(scope="module")
def target(request: pytest.FixtureRequest) -> tuple[Body, Limits]:
    """A clothed man as scanned, the harder one; without the real frames, a person of the open set."""
    try:
        source, name, limits = open_source("mit", request.getfixturevalue("mit_folder")), "I_crane_0000", SCANNED
    except pytest.skip.Exception:
        source, name, limits = open_source("open"), "person-100", MODELLED
    return source.build(next(ref for ref in source.bodies() if ref.mesh == name)), limits


SHORTER: Final[dict[str, Any]] = {
    "POSTURES": POSTURES[::3],
    "LIMB_POSES": {kind: poses[::3] for kind, poses in LIMB_POSES.items()},
    "_TURNS": 5,
    "_STARTS": 2,
    "_CANDIDATES": 1,
    "_FINALISTS": 1,
    "_LIMBS": (("arm", "LR"),),
    "_LIMB_TRIES": 1,
    "_FINE_POINTS": 1000,
    "_POINTS": 400,
    "_ROUGH_POINTS": 300,
    "_CLOSE_IN": ((12, 0.20, 0.03), (12, 0.10, 0.02)),
    "_SETTLE": ((12, 0.10, 0.02),),
    "_TRY": ((8, 0.20, 0.03), (8, 0.10, 0.02)),
    "_FINISH": ((20, 0.10, 0.015), (20, 0.05, 0.012)),
}
"""Every stage of the search with fewer starts, points and steps: a tenth of its time, enough for a plain posture."""


@pytest.mark.usefixtures("pymeshlab")
def test_a_body_is_found_whatever_its_numbering_and_facing(
    target: tuple[Body, Limits], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Decimated, shuffled and turned."""
    for name, shorter in SHORTER.items():
        monkeypatch.setattr(proposal_module, name, shorter)
    monkeypatch.setattr(proposal_module, "fitting_body", whole_body)
    built, (median_cm, worst_cm, wrong_surface, distance_m) = target
    turn = about_y(2.2)
    mesh = shuffled(built.mesh, 1)
    mesh = Mesh(mesh.name, mesh.vertices @ turn.T, mesh.faces)
    proposal = propose(mesh)
    figures = measure(mesh, built.mesh.vertices[built.landmarks] @ turn.T, proposal)
    assert figures["swapped"] == 0
    assert figures["median_cm"] <= median_cm and figures["worst_cm"] <= worst_cm, figures
    assert figures["wrong_surface"] < wrong_surface
    assert len(set(proposal.landmarks.vertices)) == 33
    assert proposal.distance_m.shape == (33,) and np.median(proposal.distance_m) < distance_m
    assert (proposal.landmarks.vertex_count, proposal.landmarks.face_count) == (len(mesh.vertices), len(mesh.faces))


def test_a_mesh_too_coarse_for_33_landmarks_is_refused() -> None:
    with pytest.raises(BadMesh, match="mesh ball: its largest piece must have 33 vertices, found 12"):
        propose(ball(subdivisions=0))


def small_proposal(monkeypatch: pytest.MonkeyPatch, gap_m: float = 0.03) -> list[int]:
    """In place of the search: the open body's own landmarks. Returns the numbers of tilts that were asked for."""
    asked: list[int] = []

    def stand_in(mesh: Mesh, tilts: list[np.ndarray]) -> Proposal:
        asked.append(len(tilts))
        counts = len(mesh.vertices), len(mesh.faces)
        landmarks = LandmarkSet("proposed", "proposed", *counts, tuple(coarse_body().landmark_vertices.tolist()))
        return Proposal(landmarks, np.linspace(0, 0.05, 33), gap_m)

    monkeypatch.setattr(proposal_module, "propose", stand_in)
    return asked


def obj(mesh: Mesh, scale: float) -> str:
    lines = ["v {:.4f} {:.4f} {:.4f}".format(*(scale * vertex)) for vertex in mesh.vertices]
    return "\n".join([*lines, *("f {} {} {}".format(*(face + 1)) for face in mesh.faces), ""])


@pytest.mark.usefixtures("quick_geodesics")
@pytest.mark.parametrize(("units", "scale", "up", "gap_m"), [("auto", 1000, "auto", 0.03), ("cm", 100, "y", 0.07)])
def test_the_command_writes_landmarks_picture_and_table_and_says_that_a_fit_is_poor(
    tmp_path: Path,
    scan: FittingBody,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    units: str,
    scale: float,
    up: str,
    gap_m: float,
) -> None:
    asked = small_proposal(monkeypatch, gap_m)
    file, out, picture = tmp_path / "scan.obj", tmp_path / "scan.json", tmp_path / "scan.png"
    file.write_text(obj(scan.mesh, scale))
    words = ["landmarks", "--mesh", file, "--propose", out, "--out", picture, "--height", "150", "--units", units]
    assert main([*map(str, words), "--up", up]) == 0
    assert asked == [6 if up == "auto" else 1]
    written = load_landmark_file(out)
    assert isinstance(written, LandmarkSet) and written.vertices == tuple(scan.landmark_vertices.tolist())
    with Image.open(picture) as drawn:
        assert drawn.width > 600
    said = capsys.readouterr()
    poor = "a poor fit: parts of the open body are 7 cm from the mesh, and a limb may be in the wrong place"
    assert (poor in said.err) == (gap_m > 0.05)
    table = said.out.splitlines()
    assert len(table) == 34
    assert table[1].split() == ["0", "Sellion", "0.0"]
    assert table[33].split() == ["32", "Lt.", "Digit", "II", "5.0", "look", "closely"]
    assert sum(line.endswith("look closely") for line in table) == 13


@pytest.mark.usefixtures("quick_geodesics")
def test_a_source_without_landmarks_can_be_proposed_for(
    tmp_path: Path, scan: FittingBody, monkeypatch: pytest.MonkeyPatch
) -> None:
    small_proposal(monkeypatch)
    folder = tmp_path / "scans"
    folder.mkdir()
    (folder / "one.obj").write_text(obj(scan.mesh, 1))
    out, picture = folder / "one.json", tmp_path / "one.png"
    words = ["landmarks", "--source", "folder", "--path", folder, "--out", picture, "--height", "150"]
    assert main([*map(str, words), "--propose", str(out)]) == 0
    assert json.loads(out.read_text())["vertex_count"] == len(scan.mesh.vertices)
    picture.unlink()
    assert main([*map(str, words)]) == 0  # and is then drawn with them
    assert picture.exists()


def test_the_picture_faces_the_front(scan: FittingBody) -> None:
    from benches.landmarks.command import _UP, _facing_front, _upright

    for up, axis in _UP.items():
        rotation = _upright(axis)
        np.testing.assert_allclose(rotation @ axis, (0, 1, 0), atol=1e-12)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)
        lying = Mesh("lying", scan.mesh.vertices @ about_y(2.5).T @ rotation, scan.mesh.faces)
        for upward in ([axis], list(_UP.values())):
            facing = _facing_front(lying, scan.landmark_vertices, upward)
            np.testing.assert_allclose(
                facing.vertices - facing.centre, scan.mesh.vertices - scan.mesh.centre, atol=2e-3, err_msg=up
            )


WRONG = {
    "neither": ([], "give either --source or --mesh"),
    "both": (["--source", "open", "--mesh", "x.ply"], "give either --source or --mesh"),
    "mesh alone": (
        ["--mesh", "x.ply"],
        "--mesh needs --propose; a mesh that has landmarks is drawn by --source folder",
    ),
    "path": (["--mesh", "x.ply", "--path", "x"], "--path, --landmarks and --meshes belong to --source, not to --mesh"),
    "suffix": (["--mesh", "x.ply", "--propose", "x.txt"], "--propose must be a .json file, found x.txt"),
    "no folder": (
        ["--mesh", "x.ply", "--propose", "absent/x.json"],
        "--propose needs a file in a folder that is there",
    ),
    "no folder of the picture": (["--source", "open", "--out", "absent/x.png"], "--out needs a file in a folder"),
    "in vain": (["--mesh", "x.ply", "--propose", "x.json", "--pymeshlab"], "--propose takes the mesh as it is"),
    "no mesh": (["--mesh", "absent.ply", "--propose", "x.json"], "cannot read absent.ply"),
    "several": (
        ["--source", "open", "--propose", "x.json", "--meshes", "posture-00", "posture-01"],
        "--propose takes one mesh at a time, found 2 in --meshes",
    ),
}


@pytest.mark.parametrize(("words", "message"), WRONG.values(), ids=WRONG)
def test_wrong_arguments_are_refused_in_a_line(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["landmarks", "--out", "x.png", *words]) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_file_that_is_there_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    corrected = tmp_path / "corrected.json"
    corrected.write_text("by hand")
    words = ["--mesh", str(tmp_path / "scan.ply"), "--propose", str(corrected), "--out", str(tmp_path / "scan.png")]
    assert main(["landmarks", *words]) == 2
    assert "corrected.json is there already" in capsys.readouterr().err
    assert corrected.read_text() == "by hand"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--figure", "x.png"], "bench proposal draws no figure: leave --figure out"),
        (["--views", "3"], "bench proposal measures whole bodies: leave --views out"),
    ],
)
def test_the_bench_refuses_what_it_has_no_use_for(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", "proposal", *words]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.usefixtures("quick_geodesics")
def test_the_bench_counts_errors_and_swaps(scan: FittingBody) -> None:
    counts = len(scan.mesh.vertices), len(scan.mesh.faces)
    right = scan.landmark_vertices.copy()
    positions = scan.mesh.vertices[right]
    swapped = right.copy()
    swapped[[15, 16]] = right[[16, 15]]
    for vertices, wrong in ((right, 0), (swapped, 2)):
        landmarks = LandmarkSet("x", "x", *counts, tuple(vertices.tolist()))
        figures = measure(scan.mesh, positions, Proposal(landmarks, np.zeros(33)))
        assert figures["swapped"] == figures["beyond_8_cm"] == wrong
        assert figures["median_cm"] == 0
        assert (figures["worst_cm"] > 30 and figures["wrong_surface"] > 0.03) == bool(wrong)
