"""Steps of pipelines that plain `webdataset` reads shards with.

    images = (
        wds.WebDataset("shards/train-{00000..00009}.tar", shardshuffle=10)
        .shuffle(1000)
        .decode(decoder())
        .map(VariantMaker("shards", "all"))
    )

Readers of streams check no bytes and know no order: `RangeImages` does both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from bodyseg_data.artifacts import PAPER_SENSOR, Augmentation, SensorModel, check_variant, load_sensor_model
from bodyseg_data.core import BadConfig, BadSample, check_epoch, check_seed
from bodyseg_data.labels import BACKGROUND, UNLABELLED, LabelMap, load_label_map, whole_map
from bodyseg_data.loading.image_set import check_bool
from bodyseg_data.samples import Sample, info_from_json, metres
from bodyseg_data.shards import (
    CODECS,
    MANIFEST_FORMAT,
    RIG_FIELD,
    decode_sample,
    facing_masks,
    open_store,
    parse_info,
    read_manifest,
)

_BITS: Final = "labels.png"
"""Member of the codec `png` whose bytes hold facing, too, in sets packed before format 7."""


def decoder(path: str | Path | None = None) -> Callable[[str, bytes], Any]:
    """Return a decoder of a sample's members for `WebDataset(...).decode(...)`.

    Member `bsi` becomes a dictionary: range uint16 [H, W] in steps, 0 is background; projector uint16 [Hp, Wp], the
    projector's range, or None; labels uint8 [H, W], 254 on surfaces of no class, 255 where range is 0; facing uint8
    [H, W], bit 0 set where the surface is turned towards the projector, bit 1 for a second one. `plane.NAME.bsp`
    becomes an image uint8 or uint16 [H, W], `json` a dictionary of the split and the fields. With the codec `png` each
    image is a member: range.png, projector.png, labels.png, facing.png, plane.NAME.png. Other members are left to
    further decoders.

    path: of the set. A set of PNGs needs it: what their label bytes hold is in its manifest. Raises BadConfig or
    BadShard for the set; when a member is decoded BadSample, which `webdataset` wraps, for bytes that are none.
    """
    manifest = None if path is None else read_manifest(open_store(str(path))[0])
    if manifest is not None and manifest.codec == "png" and manifest.read_as != MANIFEST_FORMAT:
        raise BadConfig(f"{path}: labels and facing share bytes in PNGs of {manifest.read_as!r}: use RangeImages")
    return _Decoder(manifest is not None)


class _Decoder:
    """See `decoder`. A class, so that it can be pickled. knows_set: whether the label bytes of PNGs are known."""

    def __init__(self, knows_set: bool) -> None:
        self._knows_set = knows_set

    def __call__(self, name: str, data: bytes) -> Any:
        member = name.removeprefix(".")
        try:
            if member == "json":
                return parse_info(data, member).to_json()
            if member == "bsi":
                images = CODECS["bsi"].decode({member: data}, True, None, UNLABELLED)
                named = {"range": images.range, "projector": images.occluder, "labels": images.labels}
                return {**named, "facing": images.facing}
            if member.startswith("plane.") and member.endswith(".bsp"):
                return CODECS["bsi"].decode_plane(data)
            if member in CODECS["png"].members or (member.startswith("plane.") and member.endswith(".png")):
                if member == _BITS and not self._knows_set:
                    raise BadConfig(f"{member}: give the set, decoder(path): its manifest says what label bytes hold")
                return CODECS["png"].decode_plane(data)
        except ValueError as error:
            raise BadSample(f"{member}: {error}") from error
        return None


class VariantMaker:
    """Makes samples of a set, as `webdataset` gives them, the images of a variant: for `WebDataset(...).map(...)`.

    path: of the set, whose manifest has rigs and classes; no shard is read. variant, seed, sensor, labels, unlabelled:
    as for `RangeImages`, which gives the same bits for the same key and epoch. epoch: of the draws; set it before each
    pass, while no worker is running.

    A sample's members may be bytes, or decoded by `decoder()`. It becomes a dictionary like an item of `RangeImages`:
    range float32 [1, H, W] in metres, labels uint8 [H, W], key; and `__key__`, which further steps need.
    """

    def __init__(
        self,
        path: str | Path,
        variant: str = "all",
        seed: int = 0,
        epoch: int = 0,
        sensor: str | Path | SensorModel = PAPER_SENSOR,
        labels: str | Path | LabelMap | None = None,
        unlabelled: bool = False,
    ) -> None:
        manifest = read_manifest(open_store(str(path))[0])
        model, name, seed = load_sensor_model(sensor), check_variant(variant), check_seed(seed)
        first = Augmentation(manifest.rig, name, seed, model)
        if first.needs_projector and manifest.projector == "none":
            raise BadConfig(f"{path} holds no projector range, which variant {variant!r} needs")
        self._augmentations = tuple(replace(first, rig=rig) for rig in manifest.rigs)
        self._map = whole_map(manifest.classes) if labels is None else load_label_map(labels, manifest.classes)
        self._unlabelled = UNLABELLED if check_bool("unlabelled", unlabelled) else BACKGROUND
        self.epoch = check_epoch(epoch)

    def __call__(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """Make the image of a sample. Raises BadSample for members that are damaged or of another set."""
        clean = self._clean(sample["__key__"], {name: each for name, each in sample.items() if name[:2] != "__"})
        number = clean.info.get(RIG_FIELD, 0) if len(self._augmentations) > 1 else 0
        if number not in range(len(self._augmentations)):
            raise BadSample(f"{clean.key}: {RIG_FIELD!r} must be 0 to {len(self._augmentations) - 1}, found {number!r}")
        augmentation = self._augmentations[number]
        made = augmentation(clean, self.epoch)
        if not self._map.is_whole:
            self._map.write(made.labels, None, self._unlabelled)
        ranges = metres(made.range, augmentation.rig.range_step_m)[None]
        named = {"__key__": clean.key, "key": clean.key}
        return {**named, "range": torch.from_numpy(ranges), "labels": torch.from_numpy(made.labels)}

    def _clean(self, key: str, members: Mapping[str, Any]) -> Sample:
        """The stored sample, of members that are bytes or decoded. Its labels are as the maker gives them."""
        projectors = len(self._augmentations[0].rig.projectors)
        if all(isinstance(each, bytes) for each in members.values()):
            needed = self._augmentations[0].needs_projector
            return decode_sample(key, members, needed, None, projectors, self._unlabelled, ())
        images = members.get("bsi", {name: members.get(f"{name}.png") for name in ("range", "projector", "facing")})
        images = {"labels": members.get(_BITS), **images}
        if not all(isinstance(images.get(name), np.ndarray) for name in ("range", "labels", "facing")):
            raise BadSample(f"{key}: a sample has bsi, or range.png, labels.png and facing.png, found {[*members]}")
        labels = np.where(images["labels"] == UNLABELLED, np.uint8(self._unlabelled), images["labels"])
        first, second = facing_masks(images["facing"], projectors)
        info = info_from_json(members.get("json"), key)
        return Sample(key, images["range"], images["projector"], labels, first, info, faces_second=second)
