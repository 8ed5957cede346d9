"""Loaders side by side: this project's, which makes `all` on the fly, and others, which read an `all` set made before.

Every loader delivers the same: batches of float32 metres and uint8 labels in the consumer's process, which does
nothing with them. All are opened at once, with workers that stay alive; a first pass, unmeasured, fills the page cache
and is compared with the stored images, bit for bit. Then every round runs each loader once, in a new order, over the
whole set. The clock of a pass starts when each worker has delivered one batch, so that what a loader does once a pass
is no part of it.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import torch
from torch.utils.data import DataLoader, Dataset

from benches.data.loader.baselines import Baseline, Memory, PngFiles, Premade, Webdataset, folder_bytes, torch_loader
from benches.data.loader.hugging_face import HfParquet, HfWebdataset
from benches.data.loader.limits import PNG_SAMPLES, five_png_bytes, limits, ratio
from benches.data.loader.litdata import LitData
from benches.data.loader.mds import Mds
from benches.data.loader.passes import Opening, Passes, checksum_of, run_rounds
from benches.data.loader.pngs import DECODERS, Decode, by_pillow, time_decoders
from benches.measuring import counter, evenly_spaced
from bodyseg_data.artifacts import VARIANTS, VariantName
from bodyseg_data.core import BadConfig, ProgressCallback, silent
from bodyseg_data.loading import Batch, Flip, RangeImages, loader
from bodyseg_data.machine import processors, torch_threads
from bodyseg_data.packing import PROCESSES, Packing, open_engine, pack
from bodyseg_data.samples import ViewGrid

BATCH: Final = 20
ROUNDS: Final = 7
_VIEWS_A_BODY: Final = 18
PACKAGES: Final = (
    "torch", "numpy", "numba", "pillow", "opencv-python-headless", "imagecodecs",
    "webdataset", "mosaicml-streaming", "litdata", "datasets", "pyarrow",
)  # fmt: skip

OURS: Final[Mapping[str, VariantName]] = {
    **{f"ours_{variant}": variant for variant in VARIANTS},
    "ours_all_dataloader": "all",
    "ours_all_batch_sampler": "all",
    "ours_all_wrapped": "all",
    "ours_all_transform": "all",
    "ours_all_labels": "all",
}
"""Row -> variant: by `loader`, and `all` also by PyTorch's own DataLoader: with plain indices, with our order, inside a
data set of a user's own, with a transform, and with a label map.
"""


OPTIONS: Final[Mapping[str, dict[str, Any]]] = {
    "ours_all_transform": {"transform": Flip()},
    "ours_all_labels": {"labels": "limbs14"},
}
"""Row -> options of `RangeImages` that the others do not have."""


class Wrapped(Dataset[dict[str, Any]]):
    """A data set of a user's own around the images."""

    def __init__(self, images: RangeImages) -> None:
        self._images = images

    def __len__(self) -> int:
        return len(self._images)

    def __getitem__(self, index: int) -> dict[str, Any]:
        sample = self._images[index]
        return {"range": sample["range"], "labels": sample["labels"], "key": sample["key"]}


def baselines(decode: Decode = by_pillow) -> dict[str, Baseline]:
    """The baselines by name. decode: for those that store PNG images."""
    return {
        "webdataset_png": Webdataset(decode),
        "webdataset_raw": Webdataset(stored="raw"),
        "webdataset_zstd": Webdataset(stored="zstd"),
        "webdataset_png_threads": Webdataset(decode, threads=True),
        "webdataset_raw_threads": Webdataset(stored="raw", threads=True),
        "hf_webdataset": HfWebdataset(decode),
        "hf_parquet": HfParquet(),
        "mds_raw": Mds(),
        "mds_zstd": Mds("zstd"),
        "litdata": LitData(),
        "png_files": PngFiles(decode),
        "memory": Memory(),
        "memory_threads": Memory(threads=True),
    }


def bench_loader(
    views: int = 1080, num_workers: Sequence[int] = (0, 2), progress: ProgressCallback = silent
) -> dict[str, Any]:
    """Samples a second of every loader with each number of workers, medians of seven rounds, and bytes a sample.

    views: samples in all, rounded up to whole bodies of the open set. docs/results/loading_speed.md says what the keys
    hold. A loader whose package is absent has null everywhere, and a line on standard error says so. Raises
    BadConfig if there are too few samples for so many workers.
    """
    with packed_set(views, num_workers) as packed:
        return measure(packed, packed.parent, num_workers, progress=progress)


@contextmanager
def packed_set(views: int, num_workers: Sequence[int]) -> Iterator[Path]:
    """A set of open bodies in a new folder, both removed afterwards.

    views: samples, rounded up to whole bodies. Raises BadConfig if there are too few for so many workers.
    """
    meshes = -(-views // _VIEWS_A_BODY)
    check_counts(meshes * _VIEWS_A_BODY, BATCH, num_workers)
    packing = Packing("open", meshes=meshes, views=ViewGrid(count=_VIEWS_A_BODY))
    with TemporaryDirectory(prefix="bodyseg-loader-") as folder:
        packed = Path(folder) / "ours"
        with open_engine(PROCESSES, None, packing) as on:
            pack(packing, packed, on.executor, on.workers)
        yield packed


def check_counts(samples: int, batch: int, num_workers: Sequence[int]) -> None:
    """Raise BadConfig unless each worker has at least four batches a pass, one of them before the clock starts."""
    if not num_workers or min(num_workers) < 0 or len(set(num_workers)) < len(num_workers):
        raise BadConfig(f"--num-workers takes different numbers of at least 0, found {' '.join(map(str, num_workers))}")
    least = 4 * batch * max(1, *num_workers)
    if samples < least:
        raise BadConfig(f"at least {least} samples are needed with {max(num_workers)} workers, found {samples}")


def measure(
    packed: Path,
    scratch: Path,
    workers: Sequence[int] = (0, 2),
    batch: int = BATCH,
    rounds: int = ROUNDS,
    progress: ProgressCallback = silent,
) -> dict[str, Any]:
    """`bench_loader` on the set in `packed`; the baselines' sets go to new folders in `scratch`."""
    images = {variant: RangeImages(packed, variant) for variant in VARIANTS}
    check_counts(len(images["all"]), batch, workers)
    decoders = time_decoders(evenly_spaced(Premade(images["all"]), PNG_SAMPLES))
    known = baselines(DECODERS[decoders.used])
    total = 1 + len(known) + len(workers) * (len(known) + len(OURS)) * (rounds + 1)
    tick = counter(progress, total)
    five_pngs = five_png_bytes(images)
    by_variant = {v: {i.key: checksum_of(i) for i in Premade(images[v])} for v in VARIANTS}
    expected = {name: by_variant[variant] for name, variant in OURS.items()}
    for name, options in OPTIONS.items():
        altered = RangeImages(packed, "all", **options)
        expected[name] = {image.key: checksum_of(image) for image in Premade(altered)}
    tick()
    stored: dict[str, int | None] = dict.fromkeys(OURS, folder_bytes(packed))
    stored |= written(known, Premade(images["all"]), scratch, tick)
    there = {name: baseline for name, baseline in known.items() if stored[name] is not None}
    expected |= dict.fromkeys(there, expected["ours_all"])
    found: dict[int, dict[str, Passes]] = {}
    # Without a processor of their own PyTorch's threads wait by spinning, which slows down those loaders most that
    # leave their collation to PyTorch.
    threads = min(max(1, processors() - max(workers)), torch.get_num_threads())
    with torch_threads(threads):
        for count in workers:
            opens = _openings(packed, there, scratch, batch, count)
            try:
                found[count] = run_rounds(opens, count, rounds, expected, tick)
            finally:
                for baseline in there.values():
                    baseline.close()
    progress(total, total)
    kept = stored | {name: folder_bytes(scratch / name) for name in there if not name.startswith("memory")}
    counts = {"samples": len(images["all"]), "batch": batch, "rounds": rounds, "threads": threads}
    return _results(found, stored, kept, five_pngs, counts) | {"png_decoders": decoders.to_json()}


def written(
    known: Mapping[str, Baseline], images: Premade, scratch: Path, tick: Callable[[], None]
) -> dict[str, int | None]:
    """Write the set of each baseline into `scratch`/NAME; name -> bytes, None if its package is absent."""
    found: dict[str, int | None] = {}
    for name, baseline in known.items():
        (scratch / name).mkdir()
        try:
            found[name] = baseline.write(images, scratch / name)
        except ImportError as error:
            sys.stderr.write(f"{name}: not installed: tools/install_rivals ({error})\n")
            found[name] = None
        tick()
    return found


def _openings(
    packed: Path, there: Mapping[str, Baseline], scratch: Path, batch: int, workers: int
) -> dict[str, Opening]:
    """Name -> what opens the loader."""

    def ours(variant: VariantName) -> Iterable[Batch]:
        return loader(RangeImages(packed, variant), batch, workers, shuffle=True)

    def plain(wrap: Callable[[RangeImages], Dataset[Any]], **options: Any) -> Iterable[Batch]:
        return torch_loader(wrap(RangeImages(packed, "all", **options)), batch, workers, shuffle=True)

    def sampled() -> Iterable[Batch]:
        images = RangeImages(packed, "all")
        order = images.batches(batch, shuffle=True)
        batches: Iterable[Batch] = DataLoader(
            images, batch_sampler=order, num_workers=workers, persistent_workers=workers > 0
        )
        return batches

    opens: dict[str, Opening] = {f"ours_{name}": partial(ours, name) for name in VARIANTS}
    opens["ours_all_batch_sampler"] = sampled
    opens["ours_all_dataloader"] = partial(plain, _same)
    opens["ours_all_wrapped"] = partial(plain, Wrapped)
    opens |= {name: partial(plain, _same, **options) for name, options in OPTIONS.items()}
    return opens | {name: partial(baseline.open, scratch / name, batch, workers) for name, baseline in there.items()}


def _same(images: RangeImages) -> Dataset[Any]:
    return images


def _results(
    found: Mapping[int, Mapping[str, Passes]],
    stored: Mapping[str, int | None],
    kept: Mapping[str, int | None],
    five_pngs: float,
    counts: Mapping[str, int],
) -> dict[str, Any]:
    table = partial(by_workers, found, stored)
    rounds = {name: {str(n): p[name].rates for n, p in found.items() if name in p} for name in stored}
    sizes = a_sample(stored, counts["samples"])
    return {
        "samples_per_second": table(Passes.samples_per_second),
        "bytes_per_sample": sizes,
        "kept_bytes_per_sample": a_sample(kept, counts["samples"]),
        "five_png_bytes_per_sample": round(five_pngs),
        "processor_ms_per_sample": table(Passes.processor_ms_per_sample),
        "worker_mb": table(lambda one: one.worker_mb),
        "all_over_none": {str(n): ratio(rounds, str(n), "ours_none", "ours_all") for n in found},
        "ours_all_over": {
            name: {str(n): ratio(rounds, str(n), "ours_all", name) for n in found}
            for name in stored
            if name != "ours_all"
        },
        "spread": table(lambda one: _spread(one.rates)),
        "limits": limits(rounds, sizes, five_pngs),
        "rounds_of": table(lambda one: [round(rate, 1) for rate in one.rates]),
        "missing": [name for name, size in stored.items() if size is None],
        "versions": {name: _version(name) for name in PACKAGES},
        **counts,
    }


def by_workers(
    found: Mapping[int, Mapping[str, Passes]], names: Iterable[str], value: Callable[[Passes], Any]
) -> dict[str, dict[str, Any]]:
    """Name of a loader -> number of workers -> a figure of its passes, None where it was not measured."""
    return {
        name: {str(n): value(passes[name]) if name in passes else None for n, passes in found.items()} for name in names
    }


def a_sample(sizes: Mapping[str, int | None], samples: int) -> dict[str, int | None]:
    """Bytes of sets as bytes of a sample."""
    return {name: None if size is None else round(size / samples) for name, size in sizes.items()}


def _spread(rates: Sequence[float]) -> float:
    """Largest less smallest, over the median."""
    return round((max(rates) - min(rates)) / statistics.median(rates), 3)


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
