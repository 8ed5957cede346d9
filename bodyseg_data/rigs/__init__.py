"""Cameras and structured-light rigs; the rigs that ship, a TOML file each."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.rigs.camera import MAX_SIDE, Camera, Distortion, PlacedCamera, axes_at, check_intrinsics
    from bodyseg_data.rigs.rig import PAPER, RANGE_STEP_MM, Rig, Sensor, load_rig, load_sensor, rig_from_json, rig_names
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
