"""Clothes over the open body: what they cover, that they stay outside, fold, and follow the pose smoothly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from bodyseg_data.bodies import open_source
from bodyseg_data.bodies.outfits import OUTFITS, Outfit
from bodyseg_data.bodies.wardrobe import FINE_M, Refinement, Wardrobe
from bodyseg_data.labels import LANDMARKS
from bodyseg_data.meshes import Mesh, load_landmarks, partition

Floats = NDArray[np.float64]

POSES = ("standing", "star", "t_pose", "deep_squat", "arms_crossed", "forward_bend", "crane")
FREE_POSES = ("star", "t_pose")  # in which no limb touches another
AT = dict(zip(LANDMARKS, load_landmarks("open").vertices, strict=True))


@pytest.fixture(scope="module")
def bodies() -> dict[str, Floats]:
    source = open_source("open")
    postures = [ref for ref in source.bodies() if ref.subset == "A"]
    return {ref.pose: source.build(ref).mesh.vertices for ref in postures if ref.pose in POSES}


@pytest.fixture(scope="module")
def faces() -> NDArray[np.int32]:
    source = open_source("open")
    return source.build(source.bodies()[0]).mesh.faces


@pytest.fixture(scope="module")
def refinement(bodies: dict[str, Floats], faces: NDArray[np.int32]) -> Refinement:
    return Refinement(bodies["standing"], faces, FINE_M)


@pytest.fixture(scope="module")
def coarse(bodies: dict[str, Floats], faces: NDArray[np.int32]) -> dict[str, Wardrobe]:
    return {name: Wardrobe(bodies["standing"], faces, OUTFITS[name]) for name in ("B", "shorts")}


@pytest.fixture(scope="module")
def fine(bodies: dict[str, Floats], refinement: Refinement) -> Wardrobe:
    return Wardrobe(refinement(bodies["standing"]), refinement.faces, OUTFITS["C"])


def roughness(vertices: Floats, faces: NDArray[np.int32], among: NDArray[np.bool_]) -> float:
    """Mean angle in degrees between neighbouring faces over the edges whose vertices are all `among` these."""
    normals = Mesh("rough", vertices, faces).normals
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    pairs, owner = pairs[order], owner[order]
    twin = np.flatnonzero((pairs[1:] == pairs[:-1]).all(axis=1) & among[pairs[1:]].all(axis=1))
    cosines = np.einsum("ij,ij->i", normals[owner[twin]], normals[owner[twin + 1]])
    return float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).mean())


def depth_inside(body: Mesh, points: Floats) -> Floats:
    """How deep points lie under the nearest place of a body's skin, metres [N]; negative outside."""
    import trimesh

    skin = trimesh.Trimesh(body.vertices, body.faces, process=False)
    nearest, _, face = trimesh.proximity.closest_point(skin, points)
    weights = body.barycentric(face, nearest)
    normals = np.einsum("nk,nkd->nd", weights, skin.vertex_normals[body.faces[face]])
    return np.asarray(-np.einsum("ij,ij->i", points - nearest, normals), np.float64)


def test_garments_cover_what_they_should(coarse: dict[str, Wardrobe], fine: Wardrobe) -> None:
    trunk = ["Substernale", "10th Rib Midspine", "Lt. ASIS", "Rt. PSIS", "Lt. Acromion", "Rt. Axilla, Post."]
    bare = ["Sellion", "Nuchale", "Supramenton", "Lt. Dactylion", "Rt. Dactylion", "Lt. Digit II", "Rt. Digit II"]
    knees = ["Lt. Knee Crease", "Rt. Femoral Lateral Epicn"]
    for wardrobe in (*coarse.values(), fine):
        assert wardrobe.covered[[AT[name] for name in trunk]].all()
        assert not wardrobe.covered[[AT[name] for name in bare]].any()
    elbows = [AT["Lt. Olecranon"], AT["Rt. Olecranon"]]
    assert fine.covered[elbows].all()
    assert not coarse["B"].covered[elbows].any()
    assert coarse["B"].covered[[AT[name] for name in knees]].all()
    assert not coarse["shorts"].covered[[AT[name] for name in knees]].any()


def test_bare_vertices_keep_every_bit(coarse: dict[str, Wardrobe], bodies: dict[str, Floats]) -> None:
    wardrobe = coarse["B"]
    before = bodies["crane"].copy()
    dressed = wardrobe.worn(before)
    assert (before == bodies["crane"]).all()
    assert dressed[~wardrobe.covered].tobytes() == before[~wardrobe.covered].tobytes()
    assert (dressed[wardrobe.covered] != before[wardrobe.covered]).any(axis=1).all()


def test_clothes_are_loose(coarse: dict[str, Wardrobe], fine: Wardrobe, bodies: dict[str, Floats]) -> None:
    for pose in ("star", "deep_squat"):
        body = bodies[pose]
        gaps = np.linalg.norm(coarse["B"].worn(body) - body, axis=1)[coarse["B"].covered]
        assert 0.01 < np.median(gaps) < 0.04
        assert 0.03 < np.quantile(gaps, 0.95) < 0.08
        assert gaps.max() < 0.15


def test_cloth_stays_outside_the_body(
    coarse: dict[str, Wardrobe], fine: Wardrobe, refinement: Refinement, bodies: dict[str, Floats],
    faces: NDArray[np.int32],
) -> None:  # fmt: skip
    for pose in FREE_POSES:
        body = Mesh(pose, bodies[pose], faces)
        cloth = coarse["B"].worn(bodies[pose])[coarse["B"].covered][::3]
        assert depth_inside(body, cloth).max() < 1e-3
        cloth = fine.worn(refinement(bodies[pose]))[fine.covered][::9]
        assert depth_inside(body, cloth).max() < 1e-3


def test_the_inside_would_be_seen(bodies: dict[str, Floats], faces: NDArray[np.int32]) -> None:
    body = Mesh("star", bodies["star"], faces)
    ahead = np.array([0, 0, 0.01])
    chest = body.vertices[[AT["Substernale"]]]
    assert depth_inside(body, chest - ahead)[0] > 5e-3
    assert depth_inside(body, chest + ahead)[0] < -5e-3


@pytest.mark.parametrize("pose", POSES)
def test_dressed_bodies_are_meshes(
    pose: str, coarse: dict[str, Wardrobe], fine: Wardrobe, refinement: Refinement, bodies: dict[str, Floats],
    faces: NDArray[np.int32],
) -> None:  # fmt: skip
    dressed = Mesh(pose, coarse["B"].worn(bodies[pose]), faces)
    assert np.linalg.norm(dressed.normals, axis=1).min() > 1e-10
    body = refinement(bodies[pose])
    refined = Mesh(pose, fine.worn(body), refinement.faces)
    assert np.linalg.norm(refined.normals, axis=1).min() > 1e-10
    among = fine.covered[refinement.faces].any(axis=1)
    agree = np.einsum("ij,ij->i", refined.normals, Mesh(pose, body, refinement.faces).normals)[among] > 0
    assert agree.mean() > 0.97  # the others are the undersides of hems and the insides of creases


def test_dressed_bodies_have_all_parts(
    coarse: dict[str, Wardrobe], bodies: dict[str, Floats], faces: NDArray[np.int32]
) -> None:
    mesh = Mesh("dressed", coarse["B"].worn(bodies["deep_squat"]), faces)
    parts = partition(mesh, load_landmarks("open").for_mesh(mesh))
    assert set(np.unique(parts.labels)) == set(range(33))


def test_a_small_step_of_the_body_moves_cloth_a_little(coarse: dict[str, Wardrobe], bodies: dict[str, Floats]) -> None:
    wardrobe, start, end = coarse["B"], bodies["standing"], bodies["deep_squat"]
    for share in (0.0, 0.3, 0.6):
        here, there = (start + at * (end - start) for at in (share, share + 1e-3))
        step = np.linalg.norm(there - here, axis=1).max()
        moved = np.linalg.norm(wardrobe.worn(there) - wardrobe.worn(here), axis=1).max()
        assert moved < 4 * step
    far = np.linalg.norm(wardrobe.worn(end) - wardrobe.worn(start), axis=1).max()
    assert far > 0.3


def test_cloth_folds(
    coarse: dict[str, Wardrobe], fine: Wardrobe, refinement: Refinement, bodies: dict[str, Floats],
) -> None:  # fmt: skip
    body = refinement(bodies["star"])
    bare = roughness(body, refinement.faces, fine.covered)
    assert roughness(fine.worn(body), refinement.faces, fine.covered) > 1.7 * bare
    plain = replace(OUTFITS["C"], slack=0, crumple=0)
    smooth = Wardrobe(refinement(bodies["standing"]), refinement.faces, plain)
    standing = refinement(bodies["standing"])
    assert roughness(fine.worn(standing), refinement.faces, fine.covered) > 1.7 * roughness(
        smooth.worn(standing), refinement.faces, fine.covered
    )
    # A bent knee shortens the cloth behind it: without any slack, folds come from the pose alone.
    knee = np.linalg.norm(standing - standing[AT["Lt. Knee Crease"]], axis=1) < 0.07
    squat = refinement(bodies["deep_squat"])
    assert roughness(smooth.worn(squat), refinement.faces, knee) > 1.5 * roughness(
        smooth.worn(standing), refinement.faces, knee
    )


def test_cloth_hangs_down(coarse: dict[str, Wardrobe], bodies: dict[str, Floats]) -> None:
    """Under a level arm a sleeve is farther off than over it; on a body upside down it is the other way round."""
    body, wardrobe = bodies["t_pose"], coarse["B"]
    arm = wardrobe.covered & (np.abs(body[:, 0]) > 0.26)
    middle = np.median(body[arm, 1])
    over, under = (arm & (sign * (body[:, 1] - middle) > 0.02) for sign in (1, -1))
    turn = np.array([1.0, -1.0, -1.0])
    for way, above, below in ((np.ones(3), over, under), (turn, under, over)):
        gaps = np.linalg.norm(wardrobe.worn(body * way) - body * way, axis=1)
        assert gaps[below].mean() > 1.5 * gaps[above].mean()


def test_the_same_bits_again(coarse: dict[str, Wardrobe], bodies: dict[str, Floats]) -> None:
    here = coarse["B"].worn(bodies["deep_squat"])
    assert here.tobytes() == coarse["B"].worn(bodies["deep_squat"]).tobytes()


def test_a_seed_is_a_set_of_folds(
    coarse: dict[str, Wardrobe], bodies: dict[str, Floats], faces: NDArray[np.int32]
) -> None:
    other = Wardrobe(bodies["standing"], faces, replace(OUTFITS["B"], seed=77)).worn(bodies["standing"])
    assert np.abs(other - coarse["B"].worn(bodies["standing"])).max() > 0.005


def test_refinement_keeps_surface_and_numbers(
    refinement: Refinement, bodies: dict[str, Floats], faces: NDArray[np.int32]
) -> None:
    body = bodies["crane"]
    fine = refinement(body)
    assert (fine[: len(body)] == body).all()
    coarse_mesh, fine_mesh = Mesh("coarse", body, faces), Mesh("fine", fine, refinement.faces)
    assert fine_mesh.signed_volume() == pytest.approx(coarse_mesh.signed_volume(), rel=1e-9)
    areas = [np.linalg.norm(mesh.normals, axis=1).sum() for mesh in (coarse_mesh, fine_mesh)]
    assert areas[0] == pytest.approx(areas[1], rel=1e-9)
    rest = refinement(bodies["standing"])
    corners = rest[refinement.faces]
    assert np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max() < 2 * FINE_M
    edges = np.sort(np.concatenate([refinement.faces[:, [0, 1]], refinement.faces[:, [1, 2]]]), axis=1)
    assert np.unique(edges, axis=0).max() == len(rest) - 1  # every vertex is used: no loose middles


def test_refinement_of_one_triangle() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0.2, 0]])
    refined = Refinement(points, np.array([[0, 1, 2]], np.int32), 0.5, rounds=1)
    assert refined(points)[3:].tolist() == [[0.5, 0, 0], [0.5, 0.1, 0]]
    assert sorted(map(sorted, refined.faces.tolist())) == [[0, 2, 3], [1, 3, 4], [2, 3, 4]]


def test_there_is_an_outfit_for_each_dressed_subject() -> None:
    assert {"B", "C"} <= set(OUTFITS)
    assert len({outfit.seed for outfit in OUTFITS.values()}) == len(OUTFITS)
    assert all(isinstance(outfit, Outfit) for outfit in OUTFITS.values())
