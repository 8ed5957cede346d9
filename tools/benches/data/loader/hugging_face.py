"""Hugging Face `datasets` as baselines of `bench loader`: Parquet files and tars of PNG images, both streamed."""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benches.data.loader.baselines import (
    SHARDS,
    Baseline,
    Premade,
    Webdataset,
    allow_read_only,
    example,
    folder_bytes,
    torch_loader,
)
from benches.data.loader.pngs import Decode, by_pillow
from bodyseg_data.loading import Batch


class HfParquet(Baseline):
    """Parquet files of raw arrays as binary columns, Snappy-compressed: the default of Parquet.

    Its own array columns take five times as long to read, and hold integers of 64 bits then.
    """

    def write(self, images: Premade, folder: Path) -> int:
        """As many files as `Webdataset` makes tars."""
        importlib.import_module("datasets")
        arrow, parquet = importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
        for number, chunk in enumerate(np.array_split(np.arange(len(images)), min(SHARDS, len(images)))):
            rows = [images[index] for index in chunk.tolist()]
            columns = {
                "key": [image.key for image in rows],
                "range": [image.range.tobytes() for image in rows],
                "labels": [image.labels.tobytes() for image in rows],
            }
            parquet.write_table(arrow.table(columns), str(folder / f"all-{number:03d}.parquet"))
        self._shape = images[0].range.shape
        return folder_bytes(folder)

    def open(self, folder: Path, batch: int, workers: int) -> Iterable[Batch]:
        """Its IterableDataset with a map, under PyTorch's DataLoader."""
        return torch_loader(
            _stream("parquet", folder, batch).map(partial(_from_bytes, self._shape)), batch, workers, False
        )


class HfWebdataset(Baseline):
    """The tars of `Webdataset`, read by `datasets`; PNG images are decoded in a map, as they are there."""

    def __init__(self, decode: Decode = by_pillow) -> None:
        self._decode = decode

    def write(self, images: Premade, folder: Path) -> int:
        """The same tars."""
        importlib.import_module("datasets")
        return Webdataset().write(images, folder)

    def open(self, folder: Path, batch: int, workers: int) -> Iterable[Batch]:
        """Its IterableDataset without its own decoder, Pillow's, and with a map, under PyTorch's DataLoader."""
        images = _stream("webdataset", folder, batch).decode(False).map(partial(_from_pngs, self._decode))
        return torch_loader(images, batch, workers, False)


def _stream(kind: str, folder: Path, buffer: int) -> Any:
    allow_read_only()
    files = [str(path) for path in sorted(folder.iterdir()) if path.is_file()]
    datasets = importlib.import_module("datasets")
    cache = str(folder / "cache")  # gets a lock file even where nothing is kept
    images = datasets.load_dataset(kind, data_files=files, split="train", streaming=True, cache_dir=cache)
    # One file at a time, as webdataset reads: with several, threads read them, and Parquet sleeps 5 s after each pass.
    # And a buffer of one batch: one that holds much of a small set would be read before the clock starts.
    return images.shuffle(seed=0, buffer_size=buffer, max_buffer_input_shards=1)


def _from_bytes(shape: tuple[int, ...], row: dict[str, Any]) -> dict[str, Any]:
    image, labels = np.frombuffer(row["range"], np.uint16), np.frombuffer(row["labels"], np.uint8)
    return example(row["key"], image.reshape(shape), labels.reshape(shape))


def _from_pngs(decode: Decode, row: dict[str, Any]) -> dict[str, Any]:
    image, labels = (decode(row[name]["bytes"]) for name in ("range.png", "labels.png"))
    return example(row["__key__"], image, labels)
