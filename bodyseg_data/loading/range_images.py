"""PyTorch dataset over a set of shards, seen as one of the five variants.

Nothing depends on a position in a stream: the order of an epoch is a permutation of indices in the manifest, and every
draw belongs to a sample's key. So batches are the same bits for any number of workers and any shard size.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from bodyseg_data.artifacts import (
    PAPER_SENSOR,
    Augmentation,
    RangeImage,
    SensorModel,
    artifacts_to_json,
    check_variant,
    load_sensor_model,
    seen_by_projectors,
)
from bodyseg_data.core import BadConfig, BadSample, BadShard, Draws, check_choice, check_epoch, check_seed
from bodyseg_data.labels import BACKGROUND, TEMPLATE, UNLABELLED, LabelMap, load_label_map, whole_map
from bodyseg_data.loading.conditions import named_fields, table_of, texts_of
from bodyseg_data.loading.image_set import ImageSet, Request, Requests, Shuffle, check_bool, check_index
from bodyseg_data.loading.pipelines import sample_of
from bodyseg_data.loading.selection import BlockOrder, Selection, permutation
from bodyseg_data.loading.skipping import with_text
from bodyseg_data.loading.transform import (
    BadTransform,
    CameraImage,
    Transforms,
    check_transforms,
    transform_image,
    transformed_shape,
    transforms_to_json,
)
from bodyseg_data.samples import OccluderName, ReadSplit, Sample, metres
from bodyseg_data.shards import (
    RIG_FIELD,
    TALLY,
    Manifest,
    Place,
    RetryPolicy,
    ShardReader,
    ShardRecord,
    Stage,
    open_columns,
    open_store,
    read_manifest,
    with_cache,
    with_columns,
    with_kept_index,
)


class RangeImages(ImageSet):
    """Dataset of range images with artifacts: one variant of a set of shards. Random access; `len()` is exact.

    path: the folder of a set, or a glob that picks some of its shards ("shards/train-*.tar"), on this machine or at an
    address like https://host/shards or s3://bucket/shards.
    variant: "none", "occ", "noise", "md", "all", or two artifacts, like "noise+md".
    split: "train", "test", "val" (with `val_share`), or None for train and test.
    seed: of all draws and of the order. epoch: the first epoch.
    sensor: the artifacts, of which the variant takes those of its kinds: a model, the name of one that ships with the
    package, or a TOML file (docs/how-to/sensors.md).
    transform: of samples, one or several, applied in their order by the workers (docs/how-to/transforms.md).
    labels: classes in place of the set's own: a map, the name of one that ships with the package, or a TOML file
    (docs/how-to/label_maps.md). A map of regions of the template takes them from the column `template`.
    unlabelled: surfaces of no class get 254 instead of 255, so that 255 means that nothing was measured.
    planes: names of further images that items and batches hold, like "instances"; as stored, also at lost pixels.
    occluder: "camera" makes the projector's range out of what the camera sees, also for a set that holds none; what the
    camera does not see then casts no shadow (docs/how-to/streaming.md).
    only: patterns as for file names ("open-A-*", "*-d255-*"), one or several; a sample's key must match one of them.
    where: conditions like "distance_cm<=255", one or several; a sample must meet all (docs/how-to/streaming.md).
    columns: names of columns to open, planes or fields that the set got later (docs/how-to/columns.md); those that
    `where` and `planes` name are opened in any case.
    val_share: share of train, 0 to below 1, read as "val" instead: whole people and motions (docs/how-to/splits.md).

    For remote sets (docs/how-to/remote.md):
    cache: folder that keeps fetched shards, None for `bodyseg` in the user's cache folder.
    cache_bytes: its limit, None for 20 GB, 0 for no cache. storage_options: for the fsspec filesystem.
    retry_policy: limits of retries and of waiting.

    Raises BadConfig for an unknown name, a bad sensor or an empty selection, BadShard for a set that is damaged or
    unfinished, Unreachable for a remote set that cannot be fetched, MissingLibrary for a package that an address needs.
    """

    def __init__(
        self,
        path: str | Path,
        variant: str = "all",
        split: ReadSplit | None = None,
        seed: int = 0,
        *,
        epoch: int = 0,
        sensor: str | Path | SensorModel = PAPER_SENSOR,
        cache: str | Path | None = None,
        cache_bytes: int | None = None,
        storage_options: Mapping[str, Any] | None = None,
        retry_policy: RetryPolicy | None = None,
        only: str | Sequence[str] = (),
        transform: Transforms = (),
        labels: str | Path | LabelMap | None = None,
        where: str | Sequence[str] = (),
        val_share: float = 0.0,
        unlabelled: bool = False,
        planes: Sequence[str] = (),
        occluder: OccluderName = "stored",
        columns: str | Sequence[str] = (),
    ) -> None:
        seed = check_seed(seed)
        model = load_sensor_model(sensor)
        if not isinstance(path, str | Path) or not str(path).strip() or "\0" in str(path):
            raise BadConfig(f"path must be that of a set, as text or a Path, found {path!r}")
        store, pattern = open_store(str(path), storage_options, retry_policy)
        self.path = store.name
        self.manifest = with_kept_index(read_manifest(store), store, cache, cache_bytes)
        classes = self.manifest.classes
        self.label_map = whole_map(classes) if labels is None else load_label_map(labels, classes)
        on_template = (TEMPLATE,) if self.label_map.template is not None else ()
        asked = (*texts_of("planes", planes), *on_template)
        named = (*named_fields(where), *asked, *(("subject",) if val_share else ()))  # val is chosen by subject
        self.columns = open_columns(store, self.manifest, texts_of("columns", columns), named)
        self.manifest = with_columns(self.manifest, self.columns)
        self.split, self.seed, self.variant = split, seed, check_variant(variant)
        self.augmentation = Augmentation(self.manifest.rig, self.variant, seed, model, classes)
        """Of the set's first rig; see `augmentation_of`."""
        self._augmentations: dict[int, Augmentation] = {}
        self._casts = occluder == "camera" and self.augmentation.needs_projector
        self.occluder = check_choice("occluder", occluder, get_args(OccluderName))
        if self.augmentation.needs_projector and self.manifest.projector == "none" and occluder == "stored":
            raise BadConfig(
                f"{path} holds no projector range, which variant {variant!r} needs: use 'none', 'noise' or 'md', or "
                "occluder='camera', which makes shadows of what the camera sees"
            )
        if TEMPLATE in asked and TEMPLATE not in (self.columns if on_template else self.manifest.planes):
            need = f", which labels {self.label_map.name!r} need" if on_template else ""
            raise BadConfig(
                f"{path} has no map of the body, the column {TEMPLATE!r}{need}: `shard --template` packs it for the "
                "open sources"
            )
        self.planes = _chosen_planes(planes, self.manifest)
        """Name -> type of the further images that items and batches hold."""
        source = self.columns[TEMPLATE].source if TEMPLATE in self.columns else "column"
        self._has_map = TEMPLATE in self.planes and source != "column"
        self.transforms = check_transforms(transform)
        self.unlabelled = UNLABELLED if check_bool("unlabelled", unlabelled) or self.label_map.has_rest else BACKGROUND
        self.step_m = self.manifest.rig.range_step_m
        """One step of uint16 range images, metres: the rig's."""
        camera = self.manifest.rig.camera
        self.shape = transformed_shape(self.transforms, camera.rows, camera.columns)
        """Rows and columns of the images, as the transforms leave them."""
        self._joins = not self.label_map.is_whole
        self._regions = self._regions_of(self.path) if on_template else None
        self._read_planes = tuple(dict.fromkeys((*self.planes, *on_template)))
        self.selection = Selection.of(pattern, split, only, where, val_share, self.manifest.fields, self.manifest.rigs)
        self._samples = self.selection.choose(self.manifest, str(path))
        chosen = self._samples.shards
        read_from = [self.manifest.shards, *(column.shards for column in self.columns.values() if column.planes)]
        files = (shards[number] for shards in read_from for number in chosen)  # of a local set, none is asked for
        self.reader = ShardReader(with_cache(store, files, cache, cache_bytes), self.manifest, self.columns)
        self.set_epoch(epoch)

    @property
    def keys(self) -> list[str]:
        """Keys of all samples, in stored order."""
        return [key for shard, own in self._chosen_records() for key in map(shard.keys.__getitem__, own)]

    @property
    def sets(self) -> tuple[RangeImages, ...]:
        """The one set itself; a mixture has several."""
        return (self,)

    def __len__(self) -> int:
        return len(self._samples)

    def __repr__(self) -> str:
        shown: dict[str, Any] = {"variant": self.variant, "split": self.split, "seed": self.seed, "epoch": self.epoch}
        shown |= self.selection.filters()
        shown |= {"transforms": list(self.transforms)} if self.transforms else {}
        shown |= {"labels": self.label_map.name} if self._joins else {}
        shown |= {"planes": list(self.planes)} if self.planes else {}
        shown |= {"occluder": self.occluder} if self._casts else {}
        rigs = self.manifest.rig.name if len(self.manifest.rigs) == 1 else f"{len(self.manifest.rigs)} rigs"
        shown |= {"samples": len(self), "image": "{} x {}".format(*self.shape), "rig": rigs}
        shown |= {"sensor": self.augmentation.sensor.name}
        return f"RangeImages({self.path!r}, {', '.join(f'{name}={value!r}' for name, value in shown.items())})"

    def clean(self, index: int) -> Sample:
        """Return the stored sample, without artifacts, with all of its planes and the set's own labels.

        With `labels` of the template, these are regions of the template instead, the classes of `manifest.classes`
        here. With `occluder="camera"`, the projector's range is made of the camera's, as artifacts use it.
        """
        shard, within = self._where(index)
        sample = self.reader.read(shard, within, self.occluder == "stored", unlabelled=self.unlabelled)
        vars(sample).update(labels=self._labels_of(sample))
        return self._shaded(sample) if self.occluder == "camera" else sample

    def _regions_of(self, path: str) -> NDArray[np.uint8]:
        """The label of each number of the plane `TEMPLATE`, uint8 [65536]; makes the regions the set's classes."""
        from bodyseg_data.bodies import load_template, region_labels

        if self.columns[TEMPLATE].source != load_template().name:
            found = f"{self.columns[TEMPLATE].source!r}, here {load_template().name!r}"
            raise BadShard(f"{path}: the column {TEMPLATE!r} is of another template: {found}")
        self.manifest = replace(self.manifest, classes=self.label_map.of)
        regions = region_labels(self.label_map)
        return np.where(regions == UNLABELLED, np.uint8(self.unlabelled), regions)

    def _labels_of(self, sample: Sample) -> NDArray[np.uint8]:
        """A clean sample's labels; its regions of the template, if the label map joins those. Raises BadSample."""
        if self._regions is None:
            return sample.labels
        if TEMPLATE not in sample.planes:
            raise BadSample(f"{sample.key}: labels {self.label_map.name!r} need the column {TEMPLATE!r}")
        found: NDArray[np.uint8] = self._regions.take(sample.planes[TEMPLATE])
        found[sample.range == 0] = BACKGROUND
        return found

    def augmentation_of(self, sample: Sample) -> Augmentation:
        """Return the artifacts made for the sample's own rig. Raises BadSample for a rig that the set does not have."""
        if len(self.manifest.rigs) == 1:
            return self.augmentation
        rig, number = self.manifest.rig_of(sample), sample.info.get(RIG_FIELD)
        if number not in self._augmentations:
            self._augmentations[number] = replace(self.augmentation, rig=rig)
        return self._augmentations[number]

    def _shaded(self, sample: Sample) -> Sample:
        """The sample with the projector's range computed from the camera's."""
        cast = seen_by_projectors(sample.range, self.manifest.rig_of(sample))
        return replace(sample, projector_range=cast, texels=None)

    def image(self, index: int, epoch: int | None = None) -> RangeImage:
        """Return the sample with artifacts and transforms as drawn in `epoch`, as 16-bit arrays.

        Raises BadShard for a sample that breaks the format, BadTransform for a transform that fails.
        """
        chosen, camera = self.epoch if epoch is None else check_epoch(epoch), self.manifest.rig.camera
        shape = (camera.rows, camera.columns)
        return self._made(index, chosen, np.empty(shape, np.uint16), np.empty(shape, np.uint8))

    def write(
        self,
        index: int,
        epoch: int,
        image: NDArray[np.uint16],
        labels: NDArray[np.uint8],
        planes: Sequence[NDArray[Any]] = (),
    ) -> None:
        """Write the arrays of `image` into given ones [H, W], replacing their content. Raises as `image`."""
        if self.transforms:
            made = self.image(index, epoch)
            image[...], labels[...] = made.range, made.labels
        else:
            made = self._made(index, epoch, image, labels)
        for given, name in zip(planes, self.planes, strict=True) if planes else ():
            given[...] = made.planes[name]

    def _made(self, index: int, epoch: int, image: NDArray[np.uint16], labels: NDArray[np.uint8]) -> RangeImage:
        """Make the sample in arrays of the camera's size; transforms may return others."""
        try:
            shard, within = self._where(index)
            stored = self.augmentation.needs_projector and self.occluder == "stored"
            sample = self.reader.read(shard, within, stored, (image, labels), self.unlabelled, self._read_planes)
            return self._made_of(sample, epoch, image, labels)
        except BadSample as error:
            name, _, offset = self.location(index)
            raise BadShard(f"{name}: offset {offset}: {error}") from error
        except BadTransform as error:
            raise with_text(error, f"{self.location(index)[0]}: {error}") from error.__cause__

    def _made_of(self, sample: Sample, epoch: int, image: NDArray[np.uint16], labels: NDArray[np.uint8]) -> RangeImage:
        """Make a clean sample in arrays of the camera's size. Raises BadSample or BadTransform."""
        regions = self._labels_of(sample)
        if self._casts:
            sample = self._shaded(sample)
        made = self.augmentation_of(sample).into(sample, epoch, image, labels)
        if self._regions is not None:  # not before: artifacts may be of the set's own parts
            vars(sample).update(labels=regions)
            labels[...] = np.where(made.range == 0, BACKGROUND, regions)
        TALLY.lap(Stage.ARTIFACTS)
        if self.planes:
            made = replace(made, planes=_in_order(sample, self.planes))
        if self.transforms:
            camera = self.manifest.rig_of(sample).camera
            about = self.step_m, camera.focal_px, camera.centre_px, sample, self.manifest.classes, self._has_map
            seen = CameraImage(made.key, made.range, made.labels, made.drawn, *about, planes=made.planes)
            draws = Draws(self.seed, epoch, made.key)
            made = transform_image(seen, self.transforms, draws, self.unlabelled)
        if self._joins:
            edges = sample.edges if self.augmentation.keeps_outline and not self.transforms else None
            self.label_map.write(made.labels, edges, self.unlabelled)
        TALLY.lap(Stage.TRANSFORM)
        return made

    def __getitem__(self, index: int | Request) -> dict[str, Any]:
        """Return one sample: range float32 [1, H, W] in metres, labels uint8 [H, W], key.

        If planes were asked for, also planes: name -> uint8 or uint16 [H, W].
        index: the sample's index, or (epoch, index) as `batches` yields. An index alone takes the epoch last set in
        this process; `set_epoch` does not reach workers that already run.
        """
        epoch, index = index if isinstance(index, tuple) and len(index) == 2 else (None, index)
        return self._item(self.image(index, epoch))

    def make(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """Make the item of a sample that plain `webdataset` has read: for `WebDataset(...).map(images.make)`.

        sample: `__key__` and the members, as bytes or decoded by `decoder`. The item is that of `images[index]`, to the
        bit, with draws of the epoch last set in this process; it also has `__key__`, which further steps need. Raises
        BadSample for members that are damaged or of another set, BadTransform for a transform that fails.
        """
        projectors, count = len(self.manifest.rig.projectors), len(self.manifest.classes)
        clean = sample_of(sample, projectors, self.unlabelled)
        if self._regions is None and (clean.labels[clean.labels < self.unlabelled] >= count).any():
            raise BadSample(f"{clean.key}: labels must be 0 to {count - 1}, as in the set, found others")
        arrays = np.empty(clean.range.shape, np.uint16), np.empty(clean.range.shape, np.uint8)
        return {"__key__": clean.key, **self._item(self._made_of(clean, self.epoch, *arrays))}

    def _item(self, image: RangeImage) -> dict[str, Any]:
        ranges = metres(image.range, self.step_m)
        item = {"range": torch.from_numpy(ranges[None]), "labels": torch.from_numpy(image.labels), "key": image.key}
        if self.planes:
            item["planes"] = {name: torch.from_numpy(plane) for name, plane in image.planes.items()}
        return item

    def describe(self, index: int) -> dict[str, Any]:
        """Return key, split and fields of a sample from the manifest; no shard is read."""
        number, within = self._where(index)
        shard = self.manifest.shards[number]
        info = shard.descriptions.info(within, shard.split)
        return {"key": shard.entry(within).key, "split": info.split, **info.fields}

    def table(self) -> dict[str, NDArray[Any]]:
        """Return what `describe` gives of all samples, name -> array [N]; no shard is read.

        Text has NumPy's `str` type, whole numbers int64, other numbers float64, flags bool; tuples of numbers are
        objects. An array is masked where samples lack the field.
        """
        return table_of(self.manifest.fields, list(self._chosen_records()))

    def _where(self, index: int) -> tuple[int, int]:
        """Return (shard number, index within the shard) of a sample. Raises as `check_index`."""
        return self._samples.place(check_index(index, len(self._samples)))

    def location(self, index: int) -> tuple[str, str, int]:
        """Return (shard name, key, byte offset in the shard) of a sample."""
        number, within = self._where(index)
        shard = self.manifest.shards[number]
        key, offset, _, _ = shard.entry(within)
        return shard.name, key, offset

    def _chosen_records(self) -> Iterator[tuple[ShardRecord, list[int]]]:
        """Yield the shards that hold the chosen samples, and these samples' indices within them, in stored order."""
        return ((self.manifest.shards[number], own) for number, own in self._samples.by_shard())

    def identity(self) -> dict[str, Any]:
        """Return all that batches depend on besides their order, as plain JSON; set: digest of all samples' bytes."""
        return {
            "set": self._digest,
            "split": self.split,
            "variant": self.variant,
            "seed": self.seed,
            "artifacts": artifacts_to_json(self.augmentation.sensor.artifacts),
            **self.selection.filters(),
            **({"transforms": transforms_to_json(self.transforms)} if self.transforms else {}),
            **({"labels": self.label_map.to_json()} if self._joins else {}),
            **({} if self._regions is None else {"regions": hashlib.sha256(self._regions.tobytes()).hexdigest()}),
            **({"unlabelled": True} if self.unlabelled == UNLABELLED else {}),
            **({"columns": {name: column.digest for name, column in self.columns.items()}} if self.columns else {}),
            **({"planes": list(self.planes)} if self.planes else {}),
            **({"occluder": self.occluder} if self._casts else {}),
        }

    @cached_property
    def _digest(self) -> str:
        """Digest of the chosen samples' keys and bytes, in stored order, independent of the cut into shards."""
        digest = hashlib.blake2b(digest_size=16)
        for shard, own in self._chosen_records():
            keys, checksums = shard.keys, shard.crc32
            digest.update("".join(f"{keys[index]} {checksums[index]}\n" for index in own).encode())
        return digest.hexdigest()

    def order(self, epoch: int, shuffle: Shuffle = True) -> NDArray[np.int64]:
        """Return the sample indices in the order of a pass, int64 [len(self)]: a function of seed and epoch alone.

        shuffle: "blocks" for the order of `BlockOrder`: blocks of 32 neighbours, 32 of which are mixed at a time.
        """
        return self.requests(epoch, shuffle).indices[:]

    def requests(self, epoch: int, shuffle: Shuffle = True) -> Requests:
        """Return `order` with the epoch of the draws, the same for all samples; by blocks, it comes in parts."""
        count, blocks = len(self), shuffle == "blocks"
        mixed = blocks or check_bool("shuffle", shuffle, "True, False or 'blocks'")
        order_of = BlockOrder if blocks else permutation
        order = order_of(count, self.seed, check_epoch(epoch)) if mixed else np.arange(count)
        return Requests(order, np.broadcast_to(np.int64(epoch), count))

    def places(self, index: int) -> list[Place]:
        """Places of a sample's bytes, and of those of its planes that are columns."""
        number, within = self._where(index)
        files = [self.manifest, *(self.columns[name] for name in self._read_planes if name in self.columns)]
        return [(self.reader.store, each.shards[number], within) for each in files]

    def evenly_sampled(self, count: int) -> NDArray[np.int64]:
        """Return at most `count` indices at even distances in stored order, each once, int64 [M]."""
        return np.unique(np.linspace(0, len(self) - 1, count).astype(np.int64))

    def webdataset(self, epoch: int | None = None) -> Any:
        """Return a `webdataset` pipeline over the chosen shards that yields this variant's images, in stored order.

        epoch: of the draws, None for the one set last before a pass. Chain `.shuffle(1000)` and other steps to it;
        workers divide the shards among them. Samples are read by their offset in the manifest, as by index, since a
        reader of streams may take a tar that is cut, or has an altered header, for complete. Raises BadShard for a
        sample that is altered or missing.
        """
        import webdataset

        chosen = None if epoch is None else check_epoch(epoch)
        ends = itertools.accumulate(self._samples.counts, initial=0)
        held = {url: range(*pair) for url, pair in zip(self.urls(), itertools.pairwise(ends), strict=True)}
        pipeline = webdataset.FluidWrapper(webdataset.SimpleShardList(list(held)))
        images = partial(self._streamed, held, chosen)  # which can be pickled for workers
        return pipeline.compose(webdataset.single_node_only, webdataset.split_by_worker, images)

    def _streamed(
        self, held: Mapping[str, range], epoch: int | None, shards: Iterable[Mapping[str, str]]
    ) -> Iterator[dict[str, Any]]:
        for shard in shards:
            for index in held[shard["url"]]:
                yield self._item(self.image(index, epoch))

    def stored_bytes(self) -> int:
        """Return the bytes that the chosen samples take in their shards, headers included."""
        return sum(sum(map(shard.lengths.__getitem__, own)) for shard, own in self._chosen_records())

    def urls(self) -> list[str]:
        """Return the paths of the shards that hold the chosen samples, in stored order."""
        return [f"{self.path}/{self.manifest.shards[number].name}" for number in self._samples.shards]


def _chosen_planes(names: Any, manifest: Manifest) -> dict[str, np.dtype[Any]]:
    """Name -> type of the planes that a user asks for. Raises BadConfig for one that the set does not hold."""
    chosen = texts_of("planes", names)
    for name in chosen:
        if name not in manifest.planes:
            held = f"holds {', '.join(manifest.planes)}" if manifest.planes else "holds no planes"
            raise BadConfig(f"planes: the set {held}, found {name!r}")
    return {name: np.dtype(manifest.planes[name]) for name in chosen}


def _in_order(sample: Sample, planes: Mapping[str, np.dtype[Any]]) -> dict[str, NDArray[Any]]:
    """The planes of a sample in the order in which they were asked for. Raises BadSample for one that it lacks."""
    for name, kind in planes.items():
        if name not in sample.planes or sample.planes[name].dtype != kind:
            found = sample.planes[name].dtype if name in sample.planes else "none"
            raise BadSample(f"{sample.key}: the plane {name!r} must be {kind}, found {found}")
    return {name: sample.planes[name] for name in planes}
