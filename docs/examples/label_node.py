r"""ROS 2 node that labels the parts of people in range images.

Run it with topics of your own:

    GOMP_SPINCOUNT=10000 python label_node.py --ros-args \
        -r depth:=/camera/depth/image_rect_raw -r camera_info:=/camera/depth/camera_info

The variable keeps PyTorch's threads from taking the processors of other nodes (docs/how-to/segment.md). The node
publishes mono8 images on `labels`: part 0 to 32, 255 elsewhere, with the header of their range image.
"""

import rclpy
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image

from bodyseg_data import BodysegError
from bodyseg_model import FrameLabeller, LiveRecording, to_metres
from bodyseg_model.recordings.bag_messages import IMAGE, camera_of, pixels


class LabelNode(Node):
    def __init__(self) -> None:
        super().__init__("bodyseg")
        self.camera = None
        self.labeller = FrameLabeller()
        self.labels = self.create_publisher(Image, "labels", qos_profile_sensor_data)
        self.create_subscription(CameraInfo, "camera_info", self.on_camera, qos_profile_sensor_data)
        self.create_subscription(Image, "depth", self.on_image, qos_profile_sensor_data)

    def on_camera(self, message: CameraInfo) -> None:
        self.camera = self.camera or camera_of(message, "camera_info", rectified=True)

    def on_image(self, message: Image) -> None:
        if self.camera is None:
            return
        try:
            (frame,) = LiveRecording([pixels(message, IMAGE)])
            range_m = to_metres(frame.read(), frame.step_m)
            labels = self.labeller(range_m, self.camera.frame_camera(range_m.shape).camera).labels
        except BodysegError as error:
            self.get_logger().error(str(error))
            return
        rows, columns = labels.shape
        answer = Image(header=message.header, height=rows, width=columns, encoding="mono8", step=columns)
        answer.data = labels.tobytes()
        self.labels.publish(answer)


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(LabelNode())
