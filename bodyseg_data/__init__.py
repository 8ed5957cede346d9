"""Streaming of range images of people, with the artifacts of a structured-light sensor made on the fly.

    from bodyseg_data import RangeImages, loader

Importing this package is fast: each name below is imported on first use, and none needs a renderer. The names in
`__all__` are the public interface; all else may move.
"""

from typing import TYPE_CHECKING, Any

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.artifacts import VARIANTS as VARIANTS, Artifact as Artifact, Augmentation as Augmentation
    from bodyseg_data.artifacts import MissingData as MissingData, Noise as Noise, Occlusion as Occlusion
    from bodyseg_data.artifacts import RangeImage as RangeImage, Scene as Scene, SensorModel as SensorModel
    from bodyseg_data.artifacts import load_sensor_model as load_sensor_model
    from bodyseg_data.bodies import Body as Body, BodyRef as BodyRef, BodySource as BodySource
    from bodyseg_data.bodies import open_source as open_source
    from bodyseg_data.core import BadConfig as BadConfig, BadSample as BadSample, BadShard as BadShard
    from bodyseg_data.core import BodysegError as BodysegError, Draws as Draws
    from bodyseg_data.drawing import colour_range as colour_range
    from bodyseg_data.example import example_set as example_set
    from bodyseg_data.labels import BACKGROUND as BACKGROUND, PARTS as PARTS, LabelMap as LabelMap
    from bodyseg_data.labels import colour_labels as colour_labels, load_label_map as load_label_map
    from bodyseg_data.loading import BadTransform as BadTransform, Batch as Batch, BodyCrop as BodyCrop
    from bodyseg_data.loading import CameraImage as CameraImage, Crop as Crop, Flip as Flip, Loader as Loader
    from bodyseg_data.loading import Mixture as Mixture, RangeImages as RangeImages, Roll as Roll
    from bodyseg_data.loading import Transform as Transform, WorkerLost as WorkerLost, Zoom as Zoom, decoder as decoder
    from bodyseg_data.loading import loader as loader
    from bodyseg_data.meshes import Mesh as Mesh
    from bodyseg_data.packing import Packing as Packing, ShardWriter as ShardWriter, pack as pack, plan as plan
    from bodyseg_data.rigs import Camera as Camera, Rig as Rig, load_rig as load_rig
    from bodyseg_data.samples import Sample as Sample, ViewGrid as ViewGrid
    from bodyseg_data.shards import ColumnWriter as ColumnWriter, RetryPolicy as RetryPolicy, Unreachable as Unreachable
    from bodyseg_data.shards import decode_sample as decode_sample

    __version__: str
else:
    _found, __dir__, __all__ = lazy_door(__name__)

    def __getattr__(name: str) -> Any:
        return _installed_version() if name == "__version__" else _found(name)


def _installed_version() -> str:
    """Return the version of the installed package `bodyseg`; "0+unknown" in a checkout that was never installed."""
    from importlib import metadata

    try:
        return metadata.version("bodyseg")
    except metadata.PackageNotFoundError:
        return "0+unknown"
