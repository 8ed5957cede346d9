"""Training of places on the template: where they come from, how they move with their images, and what the loss adds."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from kernel_forms import by_both
from small_training import TINY, log, train

from bodyseg_data import RangeImages, load_template
from bodyseg_data.core import BadConfig
from bodyseg_data.labels import NOWHERE, PARTS33
from bodyseg_model.commands import main
from bodyseg_model.networks import UNIT_M, build, load_network, place_table
from bodyseg_model.training import GeometricAugmentation, RunOptions
from bodyseg_model.training.augmentation import augmented, mirror_draws, signed_numbers
from bodyseg_model.training.loss import PLACE_WEIGHT, NetworkWithLoss

ON_TEMPLATE = {**TINY, "template": True}
WORDS = ["--steps", "2", "--batch-size", "2", "--num-workers", "0", "--threads", "1", "--device", "cpu"]


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory, pack_figures: Callable[..., Path], quick_geodesics: None) -> Path:
    return pack_figures(tmp_path_factory.mktemp("mapped") / "set", template=True)


def test_places_are_the_template_in_a_frame_whose_mirror_image_has_the_other_sign() -> None:
    template, places = load_template(), place_table()
    assert places.dtype == np.float32 and np.abs(places).max() <= 1
    assert np.allclose(places * UNIT_M + (0, 0.9, 0), template.points, atol=1e-6)
    opposite = template.nearest(template.points * (-1, 1, 1))
    apart = np.linalg.norm(places[opposite] * (-1, 1, 1) - places, axis=1) * UNIT_M
    assert apart.max() < 0.0111, "a mirrored place lies at a point of the other side"


def test_numbers_are_those_of_the_plane() -> None:
    plane = torch.from_numpy(np.array([[[0, 1, 40_000, NOWHERE]]], np.uint16))
    assert signed_numbers(plane).tolist() == [[[[1, 2, 40_001, 0]]]]


def test_places_move_as_the_labels_of_their_pixels_do() -> None:
    keys, epochs = [f"body-{number}" for number in range(12)], [2] * 12
    numbers = torch.arange(1, 12 * 60 * 40 + 1).reshape(12, 1, 60, 40).float()
    labels = (numbers[:, 0] % 33).to(torch.uint8)
    geometric = GeometricAugmentation(roll_deg=30, zoom=0.3, stretch=0.2, cut=0.5, bust=0.4)
    seen = by_both(lambda: augmented(numbers / 10, labels, 5, epochs, keys, geometric, PARTS33, numbers))
    opposite, draws = torch.from_numpy(PARTS33.mirrored), mirror_draws(5, epochs, keys)
    for range_m, named, moved in seen:
        assert moved is not None and 3 < int(draws.sum()) < 9
        shown = moved != 0
        assert torch.equal(shown[:, 0], named != 255) and 0.2 < float(shown.float().mean()) < 0.9
        assert torch.equal(range_m, moved.abs() / 10)
        assert torch.equal((moved < 0).flatten(1).any(1), draws) and torch.equal((moved > 0).flatten(1).any(1), ~draws)
        own = (moved.abs()[:, 0] % 33).to(torch.uint8)
        own = torch.where(draws[:, None, None], opposite[own.long()], own)
        assert torch.equal(own[shown[:, 0]], named[shown[:, 0]])
    assert torch.equal(seen[0][0], seen[1][0]) and torch.equal(seen[0][2], seen[1][2])
    plain = augmented(numbers / 10, labels, 5, epochs, keys, geometric, PARTS33)
    assert torch.equal(plain[0], seen[1][0]) and torch.equal(plain[1], seen[1][1]) and plain[2] is None


def test_the_loss_adds_the_errors_of_known_places() -> None:
    torch.manual_seed(0)
    network = build("compact", ON_TEMPLATE, 1).eval()
    labels = torch.full((1, 32, 32), 255, dtype=torch.uint8)
    labels[0, 4:28:4, 8:24:4] = 7
    range_m = torch.where(labels == 255, 0.0, 2.5)[:, None] + 1
    numbers = torch.zeros(1, 1, 32, 32)
    numbers[0, 0, 4, 8], numbers[0, 0, 4, 12] = 101, -101
    objective = NetworkWithLoss(network, torch.ones(33), 4)
    with torch.no_grad():
        plain = objective(range_m, labels, torch.zeros(2))
        loss, counts, off_mm = objective(range_m, labels, torch.zeros(2), numbers)
        network.output_stride, full = (
            1,
            torch.nn.functional.interpolate(network.scores_and_places(range_m), scale_factor=4, mode="bilinear"),
        )
    true = torch.from_numpy(place_table()[100])
    off = torch.stack([full[0, 33:, 4, 8] - true, full[0, 33:, 4, 12] - true * torch.tensor([-1.0, 1, 1])])
    assert float(loss - plain.loss) == pytest.approx(PLACE_WEIGHT * float(off.abs().sum()) / 24, rel=1e-4)
    assert off_mm is not None and float(off_mm) == pytest.approx(float(off.norm(dim=1).mean()) * 1000 * UNIT_M)
    assert torch.equal(counts, plain.counts) and plain.off_mm is None


def test_a_training_learns_places_and_its_network_gives_the_scores_alone_as_well(mapped: Path, tmp_path: Path) -> None:
    images = RangeImages(mapped, "all", "train", planes=["template"])
    said = train(mapped, tmp_path / "run", settings=ON_TEMPLATE, images=images, steps=90, options=RunOptions(1, 90, 0))
    off = [each.off_mm for each in said if each.off_mm is not None]
    assert len(off) == 90 and np.mean(off[-10:]) < 0.75 * np.mean(off[:5])
    assert log(tmp_path / "run")[-1]["off_mm"] == off[-1]
    network = load_network(tmp_path / "run").network
    range_m = torch.from_numpy(np.stack([images[number]["range"] for number in range(2)]))
    with torch.inference_mode():
        both = network.scores_and_places(range_m)
        assert both.shape[1] == 36 and torch.equal(both[:, :33], network.scores(range_m))


def test_a_set_without_places_is_refused(mapped: Path, tmp_path: Path) -> None:
    foreign = RangeImages(mapped, "all", "train", planes=["template"])
    foreign.columns["template"] = replace(foreign.columns["template"], source="mine")
    for images, found in ((RangeImages(mapped, "all", "train"), "None"), (foreign, "'mine'")):
        with pytest.raises(BadConfig, match=rf"^a network with places .* 'anny 11 mm 1', found {found}: open the im"):
            train(mapped, tmp_path / "run", settings=ON_TEMPLATE, images=images)
    assert not (tmp_path / "run").exists()


def test_the_command_trains_places_and_starts_from_networks_without(
    mapped: Path, small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings, plain = json.dumps(ON_TEMPLATE), json.dumps(TINY)
    bare = ["train", "--data", str(small_set), *WORDS, "--settings", settings, "--out", str(tmp_path / "no")]
    assert main(bare) == 2
    assert capsys.readouterr().err == (
        f"bodyseg train: {small_set} has no map of the body, the column 'template': `shard --template` packs it for "
        "the open sources\n"
    )
    of_set = ["train", "--data", str(mapped), *WORDS]
    assert main([*of_set, "--settings", plain, "--out", str(tmp_path / "plain")]) == 0
    more = ["--lr", "1e-9", "--pretrained", str(tmp_path / "plain")]
    assert main([*of_set, "--settings", settings, *more, "--out", str(tmp_path / "with")]) == 0
    first, then = (load_network(tmp_path / name).network for name in ("plain", "with"))
    for name, weights in first.state_dict().items():
        if weights.is_floating_point() and "running" not in name:
            assert torch.allclose(weights, then.state_dict()[name], atol=1e-6), name
    assert log(tmp_path / "with")[-1]["off_mm"] > 0
    alone = [*of_set, "--settings", settings, "--only-template", "--out", str(tmp_path / "alone")]
    assert main(alone) == 2
    assert "--only-template trains a head for a network that is trained" in capsys.readouterr().err
    assert main([*alone, "--pretrained", str(tmp_path / "plain"), "--labels", "limbs14"]) == 2
    assert f"needs the labels of --pretrained {tmp_path / 'plain'}, 'parts33'" in capsys.readouterr().err
    assert main([*alone, "--pretrained", str(tmp_path / "plain"), "--val-share", "0.3", "--val-every", "1"]) == 0
    cards = [json.loads((tmp_path / "alone" / f"{name}.json").read_text()) for name in ("best", "network")]
    assert [card["step"] for card in cards] == [cards[1]["last_step"]] * 2 != [1, 1]
    trained = load_network(tmp_path / "alone").network.state_dict()
    assert all(torch.equal(trained[name], weights) for name, weights in first.state_dict().items())
    drawn = build("compact", ON_TEMPLATE, 0).state_dict()
    assert not any(torch.equal(trained[name], drawn[name]) for name in drawn if name.startswith("template."))
    with pytest.raises(BadConfig, match="^only_places needs .* the setting 'template', found a compact without$"):
        train(mapped, tmp_path / "none", only_places=True)
