"""Steps of pipelines that plain `webdataset` reads shards with.

    images = RangeImages("shards", "all")
    pipeline = wds.WebDataset(images.urls(), shardshuffle=10).shuffle(1000).decode(decoder()).map(images.make)

Readers of streams check no bytes, and their order depends on workers: `loader` does better at both.
"""

import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from bodyseg_data.core import BadSample, reported
from bodyseg_data.labels import UNLABELLED
from bodyseg_data.samples import Sample, info_from_json
from bodyseg_data.shards import CODECS, decode_sample, facing_masks, stored_info


def decoder() -> Callable[[str, bytes], Any]:
    """Return a decoder of a sample's members for `WebDataset(...).decode(...)`.

    Member `bsi` becomes a dictionary: range uint16 [H, W] in steps, 0 is background; projector uint16 [Hp, Wp], the
    projector's range, or None; labels uint8 [H, W], 254 on surfaces of no class, 255 where range is 0; facing uint8
    [H, W], bit 0 set where the surface is turned towards the projector, bit 1 for a second one. Member `plane.NAME.bsp`
    becomes an image uint8 or uint16 [H, W], and `json` a dictionary of the split and the fields. Other members, such as
    the images of sets of PNGs, are left to further decoders. The decoder raises BadSample, which `webdataset` wraps,
    for bytes that are no such member.
    """
    return _decoded


def _decoded(name: str, data: bytes) -> Any:
    member = name.removeprefix(".")
    with reported(member, BadSample, ValueError):
        if member == "json":
            return stored_info(data, member).to_json()
        if member == "bsi":
            images = CODECS["bsi"].decode({member: data}, True, None, UNLABELLED)
            named = {"range": images.range, "projector": images.occluder, "labels": images.labels}
            return {**named, "facing": images.facing}
        if member.startswith("plane.") and member.endswith(".bsp"):
            return CODECS["bsi"].decode_plane(data)
    return None


def sample_of(read: Mapping[str, Any], projectors: int, unlabelled: int) -> Sample:
    """The clean sample that `webdataset` has read: `__key__` and members, as bytes or decoded by `decoder`.

    projectors: of the rig. unlabelled: the label of surfaces of no class, 254 or 255. Raises BadSample.
    """
    key, images = read["__key__"], read.get("bsi")
    members = {name: each for name, each in read.items() if not name.startswith("__")}
    info = members.get("json")
    if isinstance(images, dict):
        labels = np.where(images["labels"] == UNLABELLED, np.uint8(unlabelled), images["labels"])
        first, second = facing_masks(images["facing"], projectors)
        planes = {name.split(".")[1]: plane for name, plane in members.items() if name.startswith("plane.")}
        info = info_from_json(info, key)
        return Sample(key, images["range"], images["projector"], labels, first, info, second, planes)
    members |= {"json": json.dumps(info).encode()} if isinstance(info, dict) else {}
    for name, each in members.items():
        if not isinstance(each, bytes):
            raise BadSample(f"{key}: {name} must be bytes, or decoded by decoder(), found {type(each).__name__}")
    return decode_sample(key, members, projectors=projectors, unlabelled=unlabelled)
