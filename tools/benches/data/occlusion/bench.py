"""`bench occlusion`: ways to make the projector's shadow, against exact shadow rays.

Exact means: a ray from the point that the camera sees, before any rounding, to the projector meets nothing.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from typing import Any, Final

from benches.charts.fronts import dominates
from benches.data.occlusion.baselines import DEFAULT, METHODS
from benches.data.occlusion.scaled_rig import with_projector_scale
from benches.data.occlusion.stored import Storage, facing_bytes
from benches.data.occlusion.tallies import SCENES, Compiled, Foreground, Masks, Tally, WhereWrong, time_all
from benches.data.occlusion.views import (
    GROUPS,
    ORDINARY,
    SCALES,
    ExactView,
    Group,
    bodies_of,
    exact_views,
    with_baseline,
)
from bodyseg_data.artifacts import ShadowTest
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.rigs import load_rig
from bodyseg_data.samples import SHADOW_THRESHOLDS

_TIMED_EVERY: Final = 5  # one ordinary view in five is timed, and its bytes are counted

_COSTS: Final = "wrong_pixels", "us_per_view", "bytes"


def bench_occlusion(views: int = 60, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Errors, time and bytes of every method: `views` ordinary views, and a quarter as many of each other group.

    bias: millimetres. stored: of the projector image: all, what can shade, or that rounded as far as no answer changes;
    differing_pixels: between the masks from what is stored and from the whole image, in timed views.
    wrong_pixels, false_lit, false_shadow: shares of the foreground pixels inside the projector's view, all ordinary
    views pooled; worst_view: the largest share in one of them; scenes: wrong_pixels in each scene. bytes: what the
    method adds to a sample, projector image and facing bit, mean over timed views. us_per_view: processor time to
    decode that image (decode_us) and to make the mask (test_us; form: in NumPy or compiled), the median over views of
    those of sixteen runs, all methods in turn. default: the form that runs, compiled where numba is installed.
    """
    tallies = [Tally(method) for method in METHODS]
    compiled, where, masks = Compiled(), WhereWrong(), Masks()
    facing: list[int] = []
    total = sum(_count(group, views) for group in GROUPS)
    for done, (group, number, view, tests) in enumerate(_all_views(views), start=1):
        storage, foreground = Storage(view, tests), Foreground(group, view)
        for tally in tallies:
            tally.add(foreground, storage)
        where.add(foreground, DEFAULT.lit(tests[DEFAULT.projector_scale], view.images(DEFAULT.projector_scale)))
        if group.name == ORDINARY and number % _TIMED_EVERY == 0:
            time_all(tallies, storage, done)
            compiled.add(storage)
            facing.append(facing_bytes(view))
            masks.add(view)
        progress(done, total)
    bit = round(statistics.mean(facing))
    plain = {tally.method: tally.row(bit) for tally in tallies}
    rows = [*plain.values(), *compiled.rows(plain)]
    default = next((row for row in rows if row["form"] == "compiled"), rows[0])
    constants = {
        "surface_gap_mm": SHADOW_THRESHOLDS.surface_gap_m * 1e3,
        "edge_mm": SHADOW_THRESHOLDS.edge_m * 1e3,
        "facing_bit_bytes": bit,
    }
    beaten = {
        "dominated_by": [_setting(row) for row in rows if dominates(_costs(row), _costs(default))],
        "numpy_dominated_by": [
            _setting(row) for row in plain.values() if dominates(_costs(row), _costs(plain[DEFAULT]))
        ],
    }
    return {
        "default": default | constants | beaten,
        "exact_mask": masks.row(),
        "where_wrong": where.row(),
        "scenes": {scene: {"pixels": where.pixels[scene], "wrong": rows[0]["scenes"][scene]} for scene in SCENES},
        "worst_crops": where.worst_crops(),
        "views": {group.name: _count(group, views) for group in GROUPS},
        "bodies": {group.name: list(group.poses) for group in GROUPS},
        "methods": [*rows, masks.method()],
    }


def _count(group: Group, views: int) -> int:
    return max(1, round(views * group.share))


def _all_views(views: int) -> Iterator[tuple[Group, int, ExactView, dict[int, ShadowTest]]]:
    """Every group's views, numbered from 0, with the shadow tests of its rig by scale."""
    tests: dict[float, dict[int, ShadowTest]] = {}
    for group in GROUPS:
        rig = with_baseline(load_rig(), group.baseline_m)
        if group.baseline_m not in tests:
            tests[group.baseline_m] = {scale: ShadowTest(with_projector_scale(rig, scale)) for scale in SCALES}
        bodies, count = bodies_of(group.source, group.poses), _count(group, views)
        labelled = group.baseline_m == GROUPS[0].baseline_m
        made = exact_views(rig, bodies, count, source=group.source, scales=SCALES, labelled=labelled)
        for number, view in enumerate(made):
            yield group, number, view, tests[group.baseline_m]


def _setting(row: dict[str, Any]) -> dict[str, Any]:
    """The settings that identify a method, and its costs."""
    return {key: row[key] for key in ("name", "bias", "projector_scale", "facing_bit", "stored", "form", *_COSTS)}


def _costs(row: dict[str, Any]) -> list[float]:
    return [row[cost] for cost in _COSTS]
