"""MosaicML Streaming as a baseline of `bench loader`."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from benches.data.loader.baselines import Baseline, Premade, allow_read_only, example, folder_bytes, torch_loader
from bodyseg_data.loading import Batch


class Mds(Baseline):
    """Shards of raw arrays, 16 bits of range and 8 of labels, compressed or not.

    Compressed shards are decompressed when first read, and both forms stay in the folder: what its StreamingDataset
    does by default where shards are local.
    """

    def __init__(self, compression: str | None = None) -> None:
        self._compression = compression
        self._locks: list[Path] = []

    def write(self, images: Premade, folder: Path) -> int:
        """MDS shards of its default size, 64 MB."""
        writer = streaming("format").MDSWriter
        shape = ",".join(map(str, images[0].range.shape))
        columns = {"key": "str", "range": f"ndarray:uint16:{shape}", "labels": f"ndarray:uint8:{shape}"}
        with writer(out=str(folder), columns=columns, compression=self._compression) as out:
            for image in images:
                out.write({"key": image.key, "range": image.range, "labels": image.labels})
        return folder_bytes(folder)

    def open(self, folder: Path, batch: int, workers: int) -> Iterable[Batch]:
        """Its StreamingDataset, given the batch size, under PyTorch's DataLoader."""
        allow_read_only()

        class Images(streaming("dataset").StreamingDataset):  # type: ignore[misc]  # known at run time only
            def __getitem__(self, at: Any) -> Any:
                raw = super().__getitem__(at)
                return example(raw["key"], raw["range"], raw["labels"])

        images = Images(local=str(folder), shuffle=True, batch_size=batch)
        self._locks += [Path(images._cache_filelock_path), Path(images._shared_barrier.filelock_path)]
        return torch_loader(images, batch, workers, shuffle=False)

    def close(self) -> None:
        """Remove its lock files from the folder of temporary files; its shared memory goes when the process ends."""
        for lock in self._locks:
            lock.unlink(missing_ok=True)
        self._locks.clear()


def streaming(name: str) -> Any:
    """`streaming.base.NAME`, without running `streaming/__init__.py`, which needs torchvision and transformers for
    data sets of that package's own.
    """
    for package in ("streaming", "streaming.base"):
        if package not in sys.modules:
            spec = importlib.util.find_spec(package)
            if spec is None:
                raise ImportError(f"no package {package!r}")
            sys.modules[package] = importlib.util.module_from_spec(spec)
    return importlib.import_module(f"streaming.base.{name}")
