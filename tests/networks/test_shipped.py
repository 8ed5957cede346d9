"""The network in the box: small, described, and as good as its card says on bodies that it never saw."""

from __future__ import annotations

import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch

from bodyseg_data import RangeImages, load_template
from bodyseg_data.artifacts import load_sensor_model
from bodyseg_data.bodies.sources.open_bodies import OpenBodies
from bodyseg_data.core import BadConfig
from bodyseg_data.packing import Packing, pack
from bodyseg_data.packing.options import evenly_sampled
from bodyseg_data.rigs import Camera, load_rig
from bodyseg_data.samples import ViewGrid
from bodyseg_model.evaluation import evaluate
from bodyseg_model.networks import SHIPPED, checkpoints, load_network, predict
from bodyseg_model.networks.registry import predict_dense
from bodyseg_model.segmentation import Segmenter


def test_the_shipped_network_is_small_and_says_where_it_is_from() -> None:
    assert SHIPPED.stat().st_size <= 5_000_000
    trained = load_network()
    card = trained.card
    assert trained.rig == load_rig()
    artifacts = card["sensor"]["artifacts"]
    assert [each["artifact"] for each in artifacts] == [
        *(each.name for each in load_sensor_model()), "mixed_pixels", "losses"
    ]  # fmt: skip
    assert [each.name for each in trained.sensor] == [each["artifact"] for each in artifacts]
    shares = card["mean_of"]
    assert [each["share"] for each in shares] == [0.5, 0.25, 0.25]
    assert card["pretrained"]["weights_sha256"] == shares[0]["weights_sha256"]
    assert shares[2]["command"] == card["command"] and shares[2]["commit"] == card["commit"]
    assert {"rig", "sensor", "weights_sha256"} <= card.keys()
    assert card["network"] == "compact"
    assert card["variant"] == "all"
    for name in ("command", "commit", "hardware", "recipe", "data", "scores"):
        assert card[name], name
    assert card["scores"]["average_per_class_accuracy"] > 0.8


def test_the_large_network_says_where_it_is_from_and_how_good_it_is() -> None:
    assert checkpoints.LARGE.stat().st_size <= 8_000_000
    large, compact = load_network("large").card, load_network("compact").card
    assert compact == load_network().card
    for name in ("rig", "sensor", "network"):
        assert large[name] == compact[name], name
    assert large["variant"] == "all, none"
    assert large["recipe"]["optimiser"] == "muon" and large["recipe"]["start_share"] == 0.5
    twice = large["pretrained"]
    once = twice["pretrained"]
    assert twice["recipe"]["start_share"] == once["recipe"]["start_share"] == 0.5
    before = once["pretrained"]["mean_of"][0]
    assert before["mean_of"][0]["mean_of"][0]["pretrained"] is None
    assert {round(each["weight"], 9) for each in large["data"]["turns"]} == {6.1, 1.4}
    assert {round(each["weight"], 9) for each in twice["data"]["turns"]} == {6.0, 1.3}
    assert {each["weight"] for each in once["data"]["turns"]} == {4.4, 1.3}
    for name in ("command", "commit", "hardware", "data", "least_confidence_of_people"):
        assert large[name], name
    scores = [card["scores"]["average_per_class_accuracy"] for card in (compact, large)]
    assert scores[0] < scores[1]


def test_what_lies_under_the_name_of_a_network_that_ships_comes_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for file in (checkpoints.LARGE, checkpoints.FINDER):
        assert load_network(file.stem).card == load_network(file).card
    with pytest.raises(BadConfig, match="runs/large"):
        load_network("runs/large")
    (tmp_path / "large").mkdir()
    with pytest.raises(BadConfig, match="large/network"):
        load_network("large")


def test_only_compact_ships_with_places() -> None:
    camera = Camera(60, 80, 100.0, (40.0, 30.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    with pytest.raises(BadConfig, match="that of `compact` ships"):
        Segmenter(load_network("large", dense=True).network, camera, dense=True)


def test_the_head_of_places_that_ships_changes_no_label() -> None:
    plain, dense = load_network(), load_network(dense=True)
    assert dense.network.on_template and not plain.network.on_template
    rows, columns = np.mgrid[:640, :329]
    range_m = np.where(np.hypot((rows - 320) / 280, (columns - 164) / 90) < 1, 2.5, 0).astype(np.float32)
    image = torch.from_numpy(range_m)[None, None]
    labels = predict(plain.network, image)
    found, numbers = predict_dense(dense.network, image, by_part=False)
    assert torch.equal(labels.labels, found.labels) and torch.equal(labels.confidence, found.confidence)
    assert ((numbers[0] < len(load_template().points)) == (range_m > 0)).all()


def test_a_damaged_head_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copied = tmp_path / SHIPPED.name
    for file in (SHIPPED, checkpoints.PLACES):
        for suffix in (".safetensors", ".json"):
            shutil.copy(file.with_suffix(suffix), tmp_path)
    head = tmp_path / checkpoints.PLACES.name
    monkeypatch.setattr(checkpoints, "SHIPPED", copied)
    monkeypatch.setattr(checkpoints, "PLACES", head)
    assert load_network(dense=True).network.on_template
    head.write_bytes(head.read_bytes()[:-1] + b"x")
    with pytest.raises(BadConfig, match="compact_places.safetensors is damaged"):
        load_network(dense=True)
    assert not load_network().network.on_template


def test_the_shipped_network_knows_people_it_never_saw(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two bodies of the test split, with all artifacts: four images, which scatter about the card's score."""
    listed = [body for body in evenly_sampled(OpenBodies().bodies(), 7) if body.split == "test"]
    assert len(listed) == 2
    monkeypatch.setattr(OpenBodies, "bodies", lambda self: listed)
    bodies = Packing("open", views=ViewGrid((215, 295), azimuths=2, span_deg=180, count=2))
    with ThreadPoolExecutor(1) as executor:
        pack(bodies, tmp_path / "shards", executor, 1)
    images = RangeImages(tmp_path / "shards", "all", "test")
    found = evaluate(load_network().network, images, confidences=False)
    assert found.total().confusion.average_per_class_accuracy() > 0.75
