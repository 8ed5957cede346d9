"""The protocol of a codec, the images of a sample as members of a tar and back, and the label byte that codecs store.

A label byte is 255 for background; else bits 0 to 5 hold the part, and bit 6 is set if the surface faces the projector.
A thing, which has a range and no label, is stored as part 62. Bit 7 is set if the surface faces the second projector,
of a rig that has one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.labels import BACKGROUND

FACING_BIT: Final = 0x40
"""Bit of a stored label, set where the surface faces the projector; background stays 255."""
SECOND_FACING_BIT: Final = 0x80
"""The same for a rig's second projector."""
THING: Final = 62
"""Stored part of pixels that see a thing, read as 255; with both facing bits it still differs from background."""

OutputArrays = tuple[NDArray[np.uint16], NDArray[np.uint8]]
"""Arrays for range and labels, uint16 and uint8 [H, W], contiguous."""


def mark_things(labels: NDArray[np.uint8], range_image: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Labels with `THING` for 255 wherever something was measured, in an array of their own, uint8 [H, W]."""
    marked: NDArray[np.uint8] = np.where((labels == BACKGROUND) & (range_image > 0), np.uint8(THING), labels)
    return marked


def join_labels(
    labels: NDArray[np.uint8], faces_projector: NDArray[np.bool_], faces_second: NDArray[np.bool_] | None = None
) -> NDArray[np.uint8]:
    """Pack labels, 0 to 32, `THING` or 255, and masks of pixels that face the projectors: label bytes, uint8 [H, W]."""
    joined = labels | (faces_projector.view(np.uint8) * np.uint8(FACING_BIT))
    if faces_second is not None:
        joined |= faces_second.view(np.uint8) * np.uint8(SECOND_FACING_BIT)
    return joined


def split_labels(stored: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Unpack label bytes into labels, 0 to 32 or 255, and the mask of pixels that face the projector.

    The bit of a second projector stays in the labels (`take_second_facing`).
    """
    facing: NDArray[np.bool_] = (stored & np.uint8(FACING_BIT)) != 0
    facing &= stored != BACKGROUND
    labels = stored ^ (facing.view(np.uint8) * np.uint8(FACING_BIT))
    labels[labels == THING] = BACKGROUND
    return labels, facing


def take_second_facing(labels: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Remove the bit of the second projector from labels of `split_labels`, in place; returns its mask, bool [H, W]."""
    facing: NDArray[np.bool_] = labels.view(np.int8) < np.int8(-1)  # from 128 to 254: background is -1
    labels -= facing.view(np.uint8) * np.uint8(SECOND_FACING_BIT)
    labels[labels == THING] = BACKGROUND
    return facing


class DecodedImages(NamedTuple):
    """Decoded images [H, W]. occluder: the occluder range [Hp, Wp], None if it was not requested.

    edges: flat indices where foreground begins, ends, begins ... in reading order. texels: flat indices where
    `occluder` is not 0. Both are None if decoding did not give them.
    """

    range: NDArray[np.uint16]
    labels: NDArray[np.uint8]
    facing: NDArray[np.bool_]
    occluder: NDArray[np.uint16] | None
    edges: NDArray[np.int32] | None
    texels: NDArray[np.int32] | None


class ImageCodec(Protocol):
    """Encodes the images of a sample without loss; the same images give the same bytes.

    members: names of its tar members, by which the codec of a sample is identified: no two codecs have the same.
    """

    @property
    def members(self) -> tuple[str, ...]: ...

    def encode(
        self, camera: NDArray[np.uint16], labels: NDArray[np.uint8], projector: NDArray[np.uint16]
    ) -> dict[str, bytes]:
        """Encode as members: name -> bytes. camera [H, W] and projector [Hp, Wp]: ranges, steps, 0 background.

        labels: label bytes [H, W] (`join_labels`). Raises ValueError for images that the codec cannot hold.
        """

    def decode(self, members: Mapping[str, bytes], projector: bool, out: OutputArrays | None) -> DecodedImages:
        """Decode `members`. projector: decode the occluder range, too. out: arrays that may be used for the result.

        Raises ValueError, naming the member, for bytes that `encode` did not produce; sizes are checked before memory
        is allocated.
        """
