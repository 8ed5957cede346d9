"""Mirroring of the images of a batch, left and right parts exchanged."""

from __future__ import annotations

from importlib import import_module

import torch

from bodyseg_data.core.labels.label_map import PARTS33, LabelMap
from bodyseg_data.core.randomness import chance
from bodyseg_model.networks.input.looped import in_loops


def mirror(
    range_m: torch.Tensor, labels: torch.Tensor, chosen: torch.Tensor, label_map: LabelMap = PARTS33
) -> tuple[torch.Tensor, torch.Tensor]:
    """Copies of range [B, 1, H, W] and labels uint8 [B, H, W] in which those `chosen`, bool [B], are mirrored.

    A mirrored person's left hand is a right hand, so labels change sides as `label_map` says. Shadows change sides,
    too: such an image is that of a rig whose projector is on the camera's other side.
    """
    if in_loops(range_m):
        moved, named = torch.empty_like(range_m), torch.empty_like(labels)
        arrays = (each.numpy() for each in (range_m[:, 0], labels, chosen))
        loops = import_module("bodyseg_model.training.augmentation.loops")
        loops.mirror_images(*arrays, label_map.mirrored, moved[:, 0].numpy(), named.numpy())
        return moved, named
    picked = chosen.nonzero()[:, 0]
    range_m, labels = range_m.clone(), labels.clone()
    range_m[picked] = range_m[picked].flip(-1)
    table = torch.from_numpy(label_map.mirrored).to(labels.device)
    labels[picked] = table[labels[picked].flip(-1).int()]
    return range_m, labels


def mirror_draws(seed: int, epochs: list[int], keys: list[str]) -> torch.Tensor:
    """Draw the samples that are mirrored, bool [B], each with a chance of one half. epochs, keys: of the B samples."""
    drawn = (chance(seed, epoch, key, "mirror") for epoch, key in zip(epochs, keys, strict=True))
    return torch.tensor([each < 0.5 for each in drawn], dtype=torch.bool)
