r"""ROS 2 node that labels the parts of people in rectified range images.

Run it with topics of your own:

    GOMP_SPINCOUNT=10000 python label_node.py --ros-args \
        -r depth:=/camera/depth/image_rect_raw -r camera_info:=/camera/depth/camera_info

The variable keeps PyTorch's threads from taking the processors of other nodes (docs/how-to/segment.md). The node
publishes, with the header of the range image:

- `labels`, mono8: part 0 to 32, 255 = unlabelled; `label_info`, once for all: the names of these numbers;
- `persons`, 16UC1: 0 = nobody, 1 for the first person ...; the numbers are of one frame alone;
- `points`, PointCloud2: x, y, z (metres, x right, y down, z ahead), label, person, confidence;
- `parts`, PointCloud2: of each part of each person x, y, z of its middle, nearest_m, distance_m, pixels, confidence ...

Only what somebody subscribes to is made.
"""

from array import array

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField
from vision_msgs.msg import LabelInfo, VisionClass

from bodyseg_data import BadConfig, BodysegError
from bodyseg_model import FrameLabeller, LiveRecording, driver_camera, to_metres

PIXELS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}  # steps of a millimetre, or metres
DATATYPES = {"u1": 2, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}  # of sensor_msgs/msg/PointField


class LabelNode(Node):
    def __init__(self) -> None:
        super().__init__("bodyseg")
        self.camera = None
        self.labeller = FrameLabeller()
        kinds = {"labels": Image, "persons": Image, "points": PointCloud2, "parts": PointCloud2}
        self.out = {topic: self.create_publisher(kind, topic, qos_profile_sensor_data) for topic, kind in kinds.items()}
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_publisher(LabelInfo, "label_info", latched).publish(self.label_info())
        self.create_subscription(CameraInfo, "camera_info", self.on_camera, qos_profile_sensor_data)
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)  # no queue: its answers would be late
        self.create_subscription(Image, "depth", self.on_image, newest)

    def label_info(self) -> LabelInfo:
        names = {**dict(enumerate(self.labeller.label_map.names)), 255: "unlabelled"}
        classes = [VisionClass(class_id=number, class_name=name) for number, name in names.items()]
        return LabelInfo(class_map=classes, threshold=float(self.labeller.least_confidence))

    def on_camera(self, message: CameraInfo) -> None:
        try:
            if self.camera is None or self.camera.size != (message.height, message.width):  # drivers change modes
                self.camera = self.rectified(message)
        except BodysegError as error:
            self.get_logger().error(str(error))

    def rectified(self, message: CameraInfo) -> object:
        """The camera of rectified images, which is that of the projection matrix."""
        fx, _, cx, _, _, fy, cy = map(float, message.p[:7])
        region = message.roi
        if max(message.binning_x, message.binning_y) > 1 or region.x_offset or region.y_offset:
            raise BadConfig("camera_info: images must be neither binned nor cut")
        if not (fx > 0 and fy > 0):
            raise BadConfig("camera_info: the camera is not calibrated")
        return driver_camera("", [], (fx, fy, cx, cy), (message.height, message.width), "camera_info")

    def on_image(self, message: Image) -> None:
        if self.camera is None:
            return
        try:
            (frame,) = LiveRecording([self.pixels(message)])
            range_m = to_metres(frame.read(), frame.step_m)
            answer = self.labeller(range_m, self.camera.frame_camera(range_m.shape).camera)
        except BodysegError as error:
            self.get_logger().error(str(error))
            return
        makers = {
            "labels": lambda: self.image(answer.labels, "mono8"),
            "persons": lambda: self.image(answer.persons, "16UC1"),
            "points": lambda: self.cloud(answer.points()),
            "parts": lambda: self.cloud(answer.parts(), "centroid_m"),
        }
        for topic, make in makers.items():
            if self.out[topic].get_subscription_count():
                made = make()
                made.header = message.header
                self.out[topic].publish(made)

    def pixels(self, message: Image) -> np.ndarray:
        kind, step = PIXELS.get(message.encoding), message.step
        if kind is None or len(message.data) != message.height * step or step < message.width * int(kind[1]):
            raise BadConfig(f"depth: an image must be one of {', '.join(PIXELS)}, whole, found {message.encoding!r}")
        rows = np.frombuffer(message.data, np.uint8).reshape(message.height, step)[:, : message.width * int(kind[1])]
        return np.ascontiguousarray(rows).view(">"[: message.is_bigendian] + kind)

    def image(self, values: np.ndarray, encoding: str) -> Image:
        rows, columns = values.shape
        data = array("B", values.astype(values.dtype.newbyteorder("<")).tobytes())  # rclpy checks lists byte by byte
        return Image(height=rows, width=columns, encoding=encoding, step=columns * values.itemsize, data=data)

    def cloud(self, records: np.ndarray, xyz: str | None = None) -> PointCloud2:
        fields, size = [], records.itemsize
        for name, (kind, offset, *_) in records.dtype.fields.items():
            for part, letter in enumerate("xyz" if name == xyz else " "):
                base, count = kind.base, 1 if name == xyz else int(np.prod(kind.shape))
                place = {"name": letter.strip() or name, "offset": offset + part * base.itemsize}
                fields.append(PointField(datatype=DATATYPES[base.str[1:]], count=count, **place))
        data, shape = array("B", records.tobytes()), {"height": 1, "width": len(records), "is_dense": True}
        return PointCloud2(fields=fields, point_step=size, row_step=records.nbytes, data=data, **shape)


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(LabelNode())
