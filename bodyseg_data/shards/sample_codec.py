"""Encoding of samples as bytes and decoding: pure, versioned, lossless.

A sample is stored as tar members: `json`, and the images in one of two codecs, identified by the member names.

    bsi   one member of that name, "bodyseg images": runs, slopes, zstd (the default; docs/reference/shard_format.md)
    png   range.png, projector.png, labels.png, facing.png: for shards that any image tool opens

Further planes are members of their own: plane.NAME.bsp, or plane.NAME.png.
"""

import json
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadSample, check_choice, reported
from bodyseg_data.labels import BACKGROUND, UNLABELLED
from bodyseg_data.samples import Sample, SampleInfo, info_from_json
from bodyseg_data.shards.codecs import CODECS
from bodyseg_data.shards.codecs.codec import FACING, SECOND_FACING, ImageCodec, OutputArrays
from bodyseg_data.shards.codecs.png import EarlierPngImages
from bodyseg_data.shards.earlier import completed

_READ: Final[tuple[ImageCodec, ...]] = (*CODECS.values(), EarlierPngImages())
_BY_MEMBERS: Final = {frozenset((*codec.members, "json")): codec for codec in _READ}
_PLANE: Final = "plane."


def encode_sample(sample: Sample, codec: str = "bsi") -> dict[str, bytes]:
    """Encode a sample as tar members: extension -> bytes. The same sample gives the same bytes.

    Raises BadConfig for an unknown codec; with "bsi", BadSample where labels and range disagree on the background.
    """
    chosen = CODECS[check_choice("the codec", codec, CODECS)]
    facing = sample.faces_projector.view(np.uint8) * np.uint8(FACING)
    if sample.faces_second is not None:
        facing |= sample.faces_second.view(np.uint8) * np.uint8(SECOND_FACING)
    members = {"json": json.dumps(sample.info.to_json(), sort_keys=True).encode()}
    for name, plane in sample.planes.items():
        members |= {f"{_PLANE}{name}.{ending}": data for ending, data in chosen.encode_plane(plane).items()}
    with reported(sample.key, BadSample, ValueError):
        return members | chosen.encode(sample.range, sample.labels, facing, sample.projector_range)


def decode_sample(
    key: str,
    members: Mapping[str, bytes],
    *,
    projector: bool = True,
    out: OutputArrays | None = None,
    projectors: int = 1,
    unlabelled: int = UNLABELLED,
    planes: Sequence[str] | None = None,
) -> Sample:
    """Decode the members of a sample that `encode_sample` gives, of either codec.

    projector: decode the projector's range, too. projectors: how many the rig has, 1 or 2.
    out: arrays for range and labels, uint16 and uint8 [H, W], contiguous, used if the codec supports it. The sample is
    then valid until this thread decodes another one, and its `info` is parsed when it is asked for.
    unlabelled: label for surfaces of no class, 254 as stored or 255. planes: further planes to decode, None for all.

    Raises BadSample, naming key and member, for members that are missing, unknown or damaged; with `out`, a damaged
    description raises when it is asked for; BadConfig for another `unlabelled`.
    """
    check_choice("unlabelled", unlabelled, (UNLABELLED, BACKGROUND))
    stored = {name: data for name, data in members.items() if name.startswith(_PLANE)}
    codec = _BY_MEMBERS.get(frozenset(members.keys() - stored.keys()))
    if codec is None:
        known = " or ".join(", ".join(sorted([*codec.members, "json"])) for codec in CODECS.values())
        raise BadSample(f"{key}: a sample has the members {known}, found {', '.join(sorted(members)) or 'none'}")
    try:
        images = codec.decode(members, projector, out, unlabelled)
    except ValueError as error:
        raise BadSample(f"{key}: {error}") from error
    first, second = facing_masks(images.facing, projectors)
    found = _planes(key, codec, stored, planes) if stored and planes != () else {}
    if out is None:
        info = stored_info(members["json"], key)
        return Sample(key, images.range, images.occluder, images.labels, first, info, second, found)
    sample = _IntoArrays.__new__(_IntoArrays)  # not by __init__, which needs the description
    sample.__dict__.update(
        key=key,
        range=images.range,
        projector_range=images.occluder,
        labels=images.labels,
        faces_projector=first,
        faces_second=second,
        planes=found,
        edges=images.edges,
        texels=images.texels,
        _description=members["json"],
    )
    return sample


def facing_masks(facing: NDArray[np.uint8], projectors: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_] | None]:
    """The pixels that face the first projector and, of a rig that has one, the second."""
    if projectors == 1:
        return facing.view(np.bool_), None
    return (facing & np.uint8(FACING)).view(np.bool_), (facing >> np.uint8(1)).view(np.bool_)


def _planes(
    key: str, codec: ImageCodec, stored: Mapping[str, bytes], names: Sequence[str] | None
) -> dict[str, NDArray[Any]]:
    """Decode the planes that are asked for. Raises BadSample, naming the member."""
    found = {}
    for member, data in stored.items():
        name = member.removeprefix(_PLANE).partition(".")[0]
        if names is not None and name not in names:
            continue
        with reported(f"{key}: {member}", BadSample, ValueError):
            found[name] = codec.decode_plane(data)
    return found


def parse_info(description: bytes, key: str) -> SampleInfo:
    """Parse a sample's member `json`. Raises BadSample, naming the key."""
    with reported(f"{key}: json", BadSample, ValueError, RecursionError):
        return info_from_json(json.loads(description), key)


def stored_info(description: bytes, key: str) -> SampleInfo:
    """As `parse_info`, with all fields also of a sample of an earlier format."""
    return completed(parse_info(description, key))


class _IntoArrays(Sample):
    """A sample decoded into given arrays. Its description, which few artifacts read, is parsed when it is asked for."""

    _description: bytes

    @cached_property
    def info(self) -> SampleInfo:
        return stored_info(self._description, self.key)
