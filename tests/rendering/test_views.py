"""The default renderer and Embree's rays from many cameras, each against all rays of the whole frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plain_views import check_filled, check_rays
from shapes import ball, figure

from bodyseg_data.bodies import open_source
from bodyseg_data.meshes import Mesh
from bodyseg_data.rigs import PlacedCamera, load_rig
from bodyseg_data.samples import View

RIG = load_rig()
TURNED = replace(RIG, projector=replace(RIG.projector, roll_deg=30.0))

Check = Callable[[Mesh, PlacedCamera], int]

pytestmark = pytest.mark.parametrize("check", [check_filled, check_rays])


@pytest.mark.parametrize(("azimuth", "distance"), [(0, 295), (40, 150), (215, 295)])
def test_shapes_from_all_round(check: Check, azimuth: int, distance: int) -> None:
    for mesh in (ball(subdivisions=1), figure()):
        for camera in RIG.placed(mesh.centre, View(distance, azimuth)):
            assert check(mesh, camera) > 5000


@pytest.mark.parametrize("view", [View(215, 40, -35, 25, 10), View(215, 130, 20, -160), View(255, 10, -90)])
def test_shapes_from_above_and_below_and_turned(check: Check, view: View) -> None:
    for mesh in (ball(subdivisions=1), figure()):
        for camera in TURNED.placed(mesh.centre, view):
            assert check(mesh, camera) > 5000


@pytest.mark.parametrize(("index", "view"), [(30, View(295, 130)), (300, View(255, 70))])
def test_open_bodies(check: Check, index: int, view: View) -> None:
    source = open_source("open")
    mesh = source.build(source.bodies()[index]).mesh
    for camera in RIG.placed(mesh.centre, view):
        assert check(mesh, camera) > 10_000


def test_a_real_frame(check: Check, mit_folder: Path) -> None:
    source = open_source("mit", mit_folder)
    mesh = source.build(source.bodies()[0]).mesh
    for camera in RIG.placed(mesh.centre, View(255, 70)):
        assert check(mesh, camera) > 10_000


def test_bodies_cut_by_every_side_of_frames_of_any_size(check: Check) -> None:
    mesh = figure()
    placed = RIG.placed(mesh.centre, View(215, 20))[0]
    draw = np.random.default_rng(7)
    seen = 0
    for _ in range(25):
        rows, columns = draw.integers(1, 200, 2)
        x, y = draw.uniform(-200, 400, 2)
        device = replace(placed.camera, rows=int(rows), columns=int(columns), centre_px=(float(x), float(y)))
        seen += check(mesh, replace(placed, camera=device)) > 0
    assert 6 < seen < 25, "some frames hold a part of the body, some nothing"
