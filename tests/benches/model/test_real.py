"""`bench real`: fusion, labels, agreement and scores on a made recording, whose surface and labels are known."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("skimage")
pytest.importorskip("embreex")
pytest.importorskip("pygeodesic")

from benches.measuring import Figures  # noqa: E402
from benches.model import chosen  # noqa: E402
from benches.model.real import bench  # noqa: E402
from benches.model.real import labels as surface_labelling  # noqa: E402
from benches.model.real.agreement import agreement  # noqa: E402
from benches.model.real.bench import bench_real, settled  # noqa: E402
from benches.model.real.figure import draw_real  # noqa: E402
from benches.model.real.fusion import FusedSurface, fitted, fuse, residual_m  # noqa: E402
from benches.model.real.labels import (  # noqa: E402
    KINECT_V1,
    Placements,
    frame_labels,
    load_placements,
    repeatability,
    surface_labels,
)
from benches.model.real.recording import Frame, read_recording  # noqa: E402
from benches.model.real.steady import ALONE, WAYS, still_person  # noqa: E402
from label_networks import Places  # noqa: E402
from PIL import Image  # noqa: E402
from pngs import png  # noqa: E402
from scipy.spatial import KDTree  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402
from spheres import icosphere  # noqa: E402

from bodyseg_data.core import BadConfig, BadLandmarks  # noqa: E402
from bodyseg_data.labels import BACKGROUND, LANDMARKS, PARTS33  # noqa: E402
from bodyseg_data.meshes import Mesh  # noqa: E402
from bodyseg_data.meshes.geodesics import nearest_sources  # noqa: E402
from bodyseg_data.rendering.embree import EmbreeRenderer  # noqa: E402
from bodyseg_data.rigs import Camera, PlacedCamera, load_rig  # noqa: E402
from bodyseg_model.networks import Trained  # noqa: E402

LENS = Camera(126, 140, 140.0, (70.0, 63.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
"""8 mm a pixel; its lower edge cuts the body below y = 0.25 m, the world's y pointing down."""

AWAY_M, UP_M, TURNS = 1.1, 0.25, 18
SEEN = ("Sellion", "Nuchale", "Rt. Acromion", "Lt. Acromion", "Substernale")
PLACES = ((0.0, -0.3, -0.1), (0.0, -0.25, 0.15), (0.2, -0.1, 0.0), (-0.2, -0.1, 0.0), (0.0, 0.0, -0.16))
NUMBERS = np.array([LANDMARKS.index(name) for name in SEEN])
UNSEEN = (0.0, 0.42, 0.0)
VOXEL_M = 0.01


def made_body() -> Mesh:
    """An ellipsoid with three different radii and a nose: no two of its sides are alike."""
    points, faces = icosphere(5, 1.0)
    nose = 1 + 0.25 * np.exp(-((points - (0.3, -0.6, -0.74)) ** 2).sum(axis=1) / 0.06)
    return Mesh("made", points * nose[:, None] * (0.22, 0.42, 0.16), faces)


def made_frames(body: Mesh) -> list[Frame]:
    renderer = EmbreeRenderer(body)
    frames = []
    for number in range(TURNS):
        axes = Rotation.from_euler("y", 360 / TURNS * number, degrees=True).as_matrix()
        placed = PlacedCamera(LENS, axes, -AWAY_M * axes[2] - (0, UP_M, 0))
        depth = np.rint(1000 * renderer.render(placed).range) / 1000
        frames.append(Frame(f"{number:03d}", depth.astype(np.float32), np.flatnonzero(depth), placed))
    return frames


@pytest.fixture(scope="module")
def body() -> Mesh:
    return made_body()


@pytest.fixture(scope="module")
def frames(body: Mesh) -> list[Frame]:
    return made_frames(body)


@pytest.fixture(scope="module")
def fused(frames: list[Frame]) -> FusedSurface:
    return fuse(frames, VOXEL_M)


def on(body: Mesh, points: Any) -> Any:
    return body.vertices[KDTree(body.vertices).query(points)[1]]


def write(folder: Path, frames: list[Frame], body: Mesh) -> None:
    folder.mkdir(exist_ok=True)
    for frame in frames:
        (folder / f"{frame.name}_depth.png").write_bytes(png(np.rint(1000 * frame.range_m).astype(np.uint16)))
        (folder / f"{frame.name}_camera.xml").write_text(camera_xml(frame.placed))
    table = dict(zip(SEEN, on(body, PLACES).tolist(), strict=True))
    (folder / "landmarks.json").write_text(json.dumps({"first": table, "second": table}))


def camera_xml(placed: PlacedCamera) -> str:
    lens = placed.camera
    matrices = {
        "intrinsic": [lens.focal_px, 0, lens.centre_px[0], 0, lens.focal_px, lens.centre_px[1], 0, 0, 1],
        "R": placed.axes.T.ravel().tolist(),
        "t": placed.position.tolist(),
    }
    entries = [f"<{name}><data>{' '.join(map(str, data))}</data></{name}>" for name, data in matrices.items()]
    return f"<opencv_storage>{''.join(entries)}</opencv_storage>"


def test_the_fused_surface_is_the_body(body: Mesh, frames: list[Frame], fused: FusedSurface) -> None:
    tree = KDTree(body.vertices)
    away, nearest = tree.query(fused.vertices)
    assert np.quantile(away, 0.99) < 0.012  # the body's own vertices are 11 mm apart
    facing = (fused.normals * body.vertex_normals[nearest]).sum(axis=1)
    assert np.quantile(facing, 0.02) > 0.9  # outwards
    assert residual_m(frames, fused) < 0.001
    rim = fused.vertices[fused.rim]
    assert len(rim) > 50 and (rim[:, 1] > 0.1).all()
    assert fused.vertices[:, 1].min() < -0.38  # the top is closed or its boundary is no rim


def test_fitting_brings_moved_cameras_back(frames: list[Frame], fused: FusedSurface) -> None:
    random = np.random.default_rng(3)
    moved = []
    for frame in frames[:4]:
        turn = Rotation.from_rotvec(random.normal(0, 0.006, 3)).as_matrix()
        placed = PlacedCamera(LENS, frame.placed.axes @ turn, frame.placed.position + random.normal(0, 0.006, 3))
        moved.append(replace(frame, placed=placed))
    found = fitted(moved, fused)
    for wrong, right in zip(moved, found, strict=True):
        assert residual_m([right], fused) < 0.5 * residual_m([wrong], fused)
    before, after = (
        np.mean([np.abs(one.points() - frame.points()).mean() for one, frame in zip(some, frames, strict=False)])
        for some in (moved, found)
    )
    assert after < 0.4 * before


@pytest.fixture(scope="module")
def labels(body: Mesh, fused: FusedSurface) -> Any:
    """Of the fused surface's vertices, by the places that are seen."""
    return surface_labels(fused, on(body, PLACES), NUMBERS)


def test_labels_are_right_or_left_out(body: Mesh, frames: list[Frame], fused: FusedSurface, labels: Any) -> None:
    sources = KDTree(body.vertices).query([*PLACES, UNSEEN])[1]
    nearest = nearest_sources("exact", body.vertices, body.faces.astype(np.int64), sources)
    true = np.array([*NUMBERS, LANDMARKS.index("Rt. Digit II")], np.uint8)[nearest.source]
    tree, known = KDTree(body.vertices), KDTree(fused.vertices)
    right = unseen = total = person = 0
    for frame in frames[::3]:
        image = frame_labels(frame, known, labels).ravel()[frame.pixels]
        wanted = true[tree.query(frame.points())[1]]
        labelled = image != BACKGROUND
        right += int((image == wanted)[labelled].sum())
        unseen += int((wanted[labelled] == LANDMARKS.index("Rt. Digit II")).sum())
        total, person = total + int(labelled.sum()), person + len(image)
    assert unseen == 0  # left out, all of it
    assert right > 0.97 * total  # the rest is within a vertex of a border
    assert 0.5 * person < total < 0.95 * person


def test_what_is_nearest_to_a_place_left_out_gets_no_label(
    body: Mesh, fused: FusedSurface, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(surface_labelling, "nearest_sources", along_edges)
    points = on(body, PLACES)
    labels = surface_labels(fused, points, NUMBERS)
    fewer = surface_labels(fused, points[:-1], NUMBERS[:-1], points[-1:])
    assert (labels == NUMBERS[-1]).any()
    np.testing.assert_array_equal(fewer, np.where(labels == NUMBERS[-1], BACKGROUND, labels))


def test_landmarks_off_the_surface_are_refused(fused: FusedSurface) -> None:
    with pytest.raises(BadConfig, match="within 30 mm of the fused surface, found Sellion at .* mm: are they of this"):
        surface_labels(fused, np.array([[0.0, -0.6, 0.0]]), np.array([0]))


def test_frames_that_share_no_surface_are_refused(frames: list[Frame]) -> None:
    with pytest.raises(BadConfig, match="must see one surface together, found none in 2 frames: are cameras right?"):
        fuse(frames[:2], 0.02)


def test_a_mirrored_frame_is_the_mirrored_world(frames: list[Frame]) -> None:
    frame = frames[2]
    turned = frame.mirrored()
    rows, columns = np.divmod(frame.pixels, LENS.columns)
    there = rows * LENS.columns + LENS.columns - 1 - columns
    assert set(turned.pixels) == set(there)
    np.testing.assert_allclose(turned.points(there) * (-1, 1, 1), frame.points(), atol=1e-9)
    again = turned.mirrored()
    np.testing.assert_array_equal(again.range_m, frame.range_m)
    np.testing.assert_array_equal(again.pixels, frame.pixels)
    np.testing.assert_allclose(again.placed.axes, frame.placed.axes)
    points = Placements(("Sellion",), np.ones((1, 3)), np.zeros((1, 3))).mirrored()
    assert points.first.tolist() == [[-1, 1, 1]]


def shadowed(wide: str) -> Frame:
    """A Kinect v1's frame: a body before a wall, and shadows of 8 and 22 pixels beside it."""
    lens = Camera(480, 640, 525.0, (320.0, 240.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    image = np.full((480, 640), 2.6, np.float32)
    left, right = (22, 8) if wide == "left" else (8, 22)
    image[100:, 250 - left : 390 + right] = 0
    image[100:, 250:390] = 0.85
    return Frame(wide, image, np.flatnonzero(image == np.float32(0.85)), PlacedCamera(lens, np.eye(3), np.zeros(3)))


def test_the_shadow_settles_mirroring(frames: list[Frame]) -> None:
    for wide, mirrored in (("left", False), ("right", True)):
        shadow, found = settled([shadowed(wide)])
        assert shadow is not None and shadow.side == wide
        assert found is mirrored
    assert settled(frames[:3]) == (None, False)  # no room behind


def test_agreement_counts_points_that_two_frames_see(frames: list[Frame]) -> None:
    by_place, by_frame = [], []
    for number, frame in enumerate(frames):
        image = np.full(frame.range_m.shape, BACKGROUND, np.uint8)
        image.ravel()[frame.pixels] = np.where(frame.points()[:, 1] > -0.1, 3, 4)
        by_place.append(image)
        by_frame.append(np.where(image == BACKGROUND, image, np.uint8(number)))
    found = agreement(frames, by_place)
    assert found["same"] > 0.97
    assert found["within_30_mm"] == found["within_60_mm"] == 1, "the frames differ at the border alone"
    strange = agreement(frames, by_frame)
    assert strange["same"] == strange["within_60_mm"] == 0
    apart = agreement(frames[::3], by_place[::3])  # 60 degrees
    assert apart["points"] == 0 and apart["same"] is None
    nothing = [np.full_like(image, BACKGROUND) for image in by_place]
    assert agreement(frames, nothing)["points"] == 0


def test_repeatability() -> None:
    placements = Placements(("Sellion", "Nuchale"), np.zeros((2, 3)), np.array([[0.003, 0.004, 0], [0, 0, 0.01]]))
    first, second = np.array([0, 0, 1, 255], np.uint8), np.array([0, 1, 1, 1], np.uint8)
    assert repeatability(placements, first, second) == {
        "landmarks_mm": {"Sellion": 5.0, "Nuchale": 10.0},
        "mean_mm": 7.5,
        "worst_mm": 10.0,
        "surface_with_another_label": 0.3333,
    }
    assert placements.labels.tolist() == [0, 1]


def along_edges(method: str, *surface: Any) -> Any:
    """In place of exact distances, which take a second of processor; labels of exact ones are tested above."""
    return nearest_sources("edges", *surface)


@pytest.fixture(scope="module")
def coarse() -> Iterator[pytest.MonkeyPatch]:
    """The bench with coarse voxels, distances along edges, and a network that labels by columns: right is not left."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "fuse", partial(fuse, voxel_m=VOXEL_M))
        patch.setattr(surface_labelling, "nearest_sources", along_edges)
        patch.setattr(chosen, "load_network", lambda path: SimpleNamespace(network=Places(1, 12), rig=load_rig()))
        yield patch


@pytest.fixture(scope="module")
def measured(
    body: Mesh, frames: list[Frame], coarse: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> Figures:
    folder = tmp_path_factory.mktemp("recording") / "made"
    write(folder, frames, body)
    steps: list[tuple[int, int]] = []
    figures = bench_real(str(folder), views=9, progress=lambda done, total: steps.append((done, total)))
    assert steps[-1] == (18, 18)
    return figures


def test_what_the_bench_finds(measured: Figures, tmp_path: Path) -> None:
    figures = measured
    assert (figures["recording"], figures["frames"], figures["network"]) == ("made", 9, "shipped")
    assert figures["mirrored"] == {"frames": False, "shadow": None}
    assert figures["fusion"]["residual_mm"]["fitted"]["median"] < 1
    assert figures["landmarks"]["worst_mm"] == 0 and figures["landmarks"]["surface_with_another_label"] == 0
    assert set(figures["scores"]["parts"]) == set(SEEN)
    assert 0 < figures["scores"]["pixel_accuracy"] < 0.5  # labels by columns of the view
    assert figures["scores"]["calibration_error"] > 0.5  # this network is always sure
    assert 0.5 < figures["scores"]["share_of_the_person"] < 1
    gross = figures["scores"]["gross_errors"]
    assert 0.1 < gross["beyond_60_mm"] < gross["beyond_30_mm"] < 1 - figures["scores"]["pixel_accuracy"]
    assert figures["gross_errors_by_placement"] == dict.fromkeys(("mean", "first", "second"), gross), "placed alike"
    json.dumps(figures)
    draw_real(figures, tmp_path / "real.png")
    with Image.open(tmp_path / "real.png") as picture:
        assert picture.width > 200 and picture.height > 200
        drawn = {colour for _, colour in picture.convert("RGB").getcolors(picture.width * picture.height)}
    assert drawn >= {tuple(colour) for colour in PARTS33.colours.tolist()}, "the legend names each part's own colour"


def test_a_mirrored_recording_has_the_same_scores(
    body: Mesh,
    frames: list[Frame],
    measured: Figures,
    coarse: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    write(tmp_path / "mirrored", [frame.mirrored() for frame in frames], body)
    table = {name: [-x, y, z] for name, (x, y, z) in zip(SEEN, on(body, PLACES).tolist(), strict=True)}
    (tmp_path / "mirrored" / "landmarks.json").write_text(json.dumps({"first": table, "second": table}))
    with coarse.context() as patch:
        patch.setattr(bench, "settled", lambda frames: (None, True))
        turned = bench_real(str(tmp_path / "mirrored"), views=9)
    assert turned["mirrored"]["frames"] is True
    for name in ("accuracy", "pixel_accuracy", "share_of_the_person"):
        assert turned["scores"][name] == pytest.approx(measured["scores"][name], abs=0.02)
    for part in SEEN:
        accuracies = [each["scores"]["parts"][part]["accuracy"] for each in (turned, measured)]
        assert accuracies[0] == pytest.approx(accuracies[1], abs=0.04)


def test_a_still_person_is_labelled_in_every_way(
    body: Mesh, frames: list[Frame], fused: FusedSurface, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / "made", frames[:3], body)
    monkeypatch.setattr(bench, "fuse", lambda frames: fused)
    monkeypatch.setattr(surface_labelling, "nearest_sources", along_edges)
    monkeypatch.setattr(bench, "fitted", lambda frames, surface: frames)
    found = still_person(Trained(Places(1, 12), {"rig": load_rig().to_json()}), tmp_path / "made", 3)
    assert (found["recording"], found["frames"]) == ("made", 3)
    assert found["degrees_apart"] == pytest.approx({"median": 20, "most": 20})
    assert list(found["ways"]) == list(WAYS)
    alone = found["ways"][ALONE]
    # Labels are columns of the image, so the turn moves the surface under them.
    assert 0.3 < alone["changed"] < 1 and 0 < alone["pixel_accuracy"] < 0.5


def test_recordings_that_cannot_be_read_are_refused(body: Mesh, frames: list[Frame], tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(png(np.zeros((20, 20), np.uint16)))
    with pytest.raises(BadConfig, match="needs frames NAME_depth.png with NAME_camera.xml, found none in"):
        read_recording(tmp_path, 9)
    write(tmp_path / "made", frames[:1], body)
    camera = tmp_path / "made" / "000_camera.xml"
    good = camera.read_text()
    for text, message in (
        ("<", "cannot read the camera"),
        (good.replace("<t>", "<u>").replace("</t>", "</u>"), "'t' must hold 3 numbers, found ''"),
        (good.replace("140.0", "300.0", 1), "pixels must be square, found focal lengths 300 and 140 px"),
        (good.replace("<R><data>", "<R><data>-"), "'R' must be a rotation, found"),
    ):
        camera.write_text(text)
        with pytest.raises(BadConfig, match=message):
            read_recording(tmp_path / "made", 9)
    camera.write_text(good)
    assert len(read_recording(tmp_path / "made", 9)) == 1
    (tmp_path / "made" / "000_depth.png").write_bytes(png(np.zeros((126, 140), np.uint16)))
    with pytest.raises(BadConfig, match="needs a person, found none in the frames in"):
        read_recording(tmp_path / "made", 9)


def test_placements_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    assert load_placements(tmp_path).names == load_placements(KINECT_V1.parent).names
    assert {"Sellion", "Rt. Acromion", "Cervicale"} <= {*load_placements(tmp_path).names}
    point = [0, 0, 0]
    for table, message in (
        ({"first": {"Sellion": point}}, "needs 'first' and 'second', names with x, y, z: 'second'"),
        ({"first": {"Sellion": point}, "second": {"Nuchale": point}}, "both tables need the same names of the 33"),
        ({"first": {"Nose": point}, "second": {"Nose": point}}, "both tables need the same names of the 33"),
    ):
        (tmp_path / "landmarks.json").write_text(json.dumps(table))
        with pytest.raises(BadLandmarks, match=message):
            load_placements(tmp_path)
