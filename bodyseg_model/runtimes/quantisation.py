"""Quantisation of ONNX graphs to int8, calibrated on images: weights by channel, activations by their extremes.

Values pass between convolutions as 8-bit numbers, written in the graph as pairs of QuantizeLinear and DequantizeLinear
(QDQ), which ONNX Runtime and OpenVINO both compute in integers. The first layer and the scores stay float32.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig, check_int
from bodyseg_data.core.system.libraries import missing_library
from bodyseg_data.loading.loader import loader
from bodyseg_data.loading.range_images import RangeImages
from bodyseg_model.runtimes.graphs import RANGE, import_onnx
from bodyseg_model.runtimes.onnx_files import OnnxModel

METHOD: Final = "extremes of activations, weights by channel"
IMAGES: Final = 64
"""Images to calibrate on, by default."""


def calibrated(model: OnnxModel, images: RangeImages, count: int = IMAGES) -> OnnxModel:
    """A float32 model as int8, calibrated on `count` images, the first of their epoch's permutation.

    Raises BadConfig for a model that is int8 already or a count below 1, MissingLibrary without onnxruntime.
    """
    total = min(check_int("the number of images to calibrate on", count, 1), len(images))
    identity = images.identity()
    facts = {"set": identity["set"], "variant": images.variant, "split": images.split, "images": total}
    return quantised(model, _frames(images, total), {**facts, "method": METHOD})


def _frames(images: RangeImages, count: int) -> Iterator[NDArray[np.float32]]:
    batches = iter(loader(images, 1, 0, shuffle=True, rank=0, world_size=1))
    for _ in range(count):
        yield next(batches)["range"].numpy().copy()


def quantised(model: OnnxModel, frames: Iterable[NDArray[np.float32]], calibration: dict[str, Any]) -> OnnxModel:
    """A float32 model as int8. frames: [1, 1, H, W], metres, to calibrate on; calibration: what is said of them."""
    if model.facts.precision != "float32":
        raise BadConfig(f"a network is quantised from float32, found {model.facts.precision}")
    onnx = import_onnx()
    try:
        tools = import_module("onnxruntime.quantization")
    except ImportError as error:
        raise missing_library("quantising", error, extra="onnx") from error

    class Reader(tools.CalibrationDataReader):  # type: ignore[misc, name-defined]  # a class of a package without types
        def __init__(self) -> None:
            self._frames = iter(frames)

        def get_next(self) -> dict[str, Any] | None:
            frame = next(self._frames, None)
            return None if frame is None else {RANGE: frame}

    convolutions = [node.name for node in model.graph.graph.node if node.op_type == "Conv"]
    with tempfile.TemporaryDirectory() as folder, _quiet():
        path = Path(folder) / "int8.onnx"
        tools.quantize_static(
            model.graph,
            path,
            Reader(),
            quant_format=tools.QuantFormat.QDQ,
            op_types_to_quantize=["Conv", "Add", "Relu"],
            per_channel=True,
            activation_type=tools.QuantType.QUInt8,
            weight_type=tools.QuantType.QInt8,
            nodes_to_exclude=[convolutions[0], convolutions[-1]],
        )
        graph = onnx.load(path)
    return OnnxModel(graph, replace(model.facts, precision="int8", calibration=calibration), model.card)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the package's advice on graphs, which it logs as warnings, from users."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)
