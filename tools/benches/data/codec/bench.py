"""`bench codec`: bytes and time of every way to store a sample's images, on views of bare and dressed open bodies.

All times are of the processor, medians of several rounds.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.charts.fronts import pareto_front
from benches.data.codec.baselines import Baseline, baselines, label_bytes
from benches.environment import computed_by
from benches.measuring import median_time, mixed
from bodyseg_data.artifacts import VARIANTS, Augmentation, ShadowTest, shadow_tests
from bodyseg_data.bodies import open_source
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.packing import Sampler
from bodyseg_data.packing.occluders import coarsened, exact_range
from bodyseg_data.rendering import open_renderer
from bodyseg_data.rigs import load_rig
from bodyseg_data.samples import Sample, ViewGrid, steps
from bodyseg_data.shards import encode_sample
from bodyseg_data.shards.codecs.bodyseg_images import decode_images, encode_images
from bodyseg_data.shards.codecs.png import encode_png

DEFAULT: Final = "bsi, compiled"
_IMAGES: Final = ("range", "labels", "projector")
_VIEWS_A_BODY: Final = 3
_ROUNDS: Final = 5
_BLOCK: Final = 512  # of a tar: a header takes one, contents whole ones

Images = tuple[NDArray[np.uint16], NDArray[np.uint8], NDArray[np.uint16]]
"""Camera range, label bytes, projector range."""


@dataclass
class _Costs:
    """Bytes and seconds of one kind of image, one entry a sample."""

    bytes: list[int] = field(default_factory=list)
    encode_s: list[float] = field(default_factory=list)
    decode_s: list[float] = field(default_factory=list)

    def row(self) -> dict[str, float]:
        times = {name: statistics.mean(getattr(self, f"{name}_s")) for name in ("encode", "decode")}
        return {"bytes": round(statistics.mean(self.bytes))} | {
            f"{name}_ms": round(1e3 * seconds, 4) for name, seconds in times.items()
        }


def bench_codec(views: int = 60, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Every codec on `views` samples: mean bytes, ms to encode and decode, of all three images and of each kind.

    front: codecs that none beats in both bytes and decoding. projector: what rounding it to what the shadows need
    saves. png_sets: the five sets of the paper as PNG files against the one that is stored. Raises
    MissingLibrary without imagecodecs.
    """
    others = baselines()
    costs = {baseline.name: {kind: _Costs() for kind in _IMAGES} for baseline in others}
    ours = {name: {kind: _Costs() for kind in ("range and labels", "projector")} for name in ("bsi, NumPy", DEFAULT)}
    sizes, rounding = _Sizes(), _Rounding(shadow_tests(load_rig())[0])
    for done, (sample, exact) in enumerate(_samples(views), start=1):
        images = sample.range, label_bytes(sample.labels, sample.faces_projector), sample.occluder_range()
        for turn in range(len(others)):
            baseline = others[(turn + done) % len(others)]
            _measure(baseline, images, costs[baseline.name])
        for name, kinds in ours.items():
            with computed_by("compiled" if name == DEFAULT else "numpy"):
                _measure_ours(sample, kinds)
        sizes.add(sample)
        rounding.add(sample, *exact)
        progress(done, views)
    rows = {name: _summed(kinds) for name, kinds in (ours | costs).items()}
    return {
        "default": DEFAULT,
        "codecs": rows,
        "front": pareto_front(rows, lambda name: (rows[name]["bytes"], rows[name]["decode_ms"])),
        "projector": rounding.row(),
        "png_sets": sizes.row(),
        "views": views,
    }


def _samples(count: int) -> Iterator[tuple[Sample, tuple[Any, ...]]]:
    """Samples from all over the open source, bare and dressed, and what `coarsened` made of the projector's range."""
    source, rig = open_source("open"), load_rig()
    bodies, grid = source.bodies(), list(ViewGrid(span_deg=360, azimuths=18))
    meshes = -(-count // _VIEWS_A_BODY)
    for number in range(meshes):
        ref = bodies[number * len(bodies) // meshes]
        body = source.build(ref)
        with closing(open_renderer("raster", body.mesh)) as renderer:
            sampler = Sampler(renderer, rig, body.mesh, body.partition(), source.name, ref)
            for turn in range(_VIEWS_A_BODY * number, min(_VIEWS_A_BODY * (number + 1), count)):
                view = mixed(grid, turn)
                sample = sampler.take(view)
                _, projector = rig.placed(body.mesh.centre, view)
                exact = exact_range(
                    shadow_tests(rig)[0],
                    sample.range,
                    sample.faces_projector,
                    lambda texels, at=projector, seen=renderer: steps(  # type: ignore[misc]
                        seen.ranges(at, texels), rig.range_step_m, "bench"
                    ),
                )
                yield sample, exact


def _measure(baseline: Baseline, images: Images, costs: dict[str, _Costs]) -> None:
    several: list[NDArray[Any]] = [*images]
    for kind, image, background in zip(_IMAGES, several, (0, 255, 0), strict=True):
        rounds = 1 if "effort" in baseline.name else _ROUNDS  # slow ones' times need no polish
        encode_s, data = median_time(lambda image=image, background=background: baseline.encode(image, background), 1)  # type: ignore[misc]
        decode_s, decoded = median_time(lambda data=data: baseline.decode(data), rounds)  # type: ignore[misc]
        if not np.array_equal(decoded, image):
            raise AssertionError(f"{baseline.name} is not lossless")
        cost = costs[kind]
        cost.bytes.append(len(data))
        cost.encode_s.append(encode_s)
        cost.decode_s.append(decode_s)


def _measure_ours(sample: Sample, costs: dict[str, _Costs]) -> None:
    """Cost of ours; the projector's share is the difference that its image makes, since one file holds all."""
    projector, facing = sample.occluder_range(), sample.faces_projector.view(np.uint8)
    before = 0, 0.0, 0.0
    for kind, occluder in (("range and labels", np.zeros_like(projector)), ("projector", projector)):
        encode = partial(encode_images, sample.range, sample.labels, facing, occluder)
        encode_s, data = median_time(encode, _ROUNDS)
        wanted = kind == "projector"
        decode_s, _ = median_time(lambda data=data, wanted=wanted: decode_images(data, wanted), _ROUNDS)  # type: ignore[misc]
        costs[kind].bytes.append(len(data) - before[0])
        costs[kind].encode_s.append(encode_s - before[1])
        costs[kind].decode_s.append(decode_s - before[2])
        before = len(data), encode_s, decode_s


def _summed(kinds: dict[str, _Costs]) -> dict[str, Any]:
    rows = {kind: costs.row() for kind, costs in kinds.items()}
    whole = {name: round(sum(row[name] for row in rows.values()), 4) for name in ("bytes", "encode_ms", "decode_ms")}
    without = sum(row["decode_ms"] for kind, row in rows.items() if kind != "projector")
    return whole | {"decode_ms_without_projector": round(without, 4), "images": rows}


class _Sizes:
    """Five sets of PNG files against one set that makes them. One entry a sample."""

    def __init__(self) -> None:
        self._augmentations = [Augmentation(load_rig(), variant) for variant in VARIANTS]
        self._png: list[int] = []
        self._tar: list[int] = []

    def add(self, sample: Sample) -> None:
        images = [augmentation(sample) for augmentation in self._augmentations]
        self._png.append(sum(len(encode_png(image.range)) + len(encode_png(image.labels)) for image in images))
        members = encode_sample(sample).values()
        self._tar.append(sum(_BLOCK + -(-len(data) // _BLOCK) * _BLOCK for data in members))

    def row(self) -> dict[str, Any]:
        return {
            "five_png_sets_a_sample": round(statistics.mean(self._png)),
            "in_the_tar_a_sample": round(statistics.mean(self._tar)),
        }


class _Rounding:
    """Bytes saved, time taken and pixels changed by rounding the projector's range."""

    def __init__(self, test: ShadowTest) -> None:
        self._test = test
        self._exact, self._coarse, self._texels, self._kept, self._differing = 0, 0, 0, 0, 0
        self._seconds: list[float] = []

    def add(self, sample: Sample, image: NDArray[np.uint16], *points: Any) -> None:
        seconds, coarse = median_time(lambda: coarsened(self._test, image, *points), _ROUNDS)
        self._seconds.append(seconds)
        self._exact += len(encode_sample(replace(sample, projector_range=image))["bsi"])
        self._coarse += len(encode_sample(sample)["bsi"])
        self._texels, self._kept = self._texels + int((image > 0).sum()), self._kept + int((coarse > 0).sum())
        masks = [self._test.lit(sample.range, occluder, sample.faces_projector) for occluder in (image, coarse)]
        self._differing += int((masks[0] != masks[1]).sum())

    def row(self) -> dict[str, Any]:
        count = len(self._seconds)
        return {
            "bytes_saved": round((self._exact - self._coarse) / count),
            "exact_texels": round(self._texels / count),
            "coarse_texels": round(self._kept / count),
            "ms": round(1e3 * statistics.mean(self._seconds), 2),
            "pixels_in_another_light": self._differing,
        }
