"""`bench joints`: the fit finds joints that are known, frames show them where they are, the page has its figures."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from label_networks import Places
from shapes import ball

from bodyseg_data.labels import LANDMARKS, PARTS
from bodyseg_data.rigs import load_rig
from bodyseg_model.networks import Trained
from bodyseg_model.segmentation.joints import FORMAT, JOINTS, code_of, joint_map_from_json, shipped_joint_map

pytest.importorskip("torch")

from benches.model.people.joints import Person, errors_of, fitted, views_of
from folders import DOCS, ROOT

CODES = np.array([code_of(part) for part in range(33)])


def made(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Parts and joints of `count` views: the joint lies 5 cm behind two parts, whose errors are opposite."""
    draws = np.random.default_rng(seed)
    joints = draws.uniform((-1, -1, 2), (1, 1, 4), (count, len(JOINTS), 3))
    points = draws.uniform((-1, -1, 2), (1, 1, 4), (count, 33, 3))
    sides = {"right": [part.label for part in PARTS if part.side == "right"], "middle": [0, 1, 2, 3, 6, 9]}
    for joint, name in enumerate(JOINTS):
        side = "middle" if "_" not in name else "right"
        number = [each for each in JOINTS if ("_" in each) == ("_" in name)].index(name)
        pair = sides[side][2 * (number // (1 + ("_" in name))) :][:2]
        pair = [PARTS[part].mirror for part in pair] if name.startswith("left") else pair
        error = draws.normal(0, 0.05, (count, 3))
        for part, sign in zip(pair, (1, -1), strict=True):
            before = joints[:, joint] + sign * error
            points[:, part] = before * (1 - 0.05 / np.linalg.norm(before, axis=1, keepdims=True))
    points[draws.random((count, 33)) < 0.1] = np.nan
    return points, joints


def test_the_fit_finds_joints_that_are_known() -> None:
    points, joints = made(300, 1)
    tree = fitted(points, joints, CODES)
    fit = joint_map_from_json(tree)
    points, joints = made(100, 2)
    found = errors_of(fit, points[:, fit.codes // 256], joints)
    assert tree["format"] == FORMAT
    assert found["all"]["median_mm"] < 15 and found["all"]["given"] > 0.95, "one part alone errs by 77 mm"
    lengths = {
        tuple(names): length
        for names, length in zip(tree["joints"][0]["features"], tree["joints"][0]["behind_mm"], strict=True)
    }
    assert lengths[(LANDMARKS[0],)] == pytest.approx(50, abs=10)
    right, left = tree["joints"][2], tree["joints"][3]
    assert left["moments_mm2"] == right["moments_mm2"]
    assert [name.replace("Lt.", "Rt.") for (name,) in left["features"]] == [name for (name,) in right["features"]]


@pytest.mark.usefixtures("one_thread")
def test_views_show_a_body_where_its_joints_are() -> None:
    """A ball of 30 cm: every point that is measured lies at its radius from its middle, within a Kinect's noise."""
    mesh = ball(0.3, (0.0, 0.0, 0.0))
    person = Person(mesh, np.zeros((15, 3)), np.zeros((33, 3)), np.zeros(33, np.int64))
    trained = Trained(Places(0, 20), {"rig": load_rig().to_json()})
    seen = list(views_of(trained, person, 3, 5))
    assert seen
    for answer, true, joints in seen:
        points = answer.points()
        away = np.stack([points[axis] for axis in "xyz"], axis=1) - joints[0]
        assert true is None and np.abs(np.linalg.norm(away, axis=1) - 0.3).mean() < 0.02


def test_the_page_has_the_figures_of_the_bench() -> None:
    """And the map that ships is the one that was measured."""
    results = json.loads((DOCS / "results" / "joints.json").read_text())
    page = (DOCS / "how-to" / "robot.md").read_text()
    sets = [results["errors"][name] for name in ("open", "hard", "annotated")]

    def errors(kind: str, joint: str) -> list[str]:
        each = [one[kind][joint] for one in sets]
        return [f"{one['median_mm']:.0f} ({one['p90_mm']:.0f})" for one in each]

    for joint in (*JOINTS, "all"):
        (row,) = re.findall(rf"^\| {joint.replace('_', ' ')} \| (.*) \|$", page, re.MULTILINE)
        given = f"{100 * sets[0]['predicted'][joint]['given']:.0f} %"
        assert row.split(" | ") == [*errors("predicted", joint), given]
    assert "{}, {} and {}".format(*errors("true", "all")) in page
    skeleton = results["skeleton_from_landmarks"]["all"]
    assert f"{skeleton['median_mm']:.0f} mm (nine in ten below {skeleton['p90_mm']:.0f})" in page
    shipped = json.loads((ROOT / "bodyseg_model" / "weights" / "joints.json").read_text())
    assert shipped["joints"] == results["map"]["joints"] and shipped_joint_map() is shipped_joint_map()
