"""Transforms of samples in the loader's workers, after the artifacts: the protocol, and those that ship.

    from bodyseg_data.loading.transforms import Crop, Flip, Roll

A transform of your own is a function or a class derived from `Transform` (docs/how-to/transforms.md).
"""

from bodyseg_data.loading.transforms.body_crop import BodyCrop
from bodyseg_data.loading.transforms.camera_image import CameraImage
from bodyseg_data.loading.transforms.crop import Crop
from bodyseg_data.loading.transforms.flip import Flip
from bodyseg_data.loading.transforms.roll import Roll
from bodyseg_data.loading.transforms.transform import Transform
from bodyseg_data.loading.transforms.zoom import Zoom

__all__ = ["BodyCrop", "CameraImage", "Crop", "Flip", "Roll", "Transform", "Zoom"]
