"""`bench failures`: every rule on images made for it, poses against known angles, and the whole on plain figures."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from benches.model import chosen
from benches.model.failures.bench import bench_failures
from benches.model.failures.causes import (
    ADJOINING,
    CAUSES,
    NAMES,
    Prediction,
    edge_distance,
    holds,
    parts_within,
    viewing_angles,
    window_sums,
)
from benches.model.failures.figure import draw_failures
from benches.model.failures.poses import (
    SEGMENTS,
    KnownPoses,
    directions,
)
from label_networks import Places
from numpy.typing import NDArray
from samples import body_info

from bodyseg_data.artifacts import RangeImage
from bodyseg_data.bodies import open_source
from bodyseg_data.bodies.skeleton import Arm, Leg, Pose, Trunk
from bodyseg_data.labels import BACKGROUND, PARTS
from bodyseg_data.meshes import partition
from bodyseg_data.rigs import Camera
from bodyseg_data.samples import Sample, steps
from bodyseg_model.evaluation import evaluate, open_images
from bodyseg_model.networks import Trained

Labels = NDArray[np.uint8]

CAMERA = Camera(60, 48, 100.0, (24.0, 30.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
NUMBER = {part.landmark: part.label for part in PARTS}
KNEE, SHOULDER = NUMBER["Rt. Femoral Lateral Epicn"], NUMBER["Rt. Acromion"]
BREAST, BACK = NUMBER["Rt. Thelion/Bustpoint"], NUMBER["10th Rib Midspine"]
PLACES = [cause.name for cause in CAUSES if cause.about == "a place"]


# What rules are made of.


def test_parts_within_against_a_search() -> None:
    labels = np.where(np.arange(391).reshape(23, 17) % 5 < 2, BACKGROUND, np.arange(391).reshape(23, 17) * 7 % 33)
    labels = labels.astype(np.uint8)
    for reach in (1, 3, 8):
        found = parts_within(labels, reach)
        for row in range(23):
            for column in range(17):
                near = labels[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
                assert int(found[row, column]) == sum(1 << part for part in {*near.ravel().tolist()} - {BACKGROUND})


def test_window_sums_against_a_search() -> None:
    mask = np.arange(187).reshape(17, 11) * 13 % 7 < 3
    found = window_sums(mask, 4)
    for row in range(17):
        for column in range(11):
            assert found[row, column] == mask[max(row - 4, 0) : row + 5, max(column - 4, 0) : column + 5].sum()


def test_distance_to_the_edges_that_a_body_touches() -> None:
    body = np.zeros((5, 4), np.bool_)
    body[1:4, 1:3] = True
    assert (edge_distance(body) == 9).all()
    body[4, 1] = True
    assert edge_distance(body)[:, 0].tolist() == [4, 3, 2, 1, 0]
    body[2, 0] = True
    assert edge_distance(body).tolist()[:2] == [[0, 1, 2, 3], [0, 1, 2, 3]] and edge_distance(body)[4, 3] == 0


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (0.3, 0.6, 0.6), (-0.6, 0.3, 0.5)])
def test_viewing_angles_of_a_plane(normal: tuple[float, float, float]) -> None:
    rays = CAMERA.pixel_rays()
    image = steps(2.5 * normal[2] / (rays @ np.array(normal)), 1e-4, "a plane")
    exact = np.degrees(np.arccos(np.abs(rays @ normal) / np.linalg.norm(rays, axis=2) / np.linalg.norm(normal)))
    assert np.abs(viewing_angles(image, CAMERA) - exact).max() < 1  # ranges are rounded to 0.1 mm


def test_an_edge_in_depth_is_no_slope() -> None:
    image = np.full((60, 48), 20000, np.uint16)
    image[20:40, 10:30] = 15000
    assert viewing_angles(image, CAMERA).max() < 25
    image[:, 40:] = image[0] = 0
    angles = viewing_angles(image, CAMERA)
    assert np.isnan(angles[:, 40:]).all() and np.isnan(angles[0]).all() and np.nanmax(angles) < 25
    image[:] = 0
    assert np.isnan(viewing_angles(image, CAMERA)).all()
    image[30, 24] = 20000
    assert np.isnan(viewing_angles(image, CAMERA)).all(), "one pixel has no normal"


def test_which_parts_adjoin() -> None:
    assert (ADJOINING == ADJOINING.T).all() and ADJOINING.diagonal().all()
    mirror = [part.mirror for part in PARTS]
    assert (ADJOINING[np.ix_(mirror, mirror)] == ADJOINING).all()
    source = open_source("open")
    body = source.build(next(body for body in source.bodies() if body.mesh == "person-120"))
    labels = partition(body.mesh, body.landmarks).labels[body.mesh.faces]
    touching = np.zeros_like(ADJOINING)
    for one, two in ((0, 1), (1, 2), (2, 0)):
        touching[labels[:, one], labels[:, two]] = touching[labels[:, two], labels[:, one]] = True
    assert not (touching & ~ADJOINING).any()
    assert (ADJOINING & ~touching).sum() <= 2 * 14, "pairs that only other bodies have"


# The rules.


def judged(
    labels: Labels, said: Labels, shown: NDArray[np.bool_] | None = None, image: NDArray[np.uint16] | None = None
) -> Prediction:
    body = labels != BACKGROUND
    shown = body if shown is None else shown
    range_steps = np.where(body, np.uint16(25000), np.uint16(0)) if image is None else image
    info = body_info(source="folder", subset="folder", subject="S", mesh="m", split="test")
    clean = Sample("folder-S-m-d215-a000", range_steps, None, labels, body, info)
    seen = RangeImage(clean.key, range_steps * shown, np.where(shown, labels, np.uint8(BACKGROUND)), {"sigma_mm": 10.0})
    return Prediction(clean, seen, np.where(shown, said, np.uint8(BACKGROUND)), 12.0)


def plain(part: int = KNEE) -> Labels:
    """A body of one part, away from all edges."""
    labels = np.full((60, 48), BACKGROUND, np.uint8)
    labels[6:54, 6:42] = part
    return labels


def rule(name: str, case: Prediction) -> NDArray[np.bool_]:
    """Where a rule holds, bool [H, W]."""
    image = np.zeros(case.clean.labels.shape, np.bool_)
    image[case.shown.labels != BACKGROUND] = holds(case, CAMERA)[NAMES.index(name)]
    return image


def test_lost_data() -> None:
    body = plain() != BACKGROUND
    shown = body.copy()
    shown[20:44, 12:36] = False
    shown[32, 24] = True
    found = rule("lost_data", judged(plain(), plain(), shown))
    assert found[32, 24] and not found[8:12].any()
    # At the corner of the hole 289 - 81 of 289 pixels are left, at the middle of its side about half.
    assert not found[19, 11] and not found[19, 24]


def test_out_of_frame() -> None:
    labels = np.full((80, 48), BACKGROUND, np.uint8)
    labels[5:80, 10:30] = KNEE
    tall = Camera(80, 48, 100.0, (24.0, 40.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    found = holds(judged(labels, labels), tall)[NAMES.index("out_of_frame")].reshape(75, 20)
    assert found[-32:].all() and not found[:-32].any()


def test_grazing() -> None:
    rays = CAMERA.pixel_rays()
    body = plain() != BACKGROUND
    for degrees, grazing in ((60, False), (80, True)):
        normal = np.array([0.0, np.sin(np.radians(degrees)), np.cos(np.radians(degrees))])
        image = steps(np.where(body, 1.0 * normal[2] / np.maximum(rays @ normal, 0.05), 0), 1e-4, "a plane")
        assert rule("grazing", judged(plain(), plain(), image=image))[30, 24] == grazing


def test_contact_and_border() -> None:
    for other, stranger in ((NUMBER["Rt. Knee Crease"], False), (SHOULDER, True)):
        labels = plain()
        labels[30:54, 6:42] = other
        contact, border = (rule(name, judged(labels, labels)) for name in ("contact", "border"))
        assert contact.any() == stranger
        assert np.flatnonzero(border[:, 20]).tolist() == [28, 29, 30, 31]
        if stranger:
            assert np.flatnonzero(contact[:, 20]).tolist() == list(range(22, 38))


def test_mistakes() -> None:
    cases: list[tuple[int, int, int, str]] = [
        (KNEE, KNEE + 1, KNEE, "left/right"),
        (BREAST, BACK, BREAST, "front/back"),
        (BREAST, NUMBER["Lt. PSIS"], BREAST, "front/back"),  # the other side as well
        (BREAST, KNEE, BREAST, "unexplained"),
        (BREAST, BACK, BACK, "border_moved"),
        (KNEE, KNEE + 1, KNEE + 1, "border_moved"),
    ]
    for truth, answer, neighbour, name in cases:
        labels = plain(truth)
        labels[30:54, 6:42] = neighbour
        said = labels.copy()
        said[25, 20:30] = answer
        case = judged(labels, said)
        found = holds(case, CAMERA)
        ours = np.zeros(labels.shape, np.bool_)
        ours[25, 20:30] = True
        at = ours[labels != BACKGROUND]
        about = [number for number, cause in enumerate(CAUSES) if cause.about == "a mistake"]
        held = {NAMES[number] for number in about if found[number][at].all()}
        assert held == {name, "unexplained"}
        assert not found[about][:, ~at].any()


def test_rules_about_an_image() -> None:
    case = judged(plain(), plain())
    assert not rule("pose", case).any() and not rule("noise", case).any()
    body = plain() != BACKGROUND
    assert (rule("pose", case._replace(new_pose_deg=30.5)) == body).all()
    assert not rule("pose", case._replace(new_pose_deg=float("nan"))).any()
    assert (rule("noise", case._replace(shown=replace(case.shown, drawn={"sigma_mm": 60.5}))) == body).all()
    assert not rule("noise", case._replace(shown=replace(case.shown, drawn={}))).any()


# Poses.


def segment(pose: Pose, name: str) -> list[float]:
    return [round(value, 1) + 0.0 for value in directions(pose)[SEGMENTS.index(name)].tolist()]


def test_where_segments_point() -> None:
    pose = Pose(
        Trunk(lean=90),
        Arm(abduct=90, elbow=0),
        Arm(flex=90, abduct=0, elbow=90),
        Leg(flex=90, abduct=0, knee=90),
        Leg(abduct=0),
    )
    assert segment(replace(pose, trunk=Trunk()), "arm.L") == [1, 0, 0]
    assert segment(replace(pose, trunk=Trunk()), "arm.R") == [0, 0, 1]
    assert segment(replace(pose, trunk=Trunk()), "forearm.R") == pytest.approx([0, 1, 0], abs=0.11)
    assert segment(replace(pose, trunk=Trunk()), "thigh.L") == [0, 0, 1]
    assert segment(replace(pose, trunk=Trunk()), "shin.L") == pytest.approx([0, -1, 0], abs=0.11)
    assert segment(pose, "chest") == [0, 0, -1] and segment(pose, "chest's front") == [0, -1, 0]
    assert segment(pose, "thigh.R") == pytest.approx([0, 0, -1], abs=0.11)
    assert np.allclose(np.linalg.norm(directions(pose), axis=1), 1)


def test_the_nearest_known_pose() -> None:
    left_up = Pose(left_arm=Arm(abduct=120))
    known = KnownPoses([("standing", Pose()), ("left up", left_up)])
    for pose, name in (
        (Pose(), "standing"),
        (left_up.mirrored(), "left up"),
        (replace(left_up, trunk=Trunk(turn=77)), "left up"),
    ):
        found = known.nearest(pose)
        assert (found.degrees, found.pose) == (pytest.approx(0, abs=1e-4), name)
    assert known.nearest(Pose(right_arm=Arm(abduct=48))) == (pytest.approx(40, abs=0.01), "standing", "arm.R")
    assert known.nearest(Pose(left_leg=Leg(knee=25))) == (pytest.approx(25, abs=0.1), "standing", "shin.L")
    assert known.nearest(Pose(trunk=Trunk(lean=25))).degrees == pytest.approx(25, abs=0.01)
    unknown = KnownPoses([]).nearest(Pose())
    assert np.isnan(unknown.degrees) and unknown.pose == unknown.segment == ""


# The whole.


@pytest.fixture(autouse=True)
def network(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Every part a band of rows; and one thread, as pictures are many and small."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    monkeypatch.setattr(chosen, "load_network", lambda path: Trained(Places(0, 20), {}))
    yield
    torch.set_num_threads(before)


def test_the_answer_adds_up(figures_set: Path) -> None:
    done: list[tuple[int, int]] = []
    found = bench_failures(
        str(figures_set), (Path("some/run"),), 3, str(figures_set), lambda *numbers: done.append(numbers)
    )
    assert done[-1] == (11, 11) and done == sorted(done)
    assert json.loads(json.dumps(found)) == found
    assert (found["network"], list(found["sets"])) == ("run", ["test", "hard"])
    assert [entry["name"] for entry in found["rules"]] == list(NAMES)
    assert found["training_bodies"] is None, "plain figures have no joint angles"
    for name, images in (("test", 3), ("hard", 8)):
        answer = found["sets"][name]
        matrix = evaluate(Places(0, 20), open_images(str(figures_set)), images, confidences=False).total().confusion
        assert (answer["images"], answer["pixels"]) == (images, matrix.pixels)
        assert answer["accuracy"] == pytest.approx(matrix.average_per_class_accuracy(), abs=1e-4)
        check_causes(answer)
        assert len(found.shown[name]) == len(answer["worst"]) == min(images, 4)


def check_causes(answer: dict[str, Any]) -> None:
    causes = {entry["cause"]: entry for entry in answer["causes"]}
    assert tuple(causes) == NAMES
    assert sum(entry["share_of_wrong"] for entry in causes.values()) == pytest.approx(1, abs=1e-4)
    assert causes["unexplained"]["holds_of_wrong"] == 1
    assert causes["unexplained"]["holds_of_all"] == pytest.approx(1 - answer["pixel_accuracy"], abs=1e-4)
    assert causes["border"]["holds_of_wrong"] > causes["border"]["share_of_wrong"] > 0, "others are asked before"
    for entry in causes.values():
        assert entry["share_of_wrong"] <= entry["holds_of_wrong"]
        assert answer["accuracy"] <= entry["accuracy_if_right"] <= 1
    for name in PLACES:
        entry = causes[name]
        wrong, pixels = entry["holds_of_wrong"], entry["holds_of_all"]
        if pixels:
            assert entry["lift"] == pytest.approx(wrong / pixels, abs=1e-3, rel=3e-3)
            assert entry["excess"] == pytest.approx(wrong - (1 - wrong) * pixels / (1 - pixels), abs=1e-3)
        else:
            assert entry["lift"] is entry["excess"] is None


def test_the_figures_are_drawn(figures_set: Path, tmp_path: Path) -> None:
    draw_failures(bench_failures(str(figures_set), images=2, hard=str(figures_set)), tmp_path / "failures.png")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["failures.png", "failures_hard.png"]
