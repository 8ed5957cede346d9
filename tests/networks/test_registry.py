"""The registry of networks: every entry keeps the protocol, and a new one is one new file and one line."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from benches.model.chosen import parameters
from folders import HELPERS
from kernel_forms import computed_by
from toy_network import Toy

from bodyseg_data.core import BadConfig, MissingLibrary
from bodyseg_data.machine import torch_threads
from bodyseg_model.networks import Network, build, network_class, predict, predict_each, registry
from bodyseg_model.networks.names import NETWORKS
from bodyseg_model.training.loss import NetworkWithLoss
from bodyseg_model.training.recipes import PRESETS

PACKAGE = Path(registry.__file__).parents[1]

SMALL: dict[str, dict[str, Any]] = {
    "fcn_alexnet": {"width": 1 / 16},
    "compact": {"patch": 8, "widths": [6, 8], "blocks": [0, 1]},
}
"""Settings that make a network small; a name that is not here is tested with its defaults."""


def small(name: str) -> Network:
    try:
        return build(name, SMALL.get(name), seed=2).eval()
    except MissingLibrary as error:
        pytest.skip(str(error))


def figure(rows: int, columns: int) -> torch.Tensor:
    range_m = torch.zeros(1, 1, rows, columns)
    range_m[:, :, rows // 4 : -rows // 4, columns // 4 : -columns // 4] = 2.5
    return range_m


@pytest.mark.parametrize("name", NETWORKS)
def test_every_network_keeps_the_protocol(name: str) -> None:
    network, range_m = small(name), figure(70, 45)
    assert type(network) is network_class(name)
    assert network.default_recipe in PRESETS
    step = network.output_stride
    with torch.no_grad():
        assert network.scores(range_m).shape == (1, 33, -(-70 // step), -(-45 // step))
        full = network(range_m)
        assert full.shape == (1, 33, 70, 45)
        rows, columns = torch.tensor([0, 7, 69]), torch.tensor([3, 44])
        if step == 1:
            torch.testing.assert_close(network.scores_at(range_m, rows, columns), full[:, :, rows][..., columns])
    labels = predict(network, range_m).labels
    assert torch.equal(labels == 255, range_m[:, 0] == 0)
    with pytest.raises(BadConfig, match=r"range images must be \[B, 1, H, W\]"):
        network(torch.zeros(1, 2, 8, 8))
    for dtype in (torch.float64, torch.int64):
        with pytest.raises(BadConfig, match=f"^range images must be float32, found {dtype}$"):
            predict(network, range_m.to(dtype))


@pytest.mark.parametrize("name", NETWORKS)
def test_settings_are_json_that_makes_the_same_network(name: str) -> None:
    network = small(name)
    settings = json.loads(json.dumps(network.settings))
    assert settings == network.settings and SMALL.get(name, {}).items() <= settings.items()
    again = build(name, settings, seed=2).eval()
    assert all(torch.equal(one, two) for one, two in zip(network.parameters(), again.parameters(), strict=True))
    assert all(f"{key}={value!r}" in repr(network) for key, value in settings.items())


@pytest.mark.parametrize("name", NETWORKS)
def test_every_network_is_trained_at_any_loss_stride(name: str) -> None:
    network, range_m = small(name), figure(48, 32)
    labels = torch.where(range_m[:, 0] > 0, 4, 255).to(torch.uint8)
    for stride in (1, 4):
        network.zero_grad()
        loss, counts, _ = NetworkWithLoss(network, torch.ones(33), stride)(range_m, labels, torch.tensor([0.5, 0.0]))
        loss.backward()
        assert int(counts.sum()) == int((labels != 255).sum()) // max(stride, network.output_stride) ** 2
        assert any(weight.grad is not None and weight.grad.any() for weight in network.parameters())


@pytest.mark.parametrize("name", NETWORKS)
def test_images_of_16_bits_are_labelled_as_the_same_in_32(name: str) -> None:
    network = small(name)
    for kind in (torch.float16, torch.bfloat16):
        image = figure(70, 45).to(kind)
        for found, wanted in zip(predict(network, image), predict(network, image.float()), strict=True):
            assert torch.equal(found, wanted)


def test_by_default_a_network_reads_no_pretrained_weights(tmp_path: Path) -> None:
    with pytest.raises(BadConfig, match=r"Compact starts from a run's folder or a \.safetensors file, found .*a\.onnx"):
        small("compact").load_pretrained(tmp_path / "a.onnx")


def test_scores_of_chosen_pixels_are_those_of_all() -> None:
    class Plain(Network):
        def scores(self, range_m: torch.Tensor) -> torch.Tensor:
            return range_m * torch.arange(33.0)[:, None, None]

    network, range_m = Plain(), figure(8, 6)
    rows, columns = torch.tensor([2, 5]), torch.tensor([1, 3, 4])
    assert torch.equal(network(range_m), network.scores(range_m))
    assert torch.equal(network.scores_at(range_m, rows, columns), network(range_m)[:, :, rows][..., columns])
    assert network.settings == {} and parameters(network) == 0


@pytest.mark.parametrize("together", [True, False])
def test_images_of_one_size_go_together_where_that_is_quicker(together: bool) -> None:
    numbers: list[int] = []

    class Counted(Toy):
        def scores(self, range_m: torch.Tensor) -> torch.Tensor:
            numbers.append(len(range_m))
            return super().scores(range_m)

    network = Counted().eval()
    network.together = together
    draws = np.random.default_rng(8)
    images = [draws.uniform(1, 3, shape).astype(np.float32) for shape in ((30, 20), (24, 20), (30, 20))]
    answers = predict_each(network, images)
    assert sorted(numbers) == ([1, 2] if together else [1, 1, 1])
    for image, (labels, confidence) in zip(images, answers, strict=True):
        alone = predict(network, torch.from_numpy(image)[None, None])
        np.testing.assert_array_equal(labels, alone.labels[0])
        np.testing.assert_allclose(confidence, alone.confidence[0], atol=1e-6)


def test_a_network_must_define_its_scores() -> None:
    with pytest.raises(TypeError, match="scores"):
        Network()  # type: ignore[abstract]


def test_an_unknown_network_is_refused() -> None:
    with pytest.raises(BadConfig, match="one of fcn_alexnet, compact, found 'unet'"):
        build("unet")


@contextmanager
def imported_from(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The package as it is in a folder; behind this, the modules that were there before are there again."""

    def ours() -> list[str]:
        return [name for name in sys.modules if name.split(".")[0] == PACKAGE.name]

    with monkeypatch.context() as patch:
        for name in ours():
            patch.delitem(sys.modules, name)
        patch.syspath_prepend(folder)
        try:
            yield import_module(PACKAGE.name)
        finally:
            for name in ours():
                del sys.modules[name]


def test_a_new_network_is_one_new_file_and_one_line(
    figures_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The toy network is put into a copy of the package, then trained, evaluated, exported and used by its commands."""
    copy = tmp_path / "bodyseg_model"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(HELPERS / "toy_network.py", copy / "networks" / "toy.py")
    file, before = copy / "networks" / "names.py", (PACKAGE / "networks" / "names.py").read_text()
    line = '    "compact": "bodyseg_model.networks.compact.Compact",\n'
    assert before.count(line) == 1
    file.write_text(before.replace(line, line + '    "toy": "bodyseg_model.networks.toy.Toy",\n'))

    run, data, scores = str(tmp_path / "run"), str(figures_set), str(tmp_path / "scores.json")
    toy, serial = ["--network", "toy", "--settings", '{"width": 5}'], ["--num-workers", "0"]
    short = ["--steps", "2", "--batch-size", "2", "--precision", "float32", *serial]
    commands = [
        ["train", "--data", data, *toy, *short, "--out", run],
        ["evaluate", "--data", data, "--run", run, "--frames", "2", "--json", scores, *serial],
        ["export", "--run", run, "--out", str(tmp_path / "toy.safetensors")],
    ]
    # Compiled loops of another folder would be compiled anew.
    with computed_by("numpy"), imported_from(tmp_path, monkeypatch) as package:
        assert package.__file__ == str(copy / "__init__.py")
        main = import_module("bodyseg_model.commands.cli").main
        for words in commands:
            assert main(words) == 0, words
    card = json.loads((tmp_path / "toy.json").read_text())
    assert (card["network"], card["settings"]) == ("toy", {"width": 5})
    assert card["recipe"]["steps"] == 2 and card["recipe"]["mirror"], "the recipe of compact is the default"
    found = json.loads(Path(scores).read_text())
    assert found["card"]["network"] == "toy" and found["images"] == 8


def test_a_fork_predicts_though_its_parent_has_computed_in_threads() -> None:
    network, image = Toy().eval(), torch.ones(1, 1, 512, 512)
    with torch_threads(2):
        labels = predict(network, image).labels  # from here on there are two
        child = os.fork()
        if child == 0:
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(30)  # ends a hang
            os._exit(int(torch.equal(predict(network, image).labels, labels)))
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 1
