"""Transforms of a batch before the network: cropping to the bodies in it, and mirroring."""

from __future__ import annotations

import torch

from bodyseg_data.core.labels.label_map import PARTS33, LabelMap
from bodyseg_data.core.randomness import chance


def body_window(measured: torch.Tensor, margin: int, multiple: int = 1) -> tuple[slice, slice] | None:
    """Rows and columns around all that is True in bool [B, H, W], with `margin` more on every side; None if nothing is.

    The window begins at multiples of `multiple`, so that cells of a network lie in it as they lie in the whole image.
    """
    window = []
    for other, size in ((2, measured.shape[1]), (1, measured.shape[2])):
        (found,) = torch.nonzero(measured.any(other).any(0), as_tuple=True)
        if not len(found):
            return None
        first = max(0, int(found[0]) - margin) // multiple * multiple
        window.append(slice(first, min(size, int(found[-1]) + 1 + margin)))
    return window[0], window[1]


def cut_to_bodies(
    range_m: torch.Tensor, labels: torch.Tensor, margin: int, multiple: int = 1
) -> tuple[torch.Tensor, torch.Tensor]:
    """Crop range [B, 1, H, W] and labels [B, H, W] to their `body_window`; without a body both stay whole."""
    window = body_window(range_m[:, 0] > 0, margin, multiple)
    if window is None:
        return range_m, labels
    rows, columns = window
    return range_m[:, :, rows, columns], labels[:, rows, columns]


def mirror(
    range_m: torch.Tensor, labels: torch.Tensor, chosen: torch.Tensor, label_map: LabelMap = PARTS33
) -> tuple[torch.Tensor, torch.Tensor]:
    """Copies of range [B, 1, H, W] and labels uint8 [B, H, W] in which those `chosen`, bool [B], are mirrored.

    A mirrored person's left hand is a right hand, so labels change sides as `label_map` says. Shadows change sides,
    too: such an image is that of a rig whose projector is on the camera's other side.
    """
    flipped = torch.from_numpy(label_map.mirrored).to(labels.device)[labels.flip(-1).long()]
    return (
        torch.where(chosen[:, None, None, None], range_m.flip(-1), range_m),
        torch.where(chosen[:, None, None], flipped, labels),
    )


def mirror_draws(seed: int, epochs: list[int], keys: list[str]) -> torch.Tensor:
    """Draw the samples that are mirrored, bool [B], each with a chance of one half. epochs, keys: of the B samples."""
    drawn = (chance(seed, epoch, key, "mirror") for epoch, key in zip(epochs, keys, strict=True))
    return torch.tensor([each < 0.5 for each in drawn], dtype=torch.bool)
