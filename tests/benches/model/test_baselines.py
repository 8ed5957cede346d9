"""Networks of another package: the same inputs, answers and training as ours."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from benches.model.networks import baselines as rivals
from onnx_answers import check_answer, frames

from bodyseg_data.core import BadConfig, MissingLibrary
from bodyseg_model.networks import build, predict
from bodyseg_model.runtimes.onnx_files import to_onnx


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    with rivals.with_baselines():
        yield


def figure(rows: int, columns: int) -> torch.Tensor:
    range_m = torch.zeros(1, 1, rows, columns)
    range_m[:, :, rows // 4 : -rows // 4, columns // 4 : -columns // 4] = 2.5
    return range_m


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("segformer", {"size": 0, "shrink": 1}),
        ("deeplab", {"apart": 16, "shrink": 2}),
        ("deeplab", {"apart": 8, "shrink": 1}),
    ],
)
def test_any_image_gets_scores_of_its_own_size(name: str, settings: dict[str, Any]) -> None:
    pytest.importorskip("transformers")
    network = build(name, settings, seed=0).eval()
    assert network.settings == settings
    range_m = figure(70, 45)
    with torch.no_grad():
        assert network.output_stride == 4
        assert network.scores(range_m).shape == (1, 33, 18, 12)
        assert network(range_m).shape == (1, 33, 70, 45)
        torch.testing.assert_close(network(range_m), network(torch.where(range_m > 0, range_m + 1, 0.0)))
    labels = predict(network, range_m).labels
    assert torch.equal(labels == 255, range_m[:, 0] == 0)


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("segformer", {"size": 7}, "size of segformer must be 0 or 1, found 7"),
        ("deeplab", {"apart": 4}, "apart of deeplab must be 8 or 16, found 4"),
    ],
)
def test_other_settings_are_refused(name: str, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        build(name, settings)


def test_another_shrink_is_refused() -> None:
    with pytest.raises(BadConfig, match="shrink must be 1, 2 or 4, found 3"):
        rivals.Baseline(torch.nn.Identity(), 4, 3, {})


def test_without_the_package_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "transformers", None)
    with pytest.raises(MissingLibrary, match="segformer needs the package 'transformers'"):
        build("segformer")


@pytest.mark.parametrize("name", ["segformer", "deeplab"])
def test_their_onnx_graphs_answer_as_torch(name: str) -> None:
    for package in ("transformers", "onnx", "onnxruntime"):
        pytest.importorskip(package)
    network = build(name, {"shrink": 4}, seed=3).eval()
    check_answer(network, to_onnx(network), frames(1))
