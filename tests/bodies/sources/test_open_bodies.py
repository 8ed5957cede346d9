"""The open bodies: their list, and a handful of them built."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import warm
from folders import ROOT
from scipy.spatial import cKDTree
from shapes import mean_by_place

from bodyseg_data.bodies import Body, BodyRef, open_source
from bodyseg_data.bodies.anny_model import Figure
from bodyseg_data.bodies.anny_people import PEOPLE, POSTURES, SUBJECT_A, SUBJECT_B, SUBJECT_C, person, standing_pose
from bodyseg_data.bodies.outfits import OUTFITS
from bodyseg_data.bodies.skeleton import Arm, Leg, Pose, Trunk, bone_rotations
from bodyseg_data.bodies.sources.open_bodies import BareBodies, MadeBodies, OpenBodies
from bodyseg_data.core import BadConfig, MissingLibrary
from bodyseg_data.labels import LANDMARKS
from bodyseg_data.samples import ViewGrid

Built = Callable[[str], Body]


@pytest.fixture(scope="module")
def source() -> OpenBodies:
    return OpenBodies()


@pytest.fixture(scope="module")
def built(source: OpenBodies) -> Built:
    """Bodies by mesh name or by posture, each built once."""
    by_name = {key: ref for ref in reversed(source.bodies()) for key in (ref.mesh, ref.pose)}
    bodies: dict[BodyRef, Body] = {}

    def build(name: str) -> Body:
        ref = by_name[name]
        if ref not in bodies:
            bodies[ref] = source.build(ref)
        return bodies[ref]

    return build


def place(body: Body, landmark: str) -> np.ndarray:
    return body.mesh.vertices[body.landmarks[LANDMARKS.index(landmark)]]


def digest(body: Body) -> str:
    return hashlib.sha256(body.mesh.vertices.tobytes() + body.mesh.faces.tobytes()).hexdigest()


def test_counts_and_splits_are_the_papers(source: OpenBodies) -> None:
    found = source.bodies()
    assert [ref.subset for ref in found] == ["A"] * 71 + ["B"] * 825 + ["C"] * 850 + ["people"] * 583
    frames = Counter((ref.subset, ref.pose, ref.split) for ref in found if ref.subset in ("B", "C"))
    assert frames == {
        ("B", "crane", "train"): 175, ("B", "jumping", "test"): 150,
        ("B", "march", "train"): 250, ("B", "squat", "train"): 250,
        ("C", "bouncing", "train"): 175, ("C", "handstand", "train"): 175,
        ("C", "march", "train"): 250, ("C", "squat", "test"): 250,
    }  # fmt: skip
    postures, people = found[:71], found[-583:]
    assert [ref.split for ref in postures] == ["train"] * 57 + ["test"] * 14
    assert [ref.split for ref in people] == ["train"] * 467 + ["test"] * 116
    bodies, views = Counter(ref.split for ref in found), len([*ViewGrid()])
    assert {split: count * views for split, count in bodies.items()} == {"train": 97_146, "test": 28_620}
    assert found == open_source("open").bodies() and source.name == "open" and source.missing() == ()


def test_names_are_unique_and_fit_for_keys(source: OpenBodies) -> None:
    found = source.bodies()
    assert len({ref.mesh for ref in found}) == len(found)
    assert [found[index].mesh for index in (0, 70, 71, 245, 246, 895, 896, 1745, 1746, -1)] == [
        "posture-00", "posture-70", "B-crane-000", "B-crane-174", "B-jumping-000", "B-squat-249",
        "C-bouncing-000", "C-squat-249", "person-000", "person-582",
    ]  # fmt: skip
    assert all(ref.subject == ref.subset for ref in found[:-583])
    assert [ref.subject for ref in found[-583:]] == [f"P{index:03d}" for index in range(583)]
    for ref in found:
        for text in (ref.subset, ref.subject, ref.mesh, ref.pose):
            assert text and not set(text) & set("./\\ \n")


def test_test_postures_share_nothing_with_training_postures() -> None:
    assert len({name for name, _ in POSTURES}) == 71
    parents = [set(name.replace("_mirrored", "").split("-to-")) for name, _ in POSTURES]
    assert not set.union(*parents[:57]) & set.union(*parents[57:])


def test_no_two_postures_are_alike() -> None:
    turns = np.array([np.concatenate([r.ravel() for r in bone_rotations(pose).values()]) for _, pose in POSTURES])
    apart = np.linalg.norm(turns[:, None] - turns[None], axis=-1) + 10 * np.eye(len(turns))
    assert apart.min() > 0.3


def test_people_are_varied_adults() -> None:
    people = [person(index) for index in range(PEOPLE)]
    statures = np.array([p.stature_m for p in people])
    years = np.array([p.years for p in people])
    assert 1.45 <= statures.min() < 1.5 and 1.9 < statures.max() <= 2.0
    assert 18 <= years.min() < 20 and 78 < years.max() <= 80
    assert {p.female for p in people} == {0.0, 1.0}
    for p in people:
        assert all(0 <= value <= 1.05 for value in p.phenotype().values())
    assert len({standing_pose(index) for index in range(PEOPLE)}) == PEOPLE
    assert person(17) == people[17] != people[18]


BUILT = {
    "posture-00": 0.3468661, "person-000": 0.3896816, "person-001": 0.336828, "person-467": 0.3214037,
    "person-582": 0.369296, "B-march-100": 0.3744834, "C-squat-000": 0.2872022,
}  # fmt: skip


@pytest.mark.parametrize("name", BUILT)
def test_bodies_stand_on_the_floor_over_the_origin(built: Built, name: str) -> None:
    mesh = built(name).mesh
    assert mesh.name == name
    assert mesh.vertices.dtype == np.float64 and mesh.faces.dtype == np.int32
    if name.startswith(("posture", "person")):
        assert mesh.vertices.shape == (13718, 3) and mesh.faces.shape == (27420, 3)
    else:  # dressed, with smaller triangles
        assert 13718 < len(mesh.vertices) < 30000 and mesh.vertices[:, 1].size < len(mesh.faces)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    assert low[1] == 0
    assert np.abs(low + high)[[0, 2]].max() < 3e-6
    assert 1.45 <= high[1] <= 2.0
    assert 0.035 < mesh.signed_volume() < 0.16  # m3, about as many tonnes; clothes included


@pytest.mark.parametrize("index", [0, 1, 250, 467])
def test_people_have_their_stature(built: Built, index: int) -> None:
    # Feet apart and a nodding head take a little off it.
    assert person(index).stature_m - built(f"person-{index:03d}").mesh.vertices[:, 1].max() == pytest.approx(
        0.004, abs=0.014
    )


def test_men_and_women_differ(built: Built) -> None:
    man, woman = (built(name).mesh for name in ("person-000", "person-001"))
    assert np.abs(man.vertices - woman.vertices).max() > 0.02


def test_people_face_the_front_with_their_left_at_positive_x(built: Built) -> None:
    for name in ("standing", "person-001"):
        body = built(name)
        for left in (landmark for landmark in LANDMARKS if landmark.startswith("Lt.")):
            assert place(body, left)[0] > place(body, left.replace("Lt.", "Rt."))[0], left
        assert place(body, "Sellion")[2] > place(body, "Nuchale")[2] + 0.1
        feet = body.mesh.vertices[body.mesh.vertices[:, 1] < 0.03]
        for toe, ankle in (("Lt. Digit II", "Lt. Lateral Malleolus"), ("Rt. Digit II", "Rt. Lateral Malleolus")):
            assert place(body, toe)[2] > place(body, ankle)[2] + 0.08
        assert feet[:, 2].min() < place(body, "Lt. Lateral Malleolus")[2] < feet[:, 2].max() - 0.1


def test_postures_do_what_they_are_called(built: Built) -> None:
    def hands(name: str) -> np.ndarray:
        return np.stack([place(built(name), f"{side} Dactylion") for side in ("Lt.", "Rt.")])

    def crown(name: str) -> float:
        return float(place(built(name), "Sellion")[1])

    assert (hands("arms_up")[:, 1] > crown("arms_up") + 0.3).all()
    assert np.ptp(hands("t_pose")[:, 0]) > 1.5
    assert (hands("arms_forward")[:, 2] > place(built("arms_forward"), "Sellion")[2] + 0.3).all()
    assert hands("arm_raised")[0, 1] > crown("arm_raised") > hands("arm_raised")[1, 1] + 0.6
    assert crown("deep_squat") < 1.1 < 1.6 < crown("standing")
    assert place(built("crane"), "Lt. Digit II")[1] > 0.25 > 0.05 > place(built("crane"), "Rt. Digit II")[1]


@pytest.mark.parametrize("name", ["lunge", "throw"])
def test_mirrored_postures_are_mirror_images(built: Built, name: str) -> None:
    one, other = (built(each).mesh.vertices for each in (name, f"{name}_mirrored"))
    mirrored = cKDTree(one * (-1, 1, 1))
    # Anny's own left and right differ by a few millimetres about the face; as it stands, the posture is far off.
    assert mirrored.query(other)[0].max() < 0.008
    assert cKDTree(one).query(other)[0].max() > 0.1


def test_a_blend_lies_between_its_ends() -> None:
    raised, hanging = Arm(flex=90, elbow=40), Arm(flex=0, elbow=10)
    pose = Pose(Trunk(lean=10), raised).blend(Pose(Trunk(lean=20), hanging), 0.25)
    assert pose.trunk.lean == 12.5 and pose.left_arm.flex == 67.5 and pose.left_arm.elbow == 32.5
    assert Pose().blend(pose, 1.0) == pose and Pose().blend(pose, 0.0) == Pose()


def test_everyday_poses_do_what_they_are_called(source: OpenBodies) -> None:
    ref = next(ref for ref in source.bodies() if ref.subset == "people")
    kick, fist, desk = (source.in_pose(ref, name) for name in ("kick", "fist", "desk"))
    for body in (kick, fist, desk):
        assert body.mesh.vertices[:, 1].min() == 0 and body.mesh.name == ref.mesh
    toes, hip = place(kick, "Lt. Digit II"), place(kick, "Lt. Trochanterion")
    assert toes[2] - hip[2] > 0.5 and toes[1] > 0.7, "the left foot is raised to the front"
    crown = fist.mesh.vertices[fist.mesh.vertices[:, 0] > -0.1, 1].max()
    assert place(fist, "Rt. Radial Styloid")[1] > crown > place(fist, "Lt. Radial Styloid")[1] + 0.5
    assert place(desk, "Rt. Femoral Lateral Epicn")[2] - place(desk, "Rt. Trochanterion")[2] > 0.3, "people sit"


def test_mirroring_twice_changes_nothing() -> None:
    pose = Pose(Trunk(3, 4, 5, 6, 7, 8, 9, 10, 11), Arm(flex=3), Arm(flex=4), Leg(knee=5), Leg(knee=6))
    assert pose.mirrored().mirrored() == pose != pose.mirrored()
    assert pose.mirrored().trunk == Trunk(3, -4, -5, 6, -7, -8, 9, -10, -11)


def test_every_bone_is_turned_and_never_stretched() -> None:
    for name, pose in POSTURES[::3]:
        for bone, rotation in bone_rotations(pose).items():
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12, err_msg=f"{name}, {bone}")
            assert np.linalg.det(rotation) > 0


def test_soles_are_level_where_they_are_planted(built: Built) -> None:
    for name in ("half_squat", "side_lunge", "deep_squat"):
        body = built(name)
        for side in ("Lt.", "Rt."):
            assert place(body, f"{side} Digit II")[1] < 0.045, name
            assert place(body, f"{side} Lateral Malleolus")[1] < 0.12, name


def test_bits_are_the_same_in_another_process_with_other_threads(built: Built) -> None:
    """Also another order of building: the other process has built nothing before."""
    script = (
        "import hashlib, torch\n"
        "torch.set_num_threads(2)\n"
        "from bodyseg_data.bodies.sources.open_bodies import OpenBodies\n"
        "source = OpenBodies()\n"
        "for ref in reversed(source.bodies()):\n"
        "    if ref.mesh in ('posture-24', 'B-jumping-027', 'person-001'):\n"
        "        mesh = source.build(ref).mesh\n"
        "        print(hashlib.sha256(mesh.vertices.tobytes() + mesh.faces.tobytes()).hexdigest())\n"
        "print(torch.get_num_threads())\n"
    )
    answer = warm.run(["-c", script], cwd=ROOT)
    expected = [digest(built(name)) for name in ("person-001", "B-jumping-027", "posture-24")]
    assert answer.stdout.split() == [*expected, "2"]
    assert not answer.stderr


@pytest.mark.parametrize("name", BUILT)
def test_bodies_stay_as_they_were(built: Built, name: str) -> None:
    """Others are other bytes of sets, though persons, poses and outfits are the same: raise `PACKING_VERSION`."""
    assert mean_by_place(built(name).mesh.vertices) == pytest.approx(BUILT[name], abs=1e-6)


def test_building_again_gives_the_same_bits(source: OpenBodies, built: Built) -> None:
    again = source.build(next(ref for ref in source.bodies() if ref.mesh == "person-000"))
    assert digest(again) == digest(built("person-000"))
    assert digest(again) != digest(built("person-001"))


def test_importing_and_listing_is_light() -> None:
    script = (
        "import sys\n"
        "from bodyseg_data.bodies.sources.open_bodies import OpenBodies\n"
        "OpenBodies().bodies()\n"
        "print([name for name in ('anny', 'torch', 'warp', 'trimesh') if name in sys.modules])\n"
    )
    answer = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    assert answer.stdout.strip() == "[]"


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "anny", None)
    source = OpenBodies()
    assert len(source.bodies()) == 2329
    with pytest.raises(MissingLibrary, match=r"pip install 'bodyseg\[render\]'"):
        source.build(source.bodies()[0])


def test_a_damaged_cache_is_named(tmp_path: Path, built: Built) -> None:
    from anny.paths import get_anny_cache_path, set_anny_cache_path

    built("posture-00")  # so that the cache has files whose names can be taken
    before = get_anny_cache_path()
    for file in before.rglob("*.safetensors"):
        (tmp_path / file.parent.name).mkdir(exist_ok=True)
        (tmp_path / file.parent.name / file.name).write_bytes(b"cut short")
    source = OpenBodies()
    set_anny_cache_path(tmp_path)
    try:
        with pytest.raises(BadConfig, match="is damaged, delete it: "):
            source.build(source.bodies()[0])
        set_anny_cache_path(Path("/proc/no-such-folder"))
        with pytest.raises(BadConfig, match="set ANNY_CACHE_DIR"):
            source.build(source.bodies()[0])
    finally:
        set_anny_cache_path(before)


def test_bodies_of_other_sources_are_refused(source: OpenBodies) -> None:
    with pytest.raises(BadConfig, match="no body 'I_crane_0000' of subset 'B'"):
        source.build(BodyRef("B", "B", "I_crane_0000", "crane", "train"))


def test_subjects_are_people_of_their_own() -> None:
    subjects = {SUBJECT_A, SUBJECT_B, SUBJECT_C}
    assert len(subjects) == 3 and not subjects & {person(index) for index in range(PEOPLE)}
    assert [subject.female for subject in (SUBJECT_A, SUBJECT_B, SUBJECT_C)] == [0, 0, 1]


def test_b_and_c_are_dressed_and_only_they(source: OpenBodies) -> None:
    by_name = {ref.mesh: ref for ref in source.bodies()}
    for name, most in (("B-crane-000", 0.03), ("C-bouncing-000", 0.03), ("posture-00", 0.0), ("person-000", 0.0)):
        dressed, bare = (source.build(by_name[name], dressed=worn).mesh for worn in (True, False))
        apart = cKDTree(bare.vertices).query(dressed.vertices)[0]
        assert (apart.max() > most) if most else (apart.max() == 0), name
        assert np.array_equal(dressed.faces, bare.faces)


def test_the_fingerprint_sees_persons_poses_outfits_and_heights(source: OpenBodies) -> None:
    by_name = {ref.mesh: ref for ref in source.bodies()}
    names = ("posture-00", "posture-01", "B-crane-000", "B-crane-001", "C-march-003", "person-000")
    assert len({source.fingerprint([by_name[name]]) for name in names}) == len(names)
    assert source.fingerprint([by_name["C-march-003"]]) == OpenBodies().fingerprint([by_name["C-march-003"]])
    figure = Figure(SUBJECT_B, Pose(), 0.0, OUTFITS["B"])
    changes = (
        {"who": SUBJECT_C}, {"pose": Pose(Trunk(lean=1))}, {"height_m": 0.1}, {"outfit": None}, {"outfit": OUTFITS["C"]}
    )  # fmt: skip
    ref = BodyRef("x", "x", "x", "x", "test")
    made = [MadeBodies("x", {ref: partial(replace, figure, **change)}) for change in ({}, *changes)]
    assert len({each.fingerprint([ref]) for each in made}) == 1 + len(changes)


def test_the_bare_source_takes_off_what_b_and_c_wear(source: OpenBodies) -> None:
    bare = open_source("bare")
    assert bare.name == "bare"
    assert isinstance(bare, BareBodies)
    assert list(bare.bodies()) == list(source.bodies())
    for ref in (source.bodies()[0], *(next(b for b in source.bodies() if b.subject == who) for who in "BC")):
        assert bare.figure(ref) == replace(source.figure(ref), outfit=None)
    assert bare.fingerprint(source.bodies()[:80]) != source.fingerprint(source.bodies()[:80])
