"""Encoding of samples as bytes and decoding: pure, versioned, lossless.

A sample is stored as tar members: `json`, and the images in one of two codecs, identified by the member names.

    bsi   one member of that name, "bodyseg images": runs, slopes, zstd (the default; docs/reference/shard_format.md)
    png   range.png, projector.png, labels.png: for shards that any image tool opens
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, BadSample
from bodyseg_data.samples import Occupancy, Sample, SampleInfo, info_from_json
from bodyseg_data.shards.codecs import CODECS
from bodyseg_data.shards.codecs.codec import DecodedImages, OutputArrays, join_labels, mark_things, take_second_facing

_BY_MEMBERS: Final = {frozenset((*codec.members, "json")): codec for codec in CODECS.values()}


def check_codec(name: str) -> str:
    """Return `name` if it is a codec's. Raises BadConfig."""
    if name not in CODECS:
        raise BadConfig(f"the codec must be one of {', '.join(CODECS)}, found {name!r}")
    return name


def encode_sample(sample: Sample, codec: str = "bsi") -> dict[str, bytes]:
    """Encode a sample as tar members: extension -> bytes. The same sample gives the same bytes.

    Raises BadConfig for an unknown codec, BadSample for a sample that was read without its occluder range or, with
    "bsi", whose labels and range disagree on the background.
    """
    chosen = CODECS[check_codec(codec)]
    named = mark_things(sample.labels, sample.range) if sample.info.things else sample.labels
    labels = join_labels(named, sample.faces_projector, sample.faces_second)
    projector = sample.occluder_range()
    members = {"json": json.dumps(sample.info.to_json(), sort_keys=True).encode()}
    try:
        return members | chosen.encode(sample.range, labels, projector)
    except ValueError as error:
        raise BadSample(f"{sample.key}: {error}") from error


def decode_sample(
    key: str,
    members: Mapping[str, bytes],
    projector: bool = True,
    out: OutputArrays | None = None,
    projectors: int = 1,
) -> Sample:
    """Decode the members that `encode_sample` gives, of either codec.

    projector: decode the occluder range, too. out: arrays for range and labels, uint16 and uint8 [H, W], contiguous,
    used if the codec supports it; the sample is then valid until this thread decodes another one, and its `info` is
    parsed when it is asked for. projectors: how many the rig has, 1 or 2.

    Raises BadSample, naming key and member, for members that are missing, unknown or damaged; with `out`, a damaged
    description raises when it is asked for.
    """
    codec = _BY_MEMBERS.get(frozenset(members))
    if codec is None:
        known = " or ".join(", ".join(sorted([*codec.members, "json"])) for codec in CODECS.values())
        raise BadSample(f"{key}: a sample has the members {known}, found {', '.join(sorted(members)) or 'none'}")
    try:
        images = codec.decode(members, projector, out)
    except ValueError as error:
        raise BadSample(f"{key}: {error}") from error
    second = take_second_facing(images.labels) if projectors == 2 else None
    if out is None:
        info = parse_info(members["json"], key)
        return Sample(key, images.range, images.occluder, images.labels, images.facing, info, faces_second=second)
    return _IntoArrays.of(key, images, second, members["json"])


def parse_info(description: bytes, key: str) -> SampleInfo:
    """Parse a sample's member `json`. Raises BadSample, naming the key."""
    try:
        return info_from_json(json.loads(description), key)
    except (ValueError, RecursionError) as error:
        raise BadSample(f"{key}: json: {error}") from error


class _IntoArrays(Sample):
    """A sample decoded into given arrays. Its description, which few artifacts read, is parsed when it is asked for."""

    _description: bytes

    @classmethod
    def of(cls, key: str, images: DecodedImages, second: NDArray[np.bool_] | None, description: bytes) -> Sample:
        sample = cls.__new__(cls)  # not by __init__, which needs the description
        sample.__dict__.update(
            key=key,
            range=images.range,
            projector_range=images.occluder,
            labels=images.labels,
            faces_projector=images.facing,
            occupancy=Occupancy(images.edges, images.texels),
            faces_second=second,
            _description=description,
        )
        return sample

    @cached_property
    def info(self) -> SampleInfo:
        return parse_info(self._description, self.key)
