"""Skirts, coats, hair, shoes and held things: closed surfaces that enclose what they cover, in any pose."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from shapes import mean_by_place, numbers_in

from bodyseg_data.bodies.anny_model import AnnyModel, Posable
from bodyseg_data.bodies.anny_people import SUBJECT_A
from bodyseg_data.bodies.attire import Attire, drawn_attire, joined, put_on, under
from bodyseg_data.bodies.outfits import OUTFITS
from bodyseg_data.bodies.shells import Hair, Shoes, Wearer, bun, hull_radius, long_hair, scalp, settled, shell, shoe
from bodyseg_data.bodies.skeleton import Arm, Leg, Trunk, bone_rotations, symmetric
from bodyseg_data.bodies.stances import Places
from bodyseg_data.bodies.worn import Drape, Held, Kind, draped, gripping, held_thing, padded
from bodyseg_data.core import Draws
from bodyseg_data.labels import LANDMARKS
from bodyseg_data.meshes import Mesh, Solid, find_edges, load_landmarks

Floats = NDArray[np.float64]

SKIRT = Drape(0.3, 0.5, 0.012, 0.12, 1.7, 0.1, 0.012, 0, 1)
COAT = Drape(0.92, 0.6, 0.03, 0.06, 1.7, 0.14, 0.012, 18, 3)
LONG = Hair("long", 0.015, 0.35, 0.5, 5)
BUN = Hair("bun", 0.006, 0.045, 0.5)
SHOES = Shoes(0.006, 0.02)

AIR = Arm(flex=60, abduct=20, elbow=40)
POSES = {
    "standing": symmetric(Trunk(), AIR, Leg()),
    "sitting": symmetric(Trunk(lean=5), AIR, Leg(flex=85, knee=90)),
    "lying": symmetric(Trunk(lean=-90), AIR, Leg(planted=0)),
    "kicking": replace(symmetric(Trunk(), AIR, Leg()), left_leg=Leg(flex=120, abduct=40, planted=0)),
}


@cache
def adult() -> tuple[Posable, Places]:
    pytest.importorskip("anny")
    person = AnnyModel().posable(SUBJECT_A)
    return person, Places(person)


@cache
def wearer(pose: str) -> Wearer:
    person, places = adult()
    return Wearer(person, person.vertices(*person.placed(bone_rotations(POSES[pose]))), places)


def volume(solid: Solid) -> float:
    """Signed volume, m3; raises unless every edge has two faces that agree."""
    edges = find_edges(solid.faces)
    assert (edges.faces == 2).all()
    forwards = np.where(solid.faces < np.roll(solid.faces, -1, axis=1), 1, -1)
    assert not np.bincount(edges.of_side.ravel(), forwards.ravel()).any()
    return solid.volume


@pytest.mark.parametrize("around", [True, False])
def test_a_shell_is_closed_and_as_large_as_its_sheet_is_thick(around: bool) -> None:
    angles = -np.arange(60) * (2 * np.pi / 60) * (1.0 if around else 0.5)
    ring = np.stack([np.cos(angles), np.zeros(60), -np.sin(angles)], axis=1)
    tube = ring[None] * 0.3 + np.array([0, -1.0, 0]) * np.linspace(0, 1, 20)[:, None, None]
    area = 2 * np.pi * 0.3 * (1.0 if around else 0.5 * 59 / 60)
    assert volume(shell(tube, 0.002, around)) == pytest.approx(0.002 * area, rel=0.02)


def test_hulls_are_those_of_geometry() -> None:
    square = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1], [0.2, 0.1]])
    ways = np.array([[1, 0], [0, -1], [0.6, 0.8]])
    np.testing.assert_allclose(hull_radius(square, ways), [1, 1, 1.25])


def test_what_would_hang_below_the_floor_lies_on_it_in_order() -> None:
    points = np.array([[0, 0.5, 0], [0, 0.02, 0], [0, -0.1, 0], [0, -0.5, 0.0]])
    found = settled(points, 0.01)
    np.testing.assert_array_equal(found[:2], points[:2])
    assert 0.01 < found[3, 1] < found[2, 1] < 0.017


@pytest.mark.parametrize("pose", ["standing", "sitting", "lying"])
@pytest.mark.parametrize("drape", [SKIRT, COAT, replace(COAT, open_deg=0)])
def test_a_drape_is_closed_above_the_floor_and_outside_the_legs(pose: str, drape: Drape) -> None:
    person = wearer(pose)
    cloth = draped(person, drape)
    assert cloth is not None and volume(cloth) > 0
    assert cloth.vertices[:, 1].min() > person.floor
    if drape.open_deg == 0 and pose == "standing":  # thighs are enclosed: a ray outwards meets cloth
        thigh = person.points[person.of("upperleg02")]
        levels = cloth.vertices[np.abs(cloth.vertices[:, 1] - thigh[:, 1].mean()) < 0.03]
        far = np.abs(thigh[np.abs(thigh[:, 1] - thigh[:, 1].mean()) < 0.03][:, [0, 2]]).max(axis=0)
        assert (np.abs(levels[:, [0, 2]]).max(axis=0) > far).all()


def test_a_skirt_joins_the_legs_and_widens_by_its_flare() -> None:
    person = wearer("standing")
    narrow, wide = (draped(person, replace(SKIRT, flare=flare, fold_depth_m=0)) for flare in (0.0, 0.3))
    assert narrow is not None and wide is not None
    hems = [solid.vertices[solid.vertices[:, 1] < solid.vertices[:, 1].min() + 0.03] for solid in (narrow, wide)]
    spans = [float(np.ptp(hem[:, 0])) for hem in hems]
    assert 0.3 < spans[0] < 0.6 and spans[1] > spans[0] + 0.1
    long = draped(person, replace(SKIRT, length=0.95))
    assert long is not None and long.vertices[:, 1].min() < narrow.vertices[:, 1].min() - 0.25


def test_a_narrow_skirt_leaves_too_little_on_one_who_kicks() -> None:
    assert draped(wearer("kicking"), replace(SKIRT, girth_m=1.1, length=0.9)) is None
    assert draped(wearer("standing"), replace(SKIRT, girth_m=1.3)) is not None


def test_a_coat_is_open_in_front_only() -> None:
    cloth = draped(wearer("standing"), replace(COAT, open_deg=30))
    assert cloth is not None
    low = cloth.vertices[cloth.vertices[:, 1] < cloth.vertices[:, 1].min() + 0.05]
    centre = low.mean(axis=0)
    angles = np.degrees(np.arctan2(low[:, 0] - centre[0], low[:, 2] - centre[2]))
    assert (np.abs(angles) > 15).all() and (np.abs(angles) > 170).any()


@pytest.mark.parametrize("pose", ["standing", "sitting", "lying"])
def test_hair_is_closed_and_outside_the_head(pose: str) -> None:
    person = wearer(pose)
    moved = np.linalg.norm(scalp(person, LONG) - person.points, axis=1)
    assert moved.max() == pytest.approx(LONG.volume_m) and not moved[~person.of("head")].any()
    sellion, nuchale = (load_landmarks("open").vertices[LANDMARKS.index(name)] for name in ("Sellion", "Nuchale"))
    assert moved[sellion] == 0 < moved[nuchale]
    ball, hair = bun(person, BUN), long_hair(person, LONG)
    assert volume(ball) == pytest.approx(4 / 3 * np.pi * 0.75 * BUN.size_m**3, rel=0.06)
    assert volume(hair) > 0 and hair.vertices[:, 1].min() > person.floor
    if pose == "standing":
        neck = person.points[person.of("neck01")].mean(axis=0)
        assert hair.vertices[:, 1].min() < neck[1] - 0.1  # falls below the neck, behind the body
        assert ball.vertices.mean(axis=0)[2] < person.points[person.of("head")].mean(axis=0)[2]


@pytest.mark.parametrize("pose", ["standing", "sitting", "lying"])
def test_shoes_enclose_feet_and_have_soles(pose: str) -> None:
    person = wearer(pose)
    for side in ("L", "R"):
        solid = shoe(person, SHOES, side)  # type: ignore[arg-type]
        assert 0.0008 < volume(solid) < 0.004
        toes = person.points[person.of("toe", side=side)]  # type: ignore[arg-type]
        assert (solid.vertices.max(axis=0) > toes.max(axis=0)).all()
        assert (solid.vertices.min(axis=0) < toes.min(axis=0)).all()
    if pose == "standing":
        assert solid.vertices[:, 1].min() == pytest.approx(person.floor - SHOES.sole_m, abs=0.01)


@pytest.mark.parametrize("kind", ["bag", "bottle", "stick", "box"])
def test_things_are_at_the_hand(kind: Kind) -> None:
    person = wearer("standing")
    found = held_thing(person, Held(kind, "L", 0.3))
    assert found and all(volume(piece) > 0 for piece in found)
    palm = person.points[person.places.on("palm", "L")].mean(axis=0)
    corners = np.concatenate([piece.vertices for piece in found])
    assert (corners.min(axis=0) < palm + 0.06).all() and (corners.max(axis=0) > palm - 0.06).all()
    fist = gripping(POSES["standing"], Held(kind, "R")).right_arm.fist
    assert 0 < fist <= 1 and gripping(POSES["standing"], Held("backpack")) == POSES["standing"]


def test_a_backpack_is_on_the_back_unless_its_wearer_lies_on_it() -> None:
    person = wearer("standing")
    (pack,) = held_thing(person, Held("backpack"))
    back = person.points[person.places.on("upper back")]
    assert pack.vertices[:, 2].mean() < back[:, 2].mean() and volume(pack) > 0.005
    assert not held_thing(wearer("lying"), Held("backpack"))


def test_padded_blocks_have_their_size() -> None:
    block = padded((0.3, 0.4, 0.1))
    np.testing.assert_allclose(np.ptp(block.vertices, axis=0), (0.3, 0.4, 0.1), atol=1e-12)
    assert 0.75 * 0.012 < volume(block) < 0.012


@pytest.mark.parametrize(
    ("pose", "attire", "place"),
    [
        ("standing", Attire(SKIRT, LONG, SHOES, Held("bag", "R", 0.2)), 0.0726245),
        ("sitting", Attire(COAT, BUN, None, Held("box", "L", 0.4)), 0.1568558),
        ("lying", Attire(SKIRT, BUN, SHOES, Held("stick", "R", 0.7)), 0.0359706),
        ("kicking", Attire(None, LONG, None, Held("bottle", "L", 0.5)), 0.2166814),
        ("standing", Attire(COAT, None, SHOES, Held("backpack")), 0.0547125),
    ],
)
def test_what_is_worn_stays_as_it_was(pose: str, attire: Attire, place: float) -> None:
    """Other points are other bodies of sets: raise CLOTHES_VERSION."""
    body = wearer(pose)
    drape = None if attire.drape is None else draped(body, attire.drape)
    vertices, _, _ = joined(body.points, adult()[0].faces, put_on(body, attire, drape))
    assert mean_by_place(vertices) == pytest.approx(place, abs=1e-6)


def test_all_of_it_on_a_body_is_a_mesh_and_takes_the_labels_beneath() -> None:
    person, _ = adult()
    worn = put_on(
        wearer("standing"), Attire(SKIRT, LONG, SHOES, Held("bag", "R", 0.2)), draped(wearer("standing"), SKIRT)
    )
    vertices, faces, pieces = joined(wearer("standing").points, person.faces, worn)
    mesh = Mesh("dressed", vertices, faces)
    assert [bool(piece.parts) for piece in pieces] == [True] * 4 + [False] * 4
    assert len(set(mesh.pieces()[[piece.vertex for piece in pieces]])) == len(pieces)
    hand = LANDMARKS.index("Lt. Dactylion")
    assert not any(hand in piece.parts for piece in pieces)


def test_vertices_amid_edges_move_with_the_scalp() -> None:
    person, _ = adult()
    body = wearer("standing")
    ends = find_edges(person.faces).ends[::7]
    finer = np.concatenate([body.points, body.points[ends].mean(axis=1)])
    vertices, _, _ = joined(finer, person.faces, put_on(body, Attire(hair=BUN), None))
    amid = vertices[len(body.points) :][: len(ends)]
    np.testing.assert_allclose(amid, vertices[ends].mean(axis=1), atol=0.003)
    assert np.abs(amid - finer[len(body.points) :]).max() > 0.004


def test_attire_is_drawn_like_a_crowd_and_keeps_clear_of_hands() -> None:
    draws = Draws(0, 0, "tests/worn").generator("attire")
    free = [drawn_attire(draws, ("in the air", "free"), True) for _ in range(600)]
    share = {
        name: np.mean([getattr(one, name) is not None for one in free]) for name in ("drape", "hair", "shoes", "held")
    }
    assert share == pytest.approx({"drape": 0.56, "hair": 0.37, "shoes": 0.6, "held": 0.4}, abs=0.07)
    assert mean_by_place(numbers_in(free)) == pytest.approx(0.6165609, abs=1e-6), "raise CLOTHES_VERSION"
    coats = [one.drape.open_deg > 0 for one in free if one.drape is not None and one.drape.top > 0.9]
    assert np.mean(coats) == pytest.approx(0.5, abs=0.15)
    touching = [drawn_attire(draws, ("palm on thigh", "palm on crown"), True) for _ in range(100)]
    assert {(one.drape, one.hair) for one in touching} == {(None, None)}
    assert {one.held.kind for one in touching if one.held is not None} == {"backpack"}
    bare = [drawn_attire(draws, ("in the air", "free"), False) for _ in range(100)]
    assert {(one.drape, one.shoes) for one in bare} == {(None, None)}


def test_clothes_under_a_drape_do_not_show_beneath_it() -> None:
    assert under(SKIRT, OUTFITS["B"]).leg == 0.2
    assert under(COAT, OUTFITS["B"]).sleeve == 0.95 and under(COAT, OUTFITS["B"]).leg == OUTFITS["B"].leg
