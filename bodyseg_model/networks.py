"""The networks by name, and how to ask them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere
from torch import nn

from bodyseg_data.errors import BadConfig
from bodyseg_data.parts import BACKGROUND
from bodyseg_model.compact import Compact, CompactSettings
from bodyseg_model.crops import bounds
from bodyseg_model.fcn_alexnet import FcnAlexnet
from bodyseg_model.range_input import check_range_images


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


NETWORKS: Final[dict[str, Callable[..., nn.Module]]] = {"fcn_alexnet": FcnAlexnet, "compact": _compact}
"""Name -> what makes it of its settings."""


def build(name: str, settings: Mapping[str, Any] | None = None) -> nn.Module:
    """A network with new weights, drawn from torch's generator. Raises BadConfig for what it does not know."""
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
    return {}


def parameters(network: nn.Module) -> int:
    """How many numbers a network has learned, or keeps fixed as filters."""
    return sum(weight.numel() for weight in network.parameters())


def coarse(network: nn.Module, range_m: torch.Tensor) -> tuple[torch.Tensor, int]:
    """Scores at the resolution at which a network computes them, float [B, 33, h, w], and the image's pixels a step.

    Answer (i, j) is that of the point ((i + 1/2) step, (j + 1/2) step) of the image, in pixels from its corner.
    """
    if isinstance(network, Compact):
        return network.coarse(range_m), network.stride
    return network(range_m), 1


@torch.inference_mode()
def predict(network: nn.Module, range_m: torch.Tensor) -> Prediction:
    """Labels and confidences of range images in metres, float32 [B, 1, H, W], 0 = nothing measured.

    `network` must be in evaluation mode. One that bears it (`margin`) is shown the bodies of the batch with as much space
    around them, not the whole image; where its scores are coarser than the image, probabilities are interpolated between
    them. Raises BadConfig for a wrong
    shape or a network in training mode.
    """
    check_range_images(range_m)
    if network.training:
        raise BadConfig("predict needs a network in evaluation mode: call network.eval() first")
    measured = range_m[:, 0] > 0
    labels = torch.full(measured.shape, BACKGROUND, dtype=torch.uint8, device=range_m.device)
    confidence = torch.zeros(measured.shape, dtype=torch.float32, device=range_m.device)
    box = bounds(measured)
    if box is None:
        return Prediction(labels, confidence)
    top, bottom, left, right = _grown(box, getattr(network, "margin", None), measured.shape[1], measured.shape[2])
    scores, step = coarse(network, range_m[:, :, top:bottom, left:right])
    likely = scores.float().softmax(1)
    if step > 1:
        likely = F.interpolate(likely, scale_factor=step, mode="bilinear", align_corners=False)
    best, label = likely[:, :, : bottom - top, : right - left].max(1)
    seen = measured[:, top:bottom, left:right]
    labels[:, top:bottom, left:right] = torch.where(seen, label.to(torch.uint8), BACKGROUND)
    confidence[:, top:bottom, left:right] = torch.where(seen, best, 0.0)
    return Prediction(labels, confidence)


def _grown(box: tuple[int, int, int, int], margin: int | None, rows: int, columns: int) -> tuple[int, int, int, int]:
    """A rectangle with `margin` pixels more on every side, but within the image; without a margin the whole image."""
    if margin is None:
        return 0, rows, 0, columns
    top, bottom, left, right = box
    return max(0, top - margin), min(rows, bottom + margin), max(0, left - margin), min(columns, right + margin)
