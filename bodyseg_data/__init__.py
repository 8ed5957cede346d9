"""Streaming of range images of people, with the artifacts of a structured-light sensor made on the fly.

    from bodyseg_data import RangeImages, loader

Importing this package is fast: each name below is imported on first use, and none needs a renderer. The names in
`__all__` are the public interface; all else may move.
"""

from typing import TYPE_CHECKING, Any

from bodyseg_data.core import lazy_door

__all__ = [
    "BACKGROUND",
    "PARTS",
    "VARIANTS",
    "Artifact",
    "Augmentation",
    "BadConfig",
    "BadLandmarks",
    "BadMesh",
    "BadSample",
    "BadShard",
    "BadTransform",
    "Batch",
    "Body",
    "BodyCrop",
    "BodyRef",
    "BodySource",
    "BodysegError",
    "Camera",
    "CameraImage",
    "ColumnWriter",
    "Crop",
    "Distortion",
    "Draws",
    "FaultyMeshes",
    "Flip",
    "LabelClass",
    "LabelMap",
    "Loader",
    "Losses",
    "Mesh",
    "MissingData",
    "MissingLibrary",
    "MixedPixels",
    "Mixture",
    "Noise",
    "Occlusion",
    "OnFaults",
    "Packing",
    "PatchLoss",
    "PhaseShift",
    "RangeImage",
    "RangeImages",
    "Remnants",
    "RetryPolicy",
    "Rig",
    "Roll",
    "Sample",
    "Scene",
    "SensorModel",
    "ShardWriter",
    "StripeLoss",
    "Transform",
    "Unreachable",
    "ViewGrid",
    "WorkerLost",
    "Zoom",
    "colour_labels",
    "colour_range",
    "decode_sample",
    "decoder",
    "example_set",
    "load_label_map",
    "load_rig",
    "load_sensor_model",
    "load_template",
    "loader",
    "open_source",
    "pack",
    "plan",
]

if TYPE_CHECKING:
    from bodyseg_data.artifacts import (
        VARIANTS,
        Artifact,
        Augmentation,
        Losses,
        MissingData,
        MixedPixels,
        Noise,
        Occlusion,
        PatchLoss,
        PhaseShift,
        RangeImage,
        Scene,
        SensorModel,
        StripeLoss,
        load_sensor_model,
    )
    from bodyseg_data.bodies import Body, BodyRef, BodySource, load_template, open_source
    from bodyseg_data.core import (
        BadConfig,
        BadLandmarks,
        BadMesh,
        BadSample,
        BadShard,
        BodysegError,
        Draws,
        MissingLibrary,
    )
    from bodyseg_data.drawing import colour_range
    from bodyseg_data.example import example_set
    from bodyseg_data.labels import BACKGROUND, PARTS, LabelClass, LabelMap, colour_labels, load_label_map
    from bodyseg_data.loading import (
        BadTransform,
        Batch,
        BodyCrop,
        CameraImage,
        Crop,
        Flip,
        Loader,
        Mixture,
        RangeImages,
        Remnants,
        Roll,
        Transform,
        WorkerLost,
        Zoom,
        decoder,
        loader,
    )
    from bodyseg_data.meshes import Mesh
    from bodyseg_data.packing import FaultyMeshes, OnFaults, Packing, ShardWriter, pack, plan
    from bodyseg_data.rigs import Camera, Distortion, Rig, load_rig
    from bodyseg_data.samples import Sample, ViewGrid
    from bodyseg_data.shards import ColumnWriter, RetryPolicy, Unreachable, decode_sample

    __version__: str
else:
    _found, __dir__, _ = lazy_door(__name__)

    def __getattr__(name: str) -> Any:
        return _installed_version() if name == "__version__" else _found(name)


def _installed_version() -> str:
    """Return the version of the installed package `bodyseg`; "0+unknown" in a checkout that was never installed."""
    from importlib import metadata

    try:
        return metadata.version("bodyseg")
    except metadata.PackageNotFoundError:
        return "0+unknown"
