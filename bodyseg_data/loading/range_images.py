"""Shards and a variant's name -> a PyTorch dataset.

Nothing depends on position: the order of an epoch is a permutation of the samples' place in the manifest, and every
draw belongs to a sample's key. So batches are the same bits for any number of workers and any shard size.
"""

from __future__ import annotations

import fnmatch
import hashlib
import operator
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from bodyseg_data.artifacts.artifact import RangeImage
from bodyseg_data.artifacts.strengths import Artifacts
from bodyseg_data.artifacts.variants import Augmentation, check_variant
from bodyseg_data.core.errors import BadConfig, BadSample, BadShard
from bodyseg_data.core.randomness import check_epoch, check_seed, permutation
from bodyseg_data.core.sample import RANGE_STEP_M, Sample
from bodyseg_data.core.splits import SPLITS, Split
from bodyseg_data.loading.batch_order import BatchOrder, Request
from bodyseg_data.shards.cache.addresses import open_store
from bodyseg_data.shards.cache.store import with_cache
from bodyseg_data.shards.manifest import read_manifest
from bodyseg_data.shards.sample_codec import OutputArrays
from bodyseg_data.shards.stores.remote import RetryPolicy
from bodyseg_data.shards.tar import ShardReader


class Batch(TypedDict):
    """range: float32 [B, 1, H, W], metres, 0 background; labels: uint8 [B, H, W], 0..32 or 255; key: B names.

    Where 16 bits were asked for, range is uint16 in steps of 0.1 mm.
    """

    range: torch.Tensor
    labels: torch.Tensor
    key: list[str]


class RangeImages(Dataset[dict[str, Any]]):
    """A set of shards seen as one of the five variants, made on the fly. Random access; `len()` is exact.

    path: the folder of a set, or a glob that picks some of its shards ("shards/train-*.tar"), on this machine or at an
    address like https://host/shards or s3://bucket/shards. variant: "none", "occ", "noise", "md" or "all". split:
    "train", "test", or None for both. seed: of all draws and of the order. epoch: the first one. artifacts: how strong
    they are; the paper's by default. only: patterns as in file names ("open-A-*", "*-d255-*"), of which a sample's key
    must match one.

    Of remote sets (docs/remote.md): cache: the folder that keeps fetched shards, None for `bodyseg` in the user's cache
    folder. cache_bytes: its limit, None for 20 GB, 0 for no cache. storage_options: for the fsspec filesystem.
    retry_policy: how much trouble is borne.

    Raises BadConfig for an unknown name or an empty selection, BadShard for a set that is damaged or unfinished,
    Unreachable for a remote one that cannot be had, MissingLibrary for a package that its address needs.
    """

    def __init__(
        self,
        path: str | Path,
        variant: str = "all",
        split: Split | None = None,
        seed: int = 0,
        epoch: int = 0,
        artifacts: Artifacts | None = None,
        cache: str | Path | None = None,
        cache_bytes: int | None = None,
        storage_options: Mapping[str, Any] | None = None,
        retry_policy: RetryPolicy | None = None,
        only: Sequence[str] = (),
    ) -> None:
        seed = check_seed(seed)
        if artifacts is not None and not isinstance(artifacts, Artifacts):
            raise BadConfig(f"artifacts must be an Artifacts, found {type(artifacts).__name__}")
        if split is not None and split not in SPLITS:
            raise BadConfig(f"the split must be one of {', '.join(SPLITS)} or None, found {split!r}")
        store, pattern = open_store(_checked_path(path), storage_options, retry_policy)
        self.path = store.name
        self.manifest = read_manifest(store)
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
        self.only = tuple(only)
        if self.only:
            fits = [re.compile(fnmatch.translate(pattern)).match for pattern in self.only]
            keys = (self.manifest.shards[number].keys[index] for number, index in chosen)
            chosen = [place for place, key in zip(chosen, keys, strict=True) if any(fit(key) for fit in fits)]
        if not chosen:
            held = ", ".join(f"{self.manifest.samples(name)} {name}" for name in SPLITS)
            wanted = " ".join((pattern, *self.only))
            raise BadConfig(f"{path} has no sample of split {split!r} that matches {wanted!r}; the set holds {held}")
        self._places: NDArray[np.int64] = np.asarray(chosen, np.int64)
        records = [self.manifest.shards[number] for number in np.unique(self._places[:, 0])]
        self._reader = ShardReader(with_cache(store, records, cache, cache_bytes), self.manifest)
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
        shard, within = self._where(index)
        return self._reader.read(shard, within)

    def image(self, index: int, epoch: int | None = None) -> RangeImage:
        """The sample as the variant shows it in `epoch`, as 16-bit arrays."""
        return self.augmentation(self._sample(index), self.epoch if epoch is None else check_epoch(epoch))

    def _sample(self, index: int, into: OutputArrays | None = None) -> Sample:
        """What the variant needs of a stored sample; into: see `decode_sample`."""
        shard, within = self._where(index)
        return self._reader.read(shard, within, self.augmentation.needs_projector, into)

    def write(self, index: int, epoch: int, image: NDArray[np.uint16], labels: NDArray[np.uint8]) -> None:
        """Put what `image` gives into given arrays [H, W], whatever they hold. Raises BadShard if they do not fit."""
        try:
            self.augmentation.into(self._sample(index, (image, labels)), epoch, image, labels)
        except BadSample as error:
            shard, _, offset = self.place(index)
            raise BadShard(f"{shard}: offset {offset}: {error}") from error

    def __getitem__(self, index: int | Request) -> dict[str, Any]:
        """One sample: range float32 [1, H, W] in metres, labels uint8 [H, W], key.

        index: the sample's place, or (epoch, place) as `batches` gives; a place alone means the epoch last set here,
        of which workers that are running already do not hear.
        """
        epoch, index = index if isinstance(index, tuple) else (None, index)
        return _single(self.image(index, epoch))

    def _where(self, index: int) -> tuple[int, int]:
        """(number of the shard, place in it) of a sample. Raises BadConfig for what is no index, or IndexError."""
        try:
            place = operator.index(index)
        except TypeError:
            raise BadConfig(f"a sample's index must be a whole number, found {index!r}") from None
        if not -len(self) <= place < len(self):
            raise IndexError(f"index {place} of {len(self)} samples")
        shard, within = self._places[place].tolist()
        return shard, within

    def place(self, index: int) -> tuple[str, str, int]:
        """(shard's name, key, offset in the shard) of a sample."""
        number, within = self._where(index)
        shard = self.manifest.shards[number]
        return shard.name, shard.keys[within], shard.offsets[within]

    def batches(
        self,
        batch_size: int,
        shuffle: bool | None = None,
        drop_last: bool = False,
        rank: int | None = None,
        world_size: int | None = None,
    ) -> BatchOrder:
        """A `batch_sampler` for torch's DataLoader or torchdata's StatefulDataLoader; options as of `loader`."""
        return BatchOrder(self, batch_size, shuffle, drop_last, rank, world_size)

    def identity(self) -> dict[str, Any]:
        """What the batches of a run depend on besides their order, as plain JSON; set: digest of all samples' bytes."""
        return {
            "set": self._digest,
            "split": self.split,
            "variant": self.variant,
            "seed": self.seed,
            "artifacts": self.augmentation.artifacts.to_json(),
        } | ({"only": list(self.only)} if self.only else {})

    @cached_property
    def _digest(self) -> str:
        """Of the chosen samples' keys and bytes, in stored order, however they are cut into shards."""
        digest = hashlib.blake2b(digest_size=16)
        for number, within in self._places.tolist():
            shard = self.manifest.shards[number]
            digest.update(f"{shard.keys[within]} {shard.crc32[within]}\n".encode())
        return digest.hexdigest()

    def order(self, epoch: int, shuffle: bool = True) -> NDArray[np.int64]:
        """The order in which a pass visits the samples, int64 [len(self)]; a function of seed and epoch alone."""
        return permutation(len(self), self.seed, check_epoch(epoch)) if shuffle else np.arange(len(self))

    def webdataset(self, epoch: int | None = None) -> Any:
        """A pipeline of `webdataset` over the chosen shards that gives this variant's images, in stored order.

        For a pipeline of your own: chain `.shuffle(1000)` and so on; workers share the shards out. Each sample is read
        by its place in the manifest, as by index: to a reader of streams, a tar that is cut or has an altered header
        may look as if it just ended. Raises BadShard for a sample that is altered or missing.
        """
        import webdataset

        chosen = self.epoch if epoch is None else check_epoch(epoch)
        held: dict[str, list[int]] = {url: [] for url in self.urls()}
        for index in range(len(self)):
            held[f"{self.path}/{self.place(index)[0]}"].append(index)

        def images(shards: Iterable[dict[str, str]]) -> Iterator[dict[str, Any]]:
            for shard in shards:
                for index in held[shard["url"]]:
                    yield _single(self.image(index, chosen))

        pipeline = webdataset.FluidWrapper(webdataset.SimpleShardList(list(held)))
        return pipeline.compose(webdataset.single_node_only, webdataset.split_by_worker, images)

    def stored_bytes(self) -> int:
        """Bytes that the chosen samples take in their shards, headers included."""
        return sum(self.manifest.shards[shard].lengths[index] for shard, index in self._places.tolist())

    def urls(self) -> list[str]:
        """The paths of the shards that hold the chosen samples, in stored order."""
        return [f"{self.path}/{self.manifest.shards[number].name}" for number in np.unique(self._places[:, 0])]


def metres(steps: NDArray[np.uint16], out: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
    """Range in steps as metres, rounded once."""
    found: NDArray[np.float32] = np.multiply(steps, np.float32(RANGE_STEP_M), out=out)
    return found


def _checked_path(path: str | Path) -> str:
    if not isinstance(path, str | Path) or not str(path).strip() or "\0" in str(path):
        raise BadConfig(f"path must be that of a set, as text or a Path, found {path!r}")
    return str(path)


def _single(image: RangeImage) -> dict[str, Any]:
    return {
        "range": torch.from_numpy(metres(image.range)[None]),
        "labels": torch.from_numpy(image.labels),
        "key": image.key,
    }
