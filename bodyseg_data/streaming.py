"""Shards and a variant's name -> a PyTorch dataset.

Nothing depends on position: the order of an epoch is a permutation of the samples' place in the manifest, and every
draw belongs to a sample's key. So batches are the same bits for any number of workers and any shard size.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from bodyseg_data.errors import BadConfig, BadShard, BodysegError
from bodyseg_data.manifest import MANIFEST_NAME, read_manifest
from bodyseg_data.randomness import check_epoch, check_seed, permutation
from bodyseg_data.sample import RANGE_STEP_M, Sample
from bodyseg_data.shards import ShardReader
from bodyseg_data.splits import SPLITS, Split
from bodyseg_data.variants import Artifacts, Augmentation, RangeImage, check_variant


class Batch(TypedDict):
    """range: float32 [B, 1, H, W], metres, 0 background; labels: uint8 [B, H, W], 0..32 or 255; key: B names."""

    range: torch.Tensor
    labels: torch.Tensor
    key: list[str]


class RangeImages(Dataset[dict[str, Any]]):
    """A set of shards seen as one of the five variants, made on the fly. Random access; `len()` is exact.

    path: the folder of a set, or a glob that picks some of its shards ("shards/train-*.tar"). variant: "none", "occ",
    "noise", "md" or "all". split: "train", "test", or None for both. seed: of all draws and of the order. epoch: the
    first one. artifacts: how strong they are; the paper's by default.

    Raises BadConfig for an unknown name or an empty selection, BadShard for a set that is damaged or unfinished.
    """

    def __init__(
        self,
        path: str | Path,
        variant: str = "all",
        split: Split | None = None,
        seed: int = 0,
        epoch: int = 0,
        artifacts: Artifacts | None = None,
    ) -> None:
        seed = check_seed(seed)
        if artifacts is not None and not isinstance(artifacts, Artifacts):
            raise BadConfig(f"artifacts must be an Artifacts, found {type(artifacts).__name__}")
        if split is not None and split not in SPLITS:
            raise BadConfig(f"the split must be one of {', '.join(SPLITS)} or None, found {split!r}")
        folder, pattern = _locate(str(path))
        self.path = folder
        self.manifest = read_manifest(folder)
        self.split, self.seed = split, seed
        self.augmentation = Augmentation(
            self.manifest.rig, check_variant(variant), seed, Artifacts() if artifacts is None else artifacts
        )
        chosen = [
            (number, index)
            for number, shard in enumerate(self.manifest.shards)
            if split in (None, shard.split) and Path(shard.name).match(pattern)
            for index in range(len(shard))
        ]
        if not chosen:
            held = ", ".join(f"{self.manifest.samples(name)} {name}" for name in SPLITS)
            raise BadConfig(f"{path} has no sample of split {split!r} that matches {pattern!r}; the set holds {held}")
        self._places: NDArray[np.int64] = np.asarray(chosen, np.int64)
        self._reader = ShardReader(folder, self.manifest)
        self.epoch = 0
        self.epochs_set = 0
        self.set_epoch(epoch)

    @property
    def variant(self) -> str:
        """The variant's name."""
        return self.augmentation.variant

    @property
    def keys(self) -> list[str]:
        """The keys of all samples, in stored order."""
        return [self.manifest.shards[shard].keys[index] for shard, index in self._places.tolist()]

    def set_epoch(self, epoch: int) -> None:
        """The epoch that indexing draws for, and that a loader's next pass is."""
        self.epoch = check_epoch(epoch)
        self.epochs_set += 1

    def __len__(self) -> int:
        return len(self._places)

    def clean(self, index: int) -> Sample:
        """The stored sample, without artifacts."""
        shard, place = self._places[index].tolist()
        return self._reader.read(shard, place)

    def image(self, index: int, epoch: int | None = None) -> RangeImage:
        """The sample as the variant shows it in `epoch`, as 16-bit arrays."""
        return self.augmentation(self.clean(index), self.epoch if epoch is None else check_epoch(epoch))

    def __getitem__(self, index: int) -> dict[str, Any]:
        """One sample: range float32 [1, H, W] in metres, labels uint8 [H, W], key."""
        if not -len(self) <= index < len(self):
            raise IndexError(f"index {index} of {len(self)} samples")
        return _single(self.image(index))

    def order(self, epoch: int, shuffle: bool = True) -> NDArray[np.int64]:
        """The order in which a pass visits the samples, int64 [len(self)]; a function of seed and epoch alone."""
        return permutation(len(self), self.seed, epoch) if shuffle else np.arange(len(self))

    def webdataset(self, epoch: int | None = None) -> Any:
        """A `webdataset.WebDataset` over the chosen shards that gives this variant's images, in stored order.

        For reading where random access is slow, or in a pipeline of your own: chain `.shuffle(1000)` and so on. The
        images have the same bits as by index, and each one's bytes are checked against the manifest: raises BadShard
        for a sample that is altered or unknown. A tar cut between two samples only ends early, which no reader of a
        stream can see; `bodyseg verify` does.
        """
        import webdataset

        chosen = self.epoch if epoch is None else check_epoch(epoch)
        places = {self.manifest.shards[shard].keys[index]: (shard, index) for shard, index in self._places.tolist()}

        def image(raw: dict[str, Any]) -> dict[str, Any]:
            key = raw["__key__"]
            if key not in places:
                raise BadShard(f"{raw.get('__url__', self.path)}: {key}: not among the chosen samples of the manifest")
            members = {name: data for name, data in raw.items() if not name.startswith("_")}
            return _single(self.augmentation(self._reader.decode(*places[key], members), chosen))

        return webdataset.WebDataset(self.urls(), shardshuffle=False, handler=_refuse).map(image)

    def stored_bytes(self) -> int:
        """Bytes that the chosen samples take in their shards, headers included."""
        return sum(self.manifest.shards[shard].lengths[index] for shard, index in self._places.tolist())

    def urls(self) -> list[str]:
        """The paths of the shards that hold the chosen samples, in stored order."""
        return [str(self.path / self.manifest.shards[number].name) for number in np.unique(self._places[:, 0])]


def _refuse(error: Exception) -> bool:
    """What a pipeline does with a tar it cannot read."""
    raise error if isinstance(error, BodysegError) else BadShard(f"a shard cannot be read: {error}") from error


def _locate(path: str) -> tuple[Path, str]:
    """Folder of the set and the pattern its shards must match."""
    if "://" in path:
        raise BadConfig(f"shards are read from local folders, found {path!r}: copy the set here first")
    place = Path(path)
    if any(mark in place.name for mark in "*?["):
        return place.parent, place.name
    if place.name == MANIFEST_NAME:
        return place.parent, "*"
    if place.suffix == ".tar":
        return place.parent, place.name
    return place, "*"


class PackedBatch(TypedDict):
    """What crosses from a worker: 16 bits a pixel, not 32, because the copy between processes is the bottleneck."""

    range: torch.Tensor
    labels: torch.Tensor
    key: list[str]


def pack_batch(images: list[RangeImage]) -> PackedBatch:
    """Images of one size as one batch of 16 bits."""
    return {
        "range": torch.from_numpy(np.stack([image.range for image in images])[:, None]),
        "labels": torch.from_numpy(np.stack([image.labels for image in images])),
        "key": [image.key for image in images],
    }


def metres(packed: PackedBatch) -> Batch:
    """The batch that users get."""
    steps = packed["range"]
    return {"range": steps.to(torch.float32).mul_(RANGE_STEP_M), "labels": packed["labels"], "key": packed["key"]}


def _single(image: RangeImage) -> dict[str, Any]:
    batch = metres(pack_batch([image]))
    return {"range": batch["range"][0], "labels": batch["labels"][0], "key": image.key}
