"""Baseline loaders of `bench loader`: each stores a pre-made set and reads it again.

All are given the same images, write them once, and deliver what a training loop takes: float32 metres and uint8 labels,
shuffled as for training. Metres are made where their documentation puts a transform: in the data set.
"""

from __future__ import annotations

import queue
import threading
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset, default_collate

from benches.data.loader.pngs import Decode, by_pillow, png
from bodyseg_data.artifacts import RangeImage
from bodyseg_data.loading import Batch, RangeImages
from bodyseg_data.rigs import load_rig

STEP_M: Final = load_rig().range_step_m
"""One step of the images that are measured, metres: all are of the default rig."""

SHARDS: Final = 16
"""Files of baselines that store few large ones, so that up to sixteen workers have equal work."""


class Premade(Sequence[RangeImage]):
    """The images of the set that baselines store: those of this project's first epoch, made on access."""

    def __init__(self, images: RangeImages) -> None:
        self._images = images

    def __len__(self) -> int:
        return len(self._images)

    def __getitem__(self, index: Any) -> Any:
        if not 0 <= index < len(self):
            raise IndexError(index)
        return self._images.image(index, 0)


class Baseline(ABC):
    """One way to store and read a set of images that are made already."""

    @abstractmethod
    def write(self, images: Premade, folder: Path) -> int:
        """Store the set in an empty folder; bytes taken. Raises ImportError if a package is absent."""

    @abstractmethod
    def open(self, folder: Path, batch: int, workers: int) -> Iterable[Batch]:
        """Batches of the set, pass after pass, by workers that stay alive between passes."""

    def close(self) -> None:  # noqa: B027  most hold nothing
        """Leave nothing behind of what `open` made, once its result is gone."""


def example(key: str, steps: NDArray[np.uint16], labels: NDArray[np.uint8]) -> dict[str, Any]:
    """One sample as a data set gives it to the collation: float32 [1, H, W] metres with the bits that this project's
    loader gives, uint8 [H, W] labels, key.
    """
    metres = np.multiply(steps, np.float32(STEP_M), dtype=np.float32)
    return {"range": torch.from_numpy(metres[None]), "labels": torch.from_numpy(labels), "key": key}


def torch_loader(dataset: Dataset[Any], batch: int, workers: int, shuffle: bool) -> DataLoader[Any]:
    """PyTorch's own loader with its defaults. shuffle: False for data sets that shuffle themselves."""
    return DataLoader(dataset, batch, shuffle=shuffle, num_workers=workers, persistent_workers=workers > 0)


def allow_read_only() -> None:
    """Silence PyTorch's warning about arrays that are views of the bytes read: nobody writes to them here."""
    warnings.filterwarnings("ignore", message="The given NumPy array is not writable")


class InThreads:
    """Batches made by threads of this process, for comparison with a loader whose workers are threads: each thread has
    its own part of the set, and all put their batches into one queue of two a thread. One part: without a thread.

    parts: opens the parts anew for each pass.
    """

    def __init__(self, parts: Callable[[], Sequence[Iterable[Batch]]]) -> None:
        self._parts = parts

    def __iter__(self) -> Iterator[Batch]:
        parts = self._parts()
        if len(parts) == 1:
            yield from parts[0]
            return
        made: queue.Queue[Batch | BaseException | None] = queue.Queue(2 * len(parts))
        for part in parts:
            threading.Thread(target=_put_all, args=(part, made), daemon=True).start()
        left = len(parts)
        while left:
            batch = made.get()
            if isinstance(batch, BaseException):
                raise batch
            if batch is None:
                left -= 1
            else:
                yield batch


def _put_all(part: Iterable[Batch], made: queue.Queue[Batch | BaseException | None]) -> None:
    try:
        for batch in part:
            made.put(batch)
        made.put(None)
    except BaseException as error:
        made.put(error)


class _Shuffled:
    """Collated batches of a share of a data set's samples, in a new order each time."""

    def __init__(self, dataset: Dataset[Any], batch: int, numbers: Sequence[int]) -> None:
        self._dataset, self._batch, self._numbers = dataset, batch, numbers

    def __iter__(self) -> Iterator[Batch]:
        for start in range(0, len(self._numbers), self._batch):
            yield default_collate([self._dataset[number] for number in self._numbers[start : start + self._batch]])


def thread_loader(dataset: Dataset[Any], batch: int, threads: int) -> InThreads:
    """Load as `torch_loader` does, by threads in place of processes."""
    count: int = len(dataset)  # type: ignore[arg-type]  # all that are measured have a length

    def parts() -> list[Iterable[Batch]]:
        order: list[int] = torch.randperm(count).tolist()
        # In whole batches, so that no thread has a short one but the last.
        starts = np.array_split(np.arange(0, count, batch), max(1, threads))
        chosen = [order[int(part[0]) : int(part[-1]) + batch] for part in starts if len(part)]
        return [_Shuffled(dataset, batch, numbers) for numbers in chosen]

    return InThreads(parts)


def folder_bytes(folder: Path) -> int:
    """Bytes of all files in a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


class Memory(Dataset[dict[str, Any]], Baseline):
    """The limit: tensors in memory, float32 and uint8, that workers inherit when they are forked.

    threads: workers are threads of this process.
    """

    def __init__(self, threads: bool = False) -> None:
        self._threads = threads

    def write(self, images: Premade, folder: Path) -> int:
        """Nothing is written; the bytes are those of the tensors."""
        examples = [example(image.key, image.range, image.labels) for image in images]
        self._keys = [one["key"] for one in examples]
        self._ranges = torch.stack([one["range"] for one in examples])
        self._labels = torch.stack([one["labels"] for one in examples])
        return self._ranges.nbytes + self._labels.nbytes

    def open(self, folder: Path, batch: int, workers: int) -> Iterable[Batch]:
        """A plain DataLoader, or as many threads."""
        if self._threads:
            return thread_loader(self, batch, workers)
        return torch_loader(self, batch, workers, shuffle=True)

    def __len__(self) -> int:
        return len(self._keys)

    def __getitem__(self, index: int) -> dict[str, Any]:
        return {"range": self._ranges[index], "labels": self._labels[index], "key": self._keys[index]}


class PngFiles(Baseline):
    """Two PNG files a sample, read by a plain data set."""

    def __init__(self, decode: Decode = by_pillow) -> None:
        self._decode = decode

    def write(self, images: Premade, folder: Path) -> int:
        """KEY.range.png of 16 bits and KEY.labels.png of 8."""
        for image in images:
            (folder / f"{image.key}.range.png").write_bytes(png(image.range))
            (folder / f"{image.key}.labels.png").write_bytes(png(image.labels))
        return folder_bytes(folder)

    def open(self, folder: Path, batch: int, workers: int) -> Iterable[Batch]:
        """A plain DataLoader."""
        return torch_loader(_PngFolder(folder, self._decode), batch, workers, shuffle=True)


class _PngFolder(Dataset[dict[str, Any]]):
    def __init__(self, folder: Path, decode: Decode) -> None:
        self._paths = [str(path).removesuffix(".range.png") for path in sorted(folder.glob("*.range.png"))]
        self._decode = decode

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, index: int) -> dict[str, Any]:
        path = self._paths[index]
        image, labels = (self._decode(Path(f"{path}.{name}.png").read_bytes()) for name in ("range", "labels"))
        return example(Path(path).name, image, labels)


class Webdataset(Baseline):
    """Tars of PNG files or of raw arrays, decoded in a map: webdataset's own decoders cut PNG's 16 bits down to 8.

    stored: what the tars hold; raw and zstd are the arrays' bytes, whose shape the reader knows. threads: workers are
    threads of this process, each with its own tars.
    """

    def __init__(self, decode: Decode = by_pillow, stored: Stored = "png", threads: bool = False) -> None:
        self._decode, self._stored, self._threads = decode, stored, threads
        self._suffix = "png" if stored == "png" else "bin"
        self._shape: tuple[int, ...] = ()

    def write(self, images: Premade, folder: Path) -> int:
        """Sixteen shards of nearly equal length."""
        import webdataset

        encode, suffix = _ENCODERS[self._stored], self._suffix
        self._shape = images[0].range.shape
        for shard, chunk in enumerate(np.array_split(np.arange(len(images)), min(SHARDS, len(images)))):
            with webdataset.TarWriter(str(folder / f"all-{shard:03d}.tar")) as tar:
                for index in chunk.tolist():
                    image = images[index]
                    members = {f"range.{suffix}": encode(image.range), f"labels.{suffix}": encode(image.labels)}
                    tar.write({"__key__": image.key, **members})
        return folder_bytes(folder)

    def open(self, folder: Path, batch: int, workers: int) -> Iterable[Batch]:
        """Batched in the workers, as its documentation recommends for speed."""
        import webdataset

        allow_read_only()
        shards = [str(path) for path in sorted(folder.glob("*.tar"))]
        decode = self._decode if self._stored == "png" else _Arrays(self._stored, self._shape)
        decoded = partial(_decoded, decode, self._suffix)

        def batches(of: list[str]) -> Any:
            images = webdataset.WebDataset(of, shardshuffle=len(of)).shuffle(100).map(decoded)
            return images.batched(batch, collation_fn=default_collate)

        if self._threads:
            count = max(1, min(workers, len(shards)))
            return InThreads(lambda: [batches(shards[number::count]) for number in range(count)])
        loader: Iterable[Batch] = webdataset.WebLoader(
            batches(shards), batch_size=None, num_workers=workers, persistent_workers=workers > 0
        )
        return loader


Stored = Literal["png", "raw", "zstd"]


def _raw(array: NDArray[Any]) -> bytes:
    return array.tobytes()


def _zstd(array: NDArray[Any]) -> bytes:
    import zstandard

    return zstandard.ZstdCompressor().compress(array.tobytes())


_ENCODERS: Final[Mapping[Stored, Callable[[NDArray[Any]], bytes]]] = {"png": png, "raw": _raw, "zstd": _zstd}


class _Arrays:
    """Makes [H, W] of an array's bytes: uint16 where there are two bytes a pixel, else uint8."""

    def __init__(self, stored: Stored, shape: tuple[int, ...]) -> None:
        self._stored, self._shape = stored, shape

    def __call__(self, data: bytes) -> NDArray[Any]:
        if self._stored == "zstd":
            import zstandard

            data = zstandard.ZstdDecompressor().decompress(data)
        pixels = self._shape[0] * self._shape[1]
        return np.frombuffer(data, np.uint16 if len(data) == 2 * pixels else np.uint8).reshape(self._shape)


def _decoded(decode: Decode, suffix: str, raw: dict[str, Any]) -> dict[str, Any]:
    return example(raw["__key__"], decode(raw[f"range.{suffix}"]), decode(raw[f"labels.{suffix}"]))
