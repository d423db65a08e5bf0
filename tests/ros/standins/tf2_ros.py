"""A stand-in for ROS 2's tf2_ros, which PyPI lacks: filled from the real topics /tf, /tf_static."""

from threading import Lock

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage

from r3jax.formats.ros.messages import stamp_of
from tests.ros import stubs

TransformException = stubs.TransformException


class Buffer(stubs.Buffer):
    """Transforms of the topics."""

    def __init__(self):
        super().__init__()
        self.lock = Lock()

    def lookup_transform(self, parent, child, time):
        with self.lock:
            return super().lookup_transform(parent, child, time.nanoseconds)


class TransformListener:
    """Fills a buffer."""

    def __init__(self, buffer, node):
        self.buffer, group = buffer, ReentrantCallbackGroup()
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for topic, qos, is_static in (("/tf", 100, False), ("/tf_static", latched, True)):
            take = lambda message, is_static=is_static: self._add(message, is_static)
            node.create_subscription(TFMessage, topic, take, qos, callback_group=group)

    def _add(self, message, is_static):
        with self.buffer.lock:
            for one in message.transforms:
                move, turn = one.transform.translation, one.transform.rotation
                self.buffer.tree.add(
                    one.header.frame_id,
                    one.child_frame_id,
                    None if is_static else stamp_of(one),
                    [move.x, move.y, move.z],
                    [turn.x, turn.y, turn.z, turn.w],
                )
