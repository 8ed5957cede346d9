"""Sets of a rig with two projectors: packed, verified, streamed and inspected, with both codecs."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kernel_forms import computed_by
from pictures import decoded, marks, part
from small_rig import SMALL

from bodyseg_data.artifacts import VARIANTS, VariantName, lit_pixels
from bodyseg_data.commands import cli
from bodyseg_data.core import BadShard
from bodyseg_data.labels.label_map import COLOURS
from bodyseg_data.loading import RangeImages, loader
from bodyseg_data.rigs import Rig
from bodyseg_data.samples import ViewGrid
from bodyseg_data.shards import (
    CODECS,
    CodecName,
    LocalFolder,
    Manifest,
    ShardReader,
    find_faults,
    read_manifest,
    write_manifest,
)

VIEWS = ViewGrid(span_deg=360, count=3)


ROWS, ROWS_SECOND, COLUMNS = SMALL.projector.rows, 150, SMALL.projector.columns


def two_projectors() -> Rig:
    second = replace(SMALL.projector, rows=ROWS_SECOND, position_m=(-0.5, -0.3, 0.0))
    return replace(SMALL, second_projector=second)


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory, pack_figures: Callable[..., Path]) -> dict[CodecName, Path]:
    """The same views of two figures in each codec."""
    folder = tmp_path_factory.mktemp("two")
    return {
        codec: pack_figures(folder / codec, meshes=2, views=VIEWS, rig=two_projectors(), codec=codec)
        for codec in CODECS
    }


@pytest.mark.parametrize("codec", CODECS)
def test_a_set_is_whole_and_keeps_both_projectors(codec: CodecName, sets: dict[CodecName, Path]) -> None:
    assert cli.main(["verify", str(sets[codec])]) == 0
    images = RangeImages(sets[codec], "none")
    assert images.manifest.rig == two_projectors()
    for index in range(len(images)):
        sample = images.clean(index)
        sample.check()
        assert sample.occluder_range().shape == (ROWS + ROWS_SECOND, COLUMNS)
        assert sample.faces_second is not None and sample.faces_second.any()
        assert sample.occluder_range()[ROWS:].any()


@pytest.mark.parametrize("name", VARIANTS)
def test_every_variant_has_the_same_bits_from_both_codecs_and_in_both_forms(
    name: VariantName, sets: dict[CodecName, Path]
) -> None:
    first, second = (RangeImages(sets[codec], name) for codec in CODECS)
    streamed = {}
    for images in (first, second):
        for batch in loader(images, 2, 0, metres=False):
            for key, steps, labels in zip(batch["key"], batch["range"], batch["labels"], strict=True):
                streamed.setdefault(key, []).append((steps.numpy().copy().squeeze(), labels.numpy().copy()))
    assert sorted(streamed) == sorted(first.keys)
    shadowed = 0
    for index, key in enumerate(first.keys):
        with computed_by("numpy"):
            sample, plain = first.clean(index), first.image(index)
        for steps, labels in streamed[key]:
            assert np.array_equal(steps.view(np.uint16), plain.range) and np.array_equal(labels, plain.labels)
        lit = lit_pixels(first.manifest.rig, sample)
        if "occlusion" in VARIANTS[name]:
            assert not plain.range[~lit].any()
        elif name in ("none", "noise"):
            shadowed += int((plain.range[~lit] > 0).sum())
    assert shadowed > 60 or name not in ("none", "noise")


def test_inspect_draws_and_counts_a_set(
    sets: dict[CodecName, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["inspect", str(sets["bsi"]), "--variant", "occ", "--json", "--out", f"{tmp_path}/sheet.png"]) == 0
    both = json.loads(capsys.readouterr().out)
    assert both["rig"] == "small" and 0.5 < both["kept"] < 1
    picture = part(decoded(tmp_path / "sheet.png"), down=(0, 0.5))  # without the legend
    images = RangeImages(sets["bsi"])
    parts = np.unique(images.clean(0).labels)
    seen = [label for label in parts[:15] if marks(picture, COLOURS[label].tolist(), 6)]
    assert len(seen) > 10, "labels are in their colours"


def test_more_is_lit_than_by_one_projector_whose_set_is_the_same_else(
    sets: dict[CodecName, Path], tmp_path: Path, pack_figures: Callable[..., Path]
) -> None:
    two, one = (
        RangeImages(sets["bsi"], "occ"),
        RangeImages(pack_figures(tmp_path, meshes=2, views=VIEWS, rig=SMALL), "occ"),
    )
    assert two.keys == one.keys
    more = 0
    for index in range(len(two)):
        a, b = two.clean(index), one.clean(index)
        assert b.faces_second is None
        assert np.array_equal(a.range, b.range) and np.array_equal(a.labels, b.labels)
        assert np.array_equal(a.faces_projector, b.faces_projector)
        assert np.array_equal(a.occluder_range()[:ROWS], b.occluder_range())
        kept, kept_by_one = two.image(index).range > 0, one.image(index).range > 0
        assert not (kept_by_one & ~kept).any()
        more += int((kept & ~kept_by_one).sum())
    assert more > 60


def claimed(folder: Path, rig: Rig, to: Path) -> Manifest:
    """The manifest of a copy of a set that claims another rig."""
    shutil.copytree(folder, to)
    write_manifest(replace(read_manifest(folder), rigs=(rig,)), to)
    return read_manifest(to)


def test_a_set_that_claims_another_number_of_projectors_is_refused(
    sets: dict[CodecName, Path], tmp_path: Path, pack_figures: Callable[..., Path]
) -> None:
    fewer = claimed(sets["bsi"], SMALL, tmp_path / "fewer")
    both, size = (
        ROWS + ROWS_SECOND,
        rf"projector_range must be {{}} x {COLUMNS} as in the rig, found \({{}}, {COLUMNS}\)",
    )
    with pytest.raises(BadShard, match=size.format(ROWS, both)):
        ShardReader(tmp_path / "fewer", fewer).read(0, 0)
    store = LocalFolder(tmp_path / "fewer")
    faults = [fault.problem for shard in fewer.shards for fault in find_faults(store, fewer, shard)]
    assert faults == ["the rig has fewer projectors than the facing bits tell of"] * 6
    single = pack_figures(tmp_path / "single", meshes=2, views=VIEWS, rig=SMALL)
    more = claimed(single, two_projectors(), tmp_path / "more")
    with pytest.raises(BadShard, match=size.format(both, ROWS)):
        ShardReader(tmp_path / "more", more).read(0, 0)
    store = LocalFolder(tmp_path / "more")
    problems = [fault.problem for shard in more.shards for fault in find_faults(store, more, shard)]
    assert problems == [f"projector_range must be {both} x {COLUMNS} as in the rig, found ({ROWS}, {COLUMNS})"] * 6
