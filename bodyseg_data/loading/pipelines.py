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
from typing import Any

import numpy as np
import torch

from bodyseg_data.artifacts import PAPER_SENSOR, Augmentation, SensorModel, check_variant, load_sensor_model
from bodyseg_data.core import BadConfig, BadSample, check_epoch, check_seed
from bodyseg_data.labels import BACKGROUND, UNLABELLED, LabelMap, load_label_map, whole_map
from bodyseg_data.loading.image_set import check_bool
from bodyseg_data.samples import Sample, info_from_json, metres
from bodyseg_data.shards import CODECS, decode_sample, facing_masks, open_store, parse_info, read_manifest


def decoder() -> Callable[[str, bytes], Any]:
    """Return a decoder of a sample's members for `WebDataset(...).decode(...)`.

    Member `bsi` becomes a dictionary: range uint16 [H, W] in steps, 0 is background; projector uint16 [Hp, Wp], the
    projector's range, or None; labels uint8 [H, W], 254 on surfaces of no class, 255 where range is 0; facing uint8
    [H, W], bit 0 set where the surface is turned towards the projector, bit 1 for a second one. `plane.NAME.bsp`
    becomes an image uint8 or uint16 [H, W], `json` a dictionary of the split and the fields. Other members are left to
    further decoders, as are the images of sets of PNGs. It raises BadSample, which `webdataset` wraps, for bytes that
    are no such member.
    """
    return _decoded


def _decoded(name: str, data: bytes) -> Any:
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
    except ValueError as error:
        raise BadSample(f"{member}: {error}") from error
    return None


class VariantMaker:
    """Makes samples of a set, as `webdataset` gives them, the images of a variant: for `WebDataset(...).map(...)`.

    path: of the set, whose manifest has rigs and classes; no shard is read. variant, seed, sensor, labels, unlabelled:
    as for `RangeImages`, which gives the same bits for the same key and epoch. epoch: of the draws; set it before each
    pass, while no worker is running.

    A sample's members may be bytes, of either codec, or decoded by `decoder()`. It becomes a dictionary like an item of
    `RangeImages`: range float32 [1, H, W] in metres, labels uint8 [H, W], key; and `__key__`, which further steps need.
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
        self._set = replace(read_manifest(open_store(str(path))[0]), shards=())
        model, name, seed = load_sensor_model(sensor), check_variant(variant), check_seed(seed)
        self._augmentations = {rig: Augmentation(rig, name, seed, model) for rig in self._set.rigs}
        self._needs_projector = self._augmentations[self._set.rig].needs_projector
        if self._needs_projector and self._set.projector == "none":
            raise BadConfig(f"{path} holds no projector range, which variant {variant!r} needs")
        classes = self._set.classes
        self._map = whole_map(classes) if labels is None else load_label_map(labels, classes)
        self._unlabelled = UNLABELLED if check_bool("unlabelled", unlabelled) else BACKGROUND
        self.epoch = check_epoch(epoch)

    def __call__(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """Make the image of a sample. Raises BadSample for members that are damaged or of another set."""
        clean = self._clean(sample["__key__"], {name: each for name, each in sample.items() if name[:2] != "__"})
        rig = self._set.rig_of(clean)
        made = self._augmentations[rig](clean, self.epoch)
        if not self._map.is_whole:
            self._map.write(made.labels, None, self._unlabelled)
        ranges = torch.from_numpy(metres(made.range, rig.range_step_m)[None])
        return {"__key__": clean.key, "key": clean.key, "range": ranges, "labels": torch.from_numpy(made.labels)}

    def _clean(self, key: str, members: Mapping[str, Any]) -> Sample:
        """The stored sample, of members that are bytes or decoded, with labels as the maker gives them."""
        projectors, images = len(self._set.rig.projectors), members.get("bsi")
        if not isinstance(images, dict):
            return decode_sample(key, members, self._needs_projector, None, projectors, self._unlabelled, ())
        labels = np.where(images["labels"] == UNLABELLED, np.uint8(self._unlabelled), images["labels"])
        first, second = facing_masks(images["facing"], projectors)
        info = info_from_json(members.get("json"), key)
        return Sample(key, images["range"], images["projector"], labels, first, info, faces_second=second)
