"""The whole measurement: a verdict for every artifact that ships, the sensor model, a picture beside a real frame."""

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from bodyseg_data.artifacts import Augmentation, SensorModel, box_of
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.drawing import INK, PAPER, font
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.rigs import Rig
from bodyseg_data.samples import Sample, SampleInfo
from bodyseg_model.recordings import FrameCamera
from bodyseg_model.sensor_fit.edges import (
    ProjectorShadow,
    measure_mixed_pixels,
    measure_shadow,
    probably_mirrored,
    shadow_finding,
)
from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN, Finding
from bodyseg_model.sensor_fit.losses import measure_losses
from bodyseg_model.sensor_fit.noise import measure_noise
from bodyseg_model.sensor_fit.outlines import outlines_of
from bodyseg_model.sensor_fit.recording import MarkedRecording
from bodyseg_model.sensor_fit.residuals import body_surface, measure_steps, residuals_of

ORDER: Final = (
    "occlusion", "lateral_noise", "axial_noise", "stereo_noise", "noise", "mixed_pixels", "disparity_rounding",
    "range_rounding", "patch_loss", "stripe_loss", "grazing_loss", "edge_loss", "missing_data",
)  # fmt: skip
"""The artifacts in the order in which a sensor makes them: light, disparity, its rounding, and what is rejected."""

_COMMENT_WIDTH: Final = 110


@dataclass(frozen=True)
class SensorFit:
    """The measurement of a recording. findings: one for each of `ORDER`, in that order. mirrored: whether frames
    probably show left for right; None if that cannot be told.
    """

    findings: tuple[Finding, ...]
    shadow: ProjectorShadow | None
    mirrored: bool | None
    still: bool
    frames: int

    def model(self, name: str, title: str = "") -> SensorModel:
        """The sensor model of the artifacts that are needed, and of one among formulas that cannot be told apart.

        Raises BadConfig for a name that is no plain word.
        """
        return SensorModel(name, tuple(each.build() for each in self.findings if each.written), title)

    def comments(self) -> Mapping[str, str]:
        """Comments for the sensor file: each artifact's figures, and for the whole file the verdicts on the others."""
        others = [each for each in self.findings if not each.written]
        lines = [f"Measured from {self.frames} frames by `bodyseg sensor fit`."]
        lines += [f"{each.artifact}: {each.verdict}: {each.reason}" for each in others]
        if self.mirrored:
            lines.append("The frames are probably mirrored.")
        written = {each.artifact: f"{each.verdict}: {each.reason}" for each in self.findings if each.written}
        return {name: _wrapped(text) for name, text in {"": "\n".join(lines), **written}.items()}

    def to_json(self) -> dict[str, Any]:
        """Every finding as plain JSON."""
        return {
            "frames": self.frames,
            "still": self.still,
            "mirrored": self.mirrored,
            "findings": [finding.to_json() for finding in self.findings],
        }


def _wrapped(text: str) -> str:
    return "\n".join(part for line in text.splitlines() for part in textwrap.wrap(line, _COMMENT_WIDTH))


def fit_sensor(recording: MarkedRecording, camera: FrameCamera, progress: ProgressCallback = silent) -> SensorFit:
    """Measure all artifacts. camera: the recording's; the place of its projector, if known, tells mirrored frames."""
    progress(0, 5)
    shadow = measure_shadow(recording)
    baseline = camera.rig.baseline_m if camera.rig is not None else None
    if not baseline and shadow is not None and shadow.side is not None:
        baseline = shadow.total_m
    steps, findings = measure_steps(recording, baseline or None)
    progress(1, 5)
    losses = {each.artifact: each for each in measure_losses(outlines_of(recording, baseline or None))}
    progress(2, 5)
    residuals = residuals_of(recording)
    progress(3, 5)
    ragged = losses["edge_loss"].verdict == NEEDED
    noise = measure_noise(residuals, steps, recording.camera.focal_px, baseline or None, ragged)
    jitter = next(each for each in noise if each.artifact == "lateral_noise")
    if jitter.verdict == NEEDED and ragged:
        reason = f"jitter of pixels explains the outlines: {losses['edge_loss'].reason}"
        losses["edge_loss"] = replace(losses["edge_loss"], verdict=NOT_SEEN, reason=reason, strengths={})
    progress(4, 5)
    side = camera.projector_side
    findings += [*losses.values(), *noise, measure_mixed_pixels(recording), shadow_finding(shadow, side)]
    by_name = {finding.artifact: finding for finding in findings}
    progress(5, 5)
    return SensorFit(
        tuple(by_name[name] for name in ORDER),
        shadow,
        probably_mirrored(shadow, side),
        recording.still,
        len(recording.frames),
    )


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


def draw_comparison(recording: MarkedRecording, sensor: SensorModel) -> Image.Image:
    """Draw four panels: a frame and its simulation in shades of range, and both less the smooth surface of the body.

    The simulation starts from that smooth surface, so nothing is rendered; shadows, which need a mesh, are left out.
    """
    index = int(np.argmax([np.count_nonzero(frame.body) for frame in recording.frames]))
    frame = recording.frames[index]
    only = MarkedRecording((frame,), recording.camera, recording.step_m)
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


def simulate(clean_m: Floats, recording: MarkedRecording, sensor: SensorModel) -> Floats:
    """A clean body [H, W], metres, as a sensor shows it, metres; without shadows, which need what a projector sees."""
    names = [artifact.name for artifact in sensor]
    without = sensor.without("occlusion") if "occlusion" in names else sensor
    rig = Rig("frame", 1.0, recording.camera, recording.camera)
    steps = np.rint(clean_m / rig.range_step_m).clip(0, 65535).astype(np.uint16)
    labels = np.where(steps > 0, 0, BACKGROUND).astype(np.uint8)
    sample = Sample("frame", steps, None, labels, steps > 0, SampleInfo("test"))
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
