"""The motions of subjects B and C: human, smooth, and on the floor."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import fields
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from shapes import mean_by_place

from bodyseg_data.bodies import FRAMES_PER_SECOND
from bodyseg_data.bodies.anny_model import Figure
from bodyseg_data.bodies.motions.catalogue import BUILD_B, BUILD_C, MOTIONS, STRIDES_B, STRIDES_C, SUBJECTS
from bodyseg_data.bodies.motions.curves import (
    Build,
    PoseTrack,
    Sole,
    Track,
    angles,
    from_angles,
    pelvis_over,
    reach,
    wander,
)
from bodyseg_data.bodies.motions.handstand import ARM_C
from bodyseg_data.bodies.motions.jumps import Flight
from bodyseg_data.bodies.motions.walk import STANCE
from bodyseg_data.bodies.skeleton import Arm, Leg, Pose, Trunk, bone_rotations, leg_rotations, root_rotation
from bodyseg_data.bodies.sources.open_bodies import BareBodies
from bodyseg_data.labels import LANDMARKS
from bodyseg_data.meshes import load_landmarks

Floats = NDArray[np.float64]
NAMES = [(subject, name) for subject, motions in MOTIONS.items() for name in motions]
ANGLES = [
    f"{part}.{field.name}"
    for part, kind in (("trunk", Trunk), ("left_arm", Arm), ("right_arm", Arm), ("left_leg", Leg), ("right_leg", Leg))
    for field in fields(kind)
]

# Least and most, degrees. Ranges of motion of healthy adults: American Academy of Orthopaedic Surgeons, as tabled in
# Norkin and White, Measurement of Joint Motion, 5th ed. 2016, appendix B. Where a body's weight takes a joint further
# than muscles do: hips in a deep squat (Hemmerich et al. 2006, J Orthop Res 24:770), ankles in a lunge (Bennell et al.
# 1998, Aust J Physiother 44:175), wrists under the hands' load in a handstand (90).
RANGES = {
    "trunk.bend": (-30, 80), "trunk.side": (-35, 35), "trunk.twist": (-45, 45),
    "trunk.nod": (-45, 45), "trunk.tilt": (-45, 45), "trunk.look": (-60, 60),
    "arm.flex": (-60, 180), "arm.abduct": (-30, 180), "arm.twist": (-70, 90), "arm.elbow": (0, 150),
    "arm.supinate": (-80, 80), "arm.wrist": (-70, 80), "arm.fist": (-0.3, 1),
    "leg.flex": (-30, 130), "leg.abduct": (-30, 45), "leg.twist": (-45, 45), "leg.knee": (0, 135), "leg.toes": (0, 70),
}  # fmt: skip
ANKLE = (-38, 50)
LOADED_WRIST = (-90, 80)
MIRROR = np.diag([-1.0, 1, 1])
GLOBAL = {"trunk.lean", "trunk.roll", "trunk.turn"}  # where the pelvis points in the world: no joint
MIXED = {"leg.planted", "leg.ankle"}  # seen together, in the turn of the foot against the shin


@pytest.fixture(scope="module")
def frames() -> dict[tuple[str, str], list[Figure]]:
    return {(subject, name): _all(subject, name) for subject, name in NAMES}


def _all(subject: str, name: str) -> list[Figure]:
    motion = MOTIONS[subject][name]  # type: ignore[index]
    return [Figure(SUBJECTS[subject], *motion.frame(index)) for index in range(motion.frames)]


@pytest.fixture(scope="module")
def built() -> Callable[[str, str, int], Floats]:
    """Vertices of frames, of bodies for which no clothes are cut."""
    source = BareBodies()
    by_name = {ref.mesh: ref for ref in source.bodies()}
    return lambda subject, name, index: source.build(by_name[f"{subject}-{name}-{index:03d}"]).mesh.vertices


@cache
def legs_of(pose: Pose) -> Mapping[str, Floats]:
    """Rotations of both legs' bones in a pose, a fifth of all: several tests ask for those of the same frames."""
    root = root_rotation(pose.trunk)
    left, right = leg_rotations(pose.left_leg, root), leg_rotations(pose.right_leg, MIRROR @ root @ MIRROR)
    rotations = {f"{bone}.L": rotation for bone, rotation in left.items()}
    return rotations | {f"{bone}.R": MIRROR @ rotation @ MIRROR for bone, rotation in right.items()}


@pytest.mark.parametrize(("subject", "name"), NAMES)
def test_joints_stay_within_human_ranges(frames: Any, subject: str, name: str) -> None:
    table = np.array([angles(frame.pose) for frame in frames[subject, name]])
    for column, angle in zip(table.T, ANGLES, strict=True):
        joint = angle.replace("left_", "").replace("right_", "")
        if joint in GLOBAL | MIXED:
            continue
        low, high = LOADED_WRIST if joint == "arm.wrist" and name == "handstand" else RANGES[joint]
        assert low <= column.min() and column.max() <= high, (angle, column.min(), column.max())
    assert {angle.split(".")[0].split("_")[-1] + "." + angle.split(".")[1] for angle in ANGLES} == (
        set(RANGES) | GLOBAL | MIXED
    )


@pytest.mark.parametrize(("subject", "name"), NAMES)
def test_ankles_stay_within_human_ranges(frames: Any, subject: str, name: str) -> None:
    all_bones = bone_rotations(frames[subject, name][0].pose)
    for bone, rotation in legs_of(frames[subject, name][0].pose).items():
        np.testing.assert_array_equal(rotation, all_bones[bone])
    for index, frame in enumerate(frames[subject, name]):
        rotations = legs_of(frame.pose)
        for side in "LR":
            foot = rotations[f"foot.{side}"]
            bent = math.degrees(math.atan2(foot[2, 1], foot[1, 1]))
            tilted = math.degrees(math.asin(foot[1, 0]))
            assert ANKLE[0] <= bent <= ANKLE[1] and abs(tilted) <= 25, (index, side, bent, tilted)


# The most degrees a joint goes in a frame (a 25th of a second), and the most that this changes from frame to frame.
SPEEDS = {"jumping": (36, 28), "bouncing": (20, 20), "handstand": (26, 11)}


@pytest.mark.parametrize(("subject", "name"), NAMES)
def test_joints_move_smoothly(frames: Any, subject: str, name: str) -> None:
    table = np.array([angles(frame.pose) for frame in frames[subject, name]])
    most_speed, most_change = SPEEDS.get(name, (18, 18))
    assert np.abs(np.diff(table, axis=0)).max() <= most_speed
    assert np.abs(np.diff(table, 2, axis=0)).max() <= most_change
    heights = np.array([frame.height_m for frame in frames[subject, name]])
    assert np.abs(np.diff(heights)).max() < 0.12


@pytest.mark.parametrize(("subject", "name"), NAMES)
def test_the_fastest_moments_are_motion_and_no_jumps(frames: Any, subject: str, name: str) -> None:
    """Between frames, steps shrink with the time between them, and their changes shrink faster: speed is continuous."""
    motion = MOTIONS[subject][name]  # type: ignore[index]
    table = np.array([angles(frame.pose) for frame in frames[subject, name]])
    step = np.abs(np.diff(table, axis=0)).max(axis=1)
    change = np.abs(np.diff(table, 2, axis=0)).max(axis=1)
    finer = 8
    for index in {*np.argsort(step)[-2:].tolist(), *np.argsort(change)[-2:].tolist()}:
        times = (index + np.arange(2 * finer + 1) / finer) / FRAMES_PER_SECOND
        between = np.array([angles(motion.at(float(time))[0]) for time in times])
        steps = np.diff(between, axis=0)
        assert np.abs(steps).max() <= 3 * max(step[index : index + 2].max(), 1) / finer
        assert np.abs(np.diff(steps, axis=0)).max() <= 5 * max(change.max(), 1) / finer**2 + 0.15


@pytest.mark.parametrize(("subject", "name"), NAMES)
def test_no_two_frames_are_alike(frames: Any, subject: str, name: str) -> None:
    table = np.array([[*angles(frame.pose), 100 * frame.height_m] for frame in frames[subject, name]])
    apart = np.abs(table[:, None] - table[None]).max(axis=-1)
    assert (apart + 10 * np.eye(len(table))).min() > 0.05


FRAMES = {
    ("B", "crane"): 10.141159, ("B", "jumping"): 10.71332, ("B", "march"): 9.144734, ("B", "squat"): 11.382113,
    ("C", "bouncing"): 10.141425, ("C", "handstand"): 10.147945, ("C", "march"): -0.879573, ("C", "squat"): 14.805371,
}  # fmt: skip


@pytest.mark.parametrize(("subject", "name"), NAMES)
def test_frames_stay_as_they_were(frames: Any, subject: str, name: str) -> None:
    table = [[*angles(frame.pose), 100 * frame.height_m] for frame in frames[subject, name]]
    assert mean_by_place(table) == pytest.approx(FRAMES[subject, name], abs=1e-5)


def test_frames_are_rounded_so_that_machines_agree(frames: Any) -> None:
    for sequence in frames.values():
        for frame in sequence[::40]:
            assert frame.pose == from_angles(angles(frame.pose), 4)
            assert frame.height_m == round(frame.height_m, 6)


@pytest.mark.parametrize(("subject", "name"), NAMES)
def test_only_jumps_and_bounces_leave_the_floor(frames: Any, subject: str, name: str) -> None:
    heights = np.array([frame.height_m for frame in frames[subject, name]])
    assert heights.min() == 0
    flown = np.diff(np.concatenate([[0], heights > 0, [0]]).astype(int))
    flights = list(zip(np.flatnonzero(flown > 0), np.flatnonzero(flown < 0), strict=True))
    if name == "jumping":
        assert len([pair for pair in flights if heights[pair[0] : pair[1]].max() > 0.1]) == 3
        assert 0.15 < heights.max() < 0.5
    elif name == "bouncing":
        assert len(flights) >= 3 and 0.02 < heights.max() < 0.1
    else:
        assert not flights


@pytest.mark.parametrize("build", [BUILD_B, BUILD_C])
def test_a_thrown_body_flies_along_a_parabola(build: Build) -> None:
    """Legs that straighten at 2 m/s and stop: the body leaves them at 2 m/s and is back after 2 v / g."""
    flight = Flight(lambda time: min(0.6 + 2 * time, 1.0), seconds=1)
    back = 0.2 + 2 * 2 / 9.81
    for time in np.arange(0, 1, 1 / 25):
        since = time - 0.2
        expected = 2 * since - 9.81 / 2 * since**2 if 0.2 < time < back else 0
        assert flight.height(float(time)) == pytest.approx(max(expected, 0), abs=0.012)
    assert Flight(lambda time: 1 + 0.05 * math.cos(12 * time), seconds=1).height(0.3) == 0  # 7.2 m/s2: no hop
    hopping = Flight(lambda time: 1 + 0.08 * math.cos(12 * time), seconds=1)  # 11.5 m/s2
    assert max(hopping.height(index / 50) for index in range(50)) > 0


def _ankle(pose: Pose, build: Build, side: str) -> Floats:
    """Where an ankle is from the pelvis, bone by bone."""
    turned, place = root_rotation(pose.trunk), np.zeros(3)
    mirror = np.array([1.0 if side == "L" else -1.0, 1, 1])
    rotations = legs_of(pose)
    for bones, offset in (((), build.hip), (("upperleg01", "upperleg02"), build.thigh), (("lowerleg01",), build.shin)):
        for bone in bones:
            turned = turned @ rotations[f"{bone}.{side}"]
        place = place + turned @ (mirror * offset)
    return place


@pytest.mark.parametrize("side", [1, -1])
def test_legs_reach_where_soles_are(side: int) -> None:
    random = np.random.default_rng(5)
    for _ in range(40):
        trunk = Trunk(*random.uniform(-15, 15, 3))
        sole = Sole(side * random.uniform(0.08, 0.3), random.uniform(-0.2, 0.2), random.uniform(-20, 20), 0)
        pelvis = np.array([random.uniform(-0.05, 0.05), random.uniform(0.6, 0.9), 0])
        leg = reach(BUILD_B, root_rotation(trunk), pelvis, sole, side)
        pose = Pose(trunk, Arm(), Arm(), leg, leg)
        wanted = np.array([sole.x, -BUILD_B.ball[1], sole.z])
        np.testing.assert_allclose(pelvis + _ankle(pose, BUILD_B, "L" if side > 0 else "R"), wanted, atol=0.004)


def test_a_leg_that_is_too_short_is_straight_and_points_there() -> None:
    leg = reach(BUILD_B, np.eye(3), np.array([0, 2.0, 0]), Sole(0.2, 0.0), 1)
    longer = reach(BUILD_B, np.eye(3), np.array([0, 3.0, 0]), Sole(0.2, 0.0), 1)
    assert leg.knee == longer.knee < 0 and abs(leg.flex) < 10


def test_a_sole_turns_over_ball_and_heel() -> None:
    ball, heel = np.array(BUILD_B.ball), np.array(BUILD_B.heel)
    for pitch, pivot in ((40.0, ball), (-20.0, heel)):
        ankle = Sole(0, 0, 0, pitch).ankle(BUILD_B)
        assert np.linalg.norm(ankle - pivot - np.array([0, -BUILD_B.ball[1], 0])) == pytest.approx(
            np.linalg.norm(pivot)
        )
        assert ankle[1] > -BUILD_B.ball[1]
    assert Sole(0.1, 0.2).ankle(BUILD_B).tolist() == [0.1, -BUILD_B.ball[1], 0.2]


def test_a_standing_pelvis_is_as_high_as_the_legs() -> None:
    straight, bent = (Pose(left_leg=Leg(flex=flex, knee=knee)) for flex, knee in ((0, 0), (60, 90)))
    assert pelvis_over(BUILD_B, straight)[1] > pelvis_over(BUILD_B, bent)[1] + 0.1
    assert pelvis_over(BUILD_B, straight)[1] == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("name", ["B squat", "C squat"])
def test_feet_do_not_slide_in_squats(frames: Any, name: str) -> None:
    subject, motion = name.split()
    build = {"B": BUILD_B, "C": BUILD_C}[subject]
    apart = np.array(
        [_ankle(frame.pose, build, "L") - _ankle(frame.pose, build, "R") for frame in frames[subject, motion]]
    )
    assert np.ptp(apart, axis=0).max() < 0.012


@pytest.mark.parametrize("subject", ["B", "C"])
def test_feet_do_not_slide_while_both_are_on_the_floor(frames: Any, subject: str) -> None:
    """Walking: for a fifth of the time the heel of the foot ahead and the ball of the foot behind are both in place."""
    build, gait = {"B": (BUILD_B, STRIDES_B), "C": (BUILD_C, STRIDES_C)}[subject]
    apart: dict[int, list[Floats]] = {}
    for index, frame in enumerate(frames[subject, "march"]):
        step, since = divmod(2 * (gait.first + index / FRAMES_PER_SECOND / gait.seconds), 1)
        if since / 2 < STANCE - 0.5:
            ahead, behind = ("L", "R") if step % 2 == 0 else ("R", "L")
            vector = _sole_point(frame.pose, build, ahead, build.heel) - _sole_point(
                frame.pose, build, behind, build.ball
            )
            apart.setdefault(int(step), []).append(vector)
    assert len(apart) >= 16 and sum(map(len, apart.values())) > 40
    for vectors in apart.values():
        assert np.ptp(vectors, axis=0).max() < 0.02
        assert np.linalg.norm(vectors[0]) > 0.25 and abs(vectors[0][1]) < 0.01


def _sole_point(pose: Pose, build: Build, side: str, point: tuple[float, float, float]) -> Floats:
    """Where a point of a foot's sole is from the pelvis."""
    turned, rotations = root_rotation(pose.trunk), legs_of(pose)
    for bone in ("upperleg01", "upperleg02", "lowerleg01", "foot"):
        turned = turned @ rotations[f"{bone}.{side}"]
    return _ankle(pose, build, side) + turned @ point


@pytest.fixture(scope="module")
def model() -> Any:
    return BareBodies().model


@pytest.mark.parametrize("subject", ["B", "C"])
def test_builds_are_those_of_the_bodies(model: Any, subject: str) -> None:
    """Legs that reach, and hands that stand, know the subjects' bones; these come from the model itself."""
    import torch

    who = SUBJECTS[subject]  # type: ignore[index]
    anny = model._anny
    with torch.inference_mode():
        shape = who.phenotype() | {"height": model._height(who)}
        heads = anny(model._pose_parameters(Pose()), shape)["rest_bone_heads"][0].numpy() @ [
            [1, 0, 0],
            [0, 0, -1],
            [0, 1, 0],
        ]
    place = {bone: heads[index] for index, bone in enumerate(anny.bone_labels)}
    build = {"B": BUILD_B, "C": BUILD_C}[subject]
    np.testing.assert_allclose(build.hip, place["upperleg01.L"] - place["root"], atol=2e-4)
    np.testing.assert_allclose(build.thigh, place["lowerleg01.L"] - place["upperleg01.L"], atol=2e-4)
    np.testing.assert_allclose(build.shin, place["foot.L"] - place["lowerleg01.L"], atol=2e-4)
    np.testing.assert_allclose(build.ball[2], (place["toe2-1.L"] - place["foot.L"])[2], atol=1e-3)
    if subject == "C":
        bones = ["root", *(bone for bone, _ in ARM_C)]
        for parent, (bone, offset) in zip(bones, ARM_C, strict=False):
            np.testing.assert_allclose(offset, place[bone] - place[parent], atol=2e-4)


def _lowest(vertices: Floats, part: str) -> float:
    return float(vertices[_PARTS[part], 1].min())


def _patch(vertices: Floats, landmark: str, radius: float) -> NDArray[np.intp]:
    place = vertices[load_landmarks("open").vertices[LANDMARKS.index(landmark)]]
    return np.flatnonzero(np.linalg.norm(vertices - place, axis=1) < radius)


_PARTS: dict[str, NDArray[np.intp]] = {}


@pytest.fixture(scope="module", autouse=True)
def _parts(built: Callable[[str, str, int], Floats]) -> None:
    """Vertices of hands and feet, by their distance from finger tips and toes in a standing body."""
    standing = built("C", "handstand", 0)
    for side in ("Lt.", "Rt."):
        _PARTS[f"{side} hand"] = _patch(standing, f"{side} Dactylion", 0.16)
        foot = np.concatenate(
            [_patch(standing, f"{side} Digit II", 0.1), _patch(standing, f"{side} Lateral Malleolus", 0.09)]
        )
        _PARTS[f"{side} foot"] = foot


def test_feet_are_on_the_floor(frames: Any, built: Callable[[str, str, int], Floats]) -> None:
    """Both in squats, at least one in each step of a walk, and both where one hands over to the other."""
    for subject in ("B", "C"):
        for index in (0, 60, 130, 249):
            vertices = built(subject, "squat", index)
            assert vertices[:, 1].min() == 0
            assert max(_lowest(vertices, "Lt. foot"), _lowest(vertices, "Rt. foot")) < 0.015, (subject, index)
        gait = {"B": STRIDES_B, "C": STRIDES_C}[subject]
        for index in range(100, 130, 6):
            vertices = built(subject, "march", index)
            feet = {"Lt.": _lowest(vertices, "Lt. foot"), "Rt.": _lowest(vertices, "Rt. foot")}
            assert vertices[:, 1].min() == 0 and min(feet.values()) < 0.003, (subject, index)
            for side, strike in (("Lt.", 0.0), ("Rt.", 0.5)):
                since = (gait.first + index / FRAMES_PER_SECOND / gait.seconds - strike) % 1
                swung = (since - STANCE) / (1 - STANCE)
                assert feet[side] < 0.02 if swung < 0 else feet[side] > 0.004 or not 0.15 < swung < 0.55, (
                    subject,
                    index,
                )


def test_in_flight_the_lowest_point_is_as_high_as_it_says(
    frames: Any, built: Callable[[str, str, int], Floats]
) -> None:
    in_flight = [index for index, frame in enumerate(frames["B", "jumping"]) if frame.height_m > 0.1]
    for index in in_flight[::6]:
        vertices = built("B", "jumping", index)
        assert vertices[:, 1].min() == pytest.approx(frames["B", "jumping"][index].height_m, abs=1e-6)


def test_a_handstand_stands_on_its_hands(built: Callable[[str, str, int], Floats]) -> None:
    for index in (70, 88, 105):
        vertices = built("C", "handstand", index)
        assert max(_lowest(vertices, "Lt. hand"), _lowest(vertices, "Rt. hand")) < 0.02, index
        assert min(_lowest(vertices, "Lt. foot"), _lowest(vertices, "Rt. foot")) > 1.2
        sellion = vertices[load_landmarks("open").vertices[LANDMARKS.index("Sellion")]]
        assert 0.1 < sellion[1] < 0.5
    for index in (42, 45, 135, 138):  # hands and feet
        vertices = built("C", "handstand", index)
        assert max(_lowest(vertices, part) for part in _PARTS) < 0.025
    for index in (0, 20, 165):
        vertices = built("C", "handstand", index)
        assert (
            max(_lowest(vertices, f"{side} foot") for side in ("Lt.", "Rt."))
            < 0.015
            < 0.5
            < _lowest(vertices, "Lt. hand")
        )


@pytest.mark.parametrize(
    ("subject", "name", "most"), [("B", "march", 0.14), ("C", "handstand", 0.36), ("B", "jumping", 0.6)]
)
def test_skin_moves_as_smoothly_as_joints(
    frames: Any, built: Callable[[str, str, int], Floats], subject: str, name: str, most: float
) -> None:
    table = np.array([angles(frame.pose) for frame in frames[subject, name]])
    fastest = int(np.abs(np.diff(table, axis=0)).max(axis=1).argmax())
    first, second, third = (built(subject, name, fastest + offset) for offset in (-1, 0, 1))
    assert 0.01 < np.linalg.norm(third - second, axis=1).max() < most
    assert np.linalg.norm(third - 2 * second + first, axis=1).max() < most


def test_walkers_turn_and_differ(frames: Any) -> None:
    turns = {subject: [frame.pose.trunk.turn for frame in frames[subject, "march"]] for subject in "BC"}
    assert np.ptp(turns["B"]) > 300 and np.ptp(turns["C"]) > 300
    assert turns["B"][-1] > turns["B"][0] and turns["C"][-1] < turns["C"][0]
    for name in ("march", "squat"):
        b, c = (np.array([angles(frame.pose) for frame in frames[subject, name]]) for subject in "BC")
        assert np.abs(np.ptp(b, axis=0) - np.ptp(c, axis=0)).max() > 5
    knees = np.array([[frame.pose.left_leg.knee, frame.pose.right_leg.knee] for frame in frames["B", "march"]])
    swings = np.diff((knees[:, 0] > knees[:, 1]).astype(int))
    assert 14 <= np.abs(swings).sum() <= 40  # legs take turns


def test_a_track_goes_through_its_keys_and_never_beyond() -> None:
    track = Track((0, 1, 1.5, 3), (0, 10, 10, -5))
    values = np.array([track.one(time) for time in np.linspace(-1, 4, 501)])
    assert values.min() == pytest.approx(-5) and values.max() == pytest.approx(10)
    assert track.one(-1) == 0 and track.one(4) == -5 and track.one(1.25) == 10
    assert np.abs(np.diff(values, 2)).max() < 0.02
    assert Track((0, 1), (0, 1), blur=0).one(0.5) == 0.5


def test_a_pose_track_blends_every_angle() -> None:
    start, end = Pose(), Pose(Trunk(*range(9)), Arm(*range(7)), Arm(flex=9), Leg(*range(7)), Leg(knee=8))
    track = PoseTrack([(0, start), (1, end)], blur=0)
    assert track.at(0) == start and track.at(1) == end
    np.testing.assert_allclose(angles(track.at(0.5)), (angles(start) + angles(end)) / 2)
    assert from_angles(angles(end)) == end


def test_wandering_stays_within_bounds() -> None:
    values = np.array([wander(time / 10, 3, 4.0) for time in range(1000)])
    assert np.abs(values).max() <= 1 and values.std() > 0.3
    assert wander(1.0, 3, 4.0) != wander(1.0, 4, 4.0)
