"""Draws where the shadow test errs: `bodyseg bench occlusion --figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.occlusion import ShadowTest
from bodyseg_data.benches.occlusion import ExactView, exact_view
from bodyseg_data.benches.occlusion_rivals import Method, nearest
from bodyseg_data.bodies import open_source
from bodyseg_data.errors import BadConfig, MissingLibrary
from bodyseg_data.rendering.embree import EmbreeRenderer
from bodyseg_data.rig import load_rig
from bodyseg_data.views import View

_SHOWN: Final = (("arms_crossed", View(215, 20), (150, 110)), ("deep_squat", View(215, 330), (150, 110)))
"""Pose, view, and size [rows, columns] of the detail, which is put where the most errors are."""

_COLOURS: Final = {
    "background": (255, 255, 255),
    "lit": (222, 222, 222),
    "in shadow": (120, 120, 128),
    "wrongly lit": (214, 39, 40),
    "wrongly dark": (31, 90, 200),
}
_MARGIN: Final = 8


def draw_occlusion(figures: dict[str, Any], path: Path) -> None:
    """Write a PNG: exact mask, the default's, and both errors, whole and in detail, for two open bodies.

    figures: what the bench measured; these views are rendered anew and need none of it.

    Raises MissingLibrary without matplotlib, BadConfig if the file cannot be written.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
        from matplotlib.patches import Patch, Rectangle
    except ImportError as error:
        raise MissingLibrary(f"charts need the package 'matplotlib': pip install matplotlib ({error})") from error

    rig = load_rig()
    test = ShadowTest(rig)
    source = open_source("open")
    simple = Method("nearest texel, 10 mm,\nno facing bit", 10.0, nearest(10.0), facing_bit=False)
    figure = Figure(figsize=(15, 10.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes: Any = figure.subplots(len(_SHOWN), 5, width_ratios=(1, 1, 1, 1, 1.3), squeeze=False)
    for row, (pose, view, detail) in zip(axes, _SHOWN, strict=True):
        body = next(body for body in source.bodies() if body.pose == pose)
        built = source.build(body)
        exact = exact_view(rig, EmbreeRenderer(built.mesh), built, body, view)
        masks = exact.lit, test.lit(*exact.images(1)), simple.lit(test, exact.images(1))
        crop = _crop(exact.range > 0)
        titles = f"{pose}, {view.name}\nexact shadow rays", "default", "default: errors", f"{simple.name}: errors"
        pictures = [
            _picture(exact, mask, errors) for mask, errors in zip((*masks[:2], *masks[1:]), (0, 0, 1, 1), strict=True)
        ]
        for axis, title, picture in zip(row, titles, pictures, strict=False):
            axis.imshow(picture[crop], interpolation="nearest")
            axis.set_title(title, fontsize=10)
        for axis, mask in zip(row[2:4], masks[1:], strict=True):
            axis.set_xlabel(f"{100 * _wrong(exact, mask):.2f} % of pixels wrong", fontsize=10)
        top, left = _densest(masks[1] != exact.lit, detail)
        window = slice(top, top + detail[0]), slice(left, left + detail[1])
        row[4].imshow(pictures[2][window], interpolation="nearest")
        row[4].set_title("default: errors, detail", fontsize=10)
        corner = left - crop[1].start - 0.5, top - crop[0].start - 0.5
        row[2].add_patch(Rectangle(corner, detail[1], detail[0], fill=False, edgecolor="black", linewidth=0.8))
        for axis in row:
            axis.set_xticks([])
            axis.set_yticks([])
    patches = [
        Patch(facecolor="#{:02x}{:02x}{:02x}".format(*rgb), edgecolor="grey", label=name)
        for name, rgb in _COLOURS.items()
    ]
    figure.legend(handles=patches[1:], loc="outside lower center", ncols=4, fontsize=10, frameon=False)
    try:
        figure.savefig(path, dpi=130)
    except OSError as error:
        raise BadConfig(f"cannot write {path}: {error.strerror or error}") from error


def _picture(view: ExactView, mask: NDArray[np.bool_], errors: int) -> NDArray[np.uint8]:
    """RGB [H, W, 3]: the mask, or the exact mask with the pixels where `mask` differs in colour."""
    picture = np.full((*mask.shape, 3), _COLOURS["background"], np.uint8)
    shown = view.lit if errors else mask
    foreground = view.range > 0
    picture[foreground & shown], picture[foreground & ~shown] = _COLOURS["lit"], _COLOURS["in shadow"]
    if errors:
        picture[mask & ~view.lit & view.inside] = _COLOURS["wrongly lit"]
        picture[~mask & view.lit & view.inside] = _COLOURS["wrongly dark"]
    return picture


def _wrong(view: ExactView, mask: NDArray[np.bool_]) -> float:
    return float((mask != view.lit)[view.inside].mean())


def _crop(foreground: NDArray[np.bool_]) -> tuple[slice, slice]:
    spans = []
    for axis in (1, 0):
        used = np.flatnonzero(foreground.any(axis=axis))
        spans.append(slice(max(int(used[0]) - _MARGIN, 0), int(used[-1]) + _MARGIN + 1))
    return spans[0], spans[1]


def _densest(errors: NDArray[np.bool_], size: tuple[int, int]) -> tuple[int, int]:
    """Top and left of the window of `size` with the most errors."""
    total = np.pad(errors.astype(np.int64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    height, width = size
    sums = total[height:, width:] - total[:-height, width:] - total[height:, :-width] + total[:-height, :-width]
    top, left = np.unravel_index(int(sums.argmax()), sums.shape)
    return int(top), int(left)
