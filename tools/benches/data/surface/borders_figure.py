"""Draws borders between parts by each method, side by side: `tools/bench borders --figure FILE.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from PIL import Image, ImageDraw

from benches.data.surface.borders import METHODS, labelled_pixels, landmark_fields
from bodyseg_data.bodies import open_source
from bodyseg_data.drawing import INK, PAPER, font, save_picture
from bodyseg_data.labels import BACKGROUND, colour_labels
from bodyseg_data.rendering.embree import EmbreeRenderer
from bodyseg_data.rigs import load_rig
from bodyseg_data.samples import View

_POSE: Final = "a_pose"
_VIEW: Final = View(215, 180)
_DETAIL: Final = (slice(130, 330), slice(95, 235))  # rows and columns of the image: the back
_ZOOM: Final = 3


def draw_borders(figures: dict[str, Any], path: Path) -> None:
    """Write a PNG: the same detail labelled by each method.

    figures: what the bench measured; this view is rendered anew and needs none of it. Raises BadConfig if the file
    cannot be written.
    """
    rig, source = load_rig(), open_source("open")
    body = source.build(next(body for body in source.bodies() if body.pose == _POSE))
    parts = body.partition()
    fields = landmark_fields(body, parts)
    camera, _ = rig.placed(body.mesh.centre, _VIEW)
    seen = EmbreeRenderer(body.mesh).render(camera)
    labels, exact = labelled_pixels(rig, body, parts, fields, _VIEW)
    reached = seen.face >= 0
    reached[reached] = np.isfinite(fields[0][body.mesh.faces[seen.face[reached]]]).all(axis=1)
    panels = []
    for name in METHODS:
        image = np.full(seen.face.shape, BACKGROUND, np.uint8)
        image[reached] = labels[name]
        wrong = float((labels[name] != exact).mean())
        drawn = Image.fromarray(colour_labels(image[_DETAIL], PAPER))
        size = drawn.width * _ZOOM, drawn.height * _ZOOM
        panels.append(
            (f"{name}: {wrong:.2%} of this view's pixels wrong", drawn.resize(size, Image.Resampling.NEAREST))
        )
    width = sum(panel.width + 12 for _, panel in panels) + 12
    sheet = Image.new("RGB", (width, panels[0][1].height + 46), PAPER)
    pen, left = ImageDraw.Draw(sheet), 12
    for title, panel in panels:
        pen.text((left, 10), title, INK, font=font(15))
        sheet.paste(panel, (left, 36))
        left += panel.width + 12
    save_picture(sheet, path)
