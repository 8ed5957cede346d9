"""Which samples of a set are read: patterns, conditions on descriptions, and the part of train to validate on."""

from __future__ import annotations

import fnmatch
import re
import shutil
from collections import Counter
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from samples import body_info

from bodyseg_data import RangeImages, loader
from bodyseg_data.bodies import open_source
from bodyseg_data.core import BadConfig
from bodyseg_data.loading.conditions import SampleTable, parse_condition
from bodyseg_data.loading.selection import BodyRow, Selection, groups, mark_val
from bodyseg_data.rigs import load_rig
from bodyseg_data.samples import ReadSplit, SampleInfo, ViewGrid
from bodyseg_data.shards import BODY_FIELDS, Fields, Manifest, Row, ShardRecord
from bodyseg_data.shards.records import describe


def infos(*fields: dict[str, Any]) -> list[SampleInfo]:
    plain = body_info("crouch")
    return [
        SampleInfo(each.get("split", "train"), {**plain.fields, **{n: v for n, v in each.items() if n != "split"}})
        for each in fields
    ]


def shard_of(described: list[SampleInfo], number: int = 0) -> ShardRecord:
    """The record of a shard that holds samples of these descriptions and has never been written."""
    split, count = described[0].split, len(described)
    keys = tuple(f"open-{info.subset}-{info.mesh}-{info.view.name}" for info in described)
    offsets = tuple(512 * index for index in range(count))
    name = f"{split}-{number:05d}.tar"
    return ShardRecord(
        name,
        split,
        512 * count,
        "0" * 64,
        keys,
        offsets,
        (512,) * count,
        (0,) * count,
        (),
        describe(described, BODY_FIELDS),
    )


OWN_FIELDS = Fields(tuple(((name, kind),) for name, kind in [("pose", "text"), ("subset", "text")]))
"""As `ShardWriter` has them: each in a table of its own."""


def met_by_own(fields: Fields, text: str, *described: dict[str, Any]) -> list[bool]:
    """Which samples, described by fields of a user's own, meet a condition."""
    samples = [SampleInfo("train", each) for each in described]
    record = shard_of([*infos(*[{}] * len(samples))])
    vars(record).update(descriptions=describe(samples, fields))
    marks: list[bool] = parse_condition(text, fields).marks(SampleTable.of(fields, [record])).tolist()
    return marks


@cache
def planned(source: str, shard_samples: int = 1080, views: int = 2) -> Manifest:
    """The manifest of a whole source with few views of a body, without its shards."""
    grid = [asdict(view) for view in ViewGrid(count=views)]
    described: dict[str, list[SampleInfo]] = {"train": [], "test": []}
    for body in open_source(source).bodies():
        fields = {name: getattr(body, name) for name in ("subset", "subject", "mesh", "pose")}
        described[body.split] += [body_info(source=source, split=body.split, **fields, **view) for view in grid]
    shards = [
        shard_of(split[first : first + shard_samples], number)
        for split in described.values()
        for number, first in enumerate(range(0, len(split), shard_samples))
    ]
    return Manifest((load_rig(),), "bsi", source, "raster", "0" * 64, tuple(shards))


def chosen_keys(manifest: Manifest, split: ReadSplit | None, val_share: float = 0.0, **options: Any) -> list[str]:
    selection = Selection.of("*", split, options.get("only", ()), options.get("where", ()), val_share, BODY_FIELDS)
    chosen = selection.choose(manifest, "here")
    return [manifest.shards[number].keys[index] for number, own in chosen.by_shard() for index in own]


def met(text: str, *described: SampleInfo) -> list[bool]:
    table = SampleTable.of(BODY_FIELDS, [shard_of(described)])
    marks: list[bool] = parse_condition(text, BODY_FIELDS).marks(table).tolist()
    return marks


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("distance_cm=255", [False, True, False]),
        ("distance_cm != 215,295", [False, True, False]),
        ("distance_cm<255", [True, False, False]),
        ("distance_cm<=255", [True, True, False]),
        ("distance_cm>255", [False, False, True]),
        ("distance_cm>=255", [False, True, True]),
        ("distance_cm=254.5..300", [False, True, True]),
        ("azimuth_deg=-90..90", [True, False, True]),
        ("azimuth_deg=-90", [False, False, True]),
        ("azimuth_deg=-10..10,180", [True, True, False]),
        ("azimuth_deg!=0..359", [False, False, False]),
        ("azimuth_deg>90", [False, True, True]),
        ("pitch_deg=-30..-10", [False, False, True]),
        ("roll_deg=0", [True, True, False]),
        ("height_cm=40", [False, True, False]),
        ("source=open", [True, True, True]),
        ("subset=B,C", [False, True, True]),
        ("subset!=B", [True, False, True]),
        ("subject=b", [False, False, False]),
        ("mesh=posture-*,*-012", [True, True, False]),
        ("pose=cr*", [True, True, False]),
        ("pose!=cr*", [False, False, True]),
        ("motion=cr*", [False, True, False]),
        ("motion=*", [False, True, True]),
        ("motion!=crane", [True, False, True]),
    ],
)
def test_conditions(text: str, expected: list[bool]) -> None:
    described = infos(
        {},
        {
            "subset": "B",
            "subject": "B",
            "mesh": "B-crane-012",
            "pose": "crane",
            "distance_cm": 255,
            "azimuth_deg": 180,
            "height_cm": 40,
        },
        {
            "subset": "C",
            "subject": "C",
            "mesh": "C-squat-001",
            "pose": "squat",
            "distance_cm": 295,
            "azimuth_deg": 270,
            "pitch_deg": -20,
            "roll_deg": 5,
        },
    )
    assert met(text, *described) == expected
    found = parse_condition(text, BODY_FIELDS)
    assert parse_condition(found.text, BODY_FIELDS) == found


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("motion=crane", [True, False, False, False]),
        ("motion!=crane", [False, True, True, True]),
        ("motion=*", [True, True, False, False]),
        ("motion=B", [False] * 4),
        ("pose=crane", [True, False, True, False]),
    ],
)
def test_a_motion_is_found_where_pose_and_subset_have_tables_of_their_own(text: str, expected: list[bool]) -> None:
    described = [{"subset": "B", "pose": "crane"}, {"subset": "C", "pose": "jump"}, {"subset": "A", "pose": "crane"}]
    assert met_by_own(OWN_FIELDS, text, *described, {"subset": "B"}) == expected


def test_a_motion_of_a_sets_own_is_its_own() -> None:
    described = [{"subset": "B", "pose": "p", "motion": motion} for motion in ("walk", "run")]
    alone = [{"motion": each["motion"]} for each in described]
    motion = (("motion", "text"),)
    assert met_by_own(Fields((*OWN_FIELDS.tables, motion)), "motion=walk", *described) == [True, False]
    assert met_by_own(Fields((motion,)), "motion!=walk", *alone) == [False, True]
    for other in ("int", "numbers"):  # no text that a motion could be made of
        with pytest.raises(BadConfig, match=r"^a condition is on one of pose.*, found 'motion' in 'motion=a'$"):
            parse_condition("motion=a", Fields(((("pose", "text"), ("subset", other)),)))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("time_s>=1700000050", [False, True]),
        ("time_s=1700000000..1700000050", [True, False]),
        ("time_s<=1.7e9", [True, False]),
        ("frame=9007199254740991", [False, True]),
        ("gain<=0.00000015", [True, False]),
        ("gain=1E-7", [True, False]),
        ("gain=-1e+3..1.5e-7", [True, False]),
    ],
)
def test_numbers_may_be_long_small_and_have_exponents(text: str, expected: list[bool]) -> None:
    fields = Fields((tuple((name, "float" if name == "gain" else "int") for name in ("time_s", "frame", "gain")),))
    described = [
        {"time_s": 1_700_000_000 + 100 * each, "frame": 2**53 - 2 + each, "gain": 1e-7 * (each + 1)} for each in (0, 1)
    ]
    assert met_by_own(fields, text, *described) == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "distance",
            "a condition is FIELD, one of = != < <= > >=, and values, like 'distance_cm<=255', found 'distanc",
        ),
        ("=3", "a condition is FIELD"),
        (
            "distance=2",
            "a condition is on one of source, subset, subject, mesh, pose, "
            "distance_cm, azimuth_deg, pitch_deg, roll_deg, height_cm, things, hidden_pct, motion, "
            "found 'distance' in 'distance=2'",
        ),
        ("distance_cm==255", "distance_cm is compared with numbers, or ranges like -90..90, found 'distance_cm==255'"),
        ("distance_cm=", "distance_cm is compared with numbers, or ranges"),
        ("distance_cm<=255,295", "distance_cm<= takes one number, found 'distance_cm<=255,295'"),
        ("distance_cm>1..2", "distance_cm> takes one number"),
        ("distance_cm>2..2", "distance_cm> takes one number"),
        ("pitch_deg=10..-10", "a range goes from the least to the greatest number, found 'pitch_deg=10..-10'"),
        ("azimuth_deg=nan", "azimuth_deg is compared with numbers"),
        ("subject<B", "subject is text and has no order: use = or !=, found 'subject<B'"),
        ("subject=", "subject needs a value after = and after each comma, found 'subject='"),
        ("motion=crane,", "motion needs a value after = and after each comma"),
    ],
)
def test_bad_conditions_are_one_line(text: str, message: str, figures_set: Path) -> None:
    with pytest.raises(BadConfig, match=f"^{re.escape(message)}") as caught:
        RangeImages(figures_set, where=text)
    assert "\n" not in str(caught.value)


def test_flags_are_compared_with_true_and_false_alone() -> None:
    fields, samples = Fields(((("night", "flag"),),)), [{"night": True}, {"night": False}, {}]
    for text in ("night=true", "night=True"):
        assert met_by_own(fields, text, *samples) == [True, False, False]
    for text in ("night!=true", "night!=True"):
        assert met_by_own(fields, text, *samples) == [False, True, True]
    for text in ("night!=yes", "night=1", "night=true,", "night!=t*"):
        with pytest.raises(BadConfig, match=f"^night in {re.escape(repr(text))} must be one of true, false, found"):
            parse_condition(text, fields)


@pytest.mark.parametrize("option", ["only", "where"])
@pytest.mark.parametrize("value", [(3,), 3, None, {"a": 1}, [None], {"a"}, b"a"])
def test_filters_are_text(option: str, value: Any, figures_set: Path) -> None:
    with pytest.raises(BadConfig, match=f"^{option} must be text or a list of texts, found "):
        RangeImages(figures_set, **{option: value})


@pytest.mark.parametrize(("option", "value"), [("only", ""), ("only", ["*", " "]), ("where", "")])
def test_filters_are_not_empty(option: str, value: Any, figures_set: Path) -> None:
    with pytest.raises(BadConfig, match=f"^{option} must hold no empty text, found "):
        RangeImages(figures_set, **{option: value})


def test_one_text_is_one_pattern(figures_set: Path) -> None:
    one = RangeImages(figures_set, only="open-A-*")
    assert one.keys == RangeImages(figures_set, only=["open-A-*"]).keys == [key for key in one.keys if "-A-" in key]
    assert one.identity()["only"] == ["open-A-*"]
    assert len(RangeImages(figures_set, where="subset=people")) == 24 - len(one) == 12


def test_keys_are_looked_up_and_patterns_alone_are_matched(figures_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keys = RangeImages(figures_set).keys
    chosen = [key for index, key in enumerate(keys) if index % 3 == 0 or key.endswith("-a080")]
    known = {"*-a080": fnmatch.translate("*-a080")}
    monkeypatch.setattr(fnmatch, "translate", known.__getitem__)
    assert RangeImages(figures_set, only=[*keys[::3], "*-a080", "none-of-these"]).keys == chosen


def test_conditions_select_what_samples_say_of_themselves(figures_set: Path) -> None:
    images = RangeImages(figures_set)
    where = ("azimuth_deg=-100..90", "subset=A", "distance_cm<=255")
    chosen = RangeImages(figures_set, split="train", where=where)
    wanted = [
        images.keys[index]
        for index in range(len(images))
        for info in [images.clean(index).info]
        if info.azimuth_deg in (260, 0, 80) and info.subset == "A" and info.distance_cm <= 255 and info.split == "train"
    ]
    assert chosen.keys == wanted
    assert 0 < len(wanted) < 12
    assert chosen.identity()["where"] == list(where)
    assert not {"where", "val_share", "only"} & images.identity().keys()
    assert f"where={list(where)!r}, samples={len(wanted)}, " in repr(chosen)
    spaced = RangeImages(figures_set, split="train", where=[" distance_cm <= 255 ", *where[:2]])
    assert spaced.identity()["where"] == ["distance_cm<=255", *where[:2]]


def test_conditions_open_no_shard(figures_set: Path, tmp_path: Path) -> None:
    shutil.copy(figures_set / "manifest.json", tmp_path)
    assert len(RangeImages(tmp_path, where="subject=A", only="*-a080")) == 3
    assert len(RangeImages(tmp_path, split="val", val_share=0.3)) == 4


def test_conditions_that_no_sample_meets_are_named(figures_set: Path) -> None:
    with pytest.raises(BadConfig, match=r"no sample that matches 'subject=Z'; the set holds 16 train, 8 test$"):
        RangeImages(figures_set, where="subject=Z")
    with pytest.raises(BadConfig, match="^an empty list of 'only' matches no sample: leave it out for all of them$"):
        RangeImages(figures_set, only=[])


def test_a_selection_does_not_depend_on_the_cut_into_shards() -> None:
    """Tables of bodies and views are a shard's own: joined, they number other rows."""
    where = ("motion=march,squat", "azimuth_deg=80..170")
    one, other = (planned("open", size) for size in (100_000, 777))
    assert chosen_keys(one, None, where=where) == chosen_keys(other, None, where=where)
    for split in ("train", "val"):
        assert chosen_keys(one, split, 0.1) == chosen_keys(other, split, 0.1)  # type: ignore[arg-type]  # literals


def subset_of(key: str) -> str:
    return "people" if key.startswith("open-people") else key.split("-")[1]


@pytest.mark.parametrize(("share", "tolerance"), [(0.05, 0.03), (0.1, 0.03), (0.2, 0.03), (0.3, 0.03), (0.5, 0.04)])
def test_val_is_a_share_of_train_in_whole_groups(share: float, tolerance: float) -> None:
    manifest = planned("open")
    train, val, rest = (
        chosen_keys(manifest, *each)  # type: ignore[arg-type]  # literals in tuples
        for each in (("train",), ("val", share), ("train", share))
    )
    assert set(val) | set(rest) == set(train)
    assert len(val) + len(rest) == len(train)
    assert abs(len(val) / len(train) - share) <= tolerance
    assert {"A", "people"} <= {subset_of(key) for key in val}
    assert {subset_of(key) for key in rest} == {"A", "B", "C", "people"}
    origin = {
        key: shard.descriptions.info(index, shard.split)
        for shard in manifest.shards
        for index, key in enumerate(shard.keys)
    }
    meshes = [{origin[key].mesh for key in part} for part in (val, rest)]
    assert not meshes[0] & meshes[1]
    motions = [
        {(origin[key].subject, origin[key].pose) for key in part if subset_of(key) in "BC"} for part in (val, rest)
    ]
    assert not motions[0] & motions[1]
    assert chosen_keys(manifest, "test", share) == chosen_keys(manifest, "test")
    assert chosen_keys(manifest, None, share) == chosen_keys(manifest, None)


@pytest.mark.parametrize(
    ("share", "postures", "people", "motions"),
    [
        (0.05, 6, 47, []),
        (0.1, 3, 23, ["C-C-bouncing"]),
        (0.2, 23, 162, ["B-B-crane"]),
        (0.3, 34, 156, ["B-B-crane", "C-C-bouncing"]),
    ],
)
def test_val_of_the_open_bodies_is_pinned(share: float, postures: int, people: int, motions: list[str]) -> None:
    """Another rule would put bodies of an earlier training into val. The numbers are those of docs/how-to/splits.md."""
    val = chosen_keys(planned("open", views=1), "val", share)
    bodies = [key.rpartition("-d")[0].removeprefix("open-") for key in val]
    assert Counter(body.rpartition("-")[0] for body in bodies) == {
        "people-person": people,
        "A-posture": postures,
        **dict.fromkeys(motions, 175),
    }
    if share == 0.1:
        assert [body for body in bodies if body.startswith("A-")] == ["A-posture-01", "A-posture-26", "A-posture-37"]


def test_val_does_not_depend_on_other_choices() -> None:
    manifest = planned("open")
    val = set(chosen_keys(manifest, "val", 0.1))
    some = chosen_keys(manifest, "val", 0.1, where=("subset=A,people", "distance_cm=255"))
    assert some == [
        key for key in chosen_keys(manifest, "train", where=("subset=A,people", "distance_cm=255")) if key in val
    ]
    shards = replace(manifest, shards=manifest.shards[::-1])
    assert set(chosen_keys(shards, "val", 0.1)) == val


def test_val_of_a_set_with_more_subsets_is_in_the_same_order() -> None:
    """The open bodies are in `wide`, too: a body of one val should be in no other's rest as far as shares allow."""
    names = [
        [key.partition("-")[2] for key in chosen_keys(planned(source, views=1), "val", 0.1)]
        for source in ("open", "wide")
    ]
    assert {key for key in names[1] if not key.startswith("wide")} == set(names[0])


def rows(subset: str, people: int, poses: int, frames: int = 1) -> list[BodyRow]:
    return [
        ("s", subset, f"p{who}", f"m{who}-{pose}-{frame}", f"pose{pose}")
        for who in range(people)
        for pose in range(poses)
        for frame in range(frames)
    ]


def found_people(bodies: list[BodyRow], share: float) -> int:
    return len(set(groups(bodies, share).values()))


def test_groups_are_people_where_there_are_enough() -> None:
    many, few = rows("X", 10, 2, 3), rows("Y", 9, 2, 3)
    found = groups([*many, *few], 0.1)
    assert found[many[0]] == ("X", "p0")
    assert len({found[row] for row in many}) == 10
    assert found[few[0]] == ("Y", "p0", "pose0")
    assert len({found[row] for row in few}) == 18
    assert len({groups(few, 0.2)[row] for row in few}) == 9
    exact = rows("Z", 49, 2, 1)
    assert found_people(exact, 1 / 49) == 49 and found_people(exact, 0.02) == 98
    postures = rows("A", 1, 1, 5)
    assert len({groups(postures, 0.1)[row] for row in postures}) == 5


def table_of(bodies: list[BodyRow]) -> SampleTable:
    numbers = np.arange(len(bodies), dtype=np.int32)
    others: list[Row] = [(215, 0, 0, 0, 0), ("", 0)]
    tables = [list[Row](bodies), *([row] for row in others)]
    return SampleTable(BODY_FIELDS, tables, [numbers, *(np.zeros_like(numbers) for _ in others)], len(bodies))


@pytest.mark.parametrize("share", [0.01, 0.1, 0.4, 0.6, 0.9, 0.99])
def test_neither_part_is_ever_empty(share: float) -> None:
    table = table_of(rows("X", 1, 3, 40))
    val = mark_val(table, share)
    assert val.sum() == {0.01: 40, 0.1: 40, 0.4: 40, 0.6: 80, 0.9: 80, 0.99: 80}[share]


def test_the_smallest_group_is_left_where_all_would_be_chosen_and_chosen_where_none_would() -> None:
    bodies = [row for name, frames in (("X", 40), ("Y", 30), ("Z", 50)) for row in rows(name, 1, 1, frames)]
    val = mark_val(table_of(bodies), 0.99)
    assert not val[40:70].any() and val[:40].all() and val[70:].all()
    assert mark_val(table_of(bodies), 0.01).tolist() == (~val).tolist()


def test_one_group_cannot_be_divided() -> None:
    with pytest.raises(BadConfig, match=r"^val_share=0\.1 divides train by people and motions, which are 1 group$"):
        mark_val(table_of(rows("X", 1, 1, 40)), 0.1)


@pytest.mark.parametrize("share", [-0.1, 1, 1.5, float("nan"), "0.1", None, True])
def test_a_share_is_a_number_below_1(share: Any, figures_set: Path) -> None:
    with pytest.raises(BadConfig, match="^val_share must be a number of at least 0 and below 1, found "):
        RangeImages(figures_set, split="val", val_share=share)


def test_val_needs_a_share(figures_set: Path) -> None:
    with pytest.raises(BadConfig, match=r"^the split 'val' is a share of train: give val_share, like 0\.1$"):
        RangeImages(figures_set, split="val")


def test_val_and_the_rest_stream(figures_set: Path) -> None:
    val = RangeImages(figures_set, split="val", val_share=0.3)
    rest = RangeImages(figures_set, split="train", val_share=0.3)
    assert sorted([*val.keys, *rest.keys]) == sorted(RangeImages(figures_set, split="train").keys)
    assert not {key.rpartition("-d")[0] for key in val.keys} & {key.rpartition("-d")[0] for key in rest.keys}
    assert [key for batch in loader(val, 4) for key in batch["key"]] == val.keys
    assert (val.identity()["split"], val.identity()["val_share"]) == ("val", 0.3)
    assert rest.identity()["val_share"] == 0.3
    assert "split='val', seed=0, epoch=0, val_share=0.3, " in repr(val)
    state = loader(rest, 4).state_dict()
    with pytest.raises(BadConfig, match="the state belongs to another run: samples"):
        loader(RangeImages(figures_set, split="train"), 4).load_state_dict(state)
    some = RangeImages(figures_set / "train-*.tar", split="val", val_share=0.3)
    assert some.keys == val.keys
