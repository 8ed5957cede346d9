"""`bench rooms` and `bench limits`: rooms that say what is in them, what is counted, and what the benches write."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benches import measuring
from benches.model.rooms import bench, limits
from benches.model.rooms.bench import WAYS, bench_rooms
from benches.model.rooms.figure import draw_rooms
from benches.model.rooms.finders import Finder, Found, network_finder
from benches.model.rooms.limits import fitted, quality
from benches.model.rooms.made import SEED, SETS, Made, Who, _touch, make
from benches.model.rooms.real import CUTS, ROOM, cut_frames, real, room_frames, score_cut
from benches.model.rooms.tallies import by_kind, by_property, by_set, counted, merged
from fakes import Figures
from folders import ROOT
from label_networks import Nearer
from PIL import Image

from bodyseg_data.core import BadConfig
from bodyseg_data.labels import BACKGROUND, UNLABELLED
from bodyseg_data.rigs import load_sensor
from bodyseg_data.rooms.scenes import RoomPerson
from bodyseg_data.samples import HELD
from bodyseg_model.networks import SHIPPED, Trained, build
from bodyseg_model.segmentation import frame_labeller

KINECT = load_sensor("kinect_v1").camera
SMALL = replace(KINECT, rows=120, columns=160, focal_px=KINECT.focal_px / 4, centre_px=(80.0, 60.0))


@cache
def people() -> list[RoomPerson]:
    source = Figures()
    built = [source.build(body) for body in source.bodies()[:2]]
    return [
        RoomPerson(body.mesh, body.partition(), pose) for body, pose in zip(built, ("sitting", "crane"), strict=True)
    ]


def room(number: int, of: str = "all kinds") -> Made:
    return make(of, number, people() if of != "nobody" else (), SETS[of], "kinect_v1", SMALL)


def test_a_room_says_what_every_pixel_shows() -> None:
    rooms = [room(number) for number in range(4)]
    again = room(3)
    for image in ("range_m", "person", "thing", "labels"):
        np.testing.assert_array_equal(getattr(rooms[3], image), getattr(again, image))
    for made in rooms:
        measured = made.range_m > 0
        np.testing.assert_array_equal(made.labels == BACKGROUND, ~measured)
        assert not ((made.person > 0) & (made.labels >= UNLABELLED)).any()
        assert ((made.person == 0) & (made.labels < UNLABELLED)).sum() <= 3, "borders move by little"
        assert not ((made.person > 0) & (made.thing > 0)).any() and not made.thing[~measured].any()
        assert made.person.max() <= len(made.people) and made.thing.max() <= len(made.kinds)
        assert {*made.kinds} <= {*SETS["all kinds"], HELD, "bed", "chair"}
    assert any((made.person > 0).any() for made in rooms) and any((made.thing > 0).any() for made in rooms)
    assert {who.posture for made in rooms for who in made.people} == {"sitting", "standing"}
    gaps = [who.gap_m for made in rooms for who in made.people if who.gap_m is not None]
    assert gaps and min(gaps) >= 0
    empty = room(1, "nobody")
    assert not empty.person.any() and (empty.range_m > 0).any() and empty.people == ()


def test_surfaces_touch_where_they_meet_in_the_image_and_in_range() -> None:
    one, other = np.zeros((10, 10), np.bool_), np.zeros((10, 10), np.bool_)
    one[:, :5], other[:, 5:] = True, True
    near = np.full((10, 10), 2.0)
    assert _touch(one, other, near) and not _touch(one, other & (np.arange(10) > 5), near)
    assert not _touch(one, other, np.where(other, 2.1, near)), "one stands behind the other"


def handmade() -> Made:
    """A person at 2 m whose lower half is a held thing, beside a chair and a table."""
    shape = (120, 160)
    range_m, labels = np.full(shape, 3.0, np.float32), np.full(shape, UNLABELLED, np.uint8)
    person, thing = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    person[20:60, 20:50], labels[20:60, 20:50], thing[60:100, 20:50] = 1, 3, 1
    thing[20:100, 60:90], thing[20:100, 100:150] = 2, 3
    range_m[(person > 0) | (thing > 0)] = 2.0
    who = (Who("standing", 0.2, "nothing", True),)
    kinds = (HELD, "chair", "table")
    return Made("unseen kinds", 0, "kinect_v1", SMALL, range_m, person, thing, labels, who, kinds, 1.0, -15.0)


def test_people_things_and_pixels_are_counted() -> None:
    made = handmade()
    truth = Found((made.person > 0).astype(np.float32), made.labels, 1)
    half = truth.person * (np.arange(120)[:, None] < 35)  # 15 rows of 40, and a third of the chair's 80
    half[73:100, 60:90] = 0.6
    half_labels = np.where(half > 0, 3, BACKGROUND).astype(np.uint8)
    half_labels[20:30, 20:50] = 4
    tally = merged([counted(made, truth), counted(made, Found(half, half_labels, 3))])
    assert len(tally["frames"]) == len(tally["people"]) == 2 and len(tally["things"]) == 4
    found = by_set(tally)["unseen kinds"]
    labelled = (40 + 15 + 27) * 30
    assert found["precision"] == round(55 * 30 / labelled, 4) and found["recall"] == round(55 / 80, 4)
    assert (found["rooms"], found["people"], found["lost"], found["bodies_a_frame"]) == (2, 2, 1, 2.0)
    assert (found["things"], found["things_labelled"], found["held_unlabelled"]) == (4, 1, 1.0)
    assert found["parts_right"] == round(45 / 55, 4)
    assert by_kind(tally["things"]) == {"chair": {"things": 2, "labelled": 1}, "table": {"things": 2, "labelled": 0}}
    properties = by_property(tally)
    assert list(properties["to the wall, m"]) == ["0.15 to 0.3"] and list(properties["distance, m"]) == ["1.5 to 2.5"]
    assert properties["camera's pitch, degrees"]["-20 to -10"]["lost"] == 1
    assert properties["holds a thing"] == {"yes": properties["sensor"]["kinect_v1"]}
    assert counted(made, Found(half, half_labels), 0.7)["things"][0]["labelled"] == 0
    small = replace(made, range_m=(made.range_m / 8).astype(np.float32))
    assert counted(small, truth)["people"] == [], "so little of somebody does not count"


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """A folder of real frames: a man at 2 m in a room of 4 m, and people cut out at 1 m."""

    def write(file: Path, image: np.ndarray[Any, Any]) -> None:
        file.parent.mkdir(exist_ok=True)
        Image.fromarray(image).save(file)

    depth, person = np.full((480, 640), 4000, np.uint16), np.zeros((480, 640), np.uint8)
    depth[100:300, 200:300], person[100:300, 200:300] = 2000, 255
    for name in ("000", "001"):
        write(tmp_path / ROOM / f"{name}_depth.png", depth)
        write(tmp_path / ROOM / f"{name}_person.png", person)
    for folder, cut in CUTS.items():
        cut_out = np.where(person > 0, 1000, 1300 if np.isfinite(cut.near_m) else 0).astype(np.uint16)
        write(tmp_path / folder / cut.pattern.replace("*", "00"), cut_out)
    return tmp_path


def test_pixels_near_a_mask_and_below_it_count_as_his(frames: Path) -> None:
    (frame, _) = room_frames(frames / ROOM)
    rows, columns = np.flatnonzero(frame.near.any(axis=1)), np.flatnonzero(frame.near.any(axis=0))
    assert (rows[0], rows[-1], columns[0], columns[-1]) == (85, 299 + 15 + 60, 185, 314)
    assert not frame.near[85, 185] and frame.near[370, 250], "corners are round"
    with pytest.raises(BadConfig, match="found none"):
        room_frames(frames / "kinect_v2")


def test_real_frames_are_scored(frames: Path) -> None:
    near = real(network_finder(Nearer(limit_m=3.0, focal_px=525.0)), frames)
    assert near[ROOM]["at"]["0.5"] == {"precision": 1.0, "recall": 1.0} and near[ROOM]["bodies_a_frame"] is None
    assert all(near[name]["recall"] == 1.0 and near[name]["found"] == 1 for name in CUTS)
    unsure = real(network_finder(Nearer(limit_m=9.0, focal_px=525.0, sure=0.6)), frames)
    assert unsure[ROOM]["at"]["0.7"] == {"precision": None, "recall": 0.0}
    assert unsure[ROOM]["at"]["0.5"]["recall"] == 1.0 and unsure[ROOM]["at"]["0.5"]["precision"] < 0.2
    cut = list(cut_frames(frames / "kinect_v1", CUTS["kinect_v1"]))
    none = score_cut(lambda range_m, camera: Found(0 * range_m), cut)
    assert (none["found"], none["recall"], none["frames"]) == (0, 0.0, 1)


def test_the_network_sees_every_second_pixel() -> None:
    network = build("compact", {"focal_px": 525.0, "patch": 8, "widths": [8], "blocks": [1], "classes": 2}, 1).eval()
    range_m = np.broadcast_to(np.linspace(1, 3, 640, dtype=np.float32), (480, 640))
    whole, coarse = (network_finder(network, step)(range_m, KINECT).person for step in (1, 2))
    assert whole.shape == coarse.shape == (480, 640) and not np.array_equal(whole, coarse)
    assert np.ptp(coarse.reshape(240, 2, 320, 2), axis=(1, 3)).max() == 0, "pixels of a square have one answer"
    with pytest.raises(BadConfig, match="focal_px"):
        network_finder(build("compact").eval())(range_m, KINECT)


class Here:
    """An executor that does all itself."""

    def __init__(self, processes: int, context: Any, setup: Any = None, given: tuple[Any, ...] = ()) -> None:
        if setup:
            setup(*given)

    def __enter__(self) -> Here:
        return self

    def __exit__(self, *_: object) -> None:
        return

    def map(self, work: Callable[..., Any], *items: Iterable[Any]) -> Iterator[Any]:
        return map(work, *items)


def test_processes_that_make_rooms_have_the_people() -> None:
    setup, given = pickle.loads(pickle.dumps((bench._meet, (people(),))))  # as a process is given it
    try:
        setup(*given)
        assert len(bench._people) == 2
    finally:
        bench._people.clear()


def test_the_bench_measures_every_way_and_draws(
    frames: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, near_is_person: None, one_thread: None
) -> None:
    for name in CUTS:
        shutil.rmtree(frames / name)
    for file in (frames / ROOM).glob("001_*"):
        file.unlink()
    finder = Trained(Nearer(limit_m=3.0), {"weights_sha256": "1"})
    monkeypatch.setattr(bench, "shipped_finder", lambda: finder)

    def at_full_size(network: Nearer, step: int = 1) -> Finder:
        return network_finder(network)

    monkeypatch.setattr(bench, "network_finder", at_full_size)
    monkeypatch.setattr(frame_labeller, "least_confidence_of_people", lambda card: 0.9)
    monkeypatch.setattr(bench, "ProcessPoolExecutor", Here)
    monkeypatch.setattr(bench, "draw_people", lambda split, block: people() if split == "test" else [])
    monkeypatch.setattr(bench, "make", partial(make, sensor="kinect_v1", camera=SMALL))
    steps: list[int] = []
    figures = bench_rooms(2, str(frames), progress=lambda done, total: steps.append(done))
    assert steps == [*range(1, 2 + len(WAYS))] and json.loads(json.dumps(figures))["default"] == WAYS[-1]
    for way in figures["ways"].values():
        assert way["ms"] > 0 and set(way["made"]) == {"unseen kinds", "all kinds"}
        assert way["real"]["kinect_v1"] is None
    recall = {name: way["real"][ROOM]["at"]["0.5"]["recall"] for name, way in figures["ways"].items()}
    assert recall == dict.fromkeys(WAYS, 1.0) | {"segment": 0.0}, "the network doubts that a board is a person"
    assert figures["ways"]["finder"]["made"]["all kinds"]["bodies_a_frame"] is None
    assert set(figures["mirrored"]) == {"compact", "large"}
    assert all(0 <= ways["mask"]["mirror"] <= 1 for ways in figures["mirrored"].values())
    assert 0 < len(figures.shown) <= 10
    draw_rooms(measuring.Figures(figures, figures.shown[:2]), tmp_path / "rooms.png")
    with Image.open(tmp_path / "rooms.png") as picture:
        assert picture.width > 1000


def test_the_limit_loses_the_share_of_people_asked() -> None:
    rng = np.random.default_rng(SEED)
    bodies = np.concatenate([np.stack([rng.uniform(0.5, 1, 200), np.ones(200)], 1), [[0.4, 0.1], [0.9, 0.2]]])
    least = fitted(bodies, 0.05)
    found = quality(bodies, least)
    assert found == {"least": least, "people": 200, "people_lost": 10, "things": 2, "things_kept": 1}
    assert fitted(bodies, 0.0) <= 0.51 and quality(bodies, fitted(bodies, 0.0))["people_lost"] == 0
    with pytest.raises(BadConfig, match="nobody is found"):
        fitted(bodies[-2:], 0.05)


def test_limits_are_fitted_to_rooms_of_the_training_split(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []

    def made(split: str, run: Path | None, rooms: range) -> Any:
        seen.append((split, run, len(rooms)))
        return np.array([[0.7, 1.0], [0.6, 0.0], [0.8 if split == "train" else 0.5, 0.9]])

    monkeypatch.setattr(limits, "_bodies", made)
    monkeypatch.setattr(limits, "ProcessPoolExecutor", Here)
    figures = limits.bench_limits(30)
    assert seen == [("train", None, 20), ("train", None, 10), ("test", None, 20), ("test", None, 10)]
    assert figures["least_confidence_of_people"] == 0.7
    assert figures["fit"] == {"least": 0.7, "people": 4, "people_lost": 0, "things": 2, "things_kept": 0}
    assert figures["test"]["people_lost"] == 2


def test_the_shipped_card_has_the_limit_that_was_fitted() -> None:
    figures = json.loads((ROOT / "docs" / "results" / "limits.json").read_text())
    card = json.loads(SHIPPED.with_suffix(".json").read_text())
    assert card["least_confidence_of_people"] == figures["least_confidence_of_people"]
