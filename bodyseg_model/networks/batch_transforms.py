"""What is done to a batch on its way to the network: cut to the bodies in it, and held before a mirror."""

from __future__ import annotations

import torch

from bodyseg_data.core.parts import MIRRORED_LABELS
from bodyseg_data.core.randomness import chance


def body_window(measured: torch.Tensor, margin: int) -> tuple[slice, slice] | None:
    """Rows and columns around all that is True in bool [B, H, W], with `margin` more on every side; None if nothing is.

    It begins at multiples of `margin`, so that a network that looks at an image cell by cell sees the same cells.
    """
    window = []
    for other, size in ((2, measured.shape[1]), (1, measured.shape[2])):
        (places,) = torch.nonzero(measured.any(other).any(0), as_tuple=True)
        if not len(places):
            return None
        first = max(0, int(places[0]) - margin) // margin * margin
        window.append(slice(first, min(size, int(places[-1]) + 1 + margin)))
    return window[0], window[1]


def cut_to_bodies(range_m: torch.Tensor, labels: torch.Tensor, margin: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The part of range [B, 1, H, W] and labels [B, H, W] in `body_window`; all of both if there is no body."""
    window = body_window(range_m[:, 0] > 0, margin)
    if window is None:
        return range_m, labels
    rows, columns = window
    return range_m[:, :, rows, columns], labels[:, rows, columns]


def mirror(range_m: torch.Tensor, labels: torch.Tensor, chosen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Copies of range [B, 1, H, W] and labels uint8 [B, H, W] in which those `chosen`, bool [B], are mirrored.

    A mirrored person's left hand is a right hand, so labels change sides. Shadows change sides, too: such an image is
    that of a rig whose projector stands on the camera's other side.
    """
    flipped = torch.from_numpy(MIRRORED_LABELS).to(labels.device)[labels.flip(-1).long()]
    return (
        torch.where(chosen[:, None, None, None], range_m.flip(-1), range_m),
        torch.where(chosen[:, None, None], flipped, labels),
    )


def mirror_draws(seed: int, epoch: int, keys: list[str]) -> torch.Tensor:
    """Which samples are mirrored in an epoch, bool [B]: every other one by chance, drawn for the sample."""
    return torch.tensor([chance(seed, epoch, key, "mirror") < 0.5 for key in keys], dtype=torch.bool)
