"""Stand-ins for the packages of makers of cameras."""

from __future__ import annotations

from types import ModuleType, SimpleNamespace
from typing import Any

from pngs import RAMP


class FakeRealSense(ModuleType):
    """The part of pyrealsense2 that is used: a camera that sends `count` frames, every second without depth."""

    def __init__(
        self, count: int = 4, coeffs: tuple[float, ...] = (0.0,) * 5, model: str = "brown", starts: bool = True
    ):
        super().__init__("pyrealsense2")
        self.stream, self.format = SimpleNamespace(depth="depth"), SimpleNamespace(z16="z16")
        self.distortion = SimpleNamespace(brown_conrady="brown")
        self.asked: list[Any] = []
        self.running = False
        self._count, self._sent, self._starts = count, 0, starts
        self._lens = SimpleNamespace(
            fx=100.0, fy=100.0, ppx=41.5, ppy=29.5, coeffs=list(coeffs), height=60, width=84, model=model
        )

    def pipeline(self) -> FakeRealSense:
        return self

    def config(self) -> SimpleNamespace:
        return SimpleNamespace(enable_stream=lambda *words: self.asked.append(words))

    def start(self, config: Any) -> Any:
        if not self._starts:
            raise RuntimeError("No device connected")
        self.running = True
        sensor = SimpleNamespace(get_depth_scale=lambda: 0.00025)
        profile = SimpleNamespace(get_intrinsics=lambda: self._lens)
        return SimpleNamespace(
            get_stream=lambda stream: SimpleNamespace(as_video_stream_profile=lambda: profile),
            get_device=lambda: SimpleNamespace(first_depth_sensor=lambda: sensor),
        )

    def wait_for_frames(self, wait_ms: int) -> Any:
        self._sent += 1
        if self._sent > self._count:
            raise RuntimeError("Frame didn't arrive within 1000")
        frame = SimpleNamespace(get_timestamp=lambda: 500.0 * self._sent, get_data=lambda: RAMP)
        return SimpleNamespace(get_depth_frame=lambda: frame if self._sent % 2 == 0 else None)

    def stop(self) -> None:
        self.running = False


class FakeOrbbec(ModuleType):
    """The part of pyorbbecsdk that is used: a camera that sends `count` frames."""

    def __init__(self, count: int = 3, k4: float = 0.0, starts: bool = True) -> None:
        super().__init__("pyorbbecsdk")
        self.OBSensorType = SimpleNamespace(DEPTH_SENSOR="depth")
        self.running = False
        self._left, self._starts = count, starts
        lens = SimpleNamespace(fx=100.0, fy=100.5, cx=41.5, cy=29.5, height=60, width=84)
        bent = SimpleNamespace(k1=0.1, k2=0.0, k3=0.3, k4=k4, k5=0.0, k6=0.0, p1=0.01, p2=0.02)
        self._parameters = SimpleNamespace(depth_intrinsic=lens, depth_distortion=bent)

    def Pipeline(self) -> FakeOrbbec:  # noqa: N802  its name there
        return self

    def Config(self) -> SimpleNamespace:  # noqa: N802
        return SimpleNamespace(enable_stream=lambda profile: None)

    def get_stream_profile_list(self, sensor: str) -> SimpleNamespace:
        return SimpleNamespace(get_default_video_stream_profile=lambda: "mode")

    def get_camera_param(self) -> SimpleNamespace:
        return self._parameters

    def start(self, config: Any) -> None:
        if not self._starts:
            raise ValueError("no device")
        self.running = True

    def wait_for_frames(self, wait_ms: int) -> Any:
        self._left -= 1
        if self._left < 0:
            return None
        frame = SimpleNamespace(
            get_height=lambda: 60,
            get_width=lambda: 84,
            get_data=lambda: RAMP.tobytes(),
            get_timestamp=lambda: 2000,
            get_depth_scale=lambda: 0.5,
        )
        return SimpleNamespace(get_depth_frame=lambda: frame)

    def stop(self) -> None:
        self.running = False
