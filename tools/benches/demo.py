"""`tools/demo`: from bodies to batches in a minute or two, with a picture and figures."""

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bodyseg_data.artifacts import VARIANTS
from bodyseg_data.bodies import load_anny
from bodyseg_data.commands import Progress, option
from bodyseg_data.commands.inspect import contact_sheet
from bodyseg_data.commands.shard import pack_on
from bodyseg_data.core import BadConfig
from bodyseg_data.drawing import save_picture
from bodyseg_data.example import example_set
from bodyseg_data.files import make_folder, write_atomically
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.loading import RangeImages, loader
from bodyseg_data.machine import processors
from bodyseg_data.packing import PROCESSES, Packing
from bodyseg_data.samples import ViewGrid

EXAMPLE = "tools/demo --out demo"


@dataclass(frozen=True)
class Options:
    out: Path = option("folder for shards, picture and figures", Path("demo"))
    meshes: int = option("number of bodies", 16)
    views: int = option("number of views of each, all around the body", 9)
    workers: int | None = option("number of processes (default: one a processor)", None)


def run(options: Options) -> int:
    """Pack a small open set, stream all five variants, write OUT/variants.png and OUT/summary.json.

    OUT/example.png comes first: the same picture of the example set, since packing takes a minute.
    """
    workers = processors() if options.workers is None else options.workers
    packing = Packing("open", meshes=options.meshes, views=ViewGrid(span_deg=360, count=options.views))
    shards = options.out / "shards"
    make_folder(options.out)
    _say("1/4 drawing the example set")
    with Progress("    drawing", "pictures"):
        save_picture(contact_sheet(RangeImages(example_set()), 6), options.out / "example.png")
    _say(f"    wrote {options.out / 'example.png'}")
    _say(f"2/4 packing {options.meshes} bodies x {options.views} views into {shards}")
    with Progress("    unpacking the body model, once", "files"):
        from anny.paths import get_anny_cache_path

        if not any(get_anny_cache_path().rglob("*.safetensors")):  # else loading the model would do nothing
            load_anny()
    start = time.monotonic()
    with Progress("    packing", "views") as progress:
        manifest = pack_on(PROCESSES, workers, packing, shards, progress)
    packed = time.monotonic() - start
    _say(f"    {manifest.samples()} samples in {packed:.1f} s")
    _say("3/4 streaming the five variants from those shards, two passes each")
    variants = {name: _stream(shards, name, workers) for name in VARIANTS}
    _say("4/4 drawing the set that was packed")
    save_picture(contact_sheet(RangeImages(shards), 6), options.out / "variants.png")
    size = sum(shard.size for shard in manifest.shards)
    summary = {
        "samples": manifest.samples(),
        "train": manifest.samples("train"),
        "test": manifest.samples("test"),
        "packing_seconds": round(packed, 1),
        "bytes_per_sample": round(size / manifest.samples()),
        "workers": workers,
        "variants": variants,
    }
    write_atomically(options.out / "summary.json", json.dumps(summary, indent=2).encode() + b"\n")
    _say(f"wrote {options.out / 'variants.png'} and {options.out / 'summary.json'}")
    return 0


def _stream(shards: Path, variant: str, workers: int) -> dict[str, Any]:
    """Make two passes over the training split: the first starts the workers, the second is timed."""
    images = RangeImages(shards, variant=variant, split="train", seed=0)
    batches = loader(images, batch_size=20, num_workers=workers)
    kept = pixels = 0
    ranges: list[float] = []
    for batch in batches:
        kept += int((batch["labels"] != BACKGROUND).sum())
        pixels += batch["labels"].numel()
        ranges.append(float(batch["range"][batch["range"] > 0].mean()))
    start = time.perf_counter()
    count = sum(len(batch["key"]) for batch in batches)
    seconds = time.perf_counter() - start
    if count != len(images):
        raise BadConfig(f"a pass must give every sample once: {len(images)} expected, found {count}")
    rate = count / seconds
    _say(f"    {variant:6} {count} samples, {rate:6.0f} samples/s, {kept / pixels:.1%} of pixels left")
    return {
        "samples": count,
        "samples_per_second": round(rate),
        "foreground": round(kept / pixels, 4),
        "mean_range_m": round(float(np.mean(ranges)), 3),
    }


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()
