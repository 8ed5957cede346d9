"""How many labels change when a network is computed in another way: fewer bits, more threads, other batches.

Every way is compared with one: each image alone, in 32 bits, by one thread.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import torch

from bodyseg_data.core.errors import BadConfig, check_int
from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.loading.range_images import RangeImages
from bodyseg_model.evaluation.scores import ConfusionMatrix
from bodyseg_model.networks.batch_transforms import body_window
from bodyseg_model.networks.network import Network
from bodyseg_model.networks.registry import device_of, predict
from bodyseg_model.training.distributed import threads

BATCH_SIZES: Final = (2, 7, 16)

Way = Callable[[torch.Tensor], torch.Tensor]
"""Range images float32 [B, 1, H, W] -> labels uint8 [B, H, W]."""


@dataclass(frozen=True)
class Shown:
    """Images to ask about: range_m: float32 [N, 1, H, W], metres; truth: uint8 [N, H, W], 255 where nothing is."""

    range_m: torch.Tensor
    truth: torch.Tensor


class Whole(Network):
    """Hides what a network is, so that `predict` shows it images as they are instead of cutting them to bodies."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network
        self.eval()

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        """Compute the hidden network's scores of every pixel."""
        scores: torch.Tensor = self.network(range_m)
        return scores


def numerical(
    network: Network,
    images: RangeImages,
    count: int = 64,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """What changes with the arithmetic, on the first `count` images of the images' permutation; plain JSON.

    changed: share of measured pixels whose label is another; accuracy_change: of average per-class accuracy, as a
    share. Both are null, with a reason, for what this machine or the network cannot compute. Of every batch size three
    comparisons: "batch", images together as against each alone; "window", each alone but in the window that holds all
    bodies of its batch, as against in its own; "arithmetic", together as against alone, both in that window. A network
    whose `margin` is the whole image knows one window only.

    count: at most so many, all held in memory, 0.8 MB each. progress: called with comparisons done and in all. Raises
    BadConfig for no image, images on which nothing was measured, or a network in training mode.
    """
    if network.training:
        raise BadConfig("comparing labels needs a network in evaluation mode: call network.eval() first")
    shown = _show(images, check_int("the number of images", count, 1), device_of(network))
    if not (shown.truth != BACKGROUND).any():
        raise BadConfig(f"comparing labels needs measured pixels, found none in {len(shown.truth)} images")
    ways = _ways(network, device_of(network).type)
    done, total = 0, len(ways) + len(BATCH_SIZES)

    def advance() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    with threads(1):
        usual = _one_by_one(functools.partial(_labels, network), shown.range_m)
        found = {}
        for name, way in ways.items():
            found[name] = _asked(way, shown, usual)
            advance()
        batches = {}
        for size in BATCH_SIZES:
            batches[str(size)] = _batch(network, shown, usual, size)
            advance()
    return {
        "images": len(shown.truth),
        "variant": images.variant,
        "split": images.split,
        "seed": images.seed,
        "pixels": int((shown.truth != BACKGROUND).sum()),
        "accuracy": round(_accuracy(shown.truth, usual), 5),
        "ways": found,
        "batches": batches,
    }


def _show(images: RangeImages, count: int, device: torch.device) -> Shown:
    chosen = [images[int(index)] for index in images.order(images.epoch)[:count]]
    truth = torch.stack([image["labels"] for image in chosen])
    return Shown(torch.stack([image["range"] for image in chosen]).to(device), truth.to(device))


def _ways(network: Network, device: str) -> dict[str, Way]:
    """Other ways to compute one image at a time, by name."""

    def mixed(kind: torch.dtype) -> Way:
        def way(range_m: torch.Tensor) -> torch.Tensor:
            with torch.autocast(device, dtype=kind):
                return _labels(network, range_m)

        return way

    def throughout(kind: torch.dtype) -> Way:
        turned = copy.deepcopy(network).to(kind)
        return lambda range_m: _labels(turned, range_m.to(kind))

    def two_threads(range_m: torch.Tensor) -> torch.Tensor:
        with threads(2):
            return _labels(network, range_m)

    def channels_last(range_m: torch.Tensor) -> torch.Tensor:
        return _labels(laid_out, range_m.contiguous(memory_format=torch.channels_last))

    laid_out = copy.deepcopy(network).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return {
        "bf16, autocast": mixed(torch.bfloat16),
        "bf16 throughout": throughout(torch.bfloat16),
        "fp16, autocast": mixed(torch.float16),
        "fp16 throughout": throughout(torch.float16),
        "weights kept in fp16": functools.partial(_labels, _kept_in_half(network)),
        "two threads": two_threads,
        "channels last": channels_last,
    }


def _kept_in_half(network: Network) -> Network:
    """A network that was saved with `save_network(..., half=True)` and loaded."""
    kept = copy.deepcopy(network)
    kept.load_state_dict(
        {
            name: weight.half().to(weight.dtype) if weight.ndim > 1 and weight.is_floating_point() else weight
            for name, weight in network.state_dict().items()
        }
    )
    return kept


def _asked(way: Way, shown: Shown, usual: torch.Tensor) -> dict[str, Any]:
    try:
        return _compared(shown.truth, usual, _one_by_one(way, shown.range_m))
    except (RuntimeError, NotImplementedError) as error:  # how torch says that it has no such kernel
        return {"changed": None, "accuracy_change": None, "reason": str(error).partition("\n")[0][:200]}


def _batch(network: Network, shown: Shown, usual: torch.Tensor, size: int) -> dict[str, Any]:
    """The three comparisons of one batch size. The last batch may be smaller."""
    whole = Whole(network)
    together, alone = (torch.full_like(usual, BACKGROUND) for _ in range(2))
    for start in range(0, len(usual), size):
        batch = slice(start, start + size)
        range_m = shown.range_m[batch]
        together[batch] = _labels(network, range_m)
        window = body_window(range_m[:, 0] > 0, network.margin, network.crop_multiple)
        if window is not None:
            rows, columns = window
            alone[batch, rows, columns] = _one_by_one(functools.partial(_labels, whole), range_m[:, :, rows, columns])
    return {
        "batch": _compared(shown.truth, usual, together),
        "window": _compared(shown.truth, usual, alone),
        "arithmetic": _compared(shown.truth, alone, together),
    }


def _labels(network: Network, range_m: torch.Tensor) -> torch.Tensor:
    return predict(network, range_m).labels


def _one_by_one(way: Way, range_m: torch.Tensor) -> torch.Tensor:
    return torch.cat([way(image[None]) for image in range_m])


def _compared(truth: torch.Tensor, before: torch.Tensor, after: torch.Tensor) -> dict[str, Any]:
    """What changes from labels to others, all uint8 [N, H, W]."""
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
