"""What is done to a batch on its way to the network: cut to the bodies in it, and held before a mirror."""

from __future__ import annotations

from typing import Final

import torch

from bodyseg_data.parts import PARTS
from bodyseg_data.randomness import chance


def _mirrored_parts() -> torch.Tensor:
    """uint8 [256]: a label -> the label of the same place on the other side of the body."""
    table = torch.arange(256, dtype=torch.uint8)
    names = {part.landmark: part.label for part in PARTS}
    for part in PARTS:
        table[part.label] = (
            names[_OTHER[part.landmark[:3]] + part.landmark[3:]] if part.side != "middle" else part.label
        )
    return table


_OTHER: Final = {"Rt.": "Lt.", "Lt.": "Rt."}
MIRRORED_PARTS: Final = _mirrored_parts()
"""uint8 [256]: label -> label of its mirror image; parts of the middle, and what is no part, are their own."""


def bounds(measured: torch.Tensor) -> tuple[int, int, int, int] | None:
    """Top, bottom, left and right of the smallest rectangle that holds all that is True in bool [B, H, W], if any."""
    edges = []
    for other in (2, 1):
        (places,) = torch.nonzero(measured.any(other).any(0), as_tuple=True)
        if not len(places):
            return None
        edges += [int(places[0]), int(places[-1]) + 1]
    return edges[0], edges[1], edges[2], edges[3]


def cut_to_bodies(range_m: torch.Tensor, labels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Views of range [B, 1, H, W] and labels [B, H, W] that hold every body of the batch; all of both if none is."""
    box = bounds(range_m[:, 0] > 0)
    if box is None:
        return range_m, labels
    top, bottom, left, right = box
    return range_m[:, :, top:bottom, left:right], labels[:, top:bottom, left:right]


def mirror(range_m: torch.Tensor, labels: torch.Tensor, chosen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Copies of range [B, 1, H, W] and labels uint8 [B, H, W] in which those `chosen`, bool [B], are mirrored.

    A mirrored person's left hand is a right hand, so labels change sides. Shadows change sides, too: such an image is
    that of a rig whose projector stands on the camera's other side.
    """
    flipped = MIRRORED_PARTS.to(labels.device)[labels.flip(-1).long()]
    return (
        torch.where(chosen[:, None, None, None], range_m.flip(-1), range_m),
        torch.where(chosen[:, None, None], flipped, labels),
    )


def mirror_draws(seed: int, epoch: int, keys: list[str]) -> torch.Tensor:
    """Which samples are mirrored in an epoch, bool [B]: every other one by chance, drawn for the sample."""
    return torch.tensor([chance(seed, epoch, key, "mirror") < 0.5 for key in keys], dtype=torch.bool)
