"""`bench numerical`: labels that change when a network is computed in another way: fewer bits, more threads, batches.

Every computation is compared with one baseline: each image alone, in 32 bits, on one thread. docs/results/stability.md
says how to read the results.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import torch

from benches.measuring import counter
from benches.model.chosen import chosen_network
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.loading import RangeImages
from bodyseg_data.machine import torch_threads
from bodyseg_model.evaluation import ConfusionMatrix
from bodyseg_model.networks import Network, device_of, predict
from bodyseg_model.networks.checkpoints import half_weights

BATCH_SIZES: Final = (2, 7, 16)

Computation = Callable[[torch.Tensor], torch.Tensor]
"""Range images float32 [B, 1, H, W] -> labels uint8 [B, H, W]."""


def bench_numerical(
    data: str, views: int = 25, runs: Sequence[Path] = (), progress: ProgressCallback = silent
) -> dict[str, Any]:
    """Compare computations of one network on `views` test images of `all` of the set `data`: see `numerical`.

    runs: the network is in the first of them; without, it is the one that ships. Another seed computes in the same way.
    """
    name, trained = chosen_network(runs)
    found = numerical(trained.network, RangeImages(data, "all", "test"), views, progress)
    return {"network": name, **found, "tables": {"arithmetic": table(found)}}


def table(found: Mapping[str, Any]) -> list[dict[str, str]]:
    """Rows of the page of tables from what `numerical` found, each a record of text."""
    batches = ((f"{size} images together", row) for size, row in found["batches"].items())
    return [_row(name, row) for name, row in (*found["computations"].items(), *batches)]


def _row(name: str, row: Mapping[str, Any]) -> dict[str, str]:
    changed, accuracy = "–", row.get("reason", "")
    if row["changed"] is not None:
        changed, accuracy = f"{100 * row['changed']:.3f}", f"{100 * row['accuracy_change']:+.2f}"
    return {"computation": name, "labels changed, %": changed, "accuracy, points": accuracy}


def numerical(
    network: Network, images: RangeImages, count: int = 64, progress: ProgressCallback = silent
) -> dict[str, Any]:
    """Compare computations on the first `count` images of the images' permutation; returns plain JSON.

    changed: share of measured pixels whose label differs; accuracy_change: difference of average per-class accuracy, as
    a share. Both are null, with a reason, for a computation that this machine or the network does not support. A batch
    size compares images together with each alone.

    network: in evaluation mode. count: at most so many images, all held in memory, 0.8 MB each. progress: called with
    comparisons done and in all.
    """
    device = device_of(network)
    order = images.order(images.epoch)[:count]
    chosen = [images[int(index)] for index in order]
    range_m = torch.stack([image["range"] for image in chosen]).to(device)
    truth = torch.stack([image["labels"] for image in chosen]).to(device)
    computations = _computations(network, device.type)
    advance = counter(progress, len(computations) + len(BATCH_SIZES))
    with torch_threads(1):
        baseline = _one_by_one(functools.partial(_labels, network), range_m)
        found = {}
        for name, computation in computations.items():
            found[name] = _attempt(computation, range_m, truth, baseline)
            advance()
        batches = {}
        for size in BATCH_SIZES:
            together = torch.cat([_labels(network, batch) for batch in torch.split(range_m, size)])
            batches[str(size)] = _compare(truth, baseline, together)
            advance()
    return {"images": len(truth), "computations": found, "batches": batches}


def _computations(network: Network, device: str) -> dict[str, Computation]:
    """Other ways to compute one image at a time, by name."""

    def autocast(dtype: torch.dtype) -> Computation:
        def computation(range_m: torch.Tensor) -> torch.Tensor:
            with torch.autocast(device, dtype=dtype):
                return _labels(network, range_m)

        return computation

    def throughout(dtype: torch.dtype) -> Computation:
        converted = copy.deepcopy(network).to(dtype)
        return lambda range_m: _labels(converted, range_m.to(dtype))

    def two_threads(range_m: torch.Tensor) -> torch.Tensor:
        with torch_threads(2):
            return _labels(network, range_m)

    def channels_last(range_m: torch.Tensor) -> torch.Tensor:
        return _labels(laid_out, range_m.contiguous(memory_format=torch.channels_last))

    laid_out = copy.deepcopy(network).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return {
        "bf16, autocast": autocast(torch.bfloat16),
        "bf16 throughout": throughout(torch.bfloat16),
        "fp16, autocast": autocast(torch.float16),
        "fp16 throughout": throughout(torch.float16),
        "weights kept in fp16": functools.partial(_labels, _rounded_to_half(network)),
        "two threads": two_threads,
        "channels last": channels_last,
    }


def _rounded_to_half(network: Network) -> Network:
    """A copy of the network as it is after `save_network(..., half=True)` and loading."""
    rounded = copy.deepcopy(network)
    rounded.load_state_dict(half_weights(network))  # copied into weights of 32 bits
    return rounded


def _attempt(
    computation: Computation, range_m: torch.Tensor, truth: torch.Tensor, baseline: torch.Tensor
) -> dict[str, Any]:
    try:
        return _compare(truth, baseline, _one_by_one(computation, range_m))
    except (RuntimeError, NotImplementedError) as error:  # torch raises these where it has no such kernel
        return {"changed": None, "accuracy_change": None, "reason": str(error).partition("\n")[0][:200]}


def _labels(network: Network, range_m: torch.Tensor) -> torch.Tensor:
    return predict(network, range_m).labels


def _one_by_one(computation: Computation, range_m: torch.Tensor) -> torch.Tensor:
    return torch.cat([computation(image[None]) for image in range_m])


def _compare(truth: torch.Tensor, before: torch.Tensor, after: torch.Tensor) -> dict[str, Any]:
    """Changes between two label images, all uint8 [N, H, W], on measured pixels."""
    body = truth != BACKGROUND
    changed = int((before != after)[body].sum()) / int(body.sum())
    return {
        "changed": round(changed, 7),
        "accuracy_change": round(_accuracy(truth, after) - _accuracy(truth, before), 7),
    }


def _accuracy(truth: torch.Tensor, predicted: torch.Tensor) -> float:
    confusion = ConfusionMatrix()
    confusion.add(truth.cpu().numpy(), predicted.cpu().numpy())
    return confusion.average_per_class_accuracy()
