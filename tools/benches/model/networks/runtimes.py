"""`bench runtimes`: one network on every backend in every precision, time beside accuracy, measured in one run.

docs/how-to/runtimes.md says how to read the results.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import torch

from benches.model.chosen import chosen_network
from benches.model.networks.network_frames import as_batch, stretched, typical_frames
from benches.model.networks.network_times import warm_up
from bodyseg_data import RangeImages, example_set
from bodyseg_data.core import MissingLibrary, ProgressCallback, silent
from bodyseg_data.machine import processors, torch_threads
from bodyseg_model.evaluation import evaluate, open_images
from bodyseg_model.networks import Network, Trained, build, predict
from bodyseg_model.runtimes import Precision, load_network, on_backend, write_onnx
from bodyseg_model.runtimes.libraries import RANGE, TORCH

REFERENCE: Final = "torch float32"
PAPERS: Final = "fcn_alexnet torch float32"
"""The paper's network at full width with new weights, for times alone."""

ROUNDS: Final = 15
_WAYS: Final[tuple[tuple[str, Precision], ...]] = (
    ("torch", "float32"),
    ("torch", "bfloat16"),
    ("onnxruntime", "float32"),
    ("openvino", "float32"),
    ("openvino", "bfloat16"),
)


@dataclass(frozen=True)
class _Frame:
    name: str
    images: list[torch.Tensor]


def bench_runtimes(
    data: str,
    views: int = 3,
    images: int = 200,
    runs: Sequence[Path] = (),
    progress: ProgressCallback = silent,
) -> dict[str, Any]:
    """Milliseconds from range to labels and confidences, and accuracy, of a network on every backend and precision,
    convolutions of 8 bits among them where both runtimes are installed.

    data: set on whose test images of `all` accuracy is measured, `images` of them. views: typical frames to take turns
    with. runs: the network is in the first of them; without, it is the one that ships. Each is timed with one thread
    and with as many as there are processors, one image at a time, in turns, of which each begins untimed
    (`network_times` says why). Runtimes that are not installed are left out. Raises BadConfig for no network,
    MissingLibrary without Anny.
    """
    network_name, trained = chosen_network(runs)
    networks, left_out = _networks(trained.network), list[str]()
    for backend, precision in _WAYS:
        try:
            networks[f"{backend} {precision}"] = on_backend(trained.network, backend, precision)
        except MissingLibrary as error:
            left_out.append(f"{backend} {precision}")
            sys.stderr.write(f"{backend} is left out: {error}\n")
    if not left_out:
        in_8_bits = _in_8_bits(trained)
        networks |= {f"{backend} int8": on_backend(in_8_bits, backend) for backend in ("onnxruntime", "openvino")}
    typical = typical_frames(views)
    largest = max(typical, key=lambda frame: int((frame > 0).sum()))
    frames = [
        _Frame("filled", [as_batch(stretched(largest, *largest.shape), 1, torch.device("cpu"))]),
        _Frame("typical", [as_batch(frame, 1, torch.device("cpu")) for frame in typical]),
    ]
    counts = sorted({1, processors()})
    total, done = len(frames) * len(counts) + len(networks) - 1, 0
    times = []
    for frame in frames:
        for count in counts:
            times.append({"frame": frame.name, "threads": count, "networks": _timed(networks, frame.images, count)})
            progress(done := done + 1, total)
    test_images, rows = open_images(data, "all", "test"), {}
    for name, network in networks.items():
        if name == PAPERS:
            continue
        found = evaluate(network, test_images, images, confidences=False, batch_size=1).total()
        rows[name] = {
            "average_per_class_accuracy": round(found.confusion.average_per_class_accuracy(), 5),
            "labels_that_differ": _differing(networks[REFERENCE], network, typical),
        }
        progress(done := done + 1, total)
    return {
        "networks": rows,
        "times": times,
        "reference": REFERENCE,
        "papers": PAPERS,
        "left_out": left_out,
        "test_images": min(images, len(test_images)),
        "network": network_name,
        "rows": largest.shape[0],
        "columns": largest.shape[1],
        "torch": torch.__version__,
    }


def _networks(network: Network) -> dict[str, Network]:
    return {PAPERS: build("fcn_alexnet", seed=0).eval(), REFERENCE: on_backend(network, TORCH)}


class _Images:
    """Images to calibrate on, as ONNX Runtime asks for them."""

    def __init__(self, images: RangeImages) -> None:
        self._images = iter(images)

    def get_next(self) -> dict[str, Any] | None:
        image = next(self._images, None)
        return None if image is None else {RANGE: image["range"].numpy()[None]}


def _in_8_bits(trained: Trained) -> Network:
    """The network with convolutions of 8 bits, as docs/how-to/runtimes.md makes it; ONNX Runtime computes it."""
    quantize_static = import_module("onnxruntime.quantization").quantize_static
    images = _Images(RangeImages(example_set(), variant="all", split="train"))
    layers = {"op_types_to_quantize": ["Conv", "Add", "Relu"], "per_channel": True, "reduce_range": True}
    with TemporaryDirectory() as folder:
        whole, quantised = Path(folder) / "whole.onnx", Path(folder) / "int8.onnx"
        write_onnx(whole, trained)
        quantize_static(whole, quantised, images, **layers)
        return load_network(quantised).network


def _timed(networks: Mapping[str, Network], images: Sequence[torch.Tensor], count: int) -> dict[str, Any]:
    """Median milliseconds of each network by the clock. The paper's network has a third of the rounds."""
    clock: dict[str, list[float]] = {name: [] for name in networks}
    with torch_threads(count):
        for number in range(ROUNDS):
            for name, network in networks.items():
                if name == PAPERS and number % 3:
                    continue
                warm_up(partial(predict, network, images[number % len(images)]))
                start = time.perf_counter()
                predict(network, images[number % len(images)])
                clock[name].append(1e3 * (time.perf_counter() - start))
    return {name: {"ms": round(statistics.median(times), 3)} for name, times in clock.items()}


def _differing(reference: Network, network: Network, frames: Sequence[np.ndarray[Any, Any]]) -> float:
    """Share of the measured pixels of typical frames whose label is not the reference's."""
    batches = [as_batch(frame, 1, torch.device("cpu")) for frame in frames]
    pairs = [(predict(reference, batch).labels, predict(network, batch).labels) for batch in batches]
    measured = sum(int((batch > 0).sum()) for batch in batches)
    return round(sum(int((a != b).sum()) for a, b in pairs) / measured, 7)
