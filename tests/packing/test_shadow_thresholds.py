"""The thresholds of the shadow test shape the bytes of shards: neither the format nor a restart may miss a change."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, fields
from pathlib import Path

import pytest

from bodyseg_data.core import BadConfig
from bodyseg_data.samples import SHADOW_THRESHOLDS
from bodyseg_data.samples.sample import ShadowThresholds
from bodyseg_data.shards import MANIFEST_FORMAT, read_manifest

ROOT = Path(__file__).parents[2]

PACK_WITH_HALF = """
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import embreex, numba, pytest, scipy.sparse  # once for both: what knows nothing of thresholds

from bodyseg_data.samples import sample

name, out = sys.argv[1], Path(sys.argv[3])
other = os.fork()
if not other:
    name, out = sys.argv[2], Path(sys.argv[4])
elif status := os.waitstatus_to_exitcode(os.waitpid(other, 0)[1]):  # first: what it compiles is compiled once
    sys.exit(status)
sample.SHADOW_THRESHOLDS = replace(sample.SHADOW_THRESHOLDS, **{name: getattr(sample.SHADOW_THRESHOLDS, name) / 2})

import numpy as np
from fakes import Figures
from plain_views import take_whole_frames
from shapes import figure
from test_sampler import REF, RIG, check_against_whole_frames, halves
from bodyseg_data.artifacts import occlusion
from benches.data.occlusion import compiled_default
from bodyseg_data.rigs.rig import Camera, Rig
from bodyseg_data.samples.views import View, ViewGrid
from bodyseg_data.packing import options
from bodyseg_data.packing import packer as pack
from bodyseg_data.packing.occluders import occluder_range

device = Camera(6, 8, 10.0, (4.0, 3.0), (0.0, 0.0, 0.0), (0.0, 0.0, 2.0))
test = occlusion.ShadowTest(Rig("one", 2.0, device, device))
wall, facing = np.full((6, 8), 20_000, np.uint16), np.ones((6, 8), bool)
for nearer in (25, 45, 55, 80, 120, 250):  # steps: around half of each threshold, and the whole
    screen = np.where(np.indices(wall.shape)[1] < 4, wall - np.uint16(nearer), wall)
    stored = occluder_range(test, wall, facing, lambda texels: screen.ravel()[texels])
    assert (test.lit(wall, stored, facing) == test.lit(wall, screen, facing)).all(), nearer

mesh = figure()
parts = halves(mesh)
check_against_whole_frames(RIG, mesh, parts, View(215, 60))
ranges, projected, _, facing = take_whole_frames(RIG, mesh, parts, View(215, 60))
test = occlusion.ShadowTest(RIG)
assert (compiled_default.lit(test, ranges, projected, facing) == test.lit(ranges, projected, facing)).all()
options.open_source = lambda *where: Figures()
views = ViewGrid(span_deg=360, count=4)
pack.pack(options.Packing("open", meshes=1, views=views), out, ThreadPoolExecutor(1), 1)
"""


def test_a_change_of_threshold_is_a_change_of_format() -> None:
    """Sets do not say which thresholds they were packed for: their format does."""
    assert MANIFEST_FORMAT == "bodyseg shards 7"
    assert asdict(SHADOW_THRESHOLDS) == {"surface_gap_m": 0.006, "edge_m": 0.020}
    text = (ROOT / "docs" / "reference" / "shard_format.md").read_text()
    assert f"at most {1000 * SHADOW_THRESHOLDS.surface_gap_m:g} mm behind the surface" in text
    assert f"texels that differ by {1000 * SHADOW_THRESHOLDS.edge_m:g} mm or more show two surfaces" in text


def test_another_threshold_packs_other_bytes_and_carries_on_no_packing(
    tmp_path: Path, pack_figures: Callable[..., Path]
) -> None:
    """Packing and both forms of the shadow test agree on each of them, as other processes assert."""
    names = [field.name for field in fields(ShadowThresholds)]
    assert len(names) == 2
    others = [tmp_path / name for name in names]
    paths = (ROOT, ROOT / "tools", ROOT / "tests" / "helpers", ROOT / "tests" / "packing")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, paths))}
    done = subprocess.run(
        [sys.executable, "-c", PACK_WITH_HALF, *names, *map(str, others)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 0, done.stderr
    usual = pack_figures(tmp_path / "usual", meshes=1)
    kept = [(usual / shard.name).read_bytes() for shard in read_manifest(usual).shards]
    for other in others:
        assert [(other / shard.name).read_bytes() for shard in read_manifest(other).shards] != kept, other.name
        with pytest.raises(BadConfig, match="already holds a set of shards packed with other options"):
            pack_figures(other, meshes=1)
