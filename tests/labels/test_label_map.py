"""Label maps: the 33 parts joined to classes, in files, in colours, in the mirror."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bodyseg_data.core import BadConfig
from bodyseg_data.labels import (
    BACKGROUND,
    LANDMARKS,
    PART_CLASSES,
    PARTS,
    PARTS33,
    UNLABELLED,
    Classes,
    LabelClass,
    LabelMap,
    classes_from_json,
    classes_of,
    label_map_from_json,
    label_map_names,
    load_label_map,
    whole_map,
)
from bodyseg_data.labels.parts import COLOURS

RIGHT = tuple(part.landmark for part in PARTS if part.side == "right")
LEFT = tuple(part.landmark for part in PARTS if part.side == "left")
MIDDLE = tuple(part.landmark for part in PARTS if part.side == "middle")
ARMS = LabelMap("arms", (("arms", ("Rt. Olecranon", "Lt. Olecranon", "Rt. Dactylion", "Lt. Dactylion")),))
SIDES = LabelMap("sides", (("left", LEFT), ("middle", MIDDLE), ("right", RIGHT)))
CROSSED = LabelMap("crossed", (("a", ("Rt. Olecranon", "Lt. PSIS")), ("b", ("Lt. Olecranon", "Rt. PSIS"))))


def test_the_maps_that_ship_cover_every_part_once() -> None:
    shipped = "densepose24", "human3d15", "itop15", "joints24", "limbs14", "people", "template33"
    assert label_map_names() == ("parts33", *shipped)
    for name, count in (("parts33", 33), ("itop15", 15), ("limbs14", 14)):
        label_map = load_label_map(name)
        assert label_map.name == name and len(label_map) == len(label_map.names) == count
        assert sorted(part for parts in label_map.members for part in parts) == list(range(33))
        assert repr(label_map) == f"LabelMap({name!r}, {count} classes)"
    assert load_label_map("itop15").names == (
        "head", "neck", "right_shoulder", "left_shoulder", "right_elbow", "left_elbow", "right_hand", "left_hand",
        "torso", "right_hip", "left_hip", "right_knee", "left_knee", "right_foot", "left_foot",
    )  # fmt: skip


def test_a_table_gives_every_part_its_class_and_all_else_the_background() -> None:
    table = load_label_map("limbs14").table
    assert table.dtype == np.uint8 and table.shape == (256,)
    assert table[[0, 1, 2, 9, 15, 16, 31, 32]].tolist() == [0, 0, 0, 1, 2, 3, 12, 13]
    assert (table[33:] == BACKGROUND).all()
    assert (PARTS33.table[:33] == np.arange(33)).all()
    left_out = np.setdiff1d(np.arange(256), [LANDMARKS.index(each) for each in ARMS.classes[0][1]])
    assert (ARMS.table[left_out] == BACKGROUND).all()


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (16, 8), (13, 29)])
@pytest.mark.parametrize("label_map", [load_label_map("limbs14"), ARMS])
@pytest.mark.usefixtures("either_form")
def test_classes_are_written_in_place(label_map: LabelMap, shape: tuple[int, int]) -> None:
    random = np.random.default_rng(0)
    for share in (0.0, 0.3, 1.0):
        batch = np.full((3, *shape), 7, np.uint8)  # images within a batch begin at any byte
        labels = batch[1]
        labels[:] = np.where(random.random(shape) < share, random.integers(0, 33, shape), BACKGROUND)
        expected = label_map.table[labels]
        label_map.write(labels)
        np.testing.assert_array_equal(labels, expected)
        assert (batch[[0, 2]] == 7).all()
        turned = random.integers(0, 33, shape, np.uint8).T
        expected = label_map.table[turned]
        label_map.write(turned)
        np.testing.assert_array_equal(turned, expected)


def test_known_edges_give_the_same_classes() -> None:
    random = np.random.default_rng(1)
    foreground = random.random((9, 31)) < 0.6
    labels = np.where(foreground, random.integers(0, 33, foreground.shape), BACKGROUND).astype(np.uint8)
    edges = np.flatnonzero(np.diff(foreground.ravel().astype(np.int8), prepend=0, append=0)).astype(np.int32)
    expected = load_label_map("itop15").table[labels]
    load_label_map("itop15").write(labels, edges)
    np.testing.assert_array_equal(labels, expected)


@pytest.mark.parametrize("label_map", [PARTS33, *map(load_label_map, ("itop15", "limbs14")), ARMS, SIDES, CROSSED])
def test_mirroring_and_joining_may_change_places(label_map: LabelMap) -> None:
    np.testing.assert_array_equal(label_map.mirrored[label_map.table], label_map.table[PART_CLASSES.mirrored])
    np.testing.assert_array_equal(label_map.mirrored[label_map.mirrored], np.arange(256))
    for name, side, mirrored in zip(label_map.names, label_map.sides, label_map.mirrored, strict=False):
        assert (side == "middle") == (label_map.names[mirrored] == name)
        if name.startswith(("right", "left", "Rt.", "Lt.")):
            assert side == {"r": "right", "R": "right", "l": "left", "L": "left"}[name[0]]


def test_sides_of_classes() -> None:
    assert ARMS.sides == ("middle",) and ARMS.mirrored[0] == 0
    assert SIDES.sides == ("left", "middle", "right") and SIDES.mirrored[:3].tolist() == [2, 1, 0]
    assert CROSSED.sides == ("right", "left"), "both have parts of either side: the first is called the right one"


@pytest.mark.parametrize("label_map", [*map(load_label_map, ("itop15", "limbs14")), SIDES])
def test_colours_differ_also_without_colour(label_map: LabelMap) -> None:
    colours = label_map.colours
    assert colours.dtype == np.uint8 and colours.shape == (len(label_map), 3)
    apart = np.linalg.norm(colours[:, None].astype(float) - colours[None], axis=-1)
    assert apart[np.triu_indices(len(colours), 1)].min() > 60
    grey = colours @ [0.299, 0.587, 0.114]  # the luma of Rec. ITU-R BT.601
    assert np.diff(np.sort(grey)).min() > 0.9 * 155 / len(colours)
    for label, side in enumerate(label_map.sides):
        if side == "right":
            assert grey[label_map.mirrored[label]] - grey[label] > 60, "left is lighter than right"


def test_the_33_parts_keep_their_colours() -> None:
    np.testing.assert_array_equal(PARTS33.colours, COLOURS)
    np.testing.assert_array_equal(LabelMap("mine", PARTS33.classes).colours, COLOURS)


def test_classes_are_joined_to_coarser_ones() -> None:
    limbs = load_label_map("limbs14")
    joined = PARTS33.joined_to(limbs)
    np.testing.assert_array_equal(joined, limbs.table)
    halves = LabelMap(
        "halves",
        (
            ("above", tuple(each for name, parts in limbs.classes[:8] for each in parts)),
            ("below", tuple(each for name, parts in limbs.classes[8:] for each in parts)),
        ),
    )
    assert limbs.joined_to(halves)[:14].tolist() == [0] * 8 + [1] * 6
    np.testing.assert_array_equal(limbs.joined_to(halves)[limbs.table], halves.table)
    with_rest = LabelMap("rest", (*PARTS33.classes, ("none", ("*",))))  # no part is left for the last
    assert with_rest.joined_to(load_label_map("people"))[:35].tolist() == [0] * 33 + [1, 255]
    with pytest.raises(BadConfig, match="labels 'rest' cannot be joined to 'limbs14', which lacks the class 'none'"):
        with_rest.joined_to(limbs)
    with pytest.raises(BadConfig, match="labels 'limbs14' cannot be joined to 'itop15', which splits .*'trunk'"):
        limbs.joined_to(load_label_map("itop15"))
    with pytest.raises(BadConfig, match="labels 'parts33' cannot be joined to 'arms', which lacks the class 'Sellion'"):
        PARTS33.joined_to(ARMS)


@pytest.mark.parametrize(
    ("classes", "message"),
    [
        ((), "there must be 1 to 33 classes, found none"),
        ((("a", ("Sellion",)), ("a", ("Nuchale",))), "a class is named once, found 'a' twice"),
        ((("a", ("Sellion",)), ("b", ("Sellion",))), "a landmark is named once, found 'Sellion' twice"),
        (
            (("a", ("Nose",)),),
            r"'Nose' is none of the 33 landmarks \(for a set of other classes, give of=images.manifest.classes\)",
        ),
        ((("a", ("Sellion",)), ("b", ())), "the class 'b' must have a landmark, found none"),
    ],
)
def test_maps_that_are_none(classes: Any, message: str) -> None:
    with pytest.raises(BadConfig, match=f"^labels 'mine': {message}$"):
        LabelMap("mine", classes)


@pytest.mark.parametrize(
    "classes",
    [
        (("a", ("Rt. Olecranon",)),),
        (("a", ("Rt. Olecranon", "Rt. Dactylion")), ("b", ("Lt. Olecranon",)), ("c", ("Lt. Dactylion",))),
        (("a", ("Sellion", "Rt. ASIS")), ("b", ("Lt. ASIS",))),
    ],
)
def test_a_map_that_its_mirror_image_splits_is_fine_until_images_are_flipped(classes: Any) -> None:
    lopsided = LabelMap("mine", classes)
    assert not lopsided.has_mirror_image and PARTS33.has_mirror_image
    assert len(lopsided.colours) == len(classes)
    with pytest.raises(BadConfig, match="^labels 'mine': the mirror image of the class 'a' must be one class$"):
        _ = lopsided.mirrored


@pytest.mark.parametrize(
    ("names", "found"),
    [
        (("trunk", "RL", "FL", "FR", "RR"), ("RL", "RR")),
        (("LF", "LR", "RF", "tail"), ("LF", "RF")),
        (("thumbL", "thumbR"), ("thumbL", "thumbR")),
        (("Lamp", "Ramp", "loof", "roof"), None),
        (("thumb_L", "thumb_R"), None),
        (("Left", "Right", "FL"), None),
        ((LabelClass("FL", mirror="FR"), "FR"), None),
    ],
)
def test_names_that_differ_by_a_letter_for_the_side_are_found_where_they_are_no_pair(
    names: Any, found: tuple[str, str] | None
) -> None:
    assert whole_map(classes_of(names)).unpaired == found
    assert PARTS33.unpaired is None


CELL = Classes(
    "cell",
    (
        LabelClass("floor", colour="#102030"),
        LabelClass("right gripper", mirror="left gripper", within="robot"),
        LabelClass("left gripper", mirror="right gripper", within="robot"),
        LabelClass("bin"),
    ),
)


def test_classes_of_a_users_own() -> None:
    assert CELL.names == ("floor", "right gripper", "left gripper", "bin")
    assert CELL.mirrored[:5].tolist() == [0, 2, 1, 3, 4] and CELL.sides == ("middle", "right", "left", "middle")
    assert CELL.colours[0].tolist() == [0x10, 0x20, 0x30] and len({tuple(each) for each in CELL.colours.tolist()}) == 4
    assert classes_from_json(json.loads(json.dumps(CELL.to_json())), "a manifest") == CELL
    assert classes_of(["a", "b"], "mine") == Classes("mine", (LabelClass("a"), LabelClass("b")))
    sided = classes_of(["left hand", "table", "right hand", LabelClass("lane.L", mirror="lane.L"), "lane.R"])
    assert sided.mirrored[:5].tolist() == [2, 1, 0, 3, 4]
    assert classes_of(["left hand", "right hand"]).mirrored[:2].tolist() == [1, 0], "a pair alone is one, too"
    one_states_it = classes_of([LabelClass("open", mirror="shut"), "lamp", "shut"])
    assert one_states_it.mirrored[:3].tolist() == [2, 1, 0]
    assert classes_from_json(PART_CLASSES.to_json(), "x") == PART_CLASSES


def test_a_users_classes_that_are_named_as_the_33_parts_are_these() -> None:
    own = classes_of(PARTS33.names)
    assert own == PARTS33.of and load_label_map(PARTS33, own) == PARTS33
    said = classes_of([LabelClass(name, mirror=name if name == "Sellion" else None) for name in PARTS33.names])
    assert load_label_map(PARTS33, said) == PARTS33, "a class may say that it is its own mirror image"
    assert PARTS33.joined_to(load_label_map("limbs14", said))[:33].max() == 13


def test_a_map_of_a_users_own_classes(tmp_path: Path) -> None:
    robot = LabelMap("robot", (("robot", ("right gripper", "left gripper")), ("rest", ("floor",))), CELL)
    assert robot.table[:5].tolist() == [1, 0, 0, BACKGROUND, BACKGROUND] and robot.mirrored[0] == 0
    assert label_map_from_json(json.loads(json.dumps(robot.to_json())), "a card") == robot
    file = tmp_path / "robot.toml"
    file.write_text(f'{GOOD}robot = ["right gripper", "left gripper"]\nrest = ["floor"]\n')
    assert load_label_map(file, CELL).members == robot.members
    whole = load_label_map("cell", CELL)
    assert whole == whole_map(CELL) and whole.is_whole and whole.colours[0].tolist() == [0x10, 0x20, 0x30]
    with pytest.raises(
        BadConfig, match="labels 'robot' are of other classes than the set's: found the labels 'cell' and 'parts33'"
    ):
        load_label_map(robot)
    with pytest.raises(BadConfig, match="labels 'parts33' are of other classes than the set's: found the labels"):
        load_label_map("parts33", CELL)
    names: Any = ["floor", "arm"]
    with pytest.raises(BadConfig, match=r"^label maps are of the classes of a set, found \['floor', 'arm'\]$"):
        load_label_map("limbs14", names)
    with pytest.raises(BadConfig, match="'Sellion' is none of the classes 'cell'"):
        LabelMap("x", (("a", ("Sellion",)),), CELL)
    with pytest.raises(
        BadConfig, match="labels 'parts33' and 'robot' are of other classes: found .* 'parts33' and 'cell': 0 is"
    ):
        PARTS33.joined_to(robot)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ([], "a set has 1 to 254 classes, found 0"),
        ([str(number) for number in range(255)], "a set has 1 to 254 classes, found 255"),
        (["a", "a"], "a class is named once, found 'a' twice"),
        ([" "], "a class needs a name that can be printed, not '*', found ' '"),
        (["*", "arm"], "a class needs a name that can be printed, not '*', found '*'"),
        ({"leg", "arm"}, "classes must be a list of names, found {"),
        ({"leg": 1, "arm": 0}, "classes must be a list of names, found {'leg': 1, 'arm': 0}"),
        (["a\n"], "a class needs a name that can be printed"),
        ([LabelClass("a", colour="red")], "the colour of 'a' must be like '#1e90ff', found 'red'"),
        ([LabelClass("a", mirror="b")], "the mirror image of 'a', 'b', is no class"),
        ([LabelClass("a", mirror="b"), LabelClass("b", mirror="b")], "the mirror image of 'b' must be 'a'"),
        ([LabelClass(5)], "a class needs a name that can be printed, not '*', found 5"),
    ],
)
def test_classes_that_are_none(entries: Any, message: str) -> None:
    with pytest.raises(BadConfig, match=re.escape(message)):
        classes_of(entries, "mine")


@pytest.mark.parametrize("label_map", [PARTS33, load_label_map("limbs14"), SIDES, CROSSED])
def test_a_map_comes_back_from_json_in_its_order(label_map: LabelMap) -> None:
    assert label_map_from_json(label_map.to_json(), "a card") == label_map
    turned = LabelMap(label_map.name, label_map.classes[::-1])
    assert turned.to_json() != label_map.to_json(), "labels follow from the order"


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        ([], "a card must be an object, found list"),
        ({}, "a card: text 'name' is missing"),
        ({"name": "x", "classes": {"a": ["Sellion"]}}, "a card: 'classes' must be a list, found dict"),
        ({"name": "x", "classes": ["a"]}, "a card, a class must be an object, found str"),
        ({"name": "x", "classes": [{"landmarks": ["Sellion"]}]}, "a card, a class: text 'name' is missing"),
        (
            {"name": "x", "classes": [{"name": "a"}]},
            "a card: the class 'a' must be a list of landmarks, found None",
        ),
        (
            {"name": "x", "classes": [{"name": "a", "landmarks": [1]}]},
            r"a card: the class 'a' must be a list of landmarks, found \[1\]",
        ),
        ({"name": "x", "classes": []}, "a card: labels 'x': there must be 1 to 33 classes, found none"),
    ],
)
def test_json_that_is_no_map(tree: Any, message: str) -> None:
    with pytest.raises(BadConfig, match=f"^{message}$"):
        label_map_from_json(tree, "a card")


GOOD = 'format = "bodyseg labels 1"\nname = "mine"\n[classes]\n'


def test_a_map_is_read_from_a_file(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(f'{GOOD}"lower arms" = ["Rt. Olecranon", "Lt. Olecranon"]\nface = ["Sellion"]\n')
    found = load_label_map(file)
    assert found == load_label_map(str(file)) == load_label_map(found)
    assert found.classes == (("lower arms", ("Rt. Olecranon", "Lt. Olecranon")), ("face", ("Sellion",)))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("=", "label map FILE is not TOML: "),
        ('name = "x"', "label map FILE: 'format' must be 'bodyseg labels 1'"),
        ('format = "bodyseg labels 1"\nname = "x"', r"label map FILE: the table \[classes\] is missing"),
        ('format = "bodyseg labels 1"\n[classes]\na = ["Sellion"]', "label map FILE: text 'name' is missing"),
        (f'colour = "red"\n{GOOD}a = ["Sellion"]', "label map FILE: unknown 'colour'"),
        (f"{GOOD}a = 3", "label map FILE: the class 'a' must be a list of landmarks, found 3"),
        (f'{GOOD}a = ["Nose"]', "label map FILE: labels 'mine': 'Nose' is none of the 33 landmarks"),
        (f'template = "bones"\n{GOOD}a = [""]', "label map FILE: classes 'regions': a class needs a name"),
    ],
)
def test_files_that_are_no_map_get_one_line(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(text)
    with pytest.raises(BadConfig, match=f"^{message.replace('FILE', str(file))}") as caught:
        load_label_map(file)
    assert "\n" not in str(caught.value)


def test_names_that_no_map_has(tmp_path: Path) -> None:
    with pytest.raises(
        BadConfig,
        match=r"no label map is called 'limbs': give one of parts33, densepose24, .* or the path of a \.toml",
    ):
        load_label_map("limbs")
    with pytest.raises(BadConfig, match="cannot read the label map file"):
        load_label_map(tmp_path / "nowhere.toml")
    with pytest.raises(BadConfig, match="a label map is given by its name or a path, found 14"):
        load_label_map(14)  # type: ignore[arg-type]


def test_a_class_for_the_rest_takes_surfaces_of_no_class() -> None:
    people = load_label_map("people")
    assert people.names == ("person", "none") and people.has_rest and not PARTS33.has_rest
    labels = np.array([[0, 32, UNLABELLED, BACKGROUND]], np.uint8)
    people.write(labels, unlabelled=UNLABELLED)
    assert labels.tolist() == [[0, 0, 1, BACKGROUND]]
    assert people.mirrored[:2].tolist() == [0, 1] and people.sides == ("middle", "middle")
    assert label_map_from_json(json.loads(json.dumps(people.to_json())), "a card") == people


def test_a_class_for_the_rest_takes_classes_that_stand_nowhere() -> None:
    hands = LabelMap("hands", (("hands", ("Rt. Dactylion", "Lt. Dactylion")), ("else", ("*",))))
    assert hands.table[[*map(LANDMARKS.index, ("Rt. Dactylion", "Sellion")), UNLABELLED, BACKGROUND]].tolist() == [
        0, 1, 1, BACKGROUND,
    ]  # fmt: skip
    last = LabelMap("last", (*((name, (name,)) for name in CELL.names[:3]), ("else", ("*",))), CELL)
    assert last.members == whole_map(CELL).members and not last.is_whole, "surfaces of no class have one"


def test_the_rest_is_one_class_alone() -> None:
    with pytest.raises(BadConfig, match="'\\*' must be alone in its class"):
        LabelMap("bad", (("else", ("*", "Sellion")),))
    with pytest.raises(BadConfig, match="a landmark is named once, found '\\*' twice"):
        LabelMap("bad", (("else", ("*",)), ("more", ("*",))))


def test_lists_are_taken_for_tuples_and_nothing_else_is() -> None:
    given: Any = [["hands", ["Rt. Dactylion"]], ["else", ["*"]]]
    lists = LabelMap("hands", given)
    assert lists == LabelMap("hands", (("hands", ("Rt. Dactylion",)), ("else", ("*",)))) and lists.has_rest
    for wrong in ({"hands": ("Rt. Dactylion",)}, (("hands", "Rt. Dactylion"),)):
        with pytest.raises(
            BadConfig, match="LabelMap: classes must be a tuple, each entry a tuple of text and a tuple"
        ):
            LabelMap("hands", wrong)  # type: ignore[arg-type]


def test_runs_of_foreground_hold_surfaces_of_no_class_too() -> None:
    labels = np.array([[BACKGROUND, 4, UNLABELLED, UNLABELLED, BACKGROUND, 9]], np.uint8)
    load_label_map("people").write(labels, np.array([1, 4, 5, 6], np.int32), UNLABELLED)
    assert labels.tolist() == [[BACKGROUND, 0, 1, 1, BACKGROUND, 0]]
