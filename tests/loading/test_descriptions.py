"""Descriptions of samples as dictionaries and tables, from the manifest alone."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from folders import GOLDEN
from samples import GOOD

from bodyseg_data import RangeImages
from bodyseg_data.samples import SampleInfo, Value
from bodyseg_data.shards import Fields, Manifest, TarWriter, encode_sample, read_manifest, write_manifest


@pytest.fixture
def without_shards(figures_set: Path, tmp_path: Path) -> Path:
    """The manifest of a set, without a shard."""
    (tmp_path / "set").mkdir()
    shutil.copy(figures_set / "manifest.json", tmp_path / "set")
    return tmp_path / "set"


def test_descriptions_are_those_of_the_samples(without_shards: Path, figures_set: Path) -> None:
    images, whole = RangeImages(without_shards, "none"), RangeImages(figures_set, "none")
    table = images.table()
    assert list(table) == ["key", "split", *read_manifest(figures_set).fields.kinds]
    for index, key in enumerate(images.keys):
        info = whole.clean(index).info
        assert images.describe(index) == {"key": key, "split": info.split, **info.fields}
        assert {name: column[index].item() for name, column in table.items()} == images.describe(index)
    assert table["distance_cm"].dtype == np.int64 and table["pose"].dtype.kind == "U"


def test_a_table_is_of_the_chosen_samples(without_shards: Path) -> None:
    first = RangeImages(without_shards, "none").describe(0)["azimuth_deg"]
    images = RangeImages(without_shards, "none", "train", where=f"azimuth_deg={first}")
    table = images.table()
    assert table["key"].tolist() == images.keys and set(table["azimuth_deg"].tolist()) == {first}
    assert 0 < len(table["key"]) < 16 and set(table["split"].tolist()) == {"train"}


def test_fields_that_some_samples_lack_are_masked(tmp_path: Path) -> None:
    kinds = {"n": "int", "x": "float", "on": "flag", "word": "text", "pose": "numbers", "odd": "numbers"}
    first: dict[str, Value] = {"n": 3, "x": 0.5, "on": True, "word": "a", "pose": (1.0, 2.0), "odd": (1.0,)}
    fields = Fields(tuple(((name, kind),) for name, kind in kinds.items()))
    infos = [SampleInfo("train", first), SampleInfo("train", {}), SampleInfo("train", {**first, "odd": ()})]
    with TarWriter(tmp_path / "train-00000.tar", tmp_path / "part", "train", fields) as shard:
        for number, info in enumerate(infos):
            sample = replace(GOOD, key=f"s{number}", info=info)
            shard.write(sample.key, encode_sample(sample))
    rig = read_manifest(GOLDEN / "format_7").rig
    write_manifest(Manifest((rig,), "bsi", "renders", "", "", (shard.record,), fields=fields), tmp_path)
    table = RangeImages(tmp_path, "none").table()
    for name in ("n", "x", "on", "word", "pose"):
        assert np.ma.getmaskarray(table[name]).tolist() == [False, True, False]
        assert table[name].tolist() == [first[name], None, first[name]]
    assert table["odd"].tolist() == [(1.0,), None, ()]
    assert RangeImages(tmp_path, "none").describe(1) == {"key": "s1", "split": "train"}
    there = RangeImages(tmp_path, "none", where="n=3").table()
    assert not any(isinstance(column, np.ma.MaskedArray) for column in there.values())
