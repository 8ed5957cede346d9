"""Networks in files: what goes in comes out, and what is wrong is named."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from bodyseg_data.core.errors import BadConfig
from bodyseg_model.networks.checkpoints import load_network, read_json, read_tensors, save_network, write_tensors
from bodyseg_model.networks.registry import build

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
        trained = load_network(path)
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
    tensors = read_tensors(file)
    tensors.pop("head.bias")
    write_tensors(file, tensors)


def change_weights(file: Path, change: Callable[[torch.Tensor], torch.Tensor]) -> None:
    tensors = read_tensors(file)
    tensors["head.bias"] = change(tensors["head.bias"])
    write_tensors(file, tensors)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda file: file.unlink(), "cannot read .*network.safetensors: No such file"),
        (lambda file: file.with_suffix(".json").unlink(), "cannot read .*network.json: No such file"),
        (lambda file: file.write_bytes(file.read_bytes()[:-9]), "is not a whole safetensors file"),
        (lambda file: file.write_bytes(b""), "is not a whole safetensors file"),
        (lambda file: file.with_suffix(".json").write_text("{"), "is not JSON"),
        (lambda file: file.with_suffix(".json").write_text("[]"), "must hold a JSON object, found list"),
        (lambda file: rewrite_card(file, format="x"), "the format must be 'bodyseg network 1', found 'x'"),
        (lambda file: rewrite_card(file, network=3), "must name the network and its settings"),
        (lambda file: rewrite_card(file, network="unet"), "the network must be one of"),
        (lambda file: rewrite_card(file, settings={"widths": [8]}), "blocks must be numbers"),
        (lambda file: rewrite_card(file, settings={**TINY, "widths": [8]}), "must be torch.float32 .*, found"),
        (drop_weights, "lacks the weights 'head.bias'"),
        (
            lambda file: write_tensors(file, {**read_tensors(file), "x": torch.zeros(1)}),
            "has no use for the weights 'x'",
        ),
        (lambda file: change_weights(file, lambda bias: bias * float("nan")), "holds numbers that are not finite"),
        (lambda file: change_weights(file, lambda bias: bias.double()), "found torch.float64"),
    ],
)
def test_damage_is_named(file: Path, damage: Callable[[Path], Any], message: str) -> None:
    damage(file)
    with pytest.raises(BadConfig, match=message):
        load_network(file)


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
