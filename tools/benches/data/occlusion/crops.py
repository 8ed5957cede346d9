"""Draws the windows with the most errors of the default shadow test, scene by scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.data.occlusion.tallies import WORST_CROP, Foreground
from benches.data.occlusion.views import GROUPS, SCALES, ExactView, bodies_of, exact_view, with_baseline
from bodyseg_data.artifacts import ShadowTest
from bodyseg_data.bodies import open_source
from bodyseg_data.drawing import new_chart, save_chart
from bodyseg_data.rendering.embree import EmbreeRenderer
from bodyseg_data.rigs import load_rig
from bodyseg_data.samples import View

_COLOURS: Final = {
    "background": (255, 255, 255),
    "lit": (222, 222, 222),
    "in shadow": (128, 128, 136),
    "wrongly lit": (230, 120, 0),
    "wrongly dark": (10, 40, 140),
}
_COLUMNS: Final = 3  # scenes beside each other


def draw_crops(figures: dict[str, Any], path: Path) -> None:
    """Write a PNG: for every scene its worst window, by exact rays, by the default, and the pixels that differ.

    figures: what the bench measured; the views are rendered anew. Raises MissingLibrary without matplotlib, BadConfig
    if the file cannot be written.
    """
    crops = figures["worst_crops"]
    rows = -(-len(crops) // _COLUMNS)
    figure = new_chart(13.5, 2.35 * rows + 0.4)
    from matplotlib.patches import Patch

    cells: Any = figure.subfigures(rows, _COLUMNS, squeeze=False, wspace=0.03)
    for cell, crop in zip(cells.ravel(), crops, strict=False):
        foreground, lit = _render(crop)
        window = (
            slice(crop["top"], crop["top"] + WORST_CROP[0]),
            slice(crop["left"], crop["left"] + WORST_CROP[1]),
        )
        cell.suptitle(
            f"{crop['scene']}: {crop['wrong']} wrong\n{crop['pose'].replace('_', ' ')}, "
            f"{crop['distance_cm'] / 100:g} m, {crop['azimuth_deg']}°",
            fontsize=9.5,
        )
        shown = np.zeros_like(lit)
        shown.ravel()[foreground.pixels] = foreground.scenes[crop["scene"]]
        masks = (foreground.view.lit, None), (lit, None), (lit, shown)
        pictures = [_picture(foreground.view, *mask) for mask in masks]
        for axis, picture, title in zip(cell.subplots(1, 3), pictures, ("exact", "default", "wrong"), strict=True):
            axis.imshow(picture[window], interpolation="nearest")
            axis.set_xlabel(title, fontsize=9)
            axis.set_xticks([])
            axis.set_yticks([])
    patches = [
        Patch(facecolor=(red / 255, green / 255, blue / 255), edgecolor="grey", label=name)
        for name, (red, green, blue) in _COLOURS.items()
    ]
    figure.legend(handles=patches[1:], loc="outside lower center", ncols=4, fontsize=10, frameon=False)
    save_chart(figure, path, dpi=120)


def _render(crop: dict[str, Any]) -> tuple[Foreground, NDArray[np.bool_]]:
    """The view of a crop, and the default's mask of it, bool [H, W]."""
    group = next(group for group in GROUPS if group.name == crop["group"])
    rig = with_baseline(load_rig(), group.baseline_m)
    (body,) = bodies_of(group.source, [crop["pose"]])
    built = open_source(group.source).build(body)
    parts = built.partition()
    placed, renderer = View(crop["distance_cm"], crop["azimuth_deg"]), EmbreeRenderer(built.mesh)
    view = exact_view(rig, renderer, built, body, placed, parts=parts, source=group.source, scales=SCALES)
    return Foreground(group, view), ShadowTest(rig).lit(*view.images(1))


def _picture(view: ExactView, lit: NDArray[np.bool_], errors: NDArray[np.bool_] | None) -> NDArray[np.uint8]:
    """RGB [H, W, 3]: a mask, or the exact mask with those pixels of a scene in colour that differ from it."""
    picture = np.full((*lit.shape, 3), _COLOURS["background"], np.uint8)
    foreground, shown = view.range > 0, lit if errors is None else view.lit
    picture[foreground & shown], picture[foreground & ~shown] = _COLOURS["lit"], _COLOURS["in shadow"]
    if errors is not None:
        picture[errors & lit & ~view.lit] = _COLOURS["wrongly lit"]
        picture[errors & ~lit & view.lit] = _COLOURS["wrongly dark"]
    return picture
