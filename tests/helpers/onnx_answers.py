"""Frames, and the answers of ONNX graphs to them beside those of torch."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
import torch

from bodyseg_model.networks import Network, predict
from bodyseg_model.runtimes.onnx_files import OnnxModel


def frames(images: int = 2) -> torch.Tensor:
    """A slope with holes in a part of each image, whose sides are no multiples of anything."""
    draws = torch.rand(images, 1, 211, 149, generator=torch.Generator().manual_seed(1))
    range_m = torch.zeros_like(draws)
    part = np.s_[:, :, 90:170, 75:131]
    slope = torch.linspace(2, 3, 80)[:, None]
    range_m[part] = torch.where(draws[part] < 0.8, slope + 0.1 * draws[part], 0)
    return range_m


def ask(model: OnnxModel, range_m: torch.Tensor) -> list[Any]:
    session = import_module("onnxruntime").InferenceSession(
        model.graph.SerializeToString(), providers=["CPUExecutionProvider"]
    )
    found: list[Any] = session.run(["labels", "confidence"], {"range_m": range_m.numpy()})
    return found


def check_answer(network: Network, model: OnnxModel, range_m: torch.Tensor) -> None:
    expected = predict(network, range_m)
    labels, confidence = ask(model, range_m)
    assert labels.dtype == np.uint8 and confidence.dtype == np.float32
    assert np.mean(labels != expected.labels.numpy()) < 1e-4  # two best classes that differ by their rounding
    assert np.array_equal(labels == 255, range_m[:, 0].numpy() == 0)
    np.testing.assert_allclose(confidence, expected.confidence.numpy(), atol=2e-4)
