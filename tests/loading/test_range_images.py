from __future__ import annotations

import gc
import pickle
import re
import shutil
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from folders import ROOT
from small_rig import SMALL
from torch.utils.data import DataLoader

from bodyseg_data import Batch, RangeImages, loader
from bodyseg_data.artifacts import VARIANTS, MissingData, load_sensor_model
from bodyseg_data.core import BadConfig, BadShard

Bits = list[tuple[tuple[str, ...], bytes, bytes]]


def bits(batches: Iterable[Batch]) -> Bits:
    """All that a pass gives, batch by batch."""
    return [
        (tuple(batch["key"]), batch["range"].numpy().tobytes(), batch["labels"].numpy().tobytes()) for batch in batches
    ]


def keys(batches: Iterable[Batch]) -> list[str]:
    return [key for batch in batches for key in batch["key"]]


def test_a_batch_is_what_the_documentation_says(paper_set: Path) -> None:
    batch = next(iter(loader(RangeImages(paper_set, variant="none"), batch_size=3)))
    assert batch["range"].dtype == torch.float32
    assert batch["range"].shape == (3, 1, 640, 329)
    assert batch["labels"].dtype == torch.uint8
    assert batch["labels"].shape == (3, 640, 329)
    assert len(batch["key"]) == 3
    images = RangeImages(paper_set)
    steps = images.clean(0).range.astype(np.float32)
    assert images.step_m == images.manifest.rig.range_step_m
    assert np.array_equal(batch["range"][0, 0].numpy(), steps * np.float32(images.step_m))
    foreground = batch["range"] > 0
    assert 1.5 < batch["range"][foreground].min() < batch["range"].max() < 3.5
    assert torch.equal(foreground[:, 0], batch["labels"] != 255)


def test_the_public_classes_print_in_one_readable_line(paper_set: Path) -> None:
    images = RangeImages(paper_set, "noise", split="test", seed=3, only=["*"])
    count = len(images)
    where = f"{str(paper_set)!r}, variant='noise', split='test', seed=3"
    held = f"only=['*'], samples={count}, image='640 x 329', rig='paper', sensor='paper'"
    shown = f"RangeImages({where}, epoch=0, {held})"
    assert repr(images) == shown
    images.set_epoch(2)
    later = shown.replace("epoch=0", "epoch=2")
    batches = loader(images, 4, num_workers=2)
    order = (
        f"BatchOrder({later}, batch_size=4, shuffle=False, drop_last=False, rank=0, world_size=1, "
        f"batches={-(-count // 4)})"
    )
    assert repr(batches.order) == order
    assert repr(batches) == f"Loader({order}, num_workers=2, worker_method='thread')"


@pytest.mark.parametrize("variant", VARIANTS)
def test_bits_do_not_depend_on_the_number_of_workers(small_set: Path, variant: str) -> None:
    one, two = (
        [bits(batches), bits(batches)]
        for batches in (loader(RangeImages(small_set, variant), 5, workers, shuffle=True) for workers in (0, 2))
    )
    assert one == two
    assert one[0] != one[1]


@pytest.mark.filterwarnings("ignore:This DataLoader will create")  # more workers than processors, on purpose
@pytest.mark.parametrize("workers", [1, 3])
def test_other_numbers_of_workers_give_the_same_bits_too(small_set: Path, workers: int) -> None:
    images = RangeImages(small_set, "all", "train")
    assert bits(loader(images, 5, workers)) == bits(loader(images, 5, 0))


def test_bits_do_not_depend_on_the_shard_size(
    small_set: Path, tmp_path: Path, pack_figures: Callable[..., Path]
) -> None:
    other = pack_figures(tmp_path / "other", rig=SMALL, shard_samples=7)
    assert bits(loader(RangeImages(other, "all", "train"), 5)) == bits(
        loader(RangeImages(small_set, "all", "train"), 5)
    )


def test_bits_do_not_depend_on_the_codec(small_set: Path, tmp_path: Path, pack_figures: Callable[..., Path]) -> None:
    other = pack_figures(tmp_path / "png", rig=SMALL, codec="png")
    assert bits(loader(RangeImages(other, "all"), 5)) == bits(loader(RangeImages(small_set, "all"), 5))


def test_every_pass_is_another_epoch_in_order_and_draws(small_set: Path) -> None:
    images = RangeImages(small_set, "all", "train")
    batches = loader(images, 5)
    first, second = bits(batches), bits(batches)
    assert batches.epoch == 2
    orders = [[key for batch in run for key in batch[0]] for run in (first, second)]
    assert orders[0] != orders[1]
    assert sorted(orders[0]) == sorted(orders[1]) == sorted(images.keys)
    images.set_epoch(1)
    assert bits(batches) == second, "an epoch asked for is that epoch"
    images.set_epoch(0)
    assert bits(batches) == first
    assert bits(loader(RangeImages(small_set, "all", "train", epoch=1), 5)) == second
    assert bits(loader(RangeImages(small_set, "all", "train", seed=1), 5)) != first


def test_the_noise_of_one_image_differs_between_epochs(small_set: Path) -> None:
    images = RangeImages(small_set, "noise")
    before = images[0]["range"]
    images.set_epoch(1)
    assert not torch.equal(before, images[0]["range"])


def test_len_is_exact(small_set: Path) -> None:
    for split, count in ((None, 24), ("train", 16), ("test", 8)):
        images = RangeImages(small_set, split=split)  # type: ignore[arg-type]  # literals in a tuple
        assert len(images) == count
        for size in (1, 5, 8, 100):
            whole = loader(images, size)
            assert len(list(whole)) == len(whole) == -(-count // size)
            assert len(keys(whole)) == count
            if size > count:
                with pytest.raises(BadConfig, match="samples are too few: they do not fill one batch"):
                    loader(images, size, drop_last=True)
                continue
            short = loader(images, size, drop_last=True)
            assert len(list(short)) == len(short) == count // size
            assert len(keys(short)) == count // size * size


def test_shuffling_is_for_training_unless_said_otherwise(small_set: Path) -> None:
    for split, shuffled in ((None, False), ("train", True), ("test", False)):
        images = RangeImages(small_set, split=split)  # type: ignore[arg-type]  # literals in a tuple
        assert (keys(loader(images, 4)) != images.keys) == shuffled
        assert keys(loader(images, 4, shuffle=False)) == images.keys


def test_paths_and_globs_choose_shards(figures_set: Path) -> None:
    everything = RangeImages(figures_set).keys
    assert RangeImages(str(figures_set) + "/").keys == everything
    assert RangeImages(figures_set / "manifest.json").keys == everything
    assert RangeImages(figures_set / "train-*.tar").keys == RangeImages(figures_set, split="train").keys
    assert len(RangeImages(figures_set / "train-00000.tar")) == 5
    assert [Path(url).name for url in RangeImages(figures_set, split="test").urls()] == [
        "test-00000.tar",
        "test-00001.tar",
    ]


def test_a_plain_dataloader_works_as_well(small_set: Path) -> None:
    images = RangeImages(small_set, "all")
    plain = list(DataLoader(images, batch_size=5, num_workers=2))
    ours = list(loader(images, 5))
    assert all(torch.equal(a["range"], b["range"]) for a, b in zip(plain, ours, strict=True))
    assert all(torch.equal(a["labels"], b["labels"]) for a, b in zip(plain, ours, strict=True))


# webdataset leaves closing its files to the garbage collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
def test_a_webdataset_pipeline_gives_the_same_bits(small_set: Path) -> None:
    images = RangeImages(small_set, "all", "train")
    pipeline = images.webdataset()
    images.set_epoch(3)
    streamed = list(pipeline)
    gc.collect()
    assert [sample["key"] for sample in streamed] == images.keys
    for index in (0, 7, 15):
        assert torch.equal(streamed[index]["range"], images[index]["range"])
        assert torch.equal(streamed[index]["labels"], images[index]["labels"])
    assert not torch.equal(next(iter(images.webdataset(epoch=4)))["range"], images[0]["range"])
    again = pickle.loads(pickle.dumps(pipeline))  # as workers that are not forked receive it
    assert torch.equal(next(iter(again))["range"], streamed[0]["range"])


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
def test_a_webdataset_pipeline_checks_every_sample(figures_set: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(figures_set, tmp_path / "copy"))
    images = RangeImages(copy, "all", "train")
    path = copy / "train-00000.tar"
    whole = path.read_bytes()
    for place in (1100, 3000):  # a label image, and its padding or another member
        spoiled = bytearray(whole)
        spoiled[place] ^= 1
        path.write_bytes(spoiled)
        with pytest.raises(BadShard, match="train-00000.tar: open-.*: (altered|cut short): "):
            list(images.webdataset())
    shutil.copy(copy / "test-00000.tar", path)
    with pytest.raises(BadShard, match="train-00000.tar: open-.*: offset 0: altered: "):  # another's samples
        list(images.webdataset())
    gc.collect()


def test_one_pass_of_a_loader_runs_at_a_time(small_set: Path) -> None:
    for workers in (0, 2):
        batches = loader(RangeImages(small_set), 4, workers)
        older = iter(batches)
        next(older)
        assert len(keys(batches)) == 24
        with pytest.raises(BadConfig, match="one pass at a time"):
            next(older)


def test_two_loaders_of_the_same_images_do_not_meet(small_set: Path) -> None:
    images = RangeImages(small_set, "all")
    pairs = list(zip(loader(images, 4, 2), loader(images, 4, 0), strict=True))
    assert all(torch.equal(a["range"], b["range"]) for a, b in pairs)
    assert len(pairs) == 6


def test_threads_may_read_at_once(small_set: Path) -> None:
    images = RangeImages(small_set, "all")
    expected = [images[index]["range"] for index in range(24)]
    with ThreadPoolExecutor(8) as executor:
        read = list(executor.map(lambda index: images[index % 24]["range"], range(120)))
    assert all(torch.equal(image, expected[number % 24]) for number, image in enumerate(read))


def test_the_order_belongs_to_the_seed(small_set: Path) -> None:
    orders = [keys(loader(RangeImages(small_set, "none", "train", seed=seed), 4)) for seed in (0, 0, 1)]
    assert orders[0] == orders[1] != orders[2]


def test_the_lines_of_the_readme_run_and_differ_by_epoch(capsys: pytest.CaptureFixture[str]) -> None:
    (lines,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    seen: dict[int, list[bytes]] = {}
    lines += "\n        seen.setdefault(epoch, []).append(range_m.numpy().tobytes())"
    exec(lines, {"seen": seen})
    assert capsys.readouterr().out == "36 images\n"
    assert sorted(seen) == [0, 1]
    assert seen[0] != seen[1]


def test_images_and_samples_are_equal_to_themselves_alone(small_set: Path) -> None:
    """And may be keys: by their arrays they could be neither."""
    images = RangeImages(small_set, "all", "train")
    for get in (images.image, images.clean):
        one, other = get(0), get(0)
        assert one == one and one != other and len({one, other}) == 2


def test_images_survive_pickling(small_set: Path) -> None:
    images = RangeImages(small_set, "all", sensor=load_sensor_model().with_artifacts(MissingData(rates=(0.5,))))
    again = pickle.loads(pickle.dumps(images))
    assert torch.equal(images[3]["range"], again[3]["range"])


def test_indices_are_those_of_a_list(small_set: Path) -> None:
    images = RangeImages(small_set)
    assert images[-1]["key"] == images.keys[-1]
    for index in (24, -25):
        with pytest.raises(IndexError, match=f"index {index} of 24 samples"):
            images[index]


@pytest.mark.parametrize("workers", [0, 2])
def test_a_bad_sample_stops_the_run_in_one_line(figures_set: Path, tmp_path: Path, workers: int) -> None:
    copy = Path(shutil.copytree(figures_set, tmp_path / "copy"))
    spoiled = bytearray((copy / "train-00001.tar").read_bytes())
    spoiled[3000] ^= 1
    (copy / "train-00001.tar").write_bytes(spoiled)
    with pytest.raises(BadShard, match=r"^train-00001.tar: open-\S+: offset 0: altered: CRC-32") as caught:
        list(loader(RangeImages(copy), 4, workers))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"variant": "everything"}, "the variant must be one of none, occ, noise, md, all"),
        ({"split": "dev"}, "the split must be one of train, val, test, None, found 'dev'"),
        ({"seed": -1}, "a seed must be a whole number"),
        ({"epoch": -1}, "an epoch must be a whole number of at least 0, found -1"),
    ],
)
def test_bad_options_are_refused(small_set: Path, options: dict[str, object], message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        RangeImages(small_set, **options)  # type: ignore[arg-type]  # on purpose


def test_bad_loader_options_are_refused(small_set: Path) -> None:
    images = RangeImages(small_set)
    with pytest.raises(BadConfig, match="batch_size must be a whole number of at least 1, found 0"):
        loader(images, 0)
    with pytest.raises(BadConfig, match="num_workers must be at least 0, found -1"):
        loader(images, 4, num_workers=-1)


def test_an_empty_selection_is_refused(tmp_path: Path, figures_set: Path) -> None:
    with pytest.raises(BadConfig, match="no sample that matches 'val-\\*.tar'; the set holds 16 train, 8 test"):
        RangeImages(figures_set / "val-*.tar")
    with pytest.raises(BadShard, match="holds no manifest.json"):
        RangeImages(tmp_path)


def test_patterns_pick_samples_by_their_keys(figures_set: Path) -> None:
    images = RangeImages(figures_set)
    wanted = [key for key in images.keys if "-d215-" in key or key.endswith("-a090")]
    chosen = RangeImages(figures_set, only=("*-d215-*", "*-a090"))
    assert 0 < len(wanted) < len(images)
    assert chosen.keys == wanted
    assert chosen[0]["key"] == wanted[0]
    assert chosen.identity()["only"] == ["*-d215-*", "*-a090"]
    assert "only" not in images.identity()
    with pytest.raises(BadConfig, match=r"no sample that matches '\*.tar nobody-\*'"):
        RangeImages(figures_set / "*.tar", only=("nobody-*",))
