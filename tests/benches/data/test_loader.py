from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from benches.data.loader import bench
from benches.data.loader import limits as loader_limits
from benches.data.loader import mds as loader_mds
from benches.data.loader.baselines import STEP_M, InThreads, Premade, folder_bytes
from benches.data.loader.figure import draw_loader
from benches.data.loader.limits import limits, ratio
from benches.data.loader.passes import _check, checksum_of
from benches.data.loader.pngs import DECODERS, by_pillow, png, time_decoders
from numpy.typing import NDArray
from pictures import decoded, marks, part

from bodyseg_data.core import BadConfig, BadSample
from bodyseg_data.loading import Batch, RangeImages

# webdataset leaves the tars it has read to the garbage collector.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")

OURS = [f"ours_{name}" for name in ("none", "occ", "noise", "md", "all")]
OURS += [f"ours_all_{name}" for name in ("dataloader", "batch_sampler", "wrapped", "transform", "labels")]
NAMES = OURS + list(bench.baselines())


def absent(*_: Any) -> Any:
    raise ImportError("no such package")


@pytest.fixture(scope="module")
def figures(small_set: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A whole measurement, where some baselines are not installed."""
    ticks: list[tuple[int, int]] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loader_mds, "streaming", absent)
        patch.setattr(bench, "LitData", loader_mds.Mds)
        patch.setitem(sys.modules, "datasets", None)
        patch.setattr(loader_limits, "PNG_SAMPLES", 2)
        patch.setattr(bench, "PNG_SAMPLES", 2)
        patch.setattr(bench, "PACKAGES", ("torch", "no-such-package"))
        found = bench.measure(
            small_set,
            tmp_path_factory.mktemp("sets"),
            workers=(0, 1),
            batch=6,
            rounds=1,
            progress=lambda done, total: ticks.append((done, total)),
        )
    done, totals = zip(*ticks, strict=True)
    assert list(done) == sorted(done) and done[0] == 1 and {done[-1]} == set(totals)
    return found


def test_every_loader_is_measured_or_null(figures: dict[str, Any]) -> None:
    assert figures["missing"] == ["hf_webdataset", "hf_parquet", "mds_raw", "mds_zstd", "litdata"]
    for table in ("samples_per_second", "processor_ms_per_sample", "worker_mb", "spread", "rounds_of"):
        assert list(figures[table]) == NAMES
        for name, found in figures[table].items():
            if name in figures["missing"]:
                assert found == {"0": None, "1": None}
            elif table == "worker_mb":
                ours = name.startswith("ours") and not name.startswith("ours_all_")
                threads = ours or name.endswith("_threads")  # have no memory of their own
                assert found["0"] is None and (found["1"] is None) == threads
            elif table == "rounds_of":
                assert all(len(rates) == 1 and min(rates) > 0 for rates in found.values())
            else:
                assert min(found.values()) >= 0
    assert figures["bytes_per_sample"]["mds_raw"] is None
    assert figures["versions"]["torch"] and figures["versions"]["no-such-package"] is None
    assert (figures["samples"], figures["batch"], figures["rounds"]) == (24, 6, 1)
    assert figures["png_decoders"]["ms_per_sample"][figures["png_decoders"]["used"]] > 0


def test_bytes_are_those_on_disk(figures: dict[str, Any], small_set: Path) -> None:
    sizes = figures["bytes_per_sample"]
    assert sizes["ours_all"] == sizes["ours_none"] == round(folder_bytes(small_set) / 24)
    assert sizes["memory"] == sizes["memory_threads"] == 160 * 82 * 5
    assert sizes["webdataset_raw"] > 160 * 82 * 3 > sizes["webdataset_zstd"]
    assert sizes["png_files"] < sizes["webdataset_png"] < sizes["png_files"] + 12_000, "tars are padded"
    assert figures["five_png_bytes_per_sample"] > 2.4 * sizes["png_files"], "other variants have less noise in them"
    assert figures["kept_bytes_per_sample"] == sizes


def test_threads_share_a_set_and_pass_errors_on() -> None:
    """Each thread has its own samples; one that fails ends the pass."""

    def failing() -> Iterator[Batch]:
        yield {"key": ["a"]}  # type: ignore[typeddict-item]
        raise ValueError("a damaged file")

    two = InThreads(lambda: [[{"key": ["a"]}], [{"key": ["b"]}, {"key": ["c"]}]])  # type: ignore[list-item]
    for _ in range(2):
        assert sorted(batch["key"][0] for batch in two) == ["a", "b", "c"]
    with pytest.raises(ValueError, match="a damaged file"):
        list(InThreads(lambda: [failing(), failing()]))


def assert_shuffled(delivered: list[Batch], stored: list[str]) -> None:
    """What is read in the order of storage is read faster."""
    found = [key for one in delivered for key in one["key"]]
    assert sorted(found) == sorted(stored) and found != stored


@pytest.mark.parametrize("name", bench.baselines())
def test_baselines_deliver_what_was_stored(name: str, small_set: Path, tmp_path: Path) -> None:
    """Shuffled, in each pass; webdataset's own decoder, for one, would not: it leaves 8 of 16 bits."""
    premade, baseline = Premade(RangeImages(small_set)), bench.baselines()[name]
    try:
        size = baseline.write(premade, tmp_path)
    except ImportError as error:
        pytest.skip(f"{name} is not installed: {error}")
    expected = {image.key: checksum_of(image) for image in premade}
    for workers in (0, 2):
        batches = baseline.open(tmp_path, 5, workers)
        for _ in range(2):
            delivered = list(batches)
            _check(name, delivered, expected)
            for one in delivered:
                assert one["range"].dtype == torch.float32 and one["labels"].dtype == torch.uint8
                assert one["range"].shape[1:] == (1, 160, 82) and one["labels"].shape[1:] == (160, 82)
                assert len(one["range"]) == len(one["labels"]) == len(one["key"]) <= 5
            assert_shuffled(delivered, list(expected))
        del batches, delivered, one
        baseline.close()
    if name == "mds_zstd":
        assert folder_bytes(tmp_path) > 24 * 160 * 82 * 3 > 3 * size, "it keeps both forms"


@pytest.mark.parametrize("name", OURS)
def test_ours_shuffle_too(name: str, small_set: Path, tmp_path: Path) -> None:
    batches = bench._openings(small_set, {}, tmp_path, 5, 0)[name]()
    for _ in range(2):
        assert_shuffled(list(batches), list(RangeImages(small_set).keys))


def test_the_quickest_decoder_that_is_installed_is_used(small_set: Path) -> None:
    images = list(Premade(RangeImages(small_set)))[:2]

    def slow(data: bytes) -> NDArray[Any]:
        return [by_pillow(data) for _ in range(4)][-1]

    found = time_decoders(images, {"slow": slow, "absent": absent, "pillow": by_pillow})
    assert found.used == "pillow" and found.to_json()["used"] == "pillow"
    assert found.ms_per_sample["absent"] is None
    assert 0 < (found.ms_per_sample["pillow"] or 0) < (found.ms_per_sample["slow"] or 0)


@pytest.mark.parametrize("name", DECODERS)
def test_decoders_are_exact(name: str) -> None:
    """Ranges of all 65 536 values, and labels."""
    values = np.arange(1 << 16, dtype=np.uint16).reshape(256, 256)
    try:
        found = [DECODERS[name](png(image)) for image in (values, values.astype(np.uint8))]
    except ImportError as error:
        pytest.skip(f"{name} is not installed: {error}")
    np.testing.assert_array_equal(found[0], values, strict=True)
    np.testing.assert_array_equal(found[1], values.astype(np.uint8), strict=True)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_a_decoder_that_changes_pixels_is_refused(kind: type[np.generic], small_set: Path) -> None:
    """One that leaves 8 of 16 bits, and one that changes labels alone."""
    images = list(Premade(RangeImages(small_set)))[:1]

    def wrong(data: bytes) -> NDArray[Any]:
        image = by_pillow(data)
        return image if image.dtype != kind else (image >> 1).astype(kind)

    with pytest.raises(BadSample, match=f"^wrong: {images[0].key} is decoded to .* not what was stored$"):
        time_decoders(images, {"wrong": wrong})


def batch_of(images: list[Any]) -> Batch:
    ranges = [torch.from_numpy(image.range[None].astype(np.float32) * np.float32(STEP_M)) for image in images]
    labels = [torch.from_numpy(image.labels.copy()) for image in images]
    return {"range": torch.stack(ranges), "labels": torch.stack(labels), "key": [image.key for image in images]}


def test_other_pixels_doubles_and_losses_are_seen(small_set: Path) -> None:
    images = list(Premade(RangeImages(small_set)))[:3]
    expected = {image.key: checksum_of(image) for image in images}
    _check("x", [batch_of(images)], expected)
    with pytest.raises(BadSample, match="x delivers 2 of 3 samples in a pass"):
        _check("x", [batch_of(images[:2])], expected)
    with pytest.raises(BadSample, match=f"x delivers {images[0].key} twice in a pass"):
        _check("x", [batch_of([*images, images[0]])], expected)
    for change in ("range", "labels"):
        spoilt = batch_of(images)
        spoilt[change][1].view(-1)[7_000] += 1  # type: ignore[literal-required]
        with pytest.raises(BadSample, match=f"x delivers {images[1].key}: float32 .* not what was stored"):
            _check("x", [spoilt], expected)


def test_a_batch_that_is_used_again_too_soon_is_seen(small_set: Path) -> None:
    images = list(Premade(RangeImages(small_set)))[:4]

    def reusing() -> Iterator[Batch]:
        one = batch_of(images[:2])
        yield one
        later = batch_of(images[2:])
        one["range"].copy_(later["range"])
        one["labels"].copy_(later["labels"])
        yield {**one, "key": later["key"]}

    with pytest.raises(BadSample, match=f"x has overwritten a batch that is in use: {images[0].key}"):
        _check("x", reusing(), {image.key: checksum_of(image) for image in images})


def test_ratios_are_medians_over_rounds() -> None:
    rounds = {"a": {"2": [10.0, 90.0, 30.0]}, "b": {"2": [10.0, 30.0, 20.0]}}
    assert ratio(rounds, "2", "a", "b") == 1.5
    assert ratio({**rounds, "b": {}}, "2", "a", "b") is None


def test_limits_say_whether_they_hold() -> None:
    rates = {"ours_all": 100.0, "ours_none": 136.0, "webdataset_png": 40.0, "mds_raw": 101.0, "memory": 111.0}
    rounds = {name: {"0": [rate], "2": [rate]} for name, rate in rates.items()}
    found = {limit["what"]: limit for limit in limits(rounds, {"ours_all": 50_001}, 300_006)}
    assert {what: limit["holds"] for what, limit in found.items()} == {
        "all / webdataset_png, 0 workers": True,
        "all / mds_raw, 0 workers": True,
        "all / webdataset_png, 2 workers": False,
        "all / mds_raw, 2 workers": False,
        "all / memory, 2 workers": True,
        "time of all / time of none, 0 workers": False,
        "time of all / time of none, 2 workers": False,
        "bytes a sample": False,
        "bytes / bytes of five PNG sets": True,
    }
    assert found["all / webdataset_png, 0 workers"]["measured"] == 2.5
    through = {"ours_all_dataloader": {"2": [93.0]}, "ours_all_wrapped": {"2": [92.0]}}
    more = {limit["what"]: limit["holds"] for limit in limits(rounds | through, {"ours_all": 1}, 6)}
    assert more.items() - {what: limit["holds"] for what, limit in found.items()}.items() >= {
        ("time of ours_all_dataloader / time of memory, 2 workers", True),
        ("time of ours_all_wrapped / time of memory, 2 workers", False),
    }
    rounds["mds_raw"] = {}
    missing = {limit["what"]: limit for limit in limits(rounds, {"ours_all": 50_000}, 290_000)}
    assert missing["all / mds_raw, 2 workers"]["measured"] is missing["all / mds_raw, 2 workers"]["holds"] is None
    assert missing["bytes a sample"]["holds"] and not missing["bytes / bytes of five PNG sets"]["holds"]


@pytest.mark.parametrize(
    ("views", "workers", "message"),
    [
        (100, (0, 2), "at least 160 samples are needed with 2 workers, found 108"),
        (0, (0,), "at least 80 samples are needed with 0 workers, found 0"),
        (1080, (0, 16), "at least 1280 samples are needed with 16 workers, found 1080"),
        (1080, (2, 2), "--num-workers takes different numbers of at least 0, found 2 2"),
        (1080, (-1,), "--num-workers takes different numbers of at least 0, found -1"),
    ],
)
def test_too_little_to_measure_is_refused(views: int, workers: tuple[int, ...], message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        bench.bench_loader(views, workers)


def test_the_figure_is_drawn(figures: dict[str, Any], tmp_path: Path) -> None:
    draw_loader(figures, tmp_path / "chart.png")
    sizes = part(decoded(tmp_path / "chart.png"), across=(0.72, 1))
    ours, others = (marks(sizes, colour, 150) for colour in ("#1f5ac8", "#6e6e76"))
    assert len(ours) == len(OURS) and len({mark.width for mark in ours}) == 1, "a bar for each row of one set"
    assert len(others) == len(NAMES) - len(OURS) - len(figures["missing"]), "none for what is not installed"
    kept = figures["kept_bytes_per_sample"]
    memory = min(others, key=lambda mark: mark.top)  # the first row of the others
    assert memory.width / ours[0].width == pytest.approx(kept["memory"] / kept["ours_all"], rel=0.05)
