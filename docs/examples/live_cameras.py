"""Depth cameras by their makers' Python packages, as recordings for `FrameLabeller` and whoever takes frames.

    label = FrameLabeller()
    with realsense(rows=480, columns=640) as recording:
        for frame in recording:  # without an end: `label.recording` would wait for it
            camera = frame.camera.frame_camera((480, 640)).camera
            answer = label(to_metres(frame.read(), frame.step_m), camera)

Tried with stand-ins of the two packages, not with devices.
"""

import contextlib
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyseg_data import BadConfig
from bodyseg_model import LiveRecording, driver_camera

WAIT_MS = 1000


@contextlib.contextmanager
def realsense(rows: int = 480, columns: int = 640, frames_per_second: int = 30) -> Iterator[LiveRecording]:
    """Open the depth stream of the first RealSense camera, by `pyrealsense2`; it stops when the block ends.

    Times are the camera's. Raises BadConfig for distortion that is not Brown-Conrady's, for a camera that does not
    answer, and without its package.
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

        def frames() -> Iterator[tuple[float, NDArray[Any]]]:
            while True:
                try:
                    frame = pipeline.wait_for_frames(WAIT_MS).get_depth_frame()
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

    Times are the camera's. Raises BadConfig as `driver_camera`, for a camera that does not answer, and without its
    package.
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

        def frames() -> Iterator[tuple[float, NDArray[Any]]]:
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
        frames = pipeline.wait_for_frames(WAIT_MS)
        frame = None if frames is None else frames.get_depth_frame()
        if frame is not None:
            return frame
    raise BadConfig("the Orbbec camera has stopped: no depth frame has come")


def _package(module: str, package: str) -> Any:
    try:
        return import_module(module)
    except ImportError as error:
        raise BadConfig(f"this camera needs the package {package!r}: pip install {package} ({error})") from error
