"""A person's surface and skeleton, posed by linear skinning in NumPy in a few milliseconds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Posable:
    """A person's skeleton in its reference pose, and the surface as it was modelled; metres, body frame.

    bones: names, parents before children. parents: int [B], -1 for the root. heads: float64 [B, 3], where bones begin
    in the reference pose; modelled_heads: the same of the modelled surface. reference: float64 [B, 3, 3], the turn of
    each bone from there to the reference pose. modelled: float64 [V, 3]. faces: int32 [F, 3]. skin: int [V, K], the
    bones that move each vertex. weights: float64 [V, K], which sum to 1.
    """

    bones: tuple[str, ...]
    parents: NDArray[np.int64]
    heads: Floats
    modelled_heads: Floats
    reference: Floats
    modelled: Floats
    faces: NDArray[np.int32]
    skin: NDArray[np.int64]
    weights: Floats

    @cached_property
    def numbers(self) -> dict[str, int]:
        """Index of each bone by its name."""
        return {bone: index for index, bone in enumerate(self.bones)}

    @cached_property
    def owner(self) -> NDArray[np.int64]:
        """The bone that moves each vertex most, int [V]."""
        strongest = self.weights.argmax(axis=1)
        return np.asarray(self.skin[np.arange(len(self.skin)), strongest], np.int64)

    def placed(self, rotations: Mapping[str, Floats]) -> tuple[Floats, Floats]:
        """Return every bone's turn [B, 3, 3] in the body frame and its head [B, 3], the root's head at its rest.

        rotations: [3, 3] by bone name, each in its parent's frame; other bones keep the reference pose.
        """
        turns, heads = np.empty((len(self.bones), 3, 3)), np.empty((len(self.bones), 3))
        for index, (bone, parent) in enumerate(zip(self.bones, self.parents, strict=True)):
            own = rotations.get(bone)
            if parent < 0:
                turns[index], heads[index] = np.eye(3) if own is None else own, self.heads[index]
                continue
            turns[index] = turns[parent] if own is None else turns[parent] @ own
            heads[index] = heads[parent] + turns[parent] @ (self.heads[index] - self.heads[parent])
        return turns, heads

    def vertices(self, turns: Floats, heads: Floats) -> Floats:
        """Return the surface [V, 3] for bones as `placed` returns them."""
        whole = turns @ self.reference
        shifts = heads - np.einsum("bij,bj->bi", whole, self.modelled_heads)
        blended = np.einsum("vk,vkij->vij", self.weights, whole[self.skin])
        moved: Floats = np.einsum("vij,vj->vi", blended, self.modelled)
        moved += np.einsum("vk,vki->vi", self.weights, shifts[self.skin])
        return moved
