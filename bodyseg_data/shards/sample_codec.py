"""Encoding of samples as bytes and decoding: pure, versioned, lossless.

A sample is stored as tar members: `json`, and the images in one of two codecs, identified by the member names.

    bsi   one member of that name, "bodyseg images": runs, slopes, zstd (the default; docs/shard_format.md)
    png   range.png, projector.png, labels.png: for shards that any image tool opens
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig, BadSample
from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.core.sample import Occupancy, Sample, info_from_json
from bodyseg_data.shards.codecs.bodyseg_images import DecodedImages, decode_images, encode_images
from bodyseg_data.shards.codecs.labels import join_labels, split_labels
from bodyseg_data.shards.codecs.png import decode_png, encode_png

CodecName = Literal["bsi", "png"]
CODECS: Final[tuple[CodecName, ...]] = get_args(CodecName)

_PNGS: Final = {"range.png": np.uint16, "projector.png": np.uint16, "labels.png": np.uint8}
_MEMBERS: Final[dict[CodecName, set[str]]] = {"bsi": {"bsi", "json"}, "png": {*_PNGS, "json"}}

OutputArrays = tuple[NDArray[np.uint16], NDArray[np.uint8]]


def check_codec(name: str) -> CodecName:
    """Return `name` if it is a codec's. Raises BadConfig."""
    for known in CODECS:
        if name == known:
            return known
    raise BadConfig(f"the codec must be one of {', '.join(CODECS)}, found {name!r}")


def encode_sample(sample: Sample, codec: str = "bsi") -> dict[str, bytes]:
    """Encode a sample as tar members: extension -> bytes. The same sample gives the same bytes.

    Raises BadConfig for an unknown codec, BadSample for a sample that was read without its occluder range or, with
    "bsi", whose labels and range disagree on the background.
    """
    name = check_codec(codec)
    labels, projector = join_labels(sample.labels, sample.faces_projector), sample.occluder_range()
    members = {"json": json.dumps(asdict(sample.info), sort_keys=True).encode()}
    if name == "bsi":
        if not np.array_equal(sample.range == 0, labels == BACKGROUND):
            raise BadSample(f"{sample.key}: labels must be {BACKGROUND} exactly where range is 0")
        return members | {"bsi": encode_images(sample.range, labels, projector)}
    images: list[NDArray[Any]] = [sample.range, projector, labels]
    return members | {member: encode_png(image) for member, image in zip(_PNGS, images, strict=True)}


def decode_sample(
    key: str, members: Mapping[str, bytes], projector: bool = True, out: OutputArrays | None = None
) -> Sample:
    """Decode the members that `encode_sample` gives, of either codec.

    projector: decode the occluder range, too. out: arrays for range and labels, uint16 and uint8 [H, W], contiguous,
    used if the codec supports it; the sample is then valid until this thread decodes another one.

    Raises BadSample, naming key and member, for members that are missing, unknown or damaged.
    """
    found = set(members)
    if found not in _MEMBERS.values():
        known = " or ".join(", ".join(sorted(names)) for names in _MEMBERS.values())
        raise BadSample(f"{key}: a sample has the members {known}, found {', '.join(sorted(found)) or 'none'}")
    images = (
        _decode_bsi(key, members["bsi"], projector, out) if "bsi" in found else _decode_pngs(key, members, projector)
    )
    try:
        info = info_from_json(json.loads(members["json"]), key)
    except (ValueError, RecursionError) as error:
        raise BadSample(f"{key}: json: {error}") from error
    occupancy = None if out is None else Occupancy(images.edges, images.texels)
    return Sample(key, images.range, images.occluder, images.labels, images.facing, info, occupancy)


def _decode_bsi(key: str, data: bytes, projector: bool, out: OutputArrays | None) -> DecodedImages:
    try:
        return decode_images(data, projector, out)
    except ValueError as error:
        raise BadSample(f"{key}: bsi: {error}") from error


def _decode_pngs(key: str, members: Mapping[str, bytes], projector: bool) -> DecodedImages:
    images: dict[str, NDArray[Any]] = {}
    for member, kind in _PNGS.items():
        if member == "projector.png" and not projector:
            continue
        try:
            images[member] = decode_png(members[member])
        except ValueError as error:
            raise BadSample(f"{key}: {member}: {error}") from error
        if images[member].dtype != kind:
            raise BadSample(f"{key}: {member}: must be {kind.__name__}, found {images[member].dtype}")
    labels, facing = split_labels(images["labels.png"])
    return DecodedImages(images["range.png"], labels, facing, images.get("projector.png"), None, None)
