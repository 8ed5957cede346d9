"""The ROS 2 node of the documentation, with a stub of rclpy's interface: rclpy itself is in no package registry.

The stubs' messages refuse what rclpy's refuse: unknown fields, and values of another type. They cannot tell whether
messages arrive.
"""

from __future__ import annotations

import sys
from array import array
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from bags import ROS2, built, camera_info, image
from label_networks import Places

from bodyseg_data.labels import BACKGROUND, LANDMARKS
from bodyseg_model.networks import Trained

NODE = Path(__file__).parents[2] / "docs" / "examples" / "label_node.py"

pytestmark = pytest.mark.usefixtures("near_is_person")


class StubNode:
    """What rclpy's Node does for this node: it keeps publishers, subscriptions and lines of its log."""

    def __init__(self, name: str) -> None:
        self.name, self.sent, self.said = name, [], []
        self.heard: dict[str, Any] = {}
        self.asked: dict[str, Any] = {}
        self.listeners = {"labels": 1, "persons": 1, "points": 1, "parts": 1}

    def create_publisher(self, kind: Any, topic: str, profile: Any) -> Any:
        def publish(message: Any) -> None:
            assert type(message) is kind
            self.sent.append((topic, message))

        return SimpleNamespace(publish=publish, get_subscription_count=lambda: self.listeners[topic])

    def create_subscription(self, kind: Any, topic: str, callback: Any, profile: Any) -> None:
        self.heard[topic], self.asked[topic] = callback, profile

    def get_logger(self) -> Any:
        return SimpleNamespace(error=self.said.append)


class StubMessage:
    """A message that is made from keywords and altered by attributes, as rclpy's are, with fields of `kinds` alone."""

    kinds: ClassVar[dict[str, type]]

    def __init__(self, **fields: Any) -> None:
        for name, value in fields.items():
            setattr(self, name, value)

    def __setattr__(self, name: str, value: Any) -> None:
        assert isinstance(value, self.kinds[name]), f"{name} must be {self.kinds[name]}, found {type(value)}"
        super().__setattr__(name, value)


def stub(**kinds: type) -> type[StubMessage]:
    return type("Stub", (StubMessage,), {"kinds": {"header": object, "height": int, "width": int, **kinds}})


Image = stub(encoding=str, is_bigendian=int, step=int, data=array)
PointField = stub(name=str, offset=int, datatype=int, count=int)
PointCloud2 = stub(fields=list, is_bigendian=bool, point_step=int, row_step=int, data=array, is_dense=bool)
VisionClass = stub(class_id=int, class_name=str)
LabelInfo = stub(class_map=list, threshold=float)


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Any:
    stubs = {
        "rclpy": {},
        "rclpy.node": {"Node": StubNode},
        "rclpy.qos": {
            "qos_profile_sensor_data": "best effort",
            "QoSProfile": SimpleNamespace,
            "DurabilityPolicy": SimpleNamespace(TRANSIENT_LOCAL=1),
            "ReliabilityPolicy": SimpleNamespace(BEST_EFFORT=2),
        },
        "sensor_msgs": {},
        "sensor_msgs.msg": {"Image": Image, "CameraInfo": object, "PointCloud2": PointCloud2, "PointField": PointField},
        "vision_msgs": {},
        "vision_msgs.msg": {"LabelInfo": LabelInfo, "VisionClass": VisionClass},
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
    made.labeller = module.FrameLabeller(network)
    return made


def message(sent: Any) -> Any:
    _, kind, fields = sent
    return built(ROS2, kind, fields)


FRAME = np.full((60, 80), 4000, np.uint16)
FRAME[10:50, 30:42] = 2000


def see_camera(node: Any) -> None:
    projection = np.array([100.0, 0, 39.5, 0, 0, 100, 29.5, 0, 0, 0, 1, 0])
    node.heard["camera_info"](message(camera_info((60, 80), p=projection)))


def test_the_node_answers_range_images_with_labels(node: Any) -> None:
    assert node.name == "bodyseg" and set(node.heard) == {"camera_info", "depth"}
    assert vars(node.asked["depth"]) == {"depth": 1, "reliability": 2}, "the newest frame, whatever the sensor offers"
    ((topic, info),) = node.sent
    assert topic == "label_info" and info.threshold == 0
    assert [each.class_id for each in info.class_map] == [*range(33), 255]
    assert [each.class_name for each in info.class_map] == [*LANDMARKS, "unlabelled"]
    node.sent.clear()
    node.listeners = dict.fromkeys(node.listeners, 0) | {"labels": 1}
    node.heard["depth"](message(image(FRAME, "16UC1")))
    assert not node.sent, "nothing is said before the camera is known"
    see_camera(node)
    node.heard["depth"](message(image(FRAME, "16UC1", 7.25)))
    node.heard["depth"](message(image(FRAME.astype(np.float32) / 1000, "32FC1", 7.5)))
    assert [topic for topic, _ in node.sent] == ["labels", "labels"], "nobody asked for more"
    for (_, answer), nanoseconds in zip(node.sent, (250_000_000, 500_000_000), strict=True):
        assert (answer.height, answer.width, answer.step, answer.encoding) == (60, 80, 80, "mono8")
        assert (answer.header.stamp.sec, answer.header.stamp.nanosec) == (7, nanoseconds)
        labels = np.frombuffer(answer.data, np.uint8).reshape(60, 80)
        np.testing.assert_array_equal(labels != BACKGROUND, FRAME == 2000)
    node.heard["depth"](message(image(FRAME[:50], "16UC1")))
    assert len(node.sent) == 2 and "the frame must have 60 x 80 pixels, found 50 x 80" in node.said[0]


def test_the_node_says_why_a_camera_is_none_and_takes_the_next(node: Any) -> None:
    node.heard["camera_info"](message(camera_info((60, 80), binning_x=2)))
    assert "camera_info: images must be neither binned nor cut" in node.said[0]
    node.heard["camera_info"](message(camera_info((60, 80), k=np.zeros(9), p=np.zeros(12))))
    assert node.said[1:] == ["camera_info: the camera is not calibrated"]
    see_camera(node)
    node.heard["depth"](message(image(FRAME, "16UC1", 7.25)))
    node.heard["camera_info"](message(camera_info((50, 80), p=np.array([100.0, 0, 39, 0, 0, 100, 24, 0, 0, 0, 1, 0]))))
    node.heard["depth"](message(image(FRAME[:50], "16UC1", 7.5)))
    assert len(node.said) == 2 and [made.height for topic, made in node.sent if topic == "labels"] == [60, 50]


def as_records(cloud: Any) -> Any:
    """What a PointCloud2 says, read by its own fields as subscribers read it."""
    numbers = {2: "u1", 4: "u2", 5: "i4", 6: "u4", 7: "f4"}
    kind = np.dtype(
        {
            "names": [each.name for each in cloud.fields],
            "formats": [(numbers[each.datatype], (each.count,)) for each in cloud.fields],
            "offsets": [each.offset for each in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    assert cloud.row_step == cloud.width * cloud.point_step == len(cloud.data) and cloud.height == 1
    return np.frombuffer(cloud.data, kind)


def test_the_node_publishes_persons_points_and_parts(node: Any) -> None:
    see_camera(node)
    node.heard["depth"](message(image(FRAME, "16UC1", 7.25)))
    sent = dict(node.sent)
    persons = np.frombuffer(sent["persons"].data, "<u2").reshape(60, 80)
    assert sent["persons"].step == 160
    np.testing.assert_array_equal(persons, FRAME == 2000)
    points, parts = as_records(sent["points"]), as_records(sent["parts"])
    assert len(points) == 40 * 12 and set(points["person"].ravel()) == {1}
    np.testing.assert_allclose(points["z"], 2)
    np.testing.assert_allclose([points["x"].min(), points["x"].max()], [2 * -9.5 / 100, 2 * 1.5 / 100], atol=1e-6)
    labels = np.frombuffer(sent["labels"].data, np.uint8)
    np.testing.assert_array_equal(points["label"].ravel(), labels[labels != BACKGROUND])
    np.testing.assert_array_equal(parts["part"].ravel(), np.unique(points["label"]))
    assert parts["pixels"].sum() == 480
    top = points[points["label"].ravel() == parts["part"][0]]
    np.testing.assert_allclose(parts["y"][0], top["y"].mean(), atol=1e-5)
    assert all(sent[topic].header.stamp.sec == 7 for topic in ("labels", "persons", "points", "parts"))


def test_the_node_is_short() -> None:
    assert len(NODE.read_text().splitlines()) <= 117
