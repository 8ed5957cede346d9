"""The gallery: an even choice, surfaces shaded as they lie, one picture from several sets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bodyseg_data.commands import cli
from bodyseg_data.core import BadConfig
from bodyseg_data.drawing import choose_views
from bodyseg_data.drawing.gallery import COLUMNS, surface_shading
from bodyseg_data.rigs import load_rig

CAMERA = load_rig().camera


def keys(meshes: dict[str, int], views: int = 3) -> list[str]:
    return [
        f"open-{subject}-mesh-{mesh:02d}-d215-a{10 * view:03d}"
        for subject, count in meshes.items()
        for mesh in range(count)
        for view in range(views)
    ]


def test_a_choice_is_even_over_subjects_and_meshes() -> None:
    names = keys({"A": 40, "B": 3, "P000": 20, "P001": 20})
    chosen = [names[index] for index in choose_views(names, 18)]
    assert len(set(chosen)) == 18
    subjects = [name.split("-")[1][0] for name in chosen]
    assert {name: subjects.count(name) for name in "ABP"} == {"A": 6, "B": 6, "P": 6}
    of_a = [int(name.split("-")[3]) for name in chosen if name.startswith("open-A")]
    assert np.diff(of_a).min() >= 6  # 40 meshes in 6 equal stretches
    of_b = [name.split("-")[3] for name in chosen if name.startswith("open-B")]
    assert sorted(of_b) == ["00", "00", "01", "01", "02", "02"]


def test_a_choice_is_the_same_every_time_and_takes_all_if_asked() -> None:
    names = keys({"A": 4, "B": 1})
    assert choose_views(names, 7) == choose_views(names, 7)
    assert sorted(choose_views(names, len(names))) == list(range(len(names)))


@pytest.mark.parametrize("count", [0, 16])
def test_a_choice_of_more_than_there_is_is_refused(count: int) -> None:
    with pytest.raises(BadConfig, match=f"1 to 15 views, found {count}"):
        choose_views(keys({"A": 5}), count)


def test_views_from_above_and_turned_are_views_of_the_same_mesh() -> None:
    names = [f"open-A-mesh-0{mesh}-d215-a000{more}" for mesh in range(3) for more in ("", "-p-30", "-p010-r005-h-20")]
    chosen = [names[index] for index in choose_views(names, 3)]
    assert sorted(name.split("-")[3] for name in chosen) == ["00", "01", "02"]


def test_keys_of_another_kind_are_chosen_evenly() -> None:
    assert choose_views([f"scene-{number:03d}" for number in range(9)], 3) == [1, 4, 7]


def test_shading_follows_the_surface() -> None:
    rows, columns = np.mgrid[0 : CAMERA.rows, 0 : CAMERA.columns]
    x = (columns + 0.5 - CAMERA.centre_px[0]) / CAMERA.focal_px
    y = (rows + 0.5 - CAMERA.centre_px[1]) / CAMERA.focal_px
    normal = np.array([0.5, -0.3, -0.8])  # towards the camera, up and to the right
    depth = 2.5 * normal[2] / (normal[0] * x + normal[1] * y + normal[2])
    image = np.rint(depth * 1e4).astype(np.uint16)
    image[:100] = 0
    shade = surface_shading(image, 1e-4, CAMERA)
    light = np.array([-0.3, -0.45, -1.0])
    expected = normal @ light / np.linalg.norm(normal) / np.linalg.norm(light)
    assert np.all(shade[:100] == 0)
    np.testing.assert_allclose(shade[100:], expected, atol=0.03)


def test_a_step_in_range_does_not_darken_its_edge() -> None:
    image = np.full((20, 20), 20000, np.uint16)
    image[:, 10:] = 30000
    shade = surface_shading(image, 1e-4, CAMERA)
    assert shade.min() > 0.8


def test_one_picture_of_two_sets(figures_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "gallery.png"
    assert cli.main(["gallery", str(figures_set), str(figures_set), "--views", "14", "--out", str(out)]) == 0
    with Image.open(out) as picture:
        colours = np.asarray(picture.convert("RGB"))
    assert colours.shape[1] > COLUMNS * 150
    assert (colours.max(axis=2).astype(int) - colours.min(axis=2) > 100).mean() > 0.02  # parts in their colours
    assert cli.main(["gallery", str(figures_set), "--out", str(tmp_path / "all.png")]) == 0  # 24 are there, not 48
    assert cli.main(["gallery", str(figures_set), "--out", str(tmp_path / "gallery.jpg")]) == 2
    assert "must be a .png file" in capsys.readouterr().err
