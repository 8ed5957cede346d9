"""The ROS 2 node of the documentation, with a stub of rclpy's interface."""

from __future__ import annotations

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bags import ROS2, built, camera_info, image
from label_networks import Places

from bodyseg_data.labels import BACKGROUND
from bodyseg_model.networks import Trained

NODE = Path(__file__).parents[2] / "docs" / "examples" / "label_node.py"


class StubNode:
    """What rclpy's Node does for this node: it keeps publishers, subscriptions and lines of its log."""

    def __init__(self, name: str) -> None:
        self.name, self.sent, self.said = name, [], []
        self.heard: dict[str, Any] = {}

    def create_publisher(self, kind: Any, topic: str, profile: Any) -> Any:
        return SimpleNamespace(publish=lambda message: self.sent.append((topic, message)))

    def create_subscription(self, kind: Any, topic: str, callback: Any, profile: Any) -> None:
        self.heard[topic] = callback

    def get_logger(self) -> Any:
        return SimpleNamespace(error=self.said.append)


class StubImage:
    """A message that is made from keywords and altered by attributes, as rclpy's are."""

    def __init__(self, **fields: Any) -> None:
        self.__dict__.update(fields)


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Any:
    stubs = {
        "rclpy": {},
        "rclpy.node": {"Node": StubNode},
        "rclpy.qos": {"qos_profile_sensor_data": "best effort"},
        "sensor_msgs": {},
        "sensor_msgs.msg": {"Image": StubImage, "CameraInfo": object},
    }
    for name, content in stubs.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    spec = spec_from_file_location("label_node", NODE)
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    made = module.LabelNode()
    network = Trained(Places(axis=0, step=20), {"network": "places", "seed": 3})
    made.labeller = module.FrameLabeller(network, keep_things=True)  # a block is no person: all bodies get labels
    return made


def message(sent: Any) -> Any:
    _, kind, fields = sent
    return built(ROS2, kind, fields)


def test_the_node_answers_range_images_with_labels(node: Any) -> None:
    frame = np.full((60, 80), 4000, np.uint16)
    frame[10:50, 30:42] = 2000
    assert node.name == "bodyseg" and set(node.heard) == {"camera_info", "depth"}
    node.heard["depth"](message(image(frame, "16UC1")))
    assert not node.sent, "nothing is said before the camera is known"
    projection = np.array([100.0, 0, 39.5, 0, 0, 100, 29.5, 0, 0, 0, 1, 0])
    node.heard["camera_info"](message(camera_info((60, 80), p=projection)))
    node.heard["depth"](message(image(frame, "16UC1", 7.25)))
    node.heard["depth"](message(image(frame.astype(np.float32) / 1000, "32FC1", 7.5)))
    assert [topic for topic, _ in node.sent] == ["labels", "labels"]
    for (_, answer), nanoseconds in zip(node.sent, (250_000_000, 500_000_000), strict=True):
        assert (answer.height, answer.width, answer.step, answer.encoding) == (60, 80, 80, "mono8")
        assert (answer.header.stamp.sec, answer.header.stamp.nanosec) == (7, nanoseconds)
        labels = np.frombuffer(answer.data, np.uint8).reshape(60, 80)
        np.testing.assert_array_equal(labels != BACKGROUND, frame == 2000)
    node.heard["depth"](message(image(frame[:50], "16UC1")))
    assert len(node.sent) == 2 and "the frame must have 60 x 80 pixels, found 50 x 80" in node.said[0]


def test_the_node_is_short() -> None:
    assert len(NODE.read_text().splitlines()) <= 65
