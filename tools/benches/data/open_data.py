"""`bench open_data`: sets of others' scenes that fill the image: writing them, their bytes, and reading them.

The scenes are those of docs/examples/robot_cell.py, 640 x 480, with ranges in steps of a millimetre. Loaders are
measured as `bench loader` measures them.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from benches.data.loader.baselines import Baseline, Memory, Premade, Webdataset, folder_bytes
from benches.data.loader.bench import a_sample, by_workers, check_counts, written
from benches.data.loader.litdata import LitData
from benches.data.loader.mds import Mds
from benches.data.loader.passes import Opening, Passes, checksum_of, run_rounds
from benches.data.loader.pngs import DECODERS, time_decoders
from benches.measuring import counter, evenly_spaced, median_time
from bodyseg_data.artifacts import VARIANTS, VariantName, shadow_tests
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.loading import RangeImages, loader
from bodyseg_data.packing import ShardWriter
from bodyseg_data.packing.occluders import occluder_range
from bodyseg_data.rigs import Rig, load_rig
from bodyseg_data.samples import Sample, steps
from bodyseg_data.shards import ProjectorKind, encode_sample

EXAMPLE: Final = Path(__file__).parents[3] / "docs" / "examples" / "robot_cell.py"

WRITTEN: Final[Mapping[str, tuple[ProjectorKind, bool]]] = {
    "shadow": ("shadow", True),
    "shadow_facing_from_range": ("shadow", False),
    "exact": ("exact", True),
    "none": ("none", True),
}
"""Row -> what is stored of the projector's range, and whether facing is given."""

BATCH: Final = 4
ROUNDS: Final = 5
_DECODED: Final = 8

SceneArrays = dict[str, Any]
"""Arguments of `ShardWriter.write`."""


def bench_open_data(
    views: int = 60, num_workers: Sequence[int] = (0, 2), progress: ProgressCallback = silent
) -> dict[str, Any]:
    """Write `views` scenes of the robot cell, and stream them beside others' loaders.

    writing: of each row of `WRITTEN`: samples a second of `ShardWriter`, alone and with two threads; of the encoder
    alone, which packing runs, too, and for `shadow` reduces the projector's range before; processor seconds count, but
    for the threads. of_the_encoder: of these, the writer's share. bytes: a sample, in the tars.
    loading: as `bench loader` has it. artifacts_ms: of processor, to read and make a sample of each variant.
    Raises BadConfig for fewer scenes than the workers need, ImportError without pyrender.
    """
    check_counts(views, BATCH, num_workers)
    rig, scenes = rendered(views)
    step = counter(progress, len(WRITTEN) + 2)
    with TemporaryDirectory(prefix="bodyseg-open-data-") as name:
        folder = Path(name)
        writing = {}
        for row in WRITTEN:
            writing[row] = measure_writing(row, scenes, rig, folder)
            step()
        packed = folder / "shadow"
        made = {variant: _artifacts_ms(packed, variant) for variant in VARIANTS}
        step()
        loading = measure_loading(packed, folder, num_workers)
        step()
    measured = float(np.mean([(scene["range_m"] > 0).mean() for scene in scenes]))
    return {
        "scenes": views,
        "batch": BATCH,
        "rounds": ROUNDS,
        "image": [rig.camera.rows, rig.camera.columns],
        "measured_share": round(measured, 4),
        "writing": writing,
        "artifacts_ms": made,
        **loading,
    }


def rendered(count: int) -> tuple[Rig, list[SceneArrays]]:
    """The rig and the scenes of the example, held in memory."""
    spec = spec_from_file_location("robot_cell", EXAMPLE)
    if spec is None or spec.loader is None:
        raise ImportError(f"no program {EXAMPLE}")
    cell = module_from_spec(spec)
    spec.loader.exec_module(cell)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "rig.toml"
        path.write_text(cell.RIG.format(rows=480, columns=640, focal_px=576))
        rig = replace(load_rig(path), range_step_mm=1.0)
    return rig, list(cell.scenes(0, count, rig))


def measure_writing(row: str, scenes: Sequence[SceneArrays], rig: Rig, folder: Path) -> dict[str, Any]:
    """Write a set into `folder`/`row`, once alone and once with two threads, and encode its samples alone."""
    projector, given = WRITTEN[row]
    facing = _facing(scenes, rig, folder) if given else [None] * len(scenes)
    classes = 1 + max(int(scene["labels"][scene["labels"] < 254].max()) for scene in scenes)
    names = [f"class {number}" for number in range(classes)]

    def write(out: Path, workers: int) -> None:
        with ShardWriter(out, rig=rig, classes=names, projector=projector, workers=workers) as writer:
            for scene, faces in zip(scenes, facing, strict=True):
                arrays = {**scene, "facing": faces}
                if projector == "none":
                    del arrays["projector_range_m"]
                writer.write(**arrays)

    alone, _ = median_time(partial(write, folder / row, 0))
    start = time.perf_counter()
    write(folder / f"{row}-threads", 2)
    threads = time.perf_counter() - start
    images = RangeImages(folder / row, "none")
    samples = [images.clean(index) for index in range(len(images))]
    seen = {scene["key"]: scene["projector_range_m"] for scene in scenes}
    whole = seen if projector == "shadow" else None
    _encode_all(samples[:2], whole, rig)  # compiles
    encoder, _ = median_time(lambda: _encode_all(samples, whole, rig))
    count = len(scenes)
    return {
        "samples_per_second": {
            "writer": round(count / alone, 1),
            "writer_2_threads": round(count / threads, 1),
            "encoder": round(count / encoder, 1),
        },
        "of_the_encoder": round(encoder / alone, 3),
        "bytes": round(sum(path.stat().st_size for path in (folder / row).glob("*.tar")) / count),
    }


def _facing(scenes: Sequence[SceneArrays], rig: Rig, folder: Path) -> list[Any]:
    """Facing as it is found from ranges, for all scenes; kept in a set of its own."""
    out = folder / "facing"
    if not out.exists():
        with ShardWriter(out, rig=rig, classes=["any"], projector="none", workers=2) as writer:
            for scene in scenes:
                labels = np.where(scene["range_m"] > 0, 0, 255).astype(np.uint8)
                writer.write(key=scene["key"], range_m=scene["range_m"], labels=labels)
    images = RangeImages(out, "none")
    found = {key: images.clean(index).faces_projector for index, key in enumerate(images.keys)}
    return [found[scene["key"]] for scene in scenes]


def _encode_all(samples: Sequence[Sample], projector_m: Mapping[str, Any] | None, rig: Rig) -> None:
    """Encode samples as packing does. projector_m: by key, whole ranges that are reduced to what shadows need."""
    test = shadow_tests(rig)[0]
    for sample in samples:
        if projector_m is not None:
            whole = projector_m[sample.key].reshape(-1)

            def ranges(texels: Any, whole: Any = whole, key: str = sample.key) -> Any:
                return steps(whole[texels], rig.range_step_m, key)

            reduced = occluder_range(test, sample.range, sample.faces_projector, ranges)
            sample = replace(sample, projector_range=reduced)
        encode_sample(sample)


def _artifacts_ms(packed: Path, variant: VariantName) -> float:
    """Milliseconds of processor to read and make a sample of a variant; the first pass fills caches."""
    images = RangeImages(packed, variant)
    camera = images.manifest.rig.camera
    image, labels = (np.empty((camera.rows, camera.columns), kind) for kind in (np.uint16, np.uint8))

    def read() -> None:
        for index in range(len(images)):
            images.write(index, 0, image, labels)

    read()
    return round(1e3 * median_time(read, 3)[0] / len(images), 3)


def measure_loading(packed: Path, scratch: Path, workers: Sequence[int]) -> dict[str, Any]:
    """Samples a second and bytes a sample of loaders of the set in `packed`, those of others in new folders."""
    images = {variant: RangeImages(packed, variant) for variant in VARIANTS}
    decoders = time_decoders(evenly_spaced(Premade(images["all"]), min(_DECODED, len(images["all"]))))
    known: dict[str, Baseline] = {
        "webdataset_png": Webdataset(DECODERS[decoders.used]),
        "webdataset_raw": Webdataset(stored="raw"),
        "webdataset_zstd": Webdataset(stored="zstd"),
        "mds_raw": Mds(),
        "mds_zstd": Mds("zstd"),
        "litdata": LitData(),
        "memory": Memory(),
    }
    stored: dict[str, int | None] = {f"ours_{name}": folder_bytes(packed) for name in VARIANTS}
    stored |= written(known, Premade(images["all"]), scratch, lambda: None)
    there = {name: baseline for name, baseline in known.items() if stored[name] is not None}
    sums = {v: {image.key: checksum_of(image) for image in Premade(images[v])} for v in VARIANTS}
    expected = {f"ours_{name}": sums[name] for name in VARIANTS} | dict.fromkeys(there, sums["all"])
    found: dict[int, dict[str, Passes]] = {}
    for count in workers:
        opens: dict[str, Opening] = {
            f"ours_{name}": partial(loader, RangeImages(packed, name), BATCH, count, shuffle=True) for name in VARIANTS
        }
        opens |= {name: partial(each.open, scratch / name, BATCH, count) for name, each in there.items()}
        try:
            found[count] = run_rounds(opens, count, ROUNDS, expected, lambda: None)
        finally:
            for baseline in there.values():
                baseline.close()
    rates = by_workers(found, stored, Passes.samples_per_second)

    def quotient(one: float | None, other: float | None) -> float | None:
        return None if one is None or other is None else round(one / other, 3)

    return {
        "samples_per_second": rates,
        "processor_ms_per_sample": by_workers(found, stored, Passes.processor_ms_per_sample),
        "ours_all_over": {
            name: {n: quotient(rates["ours_all"][n], rate) for n, rate in row.items()}
            for name, row in rates.items()
            if name != "ours_all"
        },
        "bytes_per_sample": a_sample(stored, len(images["all"])),
        "png_decoder": decoders.used,
        "missing": [name for name, size in stored.items() if size is None],
    }
