"""Artifacts of real sensors that rows of the ablation add in training and conditions add in the test images."""

from __future__ import annotations

from typing import Final

from bodyseg_data.artifacts import Artifact, AxialNoise, MixedPixels
from bodyseg_data.artifacts.lost_pixels import EdgeLoss, GrazingLoss, PatchLoss, StripeLoss
from bodyseg_data.artifacts.range_errors import DisparityRounding, LateralNoise, RangeRounding, StereoNoise

ADDED: Final[dict[str, Artifact]] = {
    "noise by range and incidence": AxialNoise(),
    "pixels that show what is beside them": LateralNoise(),
    "noise of disparity": StereoNoise(0.08, 425.0, 0.05),
    "rounded disparities": DisparityRounding(0.125, 580.0, 0.075),
    "whole millimetres": RangeRounding(1.0),
    "mixed pixels": MixedPixels(0.5, 4.0),
    "patches lost": PatchLoss(0.0, 0.4),
    "stripes lost": StripeLoss(0.0, 0.4),
    "grazing surfaces lost": GrazingLoss(70.0, 0.7),
    "edges lost": EdgeLoss(2, 0.5),
}
"""In words -> the artifact, as strong as on sensors that have it: Kinect v1, and RealSense D435 for its stereo."""
