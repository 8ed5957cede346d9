"""Steps for pipelines of plain `webdataset`: the decoder and the maker of variants, with their reader and workers."""

from __future__ import annotations

import gc
import pickle
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import webdataset as wds
from folders import GOLDEN
from torch.utils.data import DataLoader

from bodyseg_data import BadSample, LabelClass, RangeImages, decoder
from bodyseg_data.labels import classes_of

pytestmark = pytest.mark.filterwarnings(  # webdataset leaves closing its files to the garbage collector
    "ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning"
)


@pytest.fixture(autouse=True)
def closed_files() -> Iterator[None]:
    """What webdataset leaves open ends with the test, whose filters of warnings know of it."""
    yield
    gc.collect()


def urls(folder: Path) -> list[str]:
    return sorted(str(path) for path in folder.glob("*-?????.tar"))


def same(ours: dict[str, Any], theirs: dict[str, Any]) -> bool:
    return all(torch.equal(ours[name], theirs[name]) for name in ("range", "labels")) and ours["key"] == theirs["key"]


@pytest.mark.parametrize("name", ["figures", "format_7"])
def test_a_pipeline_gives_the_arrays_of_a_sample(name: str, figures_set: Path) -> None:
    folder = figures_set if name == "figures" else GOLDEN / name
    images = RangeImages(folder, "none", unlabelled=True)
    found = 0
    for sample in wds.WebDataset(urls(folder), shardshuffle=False).decode(decoder()):
        clean = images.clean(images.keys.index(sample["__key__"]))
        read = sample["bsi"]
        assert np.array_equal(read["range"], clean.range) and np.array_equal(read["labels"], clean.labels)
        assert np.array_equal(read["facing"] & 1, clean.faces_projector)
        if clean.projector_range is not None:
            assert np.array_equal(read["projector"], clean.projector_range)
        assert sample["json"] == clean.info.to_json()
        for plane, image in clean.planes.items():
            assert np.array_equal(sample[f"plane.{plane}.bsp"], image)
        found += 1
    assert found == len(images)


def test_a_pipeline_makes_the_bits_of_range_images_in_workers_and_shuffled(figures_set: Path) -> None:
    images = RangeImages(figures_set, "all", seed=3)
    maker = RangeImages(figures_set, "all", seed=3, epoch=2).make
    by_key = {key: images[2, index] for index, key in enumerate(images.keys)}
    pipeline = wds.WebDataset(urls(figures_set), shardshuffle=3, seed=0).shuffle(10).decode(decoder()).map(maker)
    order = []
    for item in DataLoader(pipeline, batch_size=None, num_workers=2, multiprocessing_context="fork"):
        assert same(item, by_key[item["key"]])
        order.append(item["key"])
    assert sorted(order) == sorted(images.keys) and order != images.keys
    raw = wds.WebDataset(urls(figures_set), shardshuffle=False).map(maker).batched(5)
    keys = [key for batch in raw for key in batch["key"]]
    assert sorted(keys) == sorted(images.keys)


@pytest.mark.parametrize("name", ["format_5", "format_5_png", "format_7", "format_7_png"])
def test_a_maker_knows_every_format_and_each_samples_rig(name: str) -> None:
    variant = "noise" if name == "format_7_png" else "all"
    planes = ["instances"] if name == "format_7" else []
    maker = pickle.loads(pickle.dumps(RangeImages(GOLDEN / name, variant, planes=planes))).make
    images = RangeImages(GOLDEN / name, variant, planes=planes)
    read = wds.WebDataset(urls(GOLDEN / name), shardshuffle=False)
    for each in (read, read.decode(decoder()), read.decode()):  # the last by webdataset's own
        for sample in each:
            made = maker(sample)
            expected = images[images.keys.index(made["key"])]
            assert same(made, expected) and made.keys() == {"__key__", *expected}
            for plane in planes:
                assert torch.equal(made["planes"][plane], expected["planes"][plane])


def test_what_is_damaged_in_a_pipeline_is_one_line(figures_set: Path, tmp_path: Path) -> None:
    spoiled = Path(shutil.copytree(figures_set, tmp_path / "set")) / "train-00000.tar"
    data = bytearray(spoiled.read_bytes())
    data[900] ^= 1
    spoiled.write_bytes(data)
    with pytest.raises(wds.autodecode.DecodingError) as altered:
        list(wds.WebDataset([str(spoiled)], shardshuffle=False).decode(decoder()))
    assert str(altered.value.__cause__).startswith("bsi: ")
    assert decoder()(".cls", b"1") is None
    images = RangeImages(figures_set, "none")
    with pytest.raises(BadSample, match="a: a sample has the members .*, found cls"):
        images.make({"__key__": "a", "cls": b"3"})
    with pytest.raises(BadSample, match=r"a: cls must be bytes, or decoded by decoder\(\), found int"):
        images.make({"__key__": "a", "cls": 3})


@pytest.mark.parametrize("decoded", [False, True])
def test_a_maker_refuses_samples_of_another_set(decoded: bool, figures_set: Path) -> None:
    def first(folder: Path) -> dict[str, Any]:
        raw = wds.WebDataset(urls(folder), shardshuffle=False)
        return next(iter(raw.decode(decoder()) if decoded else raw))

    images, other = RangeImages(figures_set, "none"), first(GOLDEN / "format_7")
    with pytest.raises(BadSample, match=f"{other['__key__']}: range must be uint16 .160, 82. as in the rig, found "):
        images.make(other)
    images.manifest = replace(images.manifest, classes=classes_of((LabelClass("floor"),), "rooms"))
    with pytest.raises(BadSample, match="open-A-A-2-d215-a000: labels must be 0 to 0, as in the set, found others"):
        images.make(first(figures_set))
