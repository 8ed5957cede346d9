"""The protocol of a codec: the images of a sample as members of a tar and back."""

from collections.abc import Mapping
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Range = NDArray[np.uint16]
Bytes = NDArray[np.uint8]

FACING: Final = 1
"""Bit of a facing image, set where the surface is turned towards the projector."""

SECOND_FACING: Final = 2
"""The same for a rig's second projector."""

OutputArrays = tuple[Range, Bytes]
"""Arrays for range and labels, uint16 and uint8 [H, W], contiguous."""


class DecodedImages(NamedTuple):
    """Decoded images [H, W]. facing: uint8, `FACING` and `SECOND_FACING`. occluder: the projector's range [Hp, Wp],
    None if it was not requested or is not stored.

    edges: flat indices where foreground begins, ends, begins ... in reading order. texels: flat indices where
    `occluder` is not 0. Both are None if decoding did not give them.
    """

    range: Range
    labels: Bytes
    facing: Bytes
    occluder: Range | None
    edges: NDArray[np.int32] | None
    texels: NDArray[np.int32] | None


class ImageCodec(Protocol):
    """Encodes the images of a sample without loss; the same images give the same bytes.

    members: names of its tar members, by which the codec of a sample is identified: no two codecs have the same.
    """

    @property
    def members(self) -> tuple[str, ...]: ...

    def encode(self, camera: Range, labels: Bytes, facing: Bytes, projector: Range | None) -> dict[str, bytes]:
        """Encode as members: name -> bytes. camera [H, W] and projector [Hp, Wp]: ranges, steps, 0 background.

        labels: of the set's classes, 254 on surfaces of none, 255 exactly where camera is 0. facing: bits `FACING` and
        `SECOND_FACING`, 0 on background. projector: None without it. Raises ValueError for what the codec cannot hold.
        """

    def decode(
        self, members: Mapping[str, bytes], projector: bool, out: OutputArrays | None, unlabelled: int
    ) -> DecodedImages:
        """Decode `members`. projector: decode the projector's range, too. out: arrays that may be used for the result.

        unlabelled: the label to give to surfaces of no class, 254 or 255. Raises ValueError, naming the member, for
        bytes that `encode` did not produce; sizes are checked before memory is allocated.
        """

    def encode_plane(self, plane: Bytes | Range) -> dict[str, bytes]:
        """Encode a further image of integers [H, W] as one member, {ending of its name: bytes}."""

    def decode_plane(self, data: bytes) -> Bytes | Range:
        """Decode what `encode_plane` gave. Raises ValueError."""
