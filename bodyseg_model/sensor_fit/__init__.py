"""Measurement of a sensor's artifacts from its own frames: a verdict for each artifact, and a sensor file."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_model.sensor_fit.edges import ShadowFrames
    from bodyseg_model.sensor_fit.fit import draw_comparison, fit_sensor
    from bodyseg_model.sensor_fit.recording import read_recording
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
