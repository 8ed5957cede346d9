"""Lengths of limbs and trunk as further shapes of the fitted body: people differ in them more than the open body's do.

A segment runs from the head of one bone to that of another; what hangs from it moves along with its end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import torch

Tensor = torch.Tensor

_SEGMENTS: Final = (
    ("spine05", "neck01", 0.05),
    ("neck01", "head", 0.15),
    ("clavicle", "upperarm01", 0.08),
    ("upperarm01", "lowerarm01", 0.06),
    ("lowerarm01", "wrist", 0.06),
    ("wrist", "finger3-3", 0.08),
    ("upperleg01", "lowerleg01", 0.05),
    ("lowerleg01", "foot", 0.05),
    ("foot", "toe3-1", 0.08),
)
"""First bone, bone at the end, both without the side, and the standard deviation as a share of the length."""


def length_shapes(
    bones: Mapping[str, int], parents: Sequence[int], heads: Tensor, weights: Tensor, rest: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the shift of points [segments, N, 3] and of heads [segments, bones, 3] for one standard deviation each.

    bones: index by name. parents: index of each bone's parent, which comes before it; -1 for the root. heads: [bones,
    3]; weights: [N, bones]; rest: [N, 3]. Both sides lengthen alike.
    """
    moved = torch.zeros((len(_SEGMENTS), *rest.shape), dtype=rest.dtype)
    moved_heads = torch.zeros((len(_SEGMENTS), *heads.shape), dtype=rest.dtype)
    for number, (first, end, share) in enumerate(_SEGMENTS):
        for side in ("",) if first in bones else (".L", ".R"):
            begin, last = bones[first + side], bones.get(end + side, bones.get(end, -1))
            axis = heads[last] - heads[begin]

            def along(points: Tensor, start: Tensor = heads[begin], axis: Tensor = axis) -> Tensor:
                return (((points - start) @ axis) / (axis @ axis)).clip(0, 1)

            chain = _between(parents, begin, last)
            shares = along(rest)
            # A bone that hangs from the segment keeps the share of the place where it leaves it.
            hanging: dict[int, Tensor] = {}
            whole = torch.zeros(len(rest), dtype=rest.dtype)
            for bone, parent in enumerate(parents):
                if bone in chain:
                    whole += weights[:, bone] * shares
                    moved_heads[number, bone] = share * along(heads[bone]) * axis
                elif parent in chain or parent in hanging:
                    hanging[bone] = along(heads[bone]) if parent in chain else hanging[parent]
                    whole += weights[:, bone] * hanging[bone]
                    moved_heads[number, bone] = share * hanging[bone] * axis
            moved[number] += share * whole[:, None] * axis
    return moved, moved_heads


def _between(parents: Sequence[int], first: int, last: int) -> set[int]:
    """Return the bones from `first` to the parent of `last`."""
    chain = set()
    bone = last
    while bone != first:
        bone = parents[bone]
        chain.add(bone)
    return chain
