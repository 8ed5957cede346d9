"""Sets whose rigs have other steps of stored range: packed, verified, streamed, and read side by side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_rig import SMALL
from torch.utils.data import ConcatDataset

from bodyseg_data.artifacts import VARIANTS
from bodyseg_data.core import BadConfig
from bodyseg_data.loading import RangeImages, loader
from bodyseg_data.packing import Packing
from bodyseg_data.samples import ViewGrid, metres
from bodyseg_data.shards import CODECS
from bodyseg_model.commands import cli

STEPS_MM = 0.1, 0.25, 1.0, 3.0
VIEWS = ViewGrid(span_deg=360, count=3)


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory, pack_figures: Callable[..., Path]) -> dict[float, Path]:
    """The same views of two figures in each step."""
    folder = tmp_path_factory.mktemp("steps")
    rigs = {step_mm: replace(SMALL, range_step_mm=step_mm) for step_mm in STEPS_MM}
    return {
        step_mm: pack_figures(folder / f"{step_mm:g}", meshes=2, views=VIEWS, rig=rig) for step_mm, rig in rigs.items()
    }


@pytest.mark.parametrize("step_mm", STEPS_MM)
def test_a_set_keeps_its_step_and_is_whole(step_mm: float, sets: dict[float, Path]) -> None:
    assert cli.main(["verify", str(sets[step_mm])]) == 0
    images = RangeImages(sets[step_mm], "none")
    assert images.manifest.rig.range_step_mm == step_mm
    assert images.step_m == step_mm / 1000


@pytest.mark.parametrize("codec", sorted(CODECS))
def test_every_codec_keeps_the_step(
    codec: str, tmp_path: Path, sets: dict[float, Path], pack_figures: Callable[..., Path]
) -> None:
    rig = replace(SMALL, range_step_mm=3.0)
    packed = RangeImages(pack_figures(tmp_path, meshes=2, views=VIEWS, rig=rig, codec=codec), "none")
    for index in range(len(packed)):
        assert np.array_equal(packed.clean(index).range, RangeImages(sets[3.0], "none").clean(index).range)


@pytest.mark.parametrize("step_mm", STEPS_MM[1:])
def test_a_sample_is_that_of_fine_steps_rounded(step_mm: float, sets: dict[float, Path]) -> None:
    fine, coarse = RangeImages(sets[0.1]), RangeImages(sets[step_mm])
    assert fine.keys == coarse.keys
    for index in range(len(fine)):
        a, b = fine.clean(index), coarse.clean(index)
        assert np.array_equal(a.labels, b.labels) and np.array_equal(a.faces_projector, b.faces_projector)
        apart = np.abs(metres(a.range, fine.step_m) - metres(b.range, coarse.step_m).astype(np.float64))
        assert apart.max() <= (0.1 + step_mm) / 2000 + 1e-6
    assert coarse.stored_bytes() < fine.stored_bytes()


@pytest.mark.parametrize("step_mm", STEPS_MM[1:])
@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_is_the_same_sensor_in_any_step(variant: str, step_mm: float, sets: dict[float, Path]) -> None:
    """The same draws: what is lost differs at shadows' edges only, and values by rounding."""
    fine, coarse = RangeImages(sets[0.1], variant), RangeImages(sets[step_mm], variant)
    for index in range(len(fine)):
        a, b = fine.image(index), coarse.image(index)
        assert a.drawn == b.drawn
        # Edges are a larger share of few pixels.
        assert ((a.range > 0) != (b.range > 0)).sum() <= 0.008 * (a.range > 0).sum() * (
            "occlusion" in VARIANTS[variant]
        )
        both = (a.range > 0) & (b.range > 0)
        apart = np.abs(a.range[both] * fine.step_m - b.range[both] * coarse.step_m)
        # Clean and noisy range are each rounded once.
        assert apart.max() <= (0.1 + step_mm) / 1000 + 1e-9


@pytest.mark.parametrize("workers", [0, 2])
def test_loaders_deliver_metres_in_any_step(workers: int, sets: dict[float, Path]) -> None:
    images = RangeImages(sets[1.0], "all")
    keys = images.keys
    for whole, steps in zip(
        loader(images, 4, workers), loader(RangeImages(sets[1.0], "all"), 4, workers, metres=False), strict=True
    ):
        assert torch.equal(steps["range"].to(torch.float32).mul_(images.step_m), whole["range"])
        for key, range_m in zip(whole["key"], whole["range"].numpy(), strict=True):
            assert np.array_equal(range_m[0], images.image(keys.index(key), 0).range * np.float32(1e-3))


def test_sets_of_different_steps_mix_in_metres(sets: dict[float, Path]) -> None:
    parts = [RangeImages(sets[step_mm], "noise") for step_mm in STEPS_MM]
    batches = torch.utils.data.DataLoader(ConcatDataset(parts), batch_size=len(parts[0]))
    first, *others = [batch["range"] for batch in batches]
    for step_mm, range_m in zip(STEPS_MM[1:], others, strict=True):
        assert torch.equal(range_m > 0, first > 0)
        assert float((range_m - first).abs().max()) <= (0.1 + step_mm) / 1000 + 1e-6


def test_what_was_packed_in_another_step_is_another_set(
    sets: dict[float, Path], pack_figures: Callable[..., Path]
) -> None:
    digests = {RangeImages(path).identity()["set"] for path in sets.values()}
    assert len(digests) == len(sets)
    with pytest.raises(BadConfig, match="already holds a set of shards packed with other options"):
        pack_figures(sets[1.0], meshes=2, views=VIEWS, rig=replace(SMALL, range_step_mm=0.5))


def test_views_beyond_16_bits_are_refused_before_packing() -> None:
    rig = replace(SMALL, range_step_mm=0.05)
    message = (
        r"^rig small: 65535 steps of 'range_step_mm' must reach 0.5 m behind a body 2.95 m away, 3.541 m: found "
        r"0.05 mm, which reach 3.277 m$"
    )
    with pytest.raises(BadConfig, match=message):
        Packing("open", rig=rig)
    Packing("open", rig=rig, views=ViewGrid((255,)))
    Packing("open", rig=replace(rig, range_step_mm=0.1), views=ViewGrid((600,)))
