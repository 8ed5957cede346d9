"""The whole measurement: a verdict for every artifact that ships, and the sensor model of those that are needed."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from bodyseg_data.artifacts.sensor_model import SensorModel
from bodyseg_data.core.system.progress import ProgressCallback, silent
from bodyseg_model.recordings.cameras import FrameCamera
from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN, Finding
from bodyseg_model.sensor_fit.losses.outlines import outlines_of
from bodyseg_model.sensor_fit.losses.pixel_losses import measure_losses
from bodyseg_model.sensor_fit.noise.formulas import measure_noise
from bodyseg_model.sensor_fit.noise.residuals import residuals_of
from bodyseg_model.sensor_fit.recording import Recording
from bodyseg_model.sensor_fit.rounding import measure_steps
from bodyseg_model.sensor_fit.shadows import Shadow, measure_shadow, probably_mirrored, shadow_finding
from bodyseg_model.sensor_fit.silhouettes import measure_mixed_pixels

ORDER: Final = (
    "occlusion",
    "lateral_noise",
    "axial_noise",
    "stereo_noise",
    "noise",
    "mixed_pixels",
    "disparity_rounding",
    "range_rounding",
    "patch_loss",
    "stripe_loss",
    "grazing_loss",
    "edge_loss",
    "missing_data",
)
"""The artifacts in the order in which a sensor makes them: light, disparity, its rounding, and what is rejected."""

_COMMENT_WIDTH: Final = 110


@dataclass(frozen=True)
class SensorFit:
    """The measurement of a recording. findings: one for each of `ORDER`, in that order. mirrored: whether frames
    probably show left for right; None if that cannot be told.
    """

    findings: tuple[Finding, ...]
    shadow: Shadow | None
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


def fit_sensor(recording: Recording, camera: FrameCamera, progress: ProgressCallback = silent) -> SensorFit:
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
