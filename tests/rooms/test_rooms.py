"""Made rooms: the same for a key, things on their floor, one scene for all devices, and what sensors lose of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from people_on_disk import PERSON, VERTICES
from small_rig import SMALL

from bodyseg_data.core import Draws
from bodyseg_data.labels import UNLABELLED
from bodyseg_data.meshes import Solid, cuboid, partition
from bodyseg_data.packing import Numbers
from bodyseg_data.packing.render_packing import contradicting
from bodyseg_data.rooms import scenes
from bodyseg_data.rooms.furnishings import FURNISHINGS, SEATS
from bodyseg_data.rooms.scenes import Room, RoomPerson

KINDS = list(FURNISHINGS)


@lru_cache
def people() -> list[RoomPerson]:
    parts = partition(PERSON, np.array(VERTICES), "edges")
    return [RoomPerson(PERSON, parts, pose) for pose in ("standing", "sitting", "lying_on_the_back")]


def room(number: int, kinds: list[str] = KINDS) -> Room:
    return Room(f"room-{number}", SMALL, people(), kinds)


def test_a_room_is_the_same_for_its_key_and_another_for_another() -> None:
    one, again, other = (vars(room(number).render()) for number in (3, 3, 4))
    for name in ("range_m", "labels", "projector_range_m", "facing"):
        np.testing.assert_array_equal(one[name], again[name])
        assert not np.array_equal(one[name], other[name])
    assert one["fields"] == again["fields"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_thing_stands_on_its_floor_and_is_drawn_anew(kind: str) -> None:
    drawn = [FURNISHINGS[kind](Numbers(Draws(0, 0, f"{kind} {draw}"), "thing")) for draw in range(6)]
    for solid in drawn:
        assert np.isfinite(solid.vertices).all()
        assert solid.faces.min() == 0 <= solid.faces.max() < len(solid.vertices)
        assert -0.15 < solid.vertices[:, 1].min() < 0.3
        assert 0.05 < np.ptp(solid.vertices, axis=0).max() < 4.0
    assert len({float(np.ptp(solid.vertices)) for solid in drawn}) == len(drawn)


@pytest.mark.parametrize("kind", SEATS)
def test_a_seat_is_as_high_as_it_is_asked_for(kind: str) -> None:
    for seat_m in (0.4, 0.6):
        vertices = SEATS[kind](Numbers(Draws(0, 0, kind), "thing"), seat_m).vertices
        middle = vertices[np.hypot(vertices[:, 0], vertices[:, 2] + 0.05) < 0.12]
        assert middle[:, 1].max() == pytest.approx(seat_m, abs=0.09)


def test_walls_stand_where_people_and_things_are_kept_off_them() -> None:
    seen = 0
    for number in range(8):
        made = room(number, ["box"])
        for wall in made.walls:
            there = wall.pose.of(FURNISHINGS["box"](Numbers(Draws(0, 0, "box"), "thing")).moved((0, 0, -2.0)))
            assert (there.vertices @ wall.normal).max() < wall.offset - 1.0  # its front looks into the room
            for person, pose, _ in made.persons:
                seen += 1
                assert ((person.mesh.vertices @ pose.turn.T + pose.shift) @ wall.normal).max() < wall.offset + 1e-6
    assert seen > 12


def test_most_rooms_show_somebody_and_few_nobody() -> None:
    rooms = [room(number, ["box"]) for number in range(40)]
    assert 0 < sum(not made.persons for made in rooms) < 10
    assert 1 < sum(not made.walls for made in rooms) < 12
    assert max(len(made.persons) for made in rooms) == 3


def test_all_devices_see_one_scene() -> None:
    shares = []
    for number in range(4):
        render = room(number).render()
        assert render.projector_range_m is not None
        shares.append(contradicting(SMALL, render.range_m, render.projector_range_m))
    # Rooms full of bars have most of it: at this size a pixel is wider than a bar.
    assert np.mean(shares) < 0.1


def test_a_turned_camera_sees_the_room_turned() -> None:
    """Of a square image: turned by a right angle, the camera sees the same room, and its projector what it did."""
    camera = replace(SMALL.camera, rows=100, columns=100, focal_px=90.0, centre_px=(50.0, 50.0))
    rig = replace(SMALL, camera=camera)
    upright, turned = (
        Room("room-3", replace(rig, camera=replace(camera, roll_deg=roll)), people(), KINDS).render()
        for roll in (0, 90)
    )
    for name in ("labels", "facing"):  # but where rounding decides
        assert (vars(turned)[name] == np.rot90(vars(upright)[name])).mean() > 0.99
    np.testing.assert_allclose(turned.range_m, np.rot90(upright.range_m), atol=1e-4)
    np.testing.assert_allclose(turned.projector_range_m, upright.projector_range_m, atol=1e-4)


def test_labels_fit_ranges_and_people() -> None:
    shown = 0
    for number in range(8):
        made = room(number)
        render = made.render("test")
        people, labels, lost = render.planes["person"], render.labels, render.range_m == 0
        assert (render.split, render.fields["people"]) == ("test", len(made.persons))
        np.testing.assert_array_equal(lost, labels == 255)
        np.testing.assert_array_equal(people > 0, labels < UNLABELLED)
        assert people.max() <= len(made.persons)
        assert render.facing is not None
        assert not (render.facing & lost).any()
        shown += int((people > 0).sum())
    assert shown > 1000


def test_dark_things_are_not_measured_but_hide_what_is_behind() -> None:
    kept, dark, half = room(5), room(5), room(5)
    kept.solids = [(solid, (-9.0, 0.0, 1.0)) for solid, _ in kept.solids]
    dark.solids = [(solid, (9.0, 0.0, 1.0)) for solid, _ in dark.solids]
    half.solids = [(solid, (0.0, 0.0, 0.3)) for solid, _ in half.solids]
    for made in (kept, dark, half):
        made.persons = [(person, pose, [(-9.0, 0.0, 1.0)] * 33) for person, pose, _ in made.persons]
    whole, nothing, patches = kept.render(), dark.render(), half.render()
    things = whole.labels == UNLABELLED
    assert things.sum() > 2000
    assert not nothing.range_m[things].any()
    np.testing.assert_array_equal(nothing.range_m[~things], whole.range_m[~things])
    np.testing.assert_array_equal(nothing.projector_range_m, whole.projector_range_m)
    lost = patches.range_m[things] == 0
    assert 0.3 < lost.mean() < 0.7
    beside = (patches.range_m[:, 1:] == 0) == (patches.range_m[:, :-1] == 0)
    assert beside[things[:, 1:] & things[:, :-1]].mean() > 0.8  # in patches, not pixel by pixel


def test_grazing_surfaces_lose_more_and_people_lose_by_their_parts() -> None:
    face, people, labels = np.zeros((8, 12), np.int32), np.zeros((8, 12), np.uint8), np.zeros((8, 12), np.uint8)
    face[:, 4:8], face[:, 8:] = 1, 2  # a surface that faces the camera, one that hardly does, and two people
    face[0] = -1
    people[:, 8:], people[:, 10:], labels[:, 8::2] = 1, 2, 5
    normals = np.array([[0.0, 0.0, -2.0], [3.0, 0.0, -0.1], [0.0, 0.0, -1.0]])
    losses = np.full((68, 3), (-9.0, 0.0, 1.0))
    losses[66:] = (-3.99, 12.0, 1.0)  # of both surfaces
    losses[33 + 5] = (9.0, 0.0, 1.0)
    view = np.eye(3), np.array([0.2, -0.1, 0.3]), np.linspace(-0.02, 0.02, 12), np.linspace(-0.02, 0.02, 8)
    surface = face, np.array([66, 67, 0]), normals
    lost = scenes._lose(np.full((8, 12), 2.0, np.float32), labels, people, surface, view, losses, scenes._LATTICE)
    expected = np.zeros((8, 12), np.bool_)
    expected[1:, 4:8] = expected[1:, 10] = True
    np.testing.assert_array_equal(lost, expected)


def test_own_things_stand_in_rooms_or_reach_into_the_image() -> None:
    own, placed, near = [("press", cuboid((0.5, 0.9, 0.4), (0.0, 0.45, 0.0)))], 0, 0
    for number in range(24):
        made = Room(f"room-{number}", SMALL, people(), ["stool"], own=own)
        for place in (place for place, name in made.things.items() if name == "press"):
            vertices, placed = made.solids[place][0].vertices, placed + 1
            reaches = np.linalg.norm(vertices - (0.0, made.height_m, 0.0), axis=1)
            assert reaches.min() > 0.25
            if reaches.max() < 2.0 and abs(vertices[:, 1].min()) > 1e-9:  # off the floor, right before the camera
                near += 1
                assert reaches.min() < 0.9
        assert (made.render().labels == UNLABELLED).any()
    assert placed > 20 and near > 2


def test_kinds_that_are_left_out_are_nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: set[str] = set()

    def noting(name: str, made: Callable[..., Solid]) -> Callable[..., Solid]:
        def draw(*given: Any) -> Solid:
            drawn.add(name)
            return made(*given)

        return draw

    for table in (FURNISHINGS, SEATS):
        for name, made in table.items():
            monkeypatch.setitem(table, name, noting(name, made))  # type: ignore[attr-defined]
    monkeypatch.setattr(scenes, "coat", noting("coat", scenes.coat))
    left_out = {"bed", "bag", "coat_stand", "dressed_chair", "sofa", "wheelchair"}
    for number in range(12):
        room(number, [kind for kind in KINDS if kind not in left_out])
    assert len(drawn) > 15
    assert not drawn & {*left_out, "coat"}
    for number in range(12):
        room(number)
    assert drawn & {"coat", "bed", "bag", "wheelchair"} == {"coat", "bed", "bag", "wheelchair"}
