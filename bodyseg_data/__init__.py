"""Streaming of range images of people, with the artifacts of a structured-light sensor made on the fly.

    from bodyseg_data import RangeImages, loader

Importing this package is fast: each name below is imported on first use, and none needs a renderer.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from bodyseg_data.artifacts.sensor_model import SensorModel, load_sensor_model
    from bodyseg_data.artifacts.variants import VARIANTS, Augmentation
    from bodyseg_data.core.errors import BodysegError
    from bodyseg_data.core.parts import BACKGROUND, PARTS
    from bodyseg_data.core.rig import Rig, load_rig
    from bodyseg_data.core.sample import Sample
    from bodyseg_data.example.example_set import example_set
    from bodyseg_data.loading.image_set import Batch
    from bodyseg_data.loading.loader import Loader, loader
    from bodyseg_data.loading.mixtures.mixture import Mixture
    from bodyseg_data.loading.range_images import RangeImages

    __version__: str

_HOME: Final = {
    "BodysegError": "core.errors",
    "BACKGROUND": "core.parts",
    "PARTS": "core.parts",
    "Rig": "core.rig",
    "load_rig": "core.rig",
    "Sample": "core.sample",
    "Batch": "loading.image_set",
    "Loader": "loading.loader",
    "RangeImages": "loading.range_images",
    "loader": "loading.loader",
    "Mixture": "loading.mixtures.mixture",
    "VARIANTS": "artifacts.variants",
    "SensorModel": "artifacts.sensor_model",
    "load_sensor_model": "artifacts.sensor_model",
    "Augmentation": "artifacts.variants",
    "example_set": "example.example_set",
}

__all__ = [
    "BACKGROUND",
    "PARTS",
    "VARIANTS",
    "Augmentation",
    "Batch",
    "BodysegError",
    "Loader",
    "Mixture",
    "RangeImages",
    "Rig",
    "Sample",
    "SensorModel",
    "example_set",
    "load_rig",
    "load_sensor_model",
    "loader",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return _installed_version()
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def _installed_version() -> str:
    """Return the version of the installed package `bodyseg`; "0+unknown" in a checkout that was never installed."""
    from importlib import metadata

    try:
        return metadata.version("bodyseg")
    except metadata.PackageNotFoundError:
        return "0+unknown"
