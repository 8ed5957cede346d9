"""Augmentation of batches: images mirrored, rotated, zoomed and cut, as of a tilted camera or people partly in view."""

import math
from importlib import import_module

import torch

from bodyseg_data.core import Draws
from bodyseg_data.labels import BACKGROUND, NOWHERE, PARTS33, LabelMap
from bodyseg_data.machine import if_ready
from bodyseg_model.networks import in_loops
from bodyseg_model.training.recipes import GeometricAugmentation


def placed(
    ranges: GeometricAugmentation,
    range_m: torch.Tensor,
    labels: torch.Tensor,
    seed: int,
    epochs: list[int],
    keys: list[str],
) -> tuple[torch.Tensor, torch.Tensor]:
    """Copies of range [B, 1, H, W] and labels uint8 [B, H, W], transformed as drawn for (seed, epoch, key) of each.

    Values are taken from the nearest pixel, so that none is interpolated between two surfaces.
    """
    if ranges == GeometricAugmentation():
        return range_m, labels
    rows, columns = range_m.shape[2:]
    maps, cuts, lowest = [], [], []
    for epoch, key in zip(epochs, keys, strict=True):
        roll, zoom, stretch, cut, side, share = (
            Draws(seed, epoch, key).chance(f"placement {what}")
            for what in ("roll", "zoom", "stretch", "cut", "side", "share")
        )
        angle = math.radians(ranges.roll_deg) * (2 * roll - 1)
        down = (1 + ranges.zoom) ** (2 * zoom - 1)
        across = down * (1 + ranges.stretch) ** (2 * stretch - 1)
        maps.append(_source_map(angle, down, across, rows, columns))
        cuts.append(_cut_side(int(4 * side), share / 2, rows, columns) if cut < ranges.cut else None)
        bust = ranges.bust and Draws(seed, epoch, key).chance("placement bust")
        lowest.append(0.35 + 0.45 * bust / ranges.bust if bust < ranges.bust else 1.0)
    sources = torch.tensor(maps, dtype=torch.float32, device=range_m.device)
    moved, named = _moved(range_m, labels, sources)
    for image, place in enumerate(cuts):
        if place is not None:
            moved[image, 0][place] = 0
            named[image][place] = BACKGROUND
    for image, share in enumerate(lowest):
        body = (named[image] != BACKGROUND).any(1).nonzero()
        if share < 1 and len(body):
            first, last = int(body[0]), int(body[-1])
            below = slice(first + math.ceil(share * (last + 1 - first)), None)
            moved[image, 0, below] = 0
            named[image, below] = BACKGROUND
    return moved, named


def _moved(range_m: torch.Tensor, labels: torch.Tensor, maps: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Images and labels with each pixel taken from the one nearest to where its `_source_map`, [B, 2, 2], points."""
    images, _, rows, columns = range_m.shape
    x, y = ((2 * torch.arange(side, device=maps.device) + 1) / side - 1 for side in (columns, rows))
    down, across = (  # a place in the source is the sum of a term of the pixel's column and one of its row
        (maps[:, axis, 0, None] * x * half, (maps[:, axis, 1, None] * y + 1) * half - 0.5)
        for axis, half in ((1, rows / 2), (0, columns / 2))
    )
    if in_loops(range_m):
        moved, named = torch.empty_like(range_m), torch.empty_like(labels)
        places = (tuple(each.numpy() for each in pair) for pair in (down, across))
        loops = import_module("bodyseg_model.training.loops")
        with if_ready:
            loops.move_images(range_m[:, 0].numpy(), labels.numpy(), *places, moved[:, 0].numpy(), named.numpy())
            return moved, named
    row, column = ((by_column[:, None, :] + by_row[:, :, None]).round_() for by_column, by_row in (down, across))
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    place = torch.where(inside, row.mul_(columns).add_(column), 0).int()
    place += torch.arange(images, dtype=torch.int32, device=maps.device)[:, None, None] * (rows * columns)
    ranges, parts = (each.reshape(-1).index_select(0, place.view(-1)).view_as(inside) for each in (range_m, labels))
    return torch.where(inside, ranges, 0)[:, None], torch.where(inside, parts, BACKGROUND)


def _source_map(angle: float, down: float, across: float, rows: int, columns: int) -> list[list[float]]:
    """Affine map from the transformed image to the source, both from -1 to 1 each way: [2, 2], (x, y) -> (x, y)."""
    cosine, sine = math.cos(angle), math.sin(angle)
    aspect = rows / columns
    return [[cosine / across, -sine * aspect / across], [sine / aspect / down, cosine / down]]


def _cut_side(side: int, share: float, rows: int, columns: int) -> tuple[slice, slice]:
    """Rows and columns of the share of an image that is cut off at its top, bottom, left or right."""
    down, across = int(share * rows), int(share * columns)
    every = slice(None)
    if side < 2:
        return (slice(down) if side == 0 else slice(rows - down, None)), every
    return every, (slice(across) if side == 2 else slice(columns - across, None))


def mirror(
    range_m: torch.Tensor, labels: torch.Tensor, chosen: torch.Tensor, label_map: LabelMap = PARTS33
) -> tuple[torch.Tensor, torch.Tensor]:
    """Copies of range [B, 1, H, W] and labels uint8 [B, H, W] in which those `chosen`, bool [B], are mirrored.

    A mirrored person's left hand is a right hand, so labels change sides as `label_map` says. Shadows change sides,
    too: such an image is that of a rig whose projector is on the camera's other side.
    """
    range_m, labels = range_m.clone(), labels.clone()
    table = torch.from_numpy(label_map.mirrored).to(labels.device)
    for image in chosen.nonzero()[:, 0].tolist():  # all together they would take three times as long
        range_m[image] = range_m[image].flip(-1)
        labels[image] = table.index_select(0, labels[image].flatten().int()).view_as(labels[image]).flip(-1)
    return range_m, labels


def signed_numbers(template: torch.Tensor) -> torch.Tensor:
    """The plane `TEMPLATE` of B images, uint16 [B, H, W], as float32 [B, 1, H, W]: 1 + number of a point, 0 of none.

    Of a mirrored image, the negative: its pixel shows what lies opposite of that point, at the place of other sign.
    """
    numbers = template.view(torch.int16).int() & NOWHERE  # no device computes with uint16
    return ((numbers + 1) & NOWHERE).float()[:, None]


def augmented(
    range_m: torch.Tensor,
    labels: torch.Tensor,
    seed: int,
    epochs: list[int],
    keys: list[str],
    geometric: GeometricAugmentation,
    mirrored_as: LabelMap | None,
    places: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
    """Copies of range [B, 1, H, W], labels uint8 [B, H, W] and `signed_numbers`, if given, augmented for a training.

    mirrored_as: how labels change sides in half of the images; None if none is mirrored.
    """
    images = len(labels)
    if places is not None:
        # Numbers go along as further ranges. Draws belong to epochs and keys, so both are moved alike.
        range_m, labels = torch.cat([range_m, places]), torch.cat([labels, labels])
        epochs, keys = epochs * 2, keys * 2
    if mirrored_as is not None:
        draws = mirror_draws(seed, epochs, keys).to(range_m.device)
        range_m, labels = mirror(range_m, labels, draws, mirrored_as)
        range_m[images:][draws[images:]] *= -1  # the numbers, if any
    range_m, labels = placed(geometric, range_m, labels, seed, epochs, keys)
    return range_m[:images], labels[:images], None if places is None else range_m[images:]


def mirror_draws(seed: int, epochs: list[int], keys: list[str]) -> torch.Tensor:
    """Draw the samples that are mirrored, bool [B], each with a chance of one half. epochs, keys: of the B samples."""
    drawn = (Draws(seed, epoch, key).chance("mirror") for epoch, key in zip(epochs, keys, strict=True))
    return torch.tensor([each < 0.5 for each in drawn], dtype=torch.bool)
