"""Networks in files: what goes in comes out, and what is wrong is named."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from small_rig import SMALL

from bodyseg_data.artifacts import MissingData, Noise, SensorModel, load_sensor_model
from bodyseg_data.core import BadConfig
from bodyseg_data.files import read_json, write_json
from bodyseg_data.rigs import load_rig
from bodyseg_model.networks import (
    build,
    load_network,
    save_network,
)
from bodyseg_model.networks.checkpoints import write_tensors

TINY = {"patch": 16, "widths": [4], "blocks": [1]}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    save_network(tmp_path / "network.safetensors", build("compact", TINY), "compact", {"variant": "all"})
    return tmp_path / "network.safetensors"


@pytest.mark.parametrize(
    ("name", "settings"), [("compact", TINY), ("fcn_alexnet", {"width": 0.0625, "normalise": True})]
)
def test_a_network_comes_back_as_it_was(tmp_path: Path, name: str, settings: dict[str, Any]) -> None:
    network = build(name, settings).eval()
    save_network(tmp_path / "network.safetensors", network, name, {"variant": "occ", "seed": 3})
    for path in (tmp_path, tmp_path / "network.safetensors"):
        numbers = torch.get_rng_state()
        trained = load_network(path)
        assert torch.equal(torch.get_rng_state(), numbers), "a training goes on as if nothing were loaded"
        assert trained.card["variant"] == "occ"
        assert settings.items() <= trained.card["settings"].items()
        assert not trained.network.training
        assert repr(trained).startswith(f"Trained(network={name!r}, settings={{") and "variant='occ', seed=3" in repr(
            trained
        )
        with torch.no_grad():
            range_m = torch.full((1, 1, 32, 32), 2.0)
            assert torch.equal(trained.network(range_m), network(range_m))


def test_half_the_bytes_cost_little(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = build("compact", {"patch": 16, "widths": [32, 48], "blocks": [1, 1]}).eval()
    save_network(tmp_path / "whole.safetensors", network, "compact", {})
    save_network(tmp_path / "half.safetensors", network, "compact", {}, half=True)
    sizes = [(tmp_path / f"{name}.safetensors").stat().st_size for name in ("whole", "half")]
    assert sizes[1] < 0.56 * sizes[0]
    loaded = load_network(tmp_path / "half.safetensors").network
    assert all(weight.dtype == torch.float32 for weight in loaded.parameters())
    with torch.no_grad():
        range_m = torch.rand(1, 1, 64, 64) + 2
        torch.testing.assert_close(loaded(range_m), network(range_m), atol=5e-3, rtol=5e-3)


def rewrite_card(file: Path, **changes: Any) -> None:
    card = file.with_suffix(".json")
    card.write_text(json.dumps({**json.loads(card.read_text()), **changes}))


def drop_weights(file: Path) -> None:
    tensors = load_file(file)
    tensors.pop("head.bias")
    write_tensors(file, tensors)


def forget_digest(file: Path) -> None:
    """Make the card one without the weights' SHA-256."""
    card = read_json(file.with_suffix(".json"))
    del card["weights_sha256"]
    write_json(file.with_suffix(".json"), card)


def change_weights(file: Path, change: Callable[[torch.Tensor], torch.Tensor]) -> None:
    tensors = load_file(file)
    tensors["head.bias"] = change(tensors["head.bias"])
    write_tensors(file, tensors)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda file: file.unlink(), "found .*network.safetensors, which is not there"),
        (lambda file: file.with_suffix(".json").unlink(), "cannot read .*network.json: No such file"),
        (lambda file: file.write_bytes(file.read_bytes()[:-9]), "is not a whole safetensors file"),
        (lambda file: file.write_bytes(b""), "is not a whole safetensors file"),
        (lambda file: file.with_suffix(".json").write_text("{"), "is not JSON"),
        (lambda file: file.with_suffix(".json").write_text("[]"), "must hold a JSON object, found list"),
        (lambda file: rewrite_card(file, format="x"), "the format must be 'bodyseg network 1', found 'x'"),
        (lambda file: rewrite_card(file, rig="paper"), "network.json: a stored rig must be an object, found str"),
        (lambda file: rewrite_card(file, network=3), "must name the network and its settings"),
        (lambda file: rewrite_card(file, network="unet"), "network.json: the network must be one of"),
        (lambda file: rewrite_card(file, settings={"widths": [8]}), "network.json: blocks must be numbers"),
        (lambda file: rewrite_card(file, settings={"depth": 8}), "network.json: settings of compact that it does not"),
        (lambda file: rewrite_card(file, settings={**TINY, "widths": [8]}), "must be torch.float32 .*, found"),
        (drop_weights, "lacks the weights 'head.bias'"),
        (
            lambda file: write_tensors(file, {**load_file(file), "x": torch.zeros(1)}),
            "has no use for the weights 'x'",
        ),
        (lambda file: change_weights(file, lambda bias: bias * float("nan")), "holds numbers that are not finite"),
        (lambda file: change_weights(file, lambda bias: bias.double()), "found torch.float64"),
    ],
)
def test_damage_is_named(file: Path, damage: Callable[[Path], Any], message: str) -> None:
    forget_digest(file)
    damage(file)
    with pytest.raises(BadConfig, match=message):
        load_network(file)


def test_weights_that_are_not_those_of_the_card_are_refused_with_both_digests(file: Path) -> None:
    expected = hashlib.sha256(file.read_bytes()).hexdigest()
    assert read_json(file.with_suffix(".json"))["weights_sha256"] == expected
    load_network(file)
    change_weights(file, lambda bias: bias + 1)
    found = hashlib.sha256(file.read_bytes()).hexdigest()
    with pytest.raises(BadConfig) as caught:
        load_network(file.parent)
    assert str(caught.value) == (f"{file} is damaged or not the file of its card: SHA-256 {found}, expected {expected}")
    forget_digest(file)
    load_network(file)  # a card need not hold it


def test_rig_and_sensor_are_those_of_the_card(file: Path) -> None:
    assert (load_network(file).rig, load_network(file).sensor) == (load_rig(), load_sensor_model())
    sensor = SensorModel("mine", (Noise(0.0, 5.0), MissingData((0.1,))), "My sensor")
    rewrite_card(file, rig=SMALL.to_json(), sensor=sensor.to_json())
    trained = load_network(file)
    assert (trained.rig, trained.sensor) == (SMALL, sensor)
    tree = sensor.to_json()
    rewrite_card(file, sensor={name: tree[name] for name in ("name", "artifacts")})
    assert load_network(file).sensor == replace(sensor, title="")


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        (None, "^a network's card, sensor: a stored sensor must be an object with name and artifacts, of 'bodyseg s"),
        ({"format": "x", "name": "x"}, "a stored sensor must be an object with name and artifacts, of 'bodyseg sensor"),
        ({"artifacts": []}, "a network's card, sensor: text 'name' is missing"),
        ({"format": "bodyseg sensor 1", "name": "x", "artifacts": 3}, "'artifacts' must be tables"),
        ({"format": "bodyseg sensor 1", "name": "x", "artifacts": [{"artifact": "rust"}]}, "rust"),
    ],
)
def test_a_sensor_that_cannot_be_used_is_named_when_it_is_asked_for(file: Path, sensor: Any, message: str) -> None:
    rewrite_card(file, sensor=sensor)
    trained = load_network(file)
    with pytest.raises(BadConfig, match=message):
        _ = trained.sensor


def test_only_networks_are_loaded(tmp_path: Path) -> None:
    with pytest.raises(BadConfig, match=r"a \.safetensors file, found .*network\.pth"):
        load_network(tmp_path / "network.pth")


def test_what_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(BadConfig, match="cannot write"):
        write_tensors(tmp_path / "absent" / "x.safetensors", {})


def test_files_too_large_are_not_read(tmp_path: Path) -> None:
    with (tmp_path / "x.json").open("wb") as file:
        file.truncate((1 << 31) + 1)
    with pytest.raises(BadConfig, match="is larger than"):
        read_json(tmp_path / "x.json")


def test_a_network_larger_than_its_weights_is_not_built(file: Path) -> None:
    card = file.with_suffix(".json")
    write_json(card, {**read_json(card), "settings": {"widths": [2048] * 6, "blocks": [32] * 6}})  # 58 GB
    with pytest.raises(BadConfig, match=r"network\.json: the network must fit its weights, found a larger one"):
        load_network(file)
