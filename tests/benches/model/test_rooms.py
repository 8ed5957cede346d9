"""Made rooms: people and things where the truth says that they are, and what is counted in them."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from benches.model.things import rooms as measure
from benches.model.things.rooms import MOST_PEOPLE, MOST_THINGS, Counts, Room, Rooms, people_and_things
from fakes import Figures
from label_networks import Places

from bodyseg_data.labels import BACKGROUND
from bodyseg_data.rigs import load_sensor
from bodyseg_model.segmentation import LabelledBody, PersonScore

KINECT = load_sensor("kinect_v1").camera
SMALL = replace(KINECT, rows=120, columns=160, focal_px=KINECT.focal_px / 4, centre_px=(80.0, 60.0))


@lru_cache
def rooms(parts: bool = True) -> Rooms:
    source = Figures()
    return Rooms(source, source.bodies(), SMALL, 3, parts)


@lru_cache
def made() -> list[Room]:
    return [rooms()(number) for number in range(12)]


def test_a_room_is_the_same_again() -> None:
    for image in ("range_m", "person", "thing"):
        np.testing.assert_array_equal(getattr(made()[3], image), getattr(rooms(parts=False)(3), image))
    assert (rooms(parts=False)(3).labels == BACKGROUND).all(), "nobody asked for parts"
    assert not np.array_equal(made()[3].range_m, made()[4].range_m)


def test_rooms_hold_people_and_things() -> None:
    for room in made():
        assert 0 <= room.people <= MOST_PEOPLE and 0 <= room.things <= MOST_THINGS
        assert room.person.max() < room.people and room.thing.max() < room.things
        assert not ((room.person >= 0) & (room.thing >= 0)).any()
        np.testing.assert_array_equal(room.labels != BACKGROUND, room.person >= 0)
        nothing = room.range_m == 0
        assert (room.person[nothing] == -1).all() and (room.labels[nothing] == BACKGROUND).all()
        assert 0.01 < nothing.mean() < 0.7 and np.median(room.range_m[~nothing]) > 1
    assert {room.people for room in made()} > {0, 1} and {room.things for room in made()} > {0, 1, 2}


def test_things_touch_people_where_asked() -> None:
    """The gap from the things to the people of a room, between measured points, is far smaller."""

    def least_gaps(touching: bool) -> list[float]:
        source = Figures()
        maker, gaps = Rooms(source, source.bodies(), SMALL, 3, parts=False, touching=touching), []
        rays = SMALL.pixel_rays()
        for number in range(16):
            room = maker(number)
            points = rays * room.range_m[..., None]
            measured = room.range_m > 0
            people, things = points[(room.person >= 0) & measured], points[(room.thing >= 0) & measured]
            if len(people) and len(things):
                gaps.append(float(np.sqrt(((people[::5, None] - things[None, ::5]) ** 2).sum(-1).min())))
        return gaps

    apart, touching = least_gaps(False), least_gaps(True)
    assert len(apart) > 4 < len(touching)
    assert np.median(touching) < 0.6 * np.median(apart)


def test_ranges_have_a_kinects_noise_in_millimetres() -> None:
    room = max(made(), key=lambda room: float((room.range_m > 0).mean()))
    seen = room.range_m[room.range_m > 0].astype(np.float64)
    np.testing.assert_allclose(1000 * seen, np.rint(1000 * seen), atol=1e-3)
    rows = room.range_m.astype(np.float64)
    bend = (rows[:, :-2] - 2 * rows[:, 1:-1] + rows[:, 2:])[(rows[:, :-2] * rows[:, 1:-1] * rows[:, 2:]) > 0]
    assert 0.002 < np.median(np.abs(bend)) < 0.1


def test_labels_of_people_do_not_depend_on_where_they_stand() -> None:
    """The figure's head is above its legs in every room, however it is turned."""
    for room in made():
        for number in range(room.people):
            rows, columns = np.nonzero(room.person == number)
            if np.ptp(rows) > 40 and rows.max() < SMALL.rows - 1:
                upper, lower = (
                    set(room.labels[rows[part], columns[part]].tolist())
                    for part in (rows < np.quantile(rows, 0.1), rows > np.quantile(rows, 0.9))
                )
                assert not upper & lower
                return
    pytest.fail("nobody is seen from head to foot")


# Counts.


def room_of(person: np.ndarray[Any, Any], range_m: float = 1.0) -> Room:
    labels = np.where(person >= 0, 4, BACKGROUND).astype(np.uint8)
    return Room(np.full(person.shape, range_m, np.float32), person, np.full_like(person, -1), labels, 2, 1)


def body(pixels: np.ndarray[Any, Any]) -> LabelledBody:
    return LabelledBody(pixels, 1.0, 0.0, 1.0, np.ones(len(pixels), np.float32))


def test_counts_are_of_people_and_of_what_is_labelled() -> None:
    person = np.full((4, 10), -1, np.int32)
    person[:, :3], person[:1, 9] = 0, 1  # the second one shows too little to count
    labels = np.full(person.shape, BACKGROUND, np.uint8)
    columns = np.arange(40).reshape(4, 10)
    labels[:, :2], labels[:, 2], labels[:, 5:8] = 4, 9, 7
    found, thing = body(columns[:, :3].ravel()), body(columns[:, 5:8].ravel())
    counts = Counts()
    counts.add(room_of(person), [found, thing], labels, 0.2)
    assert counts.to_json() == {
        "people": 1, "people_found": 1, "surfaces": 2, "things": 1, "person_pixels": 13, "labelled": 12, "right": 8,
        "thing_pixels": 12, "found": 1.0, "accuracy": 0.6667, "right_of_all": 0.6154,
    }  # fmt: skip
    counts.add(room_of(person), [thing], labels, 0.2)
    assert (counts.people, counts.people_found, counts.things) == (2, 1, 2)
    assert Counts().to_json()["found"] is Counts().to_json()["accuracy"] is Counts().to_json()["right_of_all"] is None


def scored(bias: float) -> PersonScore:
    return PersonScore(lambda shape: bias, 0.5)


@pytest.mark.parametrize(("bias", "kept"), [(5.0, True), (-5.0, False)])
def test_a_score_keeps_people_or_drops_them(bias: float, kept: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measure, "rooms_of", lambda *arguments, **named: [rooms(), rooms()])
    seen: list[tuple[int, int]] = []
    found = people_and_things(Places(0, 10), scored(bias), 4, lambda *numbers: seen.append(numbers))
    assert seen == [(number, 4) for number in range(1, 5)]
    assert found["rooms"] == 4 and found["before"]["surfaces"] > 0 and found["score_ms"] > 0
    assert found["after"] == (found["before"] if kept else {**found["before"], **dropped(found["before"])})


def dropped(before: dict[str, Any]) -> dict[str, Any]:
    nothing = dict.fromkeys(("people_found", "surfaces", "things", "labelled", "right", "thing_pixels"), 0)
    return {**nothing, "found": 0.0 if before["people"] else None, "accuracy": None, "right_of_all": 0.0}
