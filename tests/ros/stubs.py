"""Stand-ins for rclpy and what comes with it: messages with ROS' own fields and types, no network.

Fields, types and constants of the messages are those that `rosbags` knows of ROS 2 Humble. As
rclpy does, a message refuses fields that it does not have and numbers of another type.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from r3jax.formats.ros.transforms import TransformTree

STORE = get_typestore(Stores.ROS2_HUMBLE)
PACKAGE = Path(__file__).resolve().parents[2] / "ros" / "r3jax_ros"
_BASE, _NAME = 1, 2
_PLAIN = {"string": str, "bool": bool, "float32": float, "float64": float}

MESSAGES = {
    "geometry_msgs": ("Point", "Pose", "PoseStamped", "TransformStamped"),
    "action_msgs": ("GoalStatus",),
    "nav_msgs": ("OccupancyGrid", "Path"),
    "sensor_msgs": ("CameraInfo", "Image", "PointCloud2", "PointField"),
    "std_msgs": ("ColorRGBA", "Header"),
    "visualization_msgs": ("Marker", "MarkerArray"),
}


class Message:
    """A message with its default values."""

    kind: str

    def __init__(self, **fields: Any):
        for name, (node, detail) in STORE.fielddefs[self.kind][1]:
            if node == _BASE:
                value = _PLAIN.get(detail[0], int)()
            else:
                value = message_class(detail)() if node == _NAME else []
            setattr(self, name, fields.pop(name, value))
        assert not fields, f"{self.kind} has no field {', '.join(fields)}"

    def __setattr__(self, name: str, value: Any) -> None:
        node, detail = dict(STORE.fielddefs[self.kind][1])[name]  # or there is no such field
        if node == _BASE:
            kind = _PLAIN.get(detail[0], int)
            assert isinstance(value, kind), f"{self.kind}.{name} must be {kind}, got {value!r}"
        elif node == _NAME:
            assert value.kind == detail, f"{self.kind}.{name} must be {detail}, got {value}"
        super().__setattr__(name, value)


def message_class(kind: str) -> type[Message]:
    """The class of a message such as std_msgs/msg/Header."""
    constants = {name: value for name, _, value in STORE.fielddefs[kind][0]}
    return type(kind.rpartition("/")[2], (Message,), {"kind": kind, **constants})


def stored(message: Message) -> Any:
    """The same message as rosbags serializes it."""
    values = {}
    for name, (node, detail) in STORE.fielddefs[message.kind][1]:
        value = getattr(message, name)
        if node == _NAME:
            value = stored(value)
        elif node > _NAME and detail[0][0] == _NAME:
            value = [stored(one) for one in value]
        elif node > _NAME:
            value = np.asarray(value, detail[0][1][0])
        values[name] = value
    return STORE.types[message.kind](**values)


class Publisher:
    """Keeps what is published, once it has been serialized."""

    def __init__(self, kind: type[Message], topic: str):
        self.kind, self.topic, self.sent = kind, topic, []

    def publish(self, message: Message) -> None:
        assert message.kind == self.kind.kind
        STORE.serialize_cdr(stored(message), message.kind)
        self.sent.append(message)


class Node:
    """A node whose callbacks the test calls."""

    parameters: dict[str, Any] = {}  # noqa: RUF012
    time = 0
    """Of its clock [ns]."""

    def __init__(self, name: str):
        self.callbacks: dict[str, Any] = {}
        self.published: dict[str, Publisher] = {}
        self.said: list[str] = []
        self.services: dict[str, Any] = {}

    def declare_parameter(self, name: str, default: Any) -> Any:
        return SimpleNamespace(value=self.parameters.get(name, default))

    def create_subscription(self, kind, topic, callback, qos_profile, callback_group=None):
        self.callbacks[topic] = callback

    def create_publisher(self, kind, topic, qos_profile):
        self.published[topic] = Publisher(kind, topic)
        return self.published[topic]

    def create_service(self, kind, name, callback, callback_group=None):
        self.services[name] = callback

    def ask(self, name: str) -> Any:
        """Calls a service."""
        answer = self.services[name](Trigger.Request(), Trigger.Response())
        assert isinstance(answer.success, bool)
        assert isinstance(answer.message, str)
        return answer

    def create_timer(self, seconds, callback, callback_group=None):
        self.callbacks["timer"] = callback

    def get_logger(self):
        say = lambda text, **options: self.said.append(text)
        return SimpleNamespace(debug=lambda text: None, info=say, warning=say)

    def get_clock(self):
        message = message_class("builtin_interfaces/msg/Time")
        now = SimpleNamespace(to_msg=message, nanoseconds=self.time)
        return SimpleNamespace(now=lambda: now)


class Trigger:
    """std_srvs/srv/Trigger."""

    Request = SimpleNamespace

    class Response(SimpleNamespace):
        success, message = False, ""


class NavigateToPose:
    """nav2_msgs/action/NavigateToPose: the fields that the node uses."""

    class Goal:
        def __init__(self, *, pose: Message):
            assert pose.kind == "geometry_msgs/msg/PoseStamped"
            self.pose = pose


class Done:
    """A future whose result the test sets."""

    def __init__(self):
        self.callbacks: list[Any] = []
        self.value: Any = None

    def add_done_callback(self, callback: Any) -> None:
        self.callbacks.append(callback)

    def result(self) -> Any:
        return self.value

    def set(self, value: Any) -> None:
        self.value = value
        for callback in self.callbacks:
            callback(self)


class ActionClient:
    """Nav2's side of its action, played by the test."""

    is_ready = True

    def __init__(self, node: Node, kind: type, name: str, callback_group: Any = None):
        assert kind is NavigateToPose
        self.sent: list[Sent] = []
        node.nav2 = self

    def server_is_ready(self) -> bool:
        return self.is_ready

    def send_goal_async(self, goal: NavigateToPose.Goal, feedback_callback: Any) -> Done:
        self.sent.append(Sent(goal, feedback_callback))
        return self.sent[-1].answer


class Sent:
    """A goal that Nav2 was sent."""

    def __init__(self, goal: NavigateToPose.Goal, feedback: Any):
        self.pose, self.feedback = goal.pose, feedback
        self.answer, self.result, self.is_canceled = Done(), Done(), False

    def accept(self, accepted: bool = True) -> None:
        def cancel() -> Done:
            self.is_canceled = True
            return Done()

        self.answer.set(
            SimpleNamespace(
                accepted=accepted, cancel_goal_async=cancel, get_result_async=lambda: self.result
            )
        )

    def drive(self, remaining: float) -> None:
        told = SimpleNamespace(distance_remaining=remaining, number_of_recoveries=1)
        self.feedback(SimpleNamespace(feedback=told))

    def end(self, status: int) -> None:
        self.result.set(SimpleNamespace(status=status))


class TransformException(Exception):
    """As tf2's."""


class Buffer:
    """tf, filled by the test; as tf2, it extrapolates nothing. Time 0 is the latest."""

    def __init__(self):
        self.tree = TransformTree()

    def lookup_transform(self, parent: str, child: str, time: int) -> Any:
        chain = self.tree.chain(child, parent)
        samples = [self.tree.edges[frame].times for frame in chain[:-1]]
        is_known = all(min(times) <= time <= max(times) for times in samples if times and time)
        poses, _ = self.tree.poses(chain, np.array([time]))
        if chain[-1] != parent or not is_known:
            raise TransformException(f"no transform from {child} to {parent}")
        found = message_class("geometry_msgs/msg/TransformStamped")()
        for name, value in zip("xyz", poses[0, :3, 3].tolist(), strict=True):
            setattr(found.transform.translation, name, value)
        turn = Rotation.from_matrix(poses[0, :3, :3]).as_quat().tolist()
        for name, value in zip("xyzw", turn, strict=True):
            setattr(found.transform.rotation, name, value)
        return found


class Time:
    """A time is its nanoseconds."""

    def __new__(cls) -> int:  # type: ignore[misc]
        return 0

    @staticmethod
    def from_msg(message: Any) -> int:
        return message.sec * 1_000_000_000 + message.nanosec


class Synchronizer:
    """Pairs of messages whose stamps differ by no more than the slop [s]."""

    def __init__(self, subscribers: list[list], queue_size: int, slop: float):
        self.slop, self.callback, self.waiting = slop, None, [[] for _ in subscribers]
        for number, subscriber in enumerate(subscribers):
            subscriber.append(lambda message, number=number: self.take(number, message))

    def registerCallback(self, callback: Any) -> None:
        self.callback = callback

    def take(self, number: int, message: Any) -> None:
        at = lambda one: Time.from_msg(one.header.stamp) * 1e-9
        self.waiting[number].append(message)
        for other in self.waiting[1 - number]:
            if abs(at(other) - at(message)) <= self.slop:
                self.callback(*((message, other) if number == 0 else (other, message)))


def subscriber(node: Node, kind: type, topic: str, **options: Any) -> list:
    """A list of callbacks that a message goes to."""
    callbacks: list = []
    node.create_subscription(kind, topic, lambda m: [one(m) for one in callbacks], **options)
    return callbacks


def modules() -> dict[str, ModuleType]:
    """All modules that a node imports, by their names."""
    anything = lambda *args, **options: SimpleNamespace()
    contents: dict[str, dict[str, Any]] = {
        "nav2_msgs": {},
        "nav2_msgs.action": {"NavigateToPose": NavigateToPose},
        "rclpy.action": {"ActionClient": ActionClient},
        "std_srvs": {},
        "std_srvs.srv": {"Trigger": Trigger},
        "rclpy": {"init": anything, "try_shutdown": anything},
        "rclpy.callback_groups": {"MutuallyExclusiveCallbackGroup": anything},
        "rclpy.executors": {"MultiThreadedExecutor": anything},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {
            "DurabilityPolicy": SimpleNamespace(TRANSIENT_LOCAL=1),
            "QoSProfile": anything,
            "qos_profile_sensor_data": None,
        },
        "rclpy.signals": {"SignalHandlerOptions": SimpleNamespace(NO=0)},
        "rclpy.task": {"Future": Done},
        "rclpy.time": {"Time": Time},
        "message_filters": {
            "Subscriber": subscriber,
            "ApproximateTimeSynchronizer": Synchronizer,
        },
        "tf2_ros": {
            "Buffer": Buffer,
            "TransformListener": anything,
            "TransformException": TransformException,
        },
    }
    for package, names in MESSAGES.items():
        kinds = {name: message_class(f"{package}/msg/{name}") for name in names}
        contents |= {package: {}, f"{package}.msg": kinds}
    found = {}
    for name, content in contents.items():
        found[name] = ModuleType(name)
        vars(found[name]).update(content)
    return found


@contextmanager
def ros2(**parameters: Any) -> Iterator[None]:
    """Puts the modules where an import finds them, and gives nodes their parameters."""
    before = {name: sys.modules.get(name) for name in modules()}
    sys.modules.update(modules())
    Node.parameters, ActionClient.is_ready = parameters, True
    sys.path.insert(0, str(PACKAGE))
    try:
        yield
    finally:
        sys.path.remove(str(PACKAGE))
        for name in [name for name in sys.modules if name.partition(".")[0] == PACKAGE.name]:
            del sys.modules[name]
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module
