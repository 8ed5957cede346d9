"""Artifacts of a structured-light sensor in clean range images. A new one is a file in this folder and a line below."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from bodyseg_data.artifacts.artifact import Artifact
from bodyseg_data.artifacts.losses import Losses
from bodyseg_data.artifacts.missing_data import MissingData
from bodyseg_data.artifacts.noise import Noise
from bodyseg_data.artifacts.occlusion import Occlusion

ARTIFACTS: Final[dict[str, type[Artifact]]] = {
    "occlusion": Occlusion,
    "noise": Noise,
    "missing_data": MissingData,
    "losses": Losses,
}
"""Name -> class, in the order in which artifacts apply; the first three are those of the paper's Table 1."""


def caption(drawn: Mapping[str, float]) -> str:
    """The quantities drawn for an image (`RangeImage.drawn`) in words: "noise 23 mm, 5% missing"."""
    captions = {name: text for artifact in ARTIFACTS.values() for name, text in artifact.drawn.items()}
    return ", ".join(captions[name].format(value) for name, value in drawn.items())
