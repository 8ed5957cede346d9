"""The choices that are charted, and how each one's points are read out of its bench's figures."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from benches.charts.choice import Choice, Limit, Panel
from benches.charts.fronts import Axis, Point
from benches.charts.scales import shown

Figures = Mapping[str, Any]

_FAMILIES: Final = {
    "compact": "compact: ours",
    "fcn_alexnet": "FCN-AlexNet: the paper's",
    "segformer": "SegFormer-B0",
    "deeplab": "DeepLabV3+, MobileNetV2",
    "forest": "random forest of depth differences",
}

_LOADERS: Final = {
    "ours_all": "bodyseg, all\nmade on the fly",
    "ours_all_batch_sampler": "bodyseg, all\nin PyTorch's DataLoader",
    "webdataset_png": "WebDataset, PNG",
    "webdataset_raw": "WebDataset, raw",
    "webdataset_zstd": "WebDataset, zstd",
    "webdataset_png_threads": "WebDataset, PNG,\nin threads",
    "webdataset_raw_threads": "WebDataset, raw,\nin threads",
    "hf_webdataset": "Hugging Face datasets,\ntars of PNG",
    "hf_parquet": "Hugging Face datasets,\nParquet, raw",
    "mds_raw": "MosaicML Streaming, raw",
    "mds_zstd": "MosaicML Streaming, zstd\n(keeps both forms)",
    "litdata": "LitData, raw",
    "png_files": "loose PNG files",
}
_LOADER_LIMITS: Final = {
    "ours_none": "bodyseg, no artifacts",
    "memory": "tensors in memory",
    "memory_threads": "tensors in memory,\nby threads",
}

_LABEL_LETTERS: Final = 24  # of a line of a long name

_NAMED_CODECS: Final = ("bsi, NumPy", "PNG", "JPEG-LS", "LERC", "JPEG XL, effort 1", "Blosc2: bytes, zstd 5")


def _renderer(figures: Figures) -> tuple[Panel, ...]:
    panels = []
    if alone := figures.get("renderers"):
        points = [
            _rendered(name, row["ms_per_view"], row["range_error_mm"], row["silhouette_error"])
            for name, row in alone.items()
        ]
        panels.append(Panel("both images alone, processor time", tuple(points), figures["default_renderer"]))
    if figures["range_error_mm"] is not None:  # null where pyrender, which it is measured with, cannot draw
        speeds, plain = figures["views_per_second"], figures["plain_errors"]
        ours, baseline = (
            _rendered("bodyseg shard", _ms(speeds["ours"]), figures["range_error_mm"], figures["silhouette_error"]),
            _rendered("pyrender, PNG files", _ms(speeds["plain"]), plain["range_mm"], plain["silhouette"]),
        )
        panels.append(Panel(f"from bodies to files, {figures['workers']} processes", (ours, baseline), ours.name))
    return tuple(panels)


def _rendered(name: str, ms: float, range_mm: float, silhouette: float) -> Point:
    label = f"{name}\n(silhouette off by {silhouette:.3%})".replace("%", " %")
    return Point(name, ms, range_mm, label, named=True)


def _shadow_test(figures: Figures) -> tuple[Panel, ...]:
    points, limits = [], []
    for row in figures["methods"]:
        if row["family"] == "exact mask":
            limits.append(Limit(row["name"], row["us_per_view"], "exact mask, stored:\nno error, for one rig"))
        else:
            name, label = _shadow_name(row), _shadow_label(row)
            points.append(Point(name, row["us_per_view"], row["wrong_pixels"], label, row["family"]))
    title, default = f"{len(points)} ways, ordinary views", _shadow_name(figures["default"])
    return (Panel(title, tuple(points), default, tuple(limits)),)


def _shadow_label(row: Figures) -> str:
    scale = row["projector_scale"]
    form = [] if row["form"] == "compiled" else ["NumPy"]
    words = [row["name"], f"{row['bias']:g} mm", *([f"×{scale:g}"] if scale != 1 else ()), *form]
    return textwrap.fill(", ".join(words), _LABEL_LETTERS)


def _shadow_name(row: Figures) -> str:
    """Name with all settings, so that no two methods share one."""
    bit = "facing bit" if row["facing_bit"] else "no facing bit"
    words = [row["name"], f"{row['bias']:g} mm", f"×{row['projector_scale']:g}", bit]
    return ", ".join([*words, f"stored: {row['stored']}", row["form"]])


def _partition(figures: Figures) -> tuple[Panel, ...]:
    groups = [(f"open bodies ({len(figures['open'])})", figures["methods"])]
    if isinstance(figures["mit"], dict):  # text where no folder of frames was given
        groups.append((f"MIT frames ({len(figures['mit']['frames'])})", figures["mit"]["methods"]))
    panels = []
    for name, methods in groups:
        points = [
            Point(method, row["partition_ms"], row["wrong_surface"], method, named=True)
            for method, row in methods.items()
        ]
        panels.append(Panel(name, tuple(points), figures["default"]))
    return tuple(panels)


_KINDS: Final = {"open": "open bodies", "mit": "MIT frames", "rough scan": "scan with 0.3 mm noise"}
_BY_SHARE: Final = "share of the triangles, given"
_BY_TOLERANCE: Final = "tolerance given, share searched for"


def _mesh_resolution(figures: Figures) -> tuple[Panel, ...]:
    panels = []
    for kind, figure in figures["kinds"].items():
        points = []
        for row in figure["shares"]:
            name = f"{row['share']:.0%} of the triangles".replace("%", " %")
            points.append(_coarser("whole mesh" if row["share"] == 1 else name, _BY_SHARE, row))
        tolerances = figure["tolerances"]
        points += [_coarser(f"within {row['tolerance_mm']:g} mm", _BY_TOLERANCE, row) for row in tolerances]
        triangles = max(row["triangles"] for row in figure["shares"])
        title = f"{_KINDS.get(kind, kind)}, {shown(triangles)} triangles"
        panels.append(Panel(title, tuple(points), "whole mesh"))
    return tuple(panels)


def _coarser(name: str, family: str, row: Figures) -> Point:
    label = name.removesuffix(" of the triangles").removeprefix("within ")
    return Point(name, _ms(row["views_per_second"]), row["p95_mm"], label, family, named=True)


def _codec(figures: Figures) -> tuple[Panel, ...]:
    points = [
        Point(name, row["decode_ms"], row["bytes"], name, named=name in _NAMED_CODECS)
        for name, row in figures["codecs"].items()
    ]
    return (Panel(f"{figures['views']} samples of bare and dressed bodies", tuple(points), figures["default"]),)


def _loader(figures: Figures) -> tuple[Panel, ...]:
    speeds, sizes = figures["samples_per_second"], figures["kept_bytes_per_sample"]
    panels = []
    for workers in speeds["ours_all"]:
        found = {name: rates[workers] for name, rates in speeds.items() if rates.get(workers)}  # null: not installed
        points = [
            Point(name, found[name], sizes[name], title, named=True)
            for name, title in _LOADERS.items()
            if name in found
        ]
        limits = [Limit(name, found[name], title) for name, title in _LOADER_LIMITS.items() if name in found]
        title = "no workers" if workers == "0" else f"{workers} workers"
        panels.append(Panel(title, tuple(points), "ours_all", tuple(limits)))
    return tuple(panels)


def _networks(figures: Figures) -> tuple[Panel, ...]:
    networks = figures["networks"]
    defaults = [name for name, row in networks.items() if row["default"]]
    if len(defaults) != 1:
        raise ValueError(f"one of the networks must be the default, found {len(defaults)}")
    panels = []
    for device, key in (("CPU", "cpu_ms"), ("GPU", "gpu_ms")):
        points = []
        for name, row in networks.items():
            if row.get(key) is not None:
                group, score = _FAMILIES.get(row["family"], row["family"]), row["accuracy_all"]
                points.append(Point(name, row[key], score["mean"], row["label"], group, named=True, y_sd=score["sd"]))
        if points:
            default = defaults[0] if defaults[0] in {point.name for point in points} else None
            panels.append(Panel(device, tuple(points), default))
    return tuple(panels)


_TESTED_ON: Final = {"people": "scans of two real people", "hard": "hard poses", "open": "open bodies in motion"}
"""Test -> title of a panel."""


def _shipped(figures: Figures) -> tuple[Panel, ...]:
    panels = []
    for test, title in _TESTED_ON.items():
        points = [
            Point(name, row["ms"]["float32"], row[test]["accuracy"], name, named=True)
            for name, row in figures["networks"].items()
        ]
        panels.append(Panel(title, tuple(points), "compact"))
    return tuple(panels)


_ON_REAL_FRAMES: Final = {
    "kinect_v1, accuracy": "right labels, Kinect v1",
    "kinect_v1, same": "agreement of views, Kinect v1",
    "structure_bust, same": "agreement of views, Structure sensor",
}
"""Measure -> title of a panel."""


def _artifacts(figures: Figures) -> tuple[Panel, ...]:
    panels = []
    for measure, title in _ON_REAL_FRAMES.items():
        points = []
        for name, cost in figures["loader"].items():
            if (score := figures["real"].get(name, {}).get(measure)) is not None:
                points.append(Point(name, cost["ms"], score["mean"], name, named=True, y_sd=score["sd"]))
        if len(points) > 1:
            panels.append(Panel(title, tuple(points), "all" if any(point.name == "all" for point in points) else None))
    return tuple(panels)


def _ms(per_second: float) -> float:
    return round(1000 / per_second, 4)


_NETWORKS: Final = Choice(
    "networks",
    "architectures",
    "Which network?",
    "Trained the same way, tested with all artifacts; bars: standard deviation over seeds.",
    Axis("ms a frame", "time"),
    Axis("average per-class accuracy, %", "accuracy", more_is_better=True, factor=100),
    _networks,
    shared="y",
)
_SMALLER_NETWORKS: Final = replace(
    _NETWORKS,
    name="smaller_networks",
    title="How small a network?",
    note="Trained alike, tested with all artifacts; bars: standard deviation over seeds.",
    results="smaller",
)

_SHIPPED: Final = replace(
    _NETWORKS,
    name="shipped",
    bench="shipped",
    title="Which of the networks that ship?",
    note="Plain, with the flip average, and with it for the half of the images that are less sure; float32.",
    x=Axis("ms an image, labels", "time"),
    read=_shipped,
    shared="",
)

CHOICES: Final = (
    _SHIPPED,
    Choice(
        "renderer",
        "render",
        "Which renderer?",
        "The error is that of the camera's ranges against one exact sample a pixel; files round to the rig's step.",
        Axis("ms a view", "time"),
        Axis("range error, mm (median)", "error"),
        _renderer,
        shared="y",
    ),
    Choice(
        "shadow_test",
        "occlusion",
        "Which test for the projector's shadow?",
        "Compiled unless called NumPy; ×2: a projector image twice as fine. Wrong: differs from exact shadow rays.",
        Axis("µs of processor a view, decoding and test", "time"),
        Axis("wrong pixels, % of the foreground", "error", factor=100),
        _shadow_test,
    ),
    Choice(
        "partition",
        "partition",
        "Which distance along the surface?",
        "Wrong is the surface that is labelled differently from the exact answer.",
        Axis("ms of processor a mesh", "time"),
        Axis("wrong surface, %", "error", factor=100),
        _partition,
    ),
    Choice(
        "mesh_resolution",
        "reduction",
        "How fine a mesh?",
        "One core, reduction and partition shared by a body's views. The error is against the whole mesh.",
        Axis("ms of processor a view", "time"),
        Axis("range error, mm: 95 % of pixels", "error"),
        _mesh_resolution,
        shared="",
    ),
    Choice(
        "codec",
        "codec",
        "Which lossless codec?",
        "The three images of a sample: range, labels and the projector's range.",
        Axis("decoding a sample, ms of processor", "time"),
        Axis("kB a sample", "size", factor=1e-3),
        _codec,
    ),
    Choice(
        "loader",
        "loader",
        "Which loader?",
        "All but ours read a set made before, with the same noise each epoch; ours adds artifacts to clean samples.",
        Axis("samples a second", "speed", more_is_better=True),
        Axis("kB a sample on disk", "size", factor=1e-3),
        _loader,
    ),
    _NETWORKS,
    _SMALLER_NETWORKS,
    Choice(
        "artifacts",
        "variants",
        "Which artifacts?",
        "Networks trained alike but for the artifacts, on real frames; bars: standard deviation over seeds.",
        Axis("making a sample, ms of processor", "time"),
        Axis("% of the points that real frames show", "accuracy", more_is_better=True, factor=100),
        _artifacts,
        shared="",
    ),
)
"""In the order of the page."""
