"""The networks by name, and how to ask them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere
from torch import nn

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.core.randomness import generator
from bodyseg_model.networks.baselines import Baseline, deeplab, segformer
from bodyseg_model.networks.batch_transforms import body_window
from bodyseg_model.networks.compact import Compact, CompactSettings
from bodyseg_model.networks.fcn_alexnet import FcnAlexnet
from bodyseg_model.networks.range_input import check_range_images


class Prediction(NamedTuple):
    """labels: uint8 [B, H, W], 0..32, 255 where nothing was measured. confidence: float32 [B, H, W], the probability
    that the network gives to that label; 0 where nothing was measured.
    """

    labels: torch.Tensor
    confidence: torch.Tensor


def _compact(**settings: Any) -> Compact:
    known = {field.name for field in dataclasses.fields(CompactSettings)}
    if not settings.keys() <= known:
        raise TypeError(f"unknown {sorted(settings.keys() - known)[0]!r}")
    for name, value in settings.items():
        settings[name] = tuple(value) if isinstance(value, list) else value
    return Compact(CompactSettings(**settings))


NETWORKS: Final[dict[str, Callable[..., nn.Module]]] = {
    "fcn_alexnet": FcnAlexnet,
    "compact": _compact,
    "segformer": segformer,
    "deeplab": deeplab,
}
"""Name -> what makes it of its settings."""


def build(name: str, settings: Mapping[str, Any] | None = None, seed: int | None = None) -> nn.Module:
    """A network with new weights, those of `seed`; None: of torch's generator as it stands.

    Raises BadConfig for what it does not know.
    """
    if seed is not None:
        torch.manual_seed(int(generator(seed, 0, "", "weights").integers(2**62)))
    if name not in NETWORKS:
        raise BadConfig(f"the network must be one of {', '.join(NETWORKS)}, found {name!r}")
    try:
        return NETWORKS[name](**dict(settings or {}))
    except TypeError as error:
        raise BadConfig(f"settings of {name} that it does not take: {dict(settings or {})!r} ({error})") from error


def settings_of(network: nn.Module) -> dict[str, Any]:
    """What `build` needs to make `network` again, as plain JSON."""
    if isinstance(network, Compact):
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in dataclasses.asdict(network.settings).items()
        }
    if isinstance(network, FcnAlexnet):
        return {"normalise": network.normalise, "width": network.width}
    if isinstance(network, Baseline):
        return dict(network.settings)
    return {}


def parameters(network: nn.Module) -> int:
    """How many numbers a network has learned, or keeps fixed as filters."""
    return sum(weight.numel() for weight in network.parameters())


def device_of(network: nn.Module) -> torch.device:
    """Where a network computes; the processor for one without weights."""
    return next((weight.device for weight in network.parameters()), torch.device("cpu"))


def coarse(network: nn.Module, range_m: torch.Tensor) -> tuple[torch.Tensor, int]:
    """Scores at the resolution at which a network computes them, float [B, 33, h, w], and the image's pixels a step.

    Answer (i, j) is that of the point ((i + 1/2) step, (j + 1/2) step) of the image, in pixels from its corner.
    """
    if isinstance(network, Compact | Baseline):
        return network.coarse(range_m), network.stride
    return network(range_m), 1


def margin(network: nn.Module) -> int:
    """Empty pixels around a body after which more of them do not matter to a network; 2 ** 16 if they always do."""
    return network.margin if isinstance(network, Compact) else 1 << 16


@torch.inference_mode()
def predict(network: nn.Module, range_m: torch.Tensor) -> Prediction:
    """Labels and confidences of range images in metres, float32 [B, 1, H, W], 0 = nothing measured.

    `network` must be in evaluation mode. It is shown the bodies of the batch with its `margin` around them, not the
    whole image; where its scores are coarser than the image, they are interpolated, as they were in training. Raises
    BadConfig for a wrong shape or a network in training mode.
    """
    check_range_images(range_m)
    if network.training:
        raise BadConfig("predict needs a network in evaluation mode: call network.eval() first")
    measured = range_m[:, 0] > 0
    labels = torch.full(measured.shape, BACKGROUND, dtype=torch.uint8, device=range_m.device)
    confidence = torch.zeros(measured.shape, dtype=torch.float32, device=range_m.device)
    window = body_window(measured, margin(network))
    if window is None:
        return Prediction(labels, confidence)
    rows, columns = window
    seen = measured[:, rows, columns]
    scores, step = coarse(network, range_m[:, :, rows, columns])
    scores = scores.float().contiguous(memory_format=torch.channels_last)
    if step > 1:
        scores = F.interpolate(scores, scale_factor=step, mode="bilinear", align_corners=False)
    scores = scores.permute(0, 2, 3, 1)[:, : seen.shape[1], : seen.shape[2]][seen]
    best, label = scores.max(1)
    labels[:, rows, columns][seen] = label.to(torch.uint8)
    confidence[:, rows, columns][seen] = 1 / (scores - best[:, None]).exp_().sum(1)
    return Prediction(labels, confidence)
