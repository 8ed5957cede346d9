"""Frames as they come: from any Python iterable, or from a camera by its maker's Python package."""

import contextlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, MissingLibrary
from bodyseg_model.recordings.cameras import Intrinsics, driver_camera
from bodyseg_model.recordings.recording import FLOAT_STEP_M, MILLIMETRE, ArrayFrames, Frame

Timed = NDArray[Any] | tuple[float | None, NDArray[Any]]
"""Pixels of a frame [H, W], or its time in seconds and its pixels."""

_WAIT_MS: Final = 1000


@dataclass(frozen=True, eq=False)
class LiveRecording:
    """A recording of arrays that `arrays` yields: uint16 in steps of `step_m` metres, or floating point in metres.

    Nothing is kept: a frame lives as long as its caller holds it. where: name in messages and of frames.
    """

    arrays: Iterable[Timed]
    camera: Intrinsics | None = None
    step_m: float = MILLIMETRE
    where: str = "live"

    def __iter__(self) -> Iterator[Frame]:
        for index, item in enumerate(self.arrays):
            time_s, pixels = item if isinstance(item, tuple) else (None, item)
            step_m = FLOAT_STEP_M if pixels.dtype.kind == "f" else self.step_m
            name = f"{self.where}-{index:06d}"
            held, within = ArrayFrames(pixels[np.newaxis]), ("", index)
            yield Frame(name, name, Path(self.where), str(index), held, within, 0, time_s, step_m, self.camera)


@contextlib.contextmanager
def realsense(rows: int = 480, columns: int = 640, frames_per_second: int = 30) -> Iterator[LiveRecording]:
    """Open the depth stream of the first RealSense camera, by `pyrealsense2`; it stops when the block ends.

    Times are the camera's. Raises BadConfig for distortion that is not Brown-Conrady's, or a camera that does not
    answer, MissingLibrary.
    """
    sdk = _package("pyrealsense2", "pyrealsense2")
    pipeline, config = sdk.pipeline(), sdk.config()
    config.enable_stream(sdk.stream.depth, columns, rows, sdk.format.z16, frames_per_second)
    try:
        profile = pipeline.start(config)
    except RuntimeError as error:
        raise BadConfig(f"the RealSense camera does not start: {error}") from error
    try:
        lens = profile.get_stream(sdk.stream.depth).as_video_stream_profile().get_intrinsics()
        if any(lens.coeffs) and lens.model != sdk.distortion.brown_conrady:
            raise BadConfig(f"a camera's distortion must be Brown-Conrady's, found {lens.model}")
        numbers, size = (lens.fx, lens.fy, lens.ppx, lens.ppy), (lens.height, lens.width)
        camera = driver_camera("brown_conrady", [*map(float, lens.coeffs)], numbers, size, "RealSense")
        step_m = float(profile.get_device().first_depth_sensor().get_depth_scale())

        def frames() -> Iterator[Timed]:
            while True:
                try:
                    frame = pipeline.wait_for_frames(_WAIT_MS).get_depth_frame()
                except RuntimeError as error:
                    raise BadConfig(f"the RealSense camera has stopped: {error}") from error
                if frame:
                    yield frame.get_timestamp() / 1000, np.array(frame.get_data())

        yield LiveRecording(frames(), camera, step_m, "realsense")
    finally:
        pipeline.stop()


@contextlib.contextmanager
def orbbec() -> Iterator[LiveRecording]:
    """Open the depth stream of the first Orbbec camera in its default mode, by `pyorbbecsdk2`; it stops with the block.

    Times are the camera's. Raises BadConfig as `driver_camera`, or for a camera that does not answer, MissingLibrary.
    """
    sdk = _package("pyorbbecsdk", "pyorbbecsdk2")
    try:
        pipeline, config = sdk.Pipeline(), sdk.Config()
        modes = pipeline.get_stream_profile_list(sdk.OBSensorType.DEPTH_SENSOR)
        config.enable_stream(modes.get_default_video_stream_profile())
        pipeline.start(config)
    except Exception as error:  # the package raises a class of its own
        raise BadConfig(f"the Orbbec camera does not start: {error}") from error
    try:
        parameters = pipeline.get_camera_param()
        lens, bent = parameters.depth_intrinsic, parameters.depth_distortion
        coefficients = tuple(float(getattr(bent, name)) for name in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"))
        numbers, size = (lens.fx, lens.fy, lens.cx, lens.cy), (lens.height, lens.width)
        camera = driver_camera("rational_polynomial", coefficients, numbers, size, "Orbbec")
        first = _orbbec_frame(pipeline)

        def frames() -> Iterator[Timed]:
            frame = first
            while True:
                shape = frame.get_height(), frame.get_width()
                yield frame.get_timestamp() / 1000, np.frombuffer(frame.get_data(), np.uint16).reshape(shape).copy()
                frame = _orbbec_frame(pipeline)

        yield LiveRecording(frames(), camera, first.get_depth_scale() / 1000, "orbbec")
    finally:
        pipeline.stop()


def _orbbec_frame(pipeline: Any) -> Any:
    """Wait for the next depth frame. Raises BadConfig if none comes in ten waits."""
    for _ in range(10):
        frames = pipeline.wait_for_frames(_WAIT_MS)
        frame = None if frames is None else frames.get_depth_frame()
        if frame is not None:
            return frame
    raise BadConfig("the Orbbec camera has stopped: no depth frame has come")


def _package(module: str, package: str) -> Any:
    try:
        return import_module(module)
    except ImportError as error:
        raise MissingLibrary(f"this camera needs the package {package!r}: pip install {package} ({error})") from error
