"""Encoding of samples as bytes and decoding: pure, versioned, lossless.

A sample is stored as tar members: `json`, and the images in one of two codecs, identified by the member names.

    bsi   one member of that name, "bodyseg images": runs, slopes, zstd (the default; docs/shard_format.md)
    png   range.png, projector.png, labels.png: for shards that any image tool opens
"""

from __future__ import annotations

import json
from collections.abc import Mapping

from bodyseg_data.core.errors import BadConfig, BadSample
from bodyseg_data.core.sample import Occupancy, Sample, info_from_json
from bodyseg_data.shards.codecs import CODECS
from bodyseg_data.shards.codecs.codec import OutputArrays
from bodyseg_data.shards.codecs.labels import join_labels


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
    labels, projector = join_labels(sample.labels, sample.faces_projector), sample.occluder_range()
    members = {"json": json.dumps(sample.info.to_json(), sort_keys=True).encode()}
    try:
        return members | chosen.encode(sample.range, labels, projector)
    except ValueError as error:
        raise BadSample(f"{sample.key}: {error}") from error


def decode_sample(
    key: str, members: Mapping[str, bytes], projector: bool = True, out: OutputArrays | None = None
) -> Sample:
    """Decode the members that `encode_sample` gives, of either codec.

    projector: decode the occluder range, too. out: arrays for range and labels, uint16 and uint8 [H, W], contiguous,
    used if the codec supports it; the sample is then valid until this thread decodes another one.

    Raises BadSample, naming key and member, for members that are missing, unknown or damaged.
    """
    codec = next((codec for codec in CODECS.values() if members.keys() == {*codec.members, "json"}), None)
    if codec is None:
        known = " or ".join(", ".join(sorted([*codec.members, "json"])) for codec in CODECS.values())
        raise BadSample(f"{key}: a sample has the members {known}, found {', '.join(sorted(members)) or 'none'}")
    try:
        images = codec.decode(members, projector, out)
    except ValueError as error:
        raise BadSample(f"{key}: {error}") from error
    try:
        info = info_from_json(json.loads(members["json"]), key)
    except (ValueError, RecursionError) as error:
        raise BadSample(f"{key}: json: {error}") from error
    occupancy = None if out is None else Occupancy(images.edges, images.texels)
    return Sample(key, images.range, images.occluder, images.labels, images.facing, info, occupancy)
