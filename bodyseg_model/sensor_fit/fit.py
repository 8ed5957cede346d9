"""The whole measurement: a verdict for every artifact, the sensor model, a picture beside a real frame."""

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from bodyseg_data.artifacts import Augmentation, SensorModel, artifact_class
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.drawing import INK, PAPER, colour_shares, fitted, font
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.rigs import Rig
from bodyseg_data.samples import Sample, SampleInfo, box_of
from bodyseg_model.recordings import FrameCamera
from bodyseg_model.sensor_fit.edges import (
    ProjectorShadow,
    measure_mixed_pixels,
    measure_shadow,
    probably_mirrored,
    shadow_finding,
)
from bodyseg_model.sensor_fit.finding import NEEDED, Finding
from bodyseg_model.sensor_fit.losses import measure_losses, outlines_of
from bodyseg_model.sensor_fit.noise import measure_noise
from bodyseg_model.sensor_fit.recording import Floats, MarkedRecording, smooth_surface

ORDER: Final = ("occlusion", "noise", "mixed_pixels", "patch_loss", "stripe_loss", "missing_data")
"""The artifacts in the order in which a sensor makes them: light, range, and what is rejected."""

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
        """The sensor model of the artifacts that are needed. Raises BadConfig for a name that is no plain word."""
        needed = [each for each in self.findings if each.verdict == NEEDED]
        return SensorModel(name, tuple(artifact_class(each.artifact)(**each.strengths) for each in needed), title)

    def comments(self) -> Mapping[str, str]:
        """Comments for the sensor file: each artifact's figures, and for the whole file the verdicts on the others."""
        others = [each for each in self.findings if each.verdict != NEEDED]
        lines = [f"Measured from {self.frames} frames by `bodyseg sensor fit`."]
        lines += [f"{each.artifact}: {each.verdict}: {each.reason}" for each in others]
        if self.mirrored:
            lines.append("The frames are probably mirrored.")
        texts = {"": "\n".join(lines)}
        texts |= {each.artifact: f"{NEEDED}: {each.reason}" for each in self.findings if each.verdict == NEEDED}
        return {
            name: "\n".join(part for line in text.splitlines() for part in textwrap.wrap(line, _COMMENT_WIDTH))
            for name, text in texts.items()
        }

    def to_json(self) -> dict[str, Any]:
        """Every finding as plain JSON."""
        return {
            "frames": self.frames,
            "still": self.still,
            "mirrored": self.mirrored,
            "findings": [finding.to_json() for finding in self.findings],
        }


def fit_sensor(recording: MarkedRecording, camera: FrameCamera, progress: ProgressCallback = silent) -> SensorFit:
    """Measure all artifacts. camera: the recording's; the place of its projector, if known, tells mirrored frames."""
    progress(0, 3)
    shadow = measure_shadow(recording)
    progress(1, 3)
    findings = measure_losses(outlines_of(recording))
    progress(2, 3)
    side = camera.projector_side
    findings += [measure_noise(recording), measure_mixed_pixels(recording), shadow_finding(shadow, side, camera.rig)]
    progress(3, 3)
    ordered = tuple(sorted(findings, key=lambda each: ORDER.index(each.artifact)))
    return SensorFit(ordered, shadow, probably_mirrored(shadow, side), recording.still, len(recording.frames))


HEIGHT: Final = 420
"""Greatest height of a panel, pixels."""

_LOST: Final = (196, 40, 40)
_EMPTY: Final = (24, 24, 28)
_MARGIN: Final = 12
_HEAD: Final = 30
_FOOT: Final = 36
_NARROWEST: Final = 240
_WIDEST: Final = 640
_SHADES: Final = np.array([[245, 245, 245], [55, 55, 55]])
_RESIDUALS: Final = np.array([[31, 79, 168], [250, 250, 247], [194, 90, 0]])
_LEGEND: Final = "light is near, dark is far; red: lost; blue: nearer than the surface, orange: farther"


def draw_comparison(recording: MarkedRecording, sensor: SensorModel) -> Image.Image:
    """Draw four panels: a frame and its simulation in shades of range, and both less the smooth surface of the body.

    The simulation starts from that smooth surface, so nothing is rendered; shadows, which need a mesh, are left out.
    """
    frame = max(recording.frames, key=lambda each: np.count_nonzero(each.body))
    only = MarkedRecording((frame,), recording.camera, recording.step_m)
    full = outlines_of(only)[0].full
    surface, _ = smooth_surface(frame.range_m, frame.body, frame.noise_m, recording.camera)
    clean: Floats = np.where(full, np.where(np.isfinite(surface), surface, frame.range_m), 0.0)
    shown = simulate(clean, recording, sensor)
    box = box_of(full, _MARGIN) or np.s_[:, :]
    near, far = np.quantile(clean[clean > 0], (0.01, 0.99))
    limit = max(3 * frame.noise_m, 0.003)

    def painted(range_m: Floats, residual: bool) -> NDArray[np.uint8]:
        share = (range_m - clean) / limit if residual else (range_m - near) / max(far - near, 1e-6)
        picture = colour_shares((share + 1) / 2, _RESIDUALS) if residual else colour_shares(share, _SHADES)
        picture[range_m == 0] = np.where(full[range_m == 0, None], _LOST, _EMPTY)
        return picture[box]

    real: Floats = np.where(full, frame.range_m.astype(np.float64), 0.0)
    return _beside(
        {
            "frame": painted(real, False),
            "simulated": painted(shown, False),
            f"frame less its surface, ±{1000 * limit:.1f} mm": painted(real, True),
            "simulated less the surface": painted(shown, True),
        }
    )


def simulate(clean_m: Floats, recording: MarkedRecording, sensor: SensorModel) -> Floats:
    """A clean body [H, W], metres, as a sensor shows it, metres; without shadows, which need what a projector sees."""
    without = SensorModel(sensor.name, tuple(artifact for artifact in sensor if artifact.name != "occlusion"))
    step_mm = max(0.1, float(clean_m.max()) / 60)  # 16 bits reach beyond the range, with room for noise
    rig = Rig("frame", 1.0, recording.camera, replace(recording.camera, distortion=None), step_mm)
    steps = np.rint(clean_m / rig.range_step_m).clip(0, 65535).astype(np.uint16)
    labels = np.where(steps > 0, 0, BACKGROUND).astype(np.uint8)
    sample = Sample("frame", steps, None, labels, steps > 0, SampleInfo("test"))
    return Augmentation(rig, "all", 0, without)(sample).range.astype(np.float64) * rig.range_step_m


def _beside(panels: Mapping[str, NDArray[np.uint8]]) -> Image.Image:
    images = {title: fitted(panel, _WIDEST, HEIGHT) for title, panel in panels.items()}
    width, height = next(iter(images.values())).size
    step = max(width, _NARROWEST) + _MARGIN
    picture = Image.new("RGB", (step * len(panels) + _MARGIN, height + _HEAD + _FOOT), PAPER)
    pen = ImageDraw.Draw(picture)
    for left, (title, image) in zip(range(_MARGIN, picture.width, step), images.items(), strict=True):
        pen.text((left, _HEAD // 2), title, INK, font=font(14), anchor="lm")
        picture.paste(image, (left, _HEAD))
    pen.text((_MARGIN, _HEAD + height + _FOOT // 2), _LEGEND, INK, font=font(13), anchor="lm")
    return picture
