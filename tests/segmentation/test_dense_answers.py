"""Dense answers: the point of the template that each pixel shows, beside labels that they do not change."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from numpy.typing import NDArray
from PIL import Image

from bodyseg_data import load_template
from bodyseg_data.core import BadConfig
from bodyseg_data.labels import BACKGROUND, NOWHERE, PARTS33
from bodyseg_data.rigs import Camera
from bodyseg_model.commands import main
from bodyseg_model.networks import FlipAverage, Network, Trained, build, load_network, predict, save_network
from bodyseg_model.networks.body_map import UNIT_M, place_table, point_grids
from bodyseg_model.networks.labelling import number_pixels
from bodyseg_model.networks.registry import predict_dense
from bodyseg_model.runtimes import on_backend
from bodyseg_model.segmentation import Background, CarriedLabels, FrameLabeller, Segmenter, view_body

LENS = Camera(60, 80, 100.0, (40.0, 30.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
KEEP = Background("keep")
TINY = {"patch": 16, "widths": [8], "blocks": [1], "template": True}
REFUSED = "dense answers need a network with places on the template, computed by torch"


def network() -> Network:
    return build("compact", TINY, 3).eval()


def standing() -> NDArray[np.float32]:
    frame = np.zeros((60, 80), np.float32)
    frame[10:50, 20:34] = 2 + np.linspace(0, 0.3, 14, dtype=np.float32)
    return frame


def cubes(places: NDArray[np.float32], of: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Numbers of places [N, 3] in the grid of each one's part, or in the only one."""
    grids = point_grids(bool(of.any()))
    found = np.empty(len(places), np.uint16)
    for number, (place, part) in enumerate(zip(places, of, strict=True)):
        shape = grids.shape[part]
        at = np.clip((place - grids.corner[part]) / grids.side, 0, shape - 1).astype(int)
        found[number] = grids.numbers[grids.first[part] + np.ravel_multi_index(tuple(at), tuple(shape))]
    return found


@pytest.mark.parametrize("by_part", [False, True])
def test_the_grids_have_a_point_next_to_the_nearest_one(by_part: bool) -> None:
    template = load_template()
    draw = np.random.default_rng(2)
    near = draw.integers(0, len(template.points), 1000)
    places = place_table()[near] + draw.normal(0, 0.02 / UNIT_M, (1000, 3)).astype(np.float32)
    of = template.parts[near] if by_part else np.zeros(1000, np.uint8)
    found, own = cubes(places, of), [template.parts == part if by_part else slice(None) for part in range(33)]
    away = 1000 * UNIT_M * np.linalg.norm(place_table()[found] - places, axis=1)
    pairs = zip(places, of, strict=True)
    least = [np.linalg.norm(place_table()[own[part]] - place, axis=1).min() for place, part in pairs]
    behind = away - 1000 * UNIT_M * np.array(least)
    assert behind.mean() < 2 and behind.max() < 1000 * np.sqrt(3) * 0.016
    assert not by_part or np.array_equal(template.parts[found], of)


@pytest.mark.parametrize("by_part", [False, True])
def test_pixels_get_the_numbers_of_interpolated_places(by_part: bool) -> None:
    draw = np.random.default_rng(3)
    places = draw.uniform(-1.2, 1.2, (2, 9, 7, 3)).astype(np.float32)  # beyond the grids, too
    places[0, 4, 3, 1] = np.nan
    range_m = np.where(draw.random((2, 34, 28)) < 0.7, 2, 0).astype(np.float32)
    labels = np.where(range_m > 0, draw.integers(1, 33, range_m.shape), BACKGROUND).astype(np.uint8)
    numbers = np.full(range_m.shape, NOWHERE, np.uint16)
    number_pixels(places, range_m, 4, labels if by_part else None, numbers)
    full = F.interpolate(torch.from_numpy(places).permute(0, 3, 1, 2), scale_factor=4, mode="bilinear")
    full = full.permute(0, 2, 3, 1).numpy()[:, :34]
    seen = (range_m > 0) & ~np.isnan(full).any(-1)
    assert 20 < ((range_m > 0) & ~seen).sum() < 64
    of = labels[seen] if by_part else np.zeros(seen.sum(), np.uint8)
    expected = cubes(full[seen], of)
    assert (numbers[seen] == expected).mean() > 0.999  # sums are rounded in another order
    assert (numbers[~seen] == NOWHERE).all()


def test_labels_are_the_same_bits_beside_points() -> None:
    frame, plain = standing(), Segmenter(network(), LENS, KEEP, either_way=False)
    seen, told = plain(frame), Segmenter(network(), LENS, KEEP, dense=True, either_way=False)(frame)
    assert np.array_equal(seen.labels, told.labels) and np.array_equal(seen.confidence, told.confidence)
    assert (seen.template == NOWHERE).all() and seen.bodies[0].places is None
    template = told.template
    assert template.dtype == np.uint16 and np.array_equal(template == NOWHERE, told.labels == BACKGROUND)
    view = view_body(frame, np.flatnonzero(frame), LENS, plain.rig)
    range_m = torch.from_numpy(view.range_m)[None, None]
    prediction, numbers = predict_dense(network(), range_m, by_part=True)
    assert torch.equal(prediction.labels, predict(network(), range_m).labels)
    assert np.array_equal(template[frame > 0], view.back(numbers[0])) and len(np.unique(template)) > 3
    assert np.array_equal(load_template().parts[template[frame > 0]], told.labels[frame > 0])
    other = Segmenter(network(), LENS, KEEP, label_map=replace(PARTS33, name="own"), dense=True)(frame)
    assert np.array_equal(other.labels, told.labels) and not np.array_equal(other.template, template)


def test_points_turn_back_with_labels_and_go_where_a_pixel_has_no_label() -> None:
    frame = standing()
    upright = Segmenter(network(), LENS, KEEP, dense=True)(frame)
    sideways = Camera(80, 60, 100.0, (30.0, 40.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    turned = Segmenter(network(), sideways, KEEP, quarters=1, dense=True)(np.rot90(frame, 1).copy())
    assert np.array_equal(np.rot90(turned.template, -1), upright.template)
    least = float(np.median(upright.confidence[frame > 0]))
    some = Segmenter(network(), LENS, KEEP, least_confidence=least, dense=True)(frame)
    kept = upright.confidence >= least
    assert (
        np.array_equal(some.template, np.where(kept, upright.template, NOWHERE)) and 0 < kept.sum() < (frame > 0).sum()
    )


def test_points_of_a_video_are_of_the_part_that_is_shown_and_nearest_to_the_networks() -> None:
    template, frame = load_template(), standing()
    draw = np.random.default_rng(4)
    frames = [np.where(frame > 0, frame + draw.normal(0, 0.02, frame.shape), 0).astype(np.float32) for _ in range(4)]
    steadied = Segmenter(network(), LENS, KEEP, video=CarriedLabels(), quarters=2, dense=True)
    alone = Segmenter(network(), LENS, KEEP, quarters=2, dense=True)
    other = 0
    for each in frames:
        seen, told = alone(each), steadied(each)
        for label, point, given in zip(
            told.labels[frame > 0], told.template[frame > 0], seen.template[frame > 0], strict=True
        ):
            own = np.flatnonzero(template.parts == label)
            away = np.linalg.norm(template.points[own] - template.points[given], axis=1)
            assert template.parts[point] == label
            assert np.linalg.norm(template.points[point] - template.points[given]) < away.min() + 1e-6
        other += np.count_nonzero(seen.labels != told.labels)
    assert other > 20  # labels that the frames before changed


def test_a_mirror_image_has_the_mirrored_places() -> None:
    both = FlipAverage(network())
    range_m = torch.zeros(1, 1, 64, 48)
    range_m[..., 8:56, 8:30] = 2 + torch.rand(48, 22, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        own, mirrored = (both.scores_and_places(each) for each in (range_m, range_m.flip(3)))
        assert torch.equal(own[:, :33], both.scores(range_m))
        alone = network().scores_and_places(range_m)
    across, other = own[:, 33:34], own[:, 34:]
    assert torch.allclose(across, -mirrored[:, 33:34].flip(3), atol=1e-5)
    assert torch.allclose(other, mirrored[:, 34:].flip(3), atol=1e-5) and not torch.allclose(own, alone)
    quick = on_backend(network(), "torch", "bfloat16")
    with torch.inference_mode():
        assert torch.allclose(quick.scores_and_places(range_m).float(), alone, atol=0.05)


def test_a_network_without_places_is_refused() -> None:
    plain = build("compact", {**TINY, "template": False}, 3).eval()
    for one in (plain, FlipAverage(plain)):
        with pytest.raises(
            BadConfig,
            match=rf"^{REFUSED}: that of `compact` ships, `train --settings '.*'` trains one$",
        ):
            Segmenter(one, LENS, KEEP, dense=True)
        with pytest.raises(BadConfig, match="must have a head of places on the template"):
            one.scores_and_places(torch.zeros(1, 1, 16, 16))
    with pytest.raises(BadConfig, match=f"^{REFUSED}"):
        FrameLabeller(load_network(), KEEP, dense=True)(standing(), LENS)


def test_the_network_that_ships_knows_places() -> None:
    answer = FrameLabeller(background=KEEP, dense=True)(standing(), LENS)
    assert ((answer.template != NOWHERE) == (answer.labels != BACKGROUND)).all() and answer.pixels
    assert np.array_equal(FrameLabeller(background=KEEP)(standing(), LENS).labels, answer.labels)


@pytest.mark.usefixtures("prepared")
def test_the_command_writes_an_image_of_points(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_network(tmp_path / "network.safetensors", network(), "compact", {})
    frames = tmp_path / "frames"
    frames.mkdir()
    Image.fromarray(np.round(1000 * standing()).astype(np.uint16)).save(frames / "one.png")
    words = [str(frames), "--focal", "100", "--background", "keep", "--threads", "1", "--device", "cpu", "--dense"]
    save_network(tmp_path / "plain.safetensors", build("compact", {**TINY, "template": False}, 3), "compact", {})
    assert main(["segment", *words, "--run", str(tmp_path / "plain.safetensors"), "--out", str(tmp_path / "no")]) == 2
    assert capsys.readouterr().err.startswith(f"bodyseg segment: {REFUSED}") and not (tmp_path / "no").exists()
    run = ["--run", str(tmp_path / "network.safetensors"), "--precision", "float32"]
    assert main(["segment", *words, *run, "--out", str(tmp_path / "out")]) == 0
    with Image.open(tmp_path / "out" / "template" / "one.png") as image:
        written = np.asarray(image)
    labeller = FrameLabeller(Trained(network(), load_network(tmp_path / "network.safetensors").card), KEEP, dense=True)
    answer = labeller(np.round(1000 * standing()) / np.float32(1000), LENS)
    assert image.mode.startswith("I;16") and np.array_equal(written, answer.template)
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["template"] == "anny 11 mm 1"
