"""The protocol of a codec: the images of a sample as members of a tar, and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

OutputArrays = tuple[NDArray[np.uint16], NDArray[np.uint8]]
"""Arrays for range and labels, uint16 and uint8 [H, W], contiguous."""


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

        labels: label bytes [H, W] (`labels.join_labels`). Raises ValueError for images that the codec cannot hold.
        """

    def decode(self, members: Mapping[str, bytes], projector: bool, out: OutputArrays | None) -> DecodedImages:
        """Decode `members`. projector: decode the occluder range, too. out: arrays that may be used for the result.

        Raises ValueError, naming the member, for bytes that `encode` did not produce; sizes are checked before memory
        is allocated.
        """
