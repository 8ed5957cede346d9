"""LitData as a baseline of `bench loader`."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from benches.data.loader.baselines import STEP_M, Baseline, Premade, folder_bytes
from bodyseg_data.loading import Batch


class LitData(Baseline):
    """LitData's optimised chunks of raw tensors, which it maps into memory and reads without a copy."""

    def __init__(self) -> None:
        self._loaders: list[Any] = []

    def write(self, images: Premade, folder: Path) -> int:
        """Chunks of 64 MB, its default."""
        litdata = importlib.import_module("litdata")
        numbers = list(range(len(images)))
        # Forked, as otherwise it makes "spawn" the start method of everything that this process starts later.
        settings = {"chunk_bytes": "64MB", "num_workers": 1, "start_method": "fork", "verbose": False}
        with _scratch():
            litdata.optimize(_Tensors(images), numbers, str(folder), **settings)
        return folder_bytes(folder)

    def open(self, folder: Path, batch: int, workers: int) -> Iterable[Batch]:
        """Its StreamingDataset with a transform, under its StreamingDataLoader."""
        litdata = importlib.import_module("litdata")
        images = litdata.StreamingDataset(str(folder), shuffle=True, transform=_metres)
        loader = litdata.StreamingDataLoader(
            images, batch_size=batch, num_workers=workers, persistent_workers=workers > 0
        )
        self._loaders.append(loader)
        batches: Iterable[Batch] = loader
        return batches

    def close(self) -> None:
        """End the workers now: its loader is part of a cycle, and the garbage collector waits 5 s for each of them."""
        for loader in self._loaders:
            if loader._iterator is not None:
                loader._iterator._shutdown_workers()
        self._loaders.clear()


class _Tensors:
    """Makes the tensors of one sample, in a process of `optimize`."""

    def __init__(self, images: Premade) -> None:
        self._images = images

    def __call__(self, index: int) -> dict[str, Any]:
        image = self._images[index]
        return {
            "range": torch.from_numpy(image.range[None]),
            "labels": torch.from_numpy(image.labels),
            "key": image.key,
        }


def _metres(sample: dict[str, Any]) -> dict[str, Any]:
    return {**sample, "range": sample["range"].to(torch.float32).mul_(STEP_M)}


@contextmanager
def _scratch() -> Iterator[None]:
    """Has `optimize` keep its temporary folders together, and removes them."""
    names = ("DATA_OPTIMIZER_CACHE_FOLDER", "DATA_OPTIMIZER_DATA_CACHE_FOLDER")
    before = {name: os.environ.get(name) for name in names}
    with TemporaryDirectory(prefix="bodyseg-litdata-") as folder:
        os.environ.update({name: f"{folder}/{number}" for number, name in enumerate(names)})
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value
