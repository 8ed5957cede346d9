"""`bodyseg inspect`: draw a contact sheet of a set, or count what it holds."""

from __future__ import annotations

import json
import sys
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from PIL import Image

from bodyseg_data import loading
from bodyseg_data.artifacts import PAPER_SENSOR, VARIANTS, VariantName
from bodyseg_data.commands.options import OCCLUDER_HELP, WHERE_HELP, option
from bodyseg_data.commands.progress import Progress
from bodyseg_data.commands.records import check_target
from bodyseg_data.core import BadConfig, Draws
from bodyseg_data.drawing import Row, check_picture, draw_sheet, save_picture
from bodyseg_data.labels import label_map_names
from bodyseg_data.samples import SPLITS, OccluderName, ReadSplit
from bodyseg_data.shards import BODY_FIELDS, column_names

EXAMPLE = "bodyseg inspect shards --variant all --out sheet.png"

MOST_VALUES: Final = 20
"""A field of more values is not counted by value."""

MOST_ROWS: Final = 500
"""A sheet of more rows is too high for most viewers, and takes gigabytes while it is drawn."""


@dataclass(frozen=True)
class Options:
    folder: str = option("folder or address of a set of shards", positional=True, address=True)
    variant: VariantName = option("variant that --json counts and whose labels the sheet shows last", "all")
    sensor: str = option("the artifacts: a sensor that ships with the package, or a TOML file", PAPER_SENSOR)
    labels: str | None = option(
        f"classes to count (default: the set's): {', '.join(label_map_names())} or a label map (.toml)", None
    )
    occluder: OccluderName = option(OCCLUDER_HELP, "stored")
    split: ReadSplit | None = option("only this split (default: train and test)", None)
    val_share: float = option("share of train that is the split val, and not train", 0.0)
    where: tuple[str, ...] = option(WHERE_HELP, ())
    out: Path | None = option("write a contact sheet to this PNG file", None)
    json: bool = option("print what the set holds as JSON", False)
    rows: int = option(f"samples on the sheet, taken evenly from the set, 1 to {MOST_ROWS}", 6)
    seed: int = option("seed of the artifacts' random draws", 0)


def run(options: Options) -> int:
    """Write the sheet, print the counts, or both."""
    if options.out is None and not options.json:
        raise BadConfig("nothing to do: give --out FILE.png, --json, or both")
    if options.out is not None:
        check_picture(options.out)
        check_target(options.out, "--out")
    if not 1 <= options.rows <= MOST_ROWS:
        raise BadConfig(f"--rows must be 1 to {MOST_ROWS}, found {options.rows}")
    images = loading.RangeImages(
        options.folder,
        options.variant,
        options.split,
        options.seed,
        sensor=options.sensor,
        where=options.where,
        val_share=options.val_share,
        labels=options.labels,
        occluder=options.occluder,
    )
    if options.out is not None:
        save_picture(contact_sheet(images, options.rows), options.out)
        sys.stderr.write(f"wrote {options.out}\n")
    if options.json:
        sys.stdout.write(json.dumps(summarise(images), indent=2) + "\n")
    return 0


def contact_sheet(images: loading.RangeImages, rows: int) -> Image.Image:
    """Draw a sheet of `rows` samples spread over the set, or of all if there are fewer, in the variants it can give."""
    count = min(rows, len(images))
    lines = []
    for number in range(count):
        # Drawn from a section each, since even steps would always show the same view.
        first, end = number * len(images) // count, (number + 1) * len(images) // count
        draw = Draws(0, 0, f"{number} of {count}").generator("contact sheet")
        sample = images.clean(int(draw.integers(first, end)))
        shown = dict.fromkeys((*VARIANTS, images.augmentation.variant))
        makers = [replace(images.augmentation_of(sample), variant=name) for name in shown]
        able = [each for each in makers if sample.projector_range is not None or not each.needs_projector]
        lines.append(Row(sample, images.step_m, {each.variant: each(sample, images.epoch) for each in able}))
    sources = f"rig {images.manifest.rig.name}, sensor {images.augmentation.sensor.name}"
    title = f"{images.path.rpartition('/')[2]}: {len(images)} samples, {sources}"
    return draw_sheet(lines, images.augmentation.variant, title, images.augmentation.sensor, images.label_map)


def summarise(images: loading.RangeImages) -> dict[str, Any]:
    """Count a set's samples and pixels and the share that a variant keeps of the clean foreground, as plain JSON."""
    splits, subsets, subjects = Counter[str](), Counter[str](), Counter[str]()
    label_map = images.label_map
    pixels = np.zeros(len(label_map), np.int64)
    clean_pixels = kept_pixels = 0
    known = BODY_FIELDS.kinds if images.manifest.fields.of_bodies else {}
    fields = {name: Counter[Any]() for name in images.manifest.fields.kinds if name not in known}
    drawn: dict[str, list[float]] = {name: [] for artifact in images.augmentation.sensor for name in artifact.drawn}
    with Progress("inspecting", "samples") as progress:
        for index in range(len(images)):
            sample = images.clean(index)
            image = images.augmentation_of(sample)(sample, images.epoch)
            for name, counts in fields.items():
                counts[sample.info.get(name)] += 1
            splits[sample.info.split] += 1
            subsets.update(filter(None, [sample.info.get("subset")]))
            subjects.update(filter(None, [sample.info.get("subject")]))
            pixels += np.bincount(label_map.table[image.labels.ravel()], minlength=256)[: len(label_map)]
            clean_pixels += int(np.count_nonzero(sample.range))
            kept_pixels += int(np.count_nonzero(image.range))
            for name, value in image.drawn.items():
                drawn[name].append(value)
            progress.update(index + 1, len(images))
    manifest = images.manifest
    return {
        "path": images.path,
        "source": manifest.source,
        "renderer": manifest.renderer,
        "codec": manifest.codec,
        "rig": manifest.rig.name,
        "rigs": len(manifest.rigs),
        "planes": dict(manifest.planes),
        "columns": column_names(images.reader.store),
        "range_step_mm": manifest.rig.range_step_mm,
        "image": [manifest.rig.camera.rows, manifest.rig.camera.columns],
        "shards": len(images.urls()),
        "bytes": images.stored_bytes(),
        "bytes_per_sample": round(images.stored_bytes() / len(images)),
        "samples": len(images),
        "splits": {name: splits[name] for name in SPLITS},
        "subsets": dict(subsets),
        "subjects": len(subjects),
        "fields": {name: _told(counts) for name, counts in fields.items()},
        "variant": images.variant,
        "sensor": images.augmentation.sensor.name,
        "foreground_pixels_per_image": round(clean_pixels / len(images)),
        "kept": round(kept_pixels / max(clean_pixels, 1), 4),
        **{f"mean_{name}": round(float(np.mean(values)), 4) if values else None for name, values in drawn.items()},
        "classes": label_map.name,
        "class_shares": {
            name: round(int(count) / max(int(pixels.sum()), 1), 4)
            for name, count in zip(label_map.names, pixels, strict=True)
        },
        "notes": manifest.notes(),
    }


def _told(counts: Counter[Any]) -> dict[str, Any]:
    """A field of N samples: how many have each of a few values, else the number of values, and the ends of numbers."""
    if len(counts) <= MOST_VALUES:
        return {str(value): count for value, count in counts.most_common()}
    numbers = [value for value in counts if type(value) in (int, float)]
    return {"values": len(counts), **({"least": min(numbers), "greatest": max(numbers)} if numbers else {})}
