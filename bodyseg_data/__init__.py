"""Streaming of range images of people, with the artifacts of a structured-light sensor made on the fly.

    from bodyseg_data import RangeImages, loader

Importing this package is fast: each name below is imported on first use, and none needs a renderer. The names in
`__all__` are the public interface; all else may move.
"""

from typing import TYPE_CHECKING, Any

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:  # each name `as` itself, so that type checkers of other programs take it for offered
    from bodyseg_data.artifacts import VARIANTS as VARIANTS
    from bodyseg_data.artifacts import Artifact as Artifact
    from bodyseg_data.artifacts import Augmentation as Augmentation
    from bodyseg_data.artifacts import Losses as Losses
    from bodyseg_data.artifacts import MissingData as MissingData
    from bodyseg_data.artifacts import MixedPixels as MixedPixels
    from bodyseg_data.artifacts import Noise as Noise
    from bodyseg_data.artifacts import Occlusion as Occlusion
    from bodyseg_data.artifacts import PatchLoss as PatchLoss
    from bodyseg_data.artifacts import PhaseShift as PhaseShift
    from bodyseg_data.artifacts import RangeImage as RangeImage
    from bodyseg_data.artifacts import Scene as Scene
    from bodyseg_data.artifacts import SensorModel as SensorModel
    from bodyseg_data.artifacts import StripeLoss as StripeLoss
    from bodyseg_data.artifacts import load_sensor_model as load_sensor_model
    from bodyseg_data.bodies import Body as Body
    from bodyseg_data.bodies import BodyRef as BodyRef
    from bodyseg_data.bodies import BodySource as BodySource
    from bodyseg_data.bodies import load_template as load_template
    from bodyseg_data.bodies import open_source as open_source
    from bodyseg_data.core import BadConfig as BadConfig
    from bodyseg_data.core import BadLandmarks as BadLandmarks
    from bodyseg_data.core import BadMesh as BadMesh
    from bodyseg_data.core import BadSample as BadSample
    from bodyseg_data.core import BadShard as BadShard
    from bodyseg_data.core import BodysegError as BodysegError
    from bodyseg_data.core import Draws as Draws
    from bodyseg_data.core import MissingLibrary as MissingLibrary
    from bodyseg_data.drawing import colour_range as colour_range
    from bodyseg_data.example import example_set as example_set
    from bodyseg_data.labels import BACKGROUND as BACKGROUND
    from bodyseg_data.labels import PARTS as PARTS
    from bodyseg_data.labels import LabelClass as LabelClass
    from bodyseg_data.labels import LabelMap as LabelMap
    from bodyseg_data.labels import colour_labels as colour_labels
    from bodyseg_data.labels import load_label_map as load_label_map
    from bodyseg_data.loading import BadTransform as BadTransform
    from bodyseg_data.loading import Batch as Batch
    from bodyseg_data.loading import BodyCrop as BodyCrop
    from bodyseg_data.loading import CameraImage as CameraImage
    from bodyseg_data.loading import Crop as Crop
    from bodyseg_data.loading import Flip as Flip
    from bodyseg_data.loading import Loader as Loader
    from bodyseg_data.loading import Mixture as Mixture
    from bodyseg_data.loading import RangeImages as RangeImages
    from bodyseg_data.loading import Remnants as Remnants
    from bodyseg_data.loading import Roll as Roll
    from bodyseg_data.loading import Transform as Transform
    from bodyseg_data.loading import WorkerLost as WorkerLost
    from bodyseg_data.loading import Zoom as Zoom
    from bodyseg_data.loading import decoder as decoder
    from bodyseg_data.loading import loader as loader
    from bodyseg_data.meshes import Mesh as Mesh
    from bodyseg_data.packing import FaultyMeshes as FaultyMeshes
    from bodyseg_data.packing import OnFaults as OnFaults
    from bodyseg_data.packing import Packing as Packing
    from bodyseg_data.packing import ShardWriter as ShardWriter
    from bodyseg_data.packing import pack as pack
    from bodyseg_data.packing import plan as plan
    from bodyseg_data.rigs import Camera as Camera
    from bodyseg_data.rigs import Distortion as Distortion
    from bodyseg_data.rigs import Rig as Rig
    from bodyseg_data.rigs import load_rig as load_rig
    from bodyseg_data.samples import Sample as Sample
    from bodyseg_data.samples import ViewGrid as ViewGrid
    from bodyseg_data.shards import ColumnWriter as ColumnWriter
    from bodyseg_data.shards import RetryPolicy as RetryPolicy
    from bodyseg_data.shards import Unreachable as Unreachable
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
