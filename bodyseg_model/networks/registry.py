"""Networks by name, of those in `names.NETWORKS`, and their predictions."""

import os
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any, Final, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere
from numpy.typing import NDArray
from torch import nn

from bodyseg_data.core import BadConfig, Draws, check_choice
from bodyseg_data.labels import BACKGROUND, NOWHERE
from bodyseg_data.machine import use_compiled
from bodyseg_model.networks.names import NETWORKS
from bodyseg_model.networks.network import Network, check_range_images

_FARTHEST_M: Final = 656.0  # which no steps of a rig reach


class Prediction(NamedTuple):
    """Answer of `predict`: labels of range images, and how sure the network is of them.

    labels: uint8 [B, H, W], from 0 to below the network's `classes`, 255 where nothing was measured. confidence:
    float32 [B, H, W], the probability (of softmax) of that label; 0 where nothing was measured.
    """

    labels: torch.Tensor
    confidence: torch.Tensor


def network_class(name: str) -> type[Network]:
    """The class of the network called `name`. Raises BadConfig for an unknown name."""
    module, _, kind = NETWORKS[check_choice("the network", name, NETWORKS)].rpartition(".")
    found: type[Network] = getattr(import_module(module), kind)
    return found


def name_of(network: Network) -> str:
    """Return the name under which `NETWORKS` has a network's class. Raises BadConfig for a class that it has not."""
    kind = type(network)
    path = f"{kind.__module__}.{kind.__qualname__}"
    for name, registered in NETWORKS.items():
        if registered == path:
            return name
    raise BadConfig(f"the network must be of a class in NETWORKS, whose files can be loaded again, found {path}")


def build(name: str, settings: Mapping[str, Any] | None = None, seed: int | None = None) -> Network:
    """A network with new weights, drawn for `seed`; None: drawn from torch's generator in its present state.

    settings: see `Network.settings`; those left out have their defaults. Raises BadConfig for an unknown name, or
    settings that are unknown or out of range.
    """
    kind = network_class(name)
    if seed is not None:
        torch.manual_seed(int(Draws(seed, 0, "").generator("weights").integers(2**62)))
    try:
        return kind.from_settings(dict(settings or {}))
    except TypeError as error:
        raise BadConfig(f"settings of {name} that it does not take: {dict(settings or {})!r} ({error})") from error


def check_network(network: object) -> None:
    """Raise BadConfig for what is no network, as users' own are before they are wrapped."""
    if not isinstance(network, Network):
        what = "a network must be a bodyseg_model.Network: `bodyseg_model.wrapped(module).network` is one"
        raise BadConfig(f"{what}, found {type(network).__name__}")


def device_of(network: nn.Module) -> torch.device:
    """Device of a network's weights; the processor for one without weights."""
    return next((weight.device for weight in network.parameters()), torch.device("cpu"))


@torch.inference_mode()
def predict(network: Network, range_m: torch.Tensor) -> Prediction:
    """Label range images in metres, float32 [B, 1, H, W], 0 = nothing measured; returns labels and confidences.

    network: in evaluation mode. It sees whole images, as in training: how much is empty around a body changes its
    labels. Scores coarser than the image are interpolated, as they were in training. Raises BadConfig for a wrong
    shape, also of scores, a range that is not finite or below 0, ranges in another unit, or a network in training mode.
    """
    return _predict(network, range_m, network.scores if isinstance(network, Network) else None)


@torch.inference_mode()
def predict_dense(network: Network, range_m: torch.Tensor, by_part: bool) -> tuple[Prediction, NDArray[np.uint16]]:
    """As `predict`, and the number of the template's point that each pixel shows, uint16 [B, H, W], `NOWHERE` where
    nothing was measured, or its place is NaN (`bodyseg_data.load_template`). by_part: classes are the 33 parts, and
    points are of the label's part: a hand's of the hand, however near a place is to the hip.

    Raises BadConfig for a network that knows no places, too; MissingLibrary without numba or scipy.
    """
    seen: list[NDArray[np.float32]] = []

    def scores(range_m: torch.Tensor) -> torch.Tensor:
        both = _scores_of(network, network.scores_and_places, range_m, places=3)
        seen.append(np.ascontiguousarray(both[:, network.classes :].permute(0, 2, 3, 1).cpu().numpy()))
        return both[:, : network.classes]

    found = _predict(network, range_m, scores)
    numbers = np.full(found.labels.shape, NOWHERE, np.uint16)
    if seen:
        loops, metres = import_module(f"{__package__}.labelling"), range_m[:, 0].float().cpu().numpy()
        labels = found.labels.cpu().numpy() if by_part else None
        loops.number_pixels(seen[0], metres, network.output_stride, labels, numbers)
    return found, numbers


def _predict(network: Network, range_m: torch.Tensor, scores: Callable[[torch.Tensor], torch.Tensor]) -> Prediction:
    check_network(network)
    check_range_images(range_m)
    if network.training:
        raise BadConfig("predict needs a network in evaluation mode: call network.eval() first")
    if next(network.parameters(), range_m).dtype == torch.float32:
        range_m = range_m.float()  # layers of float32 refuse float16
    if range_m.device.type == "cpu":
        return _predict_on_processor(network, range_m, scores)
    least, most = torch.stack(range_m.aminmax()).tolist()
    _check_metres(least, most, range_m)
    measured = range_m[:, 0] > 0
    labels = torch.full(measured.shape, BACKGROUND, dtype=torch.uint8, device=range_m.device)
    empty = Prediction(labels, torch.zeros(measured.shape, dtype=torch.float32, device=range_m.device))
    if not measured.any():
        return empty
    return _label_by_torch(network, _scores_of(network, scores, range_m), measured, empty)


def _scores_of(
    network: Network, compute: Callable[[torch.Tensor], torch.Tensor], range_m: torch.Tensor, places: int = 0
) -> torch.Tensor:
    """Compute scores, float32. Raises BadConfig for another shape than `Network` promises: loops check no length."""
    scores = compute(range_m).float()
    sides = (-(-side // network.output_stride) for side in range_m.shape[2:])
    wanted = [len(range_m), network.classes + places, *sides]
    if list(scores.shape) != wanted:
        raise BadConfig(f"{type(network).__name__} must give scores {wanted}, found {list(scores.shape)}")
    return scores


def _check_metres(least: float, most: float, range_m: torch.Tensor) -> None:
    """Raise BadConfig for ranges that are none, or in steps or millimetres: all of them far. least, most: of all."""
    if not (least >= 0 and most < np.inf):  # also for NaN; one such pixel would change all labels
        raise BadConfig(f"range images must be finite, and 0 where nothing was measured, found {least:g} to {most:g}")
    nearest = float(range_m[range_m > 0].min()) if most > _FARTHEST_M else most
    if _FARTHEST_M < nearest < most:  # not for one value, as of a sky
        raise BadConfig(f"range images must be in metres, found nothing nearer than {nearest:.0f}")


def _predict_on_processor(
    network: Network, range_m: torch.Tensor, compute: Callable[[torch.Tensor], torch.Tensor]
) -> Prediction:
    """As `predict`. With numba, NumPy and compiled loops compute all but the scores: after an operation that it divides
    among threads, PyTorch's threads wait busily for the next, on processors that a runtime's threads need.
    """
    metres = np.ascontiguousarray(range_m[:, 0].float().numpy())
    _check_metres(float(metres.min()), float(metres.max()), range_m)
    labels, confidence = np.full(metres.shape, BACKGROUND, np.uint8), np.zeros(metres.shape, np.float32)
    found, measured = Prediction(torch.from_numpy(labels), torch.from_numpy(confidence)), metres > 0
    if not measured.any():
        return found
    scores = _scores_of(network, compute, range_m)
    if network.output_stride > 1 and use_compiled():
        by_point = np.ascontiguousarray(scores.permute(0, 2, 3, 1).numpy())
        if np.isfinite(by_point).all():
            loops = import_module(f"{__package__}.labelling")
            loops.label_pixels(by_point, metres, network.output_stride, labels, confidence, torch.get_num_threads())
            return found
    return _label_by_torch(network, scores, torch.from_numpy(measured), found)


def predict_each(
    network: Network, images: Sequence[NDArray[np.float32]], dense: bool = False, by_part: bool = False
) -> list[tuple[NDArray[Any], ...]]:
    """Labels uint8 and confidences float32 of each of some range images [h, w], metres, which may differ in size; and
    if `dense`, points of the template uint16, as `predict_dense` gives them.

    Images of one size go through the network together, on its device, where that is quicker (`Network.together`).
    Raises BadConfig as `predict`.
    """
    answers: dict[int, tuple[NDArray[Any], ...]] = {}
    groups: dict[Any, list[int]] = {}
    for number, image in enumerate(images):
        groups.setdefault(image.shape if network.together else number, []).append(number)
    for alike in groups.values():
        together = torch.from_numpy(np.stack([images[number] for number in alike]))[:, None]
        together = together.to(device_of(network))
        numbers: list[NDArray[np.uint16]] = []
        if dense:
            prediction, *numbers = predict_dense(network, together, by_part)
        else:
            prediction = predict(network, together)
        found = [*(each.cpu().numpy() for each in prediction), *numbers]
        answers |= dict(zip(alike, zip(*found, strict=True), strict=True))
    return [answers[number] for number in range(len(images))]


def _label_by_torch(network: Network, scores: torch.Tensor, measured: torch.Tensor, empty: Prediction) -> Prediction:
    """Label with PyTorch: on other devices, without numba, for scores everywhere, or where some are not finite."""
    rows, columns = measured.shape[1:]
    scores = scores.contiguous(memory_format=torch.channels_last)
    if network.output_stride > 1:
        scores = F.interpolate(scores, scale_factor=network.output_stride, mode="bilinear", align_corners=False)
    scores = scores.permute(0, 2, 3, 1)[:, :rows, :columns][measured]
    best, label = scores.max(1)
    empty.labels[measured] = label.to(torch.uint8)
    empty.confidence[measured] = 1 / (scores - best[:, None]).exp_().sum(1)
    return empty


def find_device(name: str | None = None) -> torch.device:
    """The device called "cpu", "cuda", "cuda:1" ...; None is the GPU of this process's local rank, else the processor.

    Raises BadConfig for a device that is absent.
    """
    if name is None:
        name = f"cuda:{os.environ.get('LOCAL_RANK', '0')}" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError, ValueError) as error:
        raise BadConfig(f"cannot compute on the device {name!r}: {str(error).splitlines()[0]}") from error
    return device
