"""Recordings of range sensors: frames in files, folders, tars and bags, their cameras and their names in results."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_model.recordings.camera_files import FrameCameras
    from bodyseg_model.recordings.cameras import FrameCamera, driver_camera, frame_camera, other_sensors
    from bodyseg_model.recordings.frames import (
        CENTRE_HELP,
        FOCAL_HELP,
        RECORDINGS_HELP,
        UNITS_HELP,
        Skipping,
        find_frames,
        metres_a_step,
        open_recording,
        to_metres,
    )
    from bodyseg_model.recordings.label_bags import LabelsOut, labels_out
    from bodyseg_model.recordings.recording import Frame, LiveRecording, Pixels, Stamp, check_metres, evenly_apart
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
