"""A picture of a real frame beside the same body as the fitted sensor would show it."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from bodyseg_data.artifacts.sensor_model import SensorModel
from bodyseg_data.artifacts.surface import box_of
from bodyseg_data.artifacts.variants import Augmentation
from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.core.rig import Rig
from bodyseg_data.core.sample import Sample, SampleInfo
from bodyseg_data.drawing.style import INK, PAPER, font
from bodyseg_model.sensor_fit.losses.outlines import outlines_of
from bodyseg_model.sensor_fit.noise.residuals import body_surface
from bodyseg_model.sensor_fit.recording import Recording

HEIGHT: Final = 420
"""Height of each panel, pixels."""

_LOST: Final = (196, 40, 40)
_EMPTY: Final = (24, 24, 28)
_MARGIN: Final = 12
_HEAD: Final = 30
_FOOT: Final = 24
_LEGEND: Final = "light is near, dark is far; red: lost; blue: nearer than the surface, orange: farther"

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


def draw_comparison(recording: Recording, sensor: SensorModel) -> Image.Image:
    """Draw four panels: a frame and its simulation in shades of range, and both less the smooth surface of the body.

    The simulation starts from that smooth surface, so nothing is rendered; shadows, which need a mesh, are left out.
    """
    index = int(np.argmax([np.count_nonzero(frame.body) for frame in recording.frames]))
    frame = recording.frames[index]
    only = Recording((frame,), recording.camera, recording.step_m)
    outline = outlines_of(only)[0]
    sigma = frame.noise_m
    surface = body_surface(frame.range_m, frame.body, sigma, only)
    clean: Floats = np.where(outline.full, np.where(np.isfinite(surface.range_m), surface.range_m, frame.range_m), 0.0)
    shown = simulate(clean, recording, sensor)
    box = box_of(outline.full, _MARGIN) or np.s_[:, :]
    near, far = (float(np.quantile(clean[clean > 0], share)) for share in (0.01, 0.99))
    residual = max(3 * sigma, 0.003)
    real: Floats = np.where(outline.full, frame.range_m.astype(np.float64), 0.0)
    panels = [
        ("frame", _shades(real, outline.full, near, far)),
        ("simulated", _shades(shown, outline.full, near, far)),
        (f"frame less its surface, ±{1000 * residual:.1f} mm", _residual(real, clean, outline.full, residual)),
        ("simulated less the surface", _residual(shown, clean, outline.full, residual)),
    ]
    return _beside([(title, panel[box]) for title, panel in panels])


def simulate(clean_m: Floats, recording: Recording, sensor: SensorModel) -> Floats:
    """A clean body [H, W], metres, as a sensor shows it, metres; without shadows, which need what a projector sees."""
    names = [artifact.name for artifact in sensor]
    without = sensor.without("occlusion") if "occlusion" in names else sensor
    rig = Rig("frame", 1.0, recording.camera, recording.camera)
    steps = np.rint(clean_m / rig.range_step_m).clip(0, 65535).astype(np.uint16)
    labels = np.where(steps > 0, 0, BACKGROUND).astype(np.uint8)
    info = SampleInfo("frame", "", "", "", "", 0, 0, "test")
    sample = Sample("frame", steps, None, labels, steps > 0, info)
    return Augmentation(rig, "all", 0, without)(sample).range.astype(np.float64) * rig.range_step_m


def _shades(range_m: NDArray[np.floating], full: Mask, near: float, far: float) -> NDArray[np.uint8]:
    shade = 245 - 190 * np.clip((range_m - near) / max(far - near, 1e-6), 0, 1)
    picture = np.repeat(shade.astype(np.uint8)[..., None], 3, -1)
    return _marked(picture, range_m > 0, full)


def _residual(range_m: NDArray[np.floating], clean: Floats, full: Mask, limit: float) -> NDArray[np.uint8]:
    share = np.clip((range_m - clean) / limit, -1, 1)[..., None]
    blue, white, orange = (np.array(colour, np.float64) for colour in ((31, 79, 168), (250, 250, 247), (194, 90, 0)))
    picture = np.where(share < 0, white + (white - blue) * share, white + (orange - white) * share)
    return _marked(picture.astype(np.uint8), range_m > 0, full)


def _marked(picture: NDArray[np.uint8], measured: Mask, full: Mask) -> NDArray[np.uint8]:
    picture[~measured] = _EMPTY
    picture[~measured & full] = _LOST
    return picture


def _beside(panels: list[tuple[str, NDArray[np.uint8]]]) -> Image.Image:
    scaled = []
    for _, panel in panels:
        image = Image.fromarray(panel)
        width = max(1, round(image.width * HEIGHT / image.height))
        scaled.append(image.resize((width, HEIGHT), Image.Resampling.NEAREST))
    widths = [max(image.width, 240) for image in scaled]
    picture = Image.new("RGB", (sum(widths) + _MARGIN * (len(widths) + 1), HEIGHT + _HEAD + _FOOT + _MARGIN), PAPER)
    pen, left = ImageDraw.Draw(picture), _MARGIN
    for (title, _), image, width in zip(panels, scaled, widths, strict=True):
        pen.text((left, _HEAD // 2), title, INK, font=font(14), anchor="lm")
        picture.paste(image, (left, _HEAD))
        left += width + _MARGIN
    pen.text((_MARGIN, _HEAD + HEIGHT + _FOOT // 2 + _MARGIN // 2), _LEGEND, INK, font=font(13), anchor="lm")
    return picture
