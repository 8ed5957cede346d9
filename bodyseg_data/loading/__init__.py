"""Batches of range images from shards."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.loading.image_set import Batch, ImageSet, find_rank, first_difference
    from bodyseg_data.loading.loaders import Loader, loader
    from bodyseg_data.loading.mixture import Mixture
    from bodyseg_data.loading.pipelines import decoder
    from bodyseg_data.loading.range_images import RangeImages
    from bodyseg_data.loading.transform import BadTransform, CameraImage, Transform
    from bodyseg_data.loading.transforms import BodyCrop, Crop, Flip, Remnants, Roll, Zoom
    from bodyseg_data.loading.workers import DEFAULT_WORKER_METHOD, WorkerLost, WorkerMethod
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
