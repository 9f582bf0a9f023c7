"""A transport without a network, for tests of what stands on it, and messages made by rosbags' general serialiser."""

from collections import defaultdict

import numpy as np
from rosbags.interfaces import Nodetype

from softfin.core.errors import DeviceError
from softfin.rig.ros2.connection import Publisher
from softfin.rig.ros2.plant import define_types
from softfin.storage.bag.messages import build_message

JOINT, WRENCH = "sensor_msgs/msg/JointState", "geometry_msgs/msg/WrenchStamped"


class Messages:
    """Messages of ROS 2's types, and of others by their definition."""

    def __init__(self, definitions=None, types=None):
        self.types = types or define_types(definitions or {})

    def make(self, kind, *values):
        return self.types.types[kind](*values)

    def encode(self, message):
        return bytes(self.types.serialize_cdr(message, message.__msgtype__))

    def decode(self, data, kind):
        return self.types.deserialize_cdr(data, kind)

    def blank(self, kind):
        return build_message(self.types, (Nodetype.NAME, kind), {})

    def header(self, stamp_ns, frame):
        return self.make(
            "std_msgs/msg/Header", self.make("builtin_interfaces/msg/Time", *divmod(stamp_ns, 10**9)), frame
        )

    def joint(self, stamp_ns, frame, name, angle, velocity):
        return self.make(
            JOINT, self.header(stamp_ns, frame), [name], np.array([angle]), np.array([velocity]), np.zeros(0)
        )

    def wrench(self, stamp_ns, frame, wrench):
        parts = (self.make("geometry_msgs/msg/Vector3", *map(float, part)) for part in (wrench[:3], wrench[3:]))
        return self.make(WRENCH, self.header(stamp_ns, frame), self.make("geometry_msgs/msg/Wrench", *parts))


class MemoryTransport:
    """Meets the Transport contract: what others say is put by the test, what is sent is kept."""

    notes = ("in memory",)

    def __init__(self, clock=lambda: 0.0):
        self.messages = Messages()
        self.clock = clock
        self.sent = defaultdict(list)
        self.waiting = defaultdict(list)
        self.asked = {}
        self.readers = defaultdict(lambda: 1)
        self.closed = False
        self.failing = False

    def publish(self, topic, kind):
        def send(data):
            if self.failing:
                raise DeviceError(f"{topic}: not sent")
            known = kind in self.messages.types.fielddefs
            self.sent[topic].append(self.messages.decode(data, kind) if known else data)

        return Publisher(send, lambda: self.readers[topic])

    def subscribe(self, topic, kind, best_effort=False):
        self.asked[topic] = (kind, best_effort)

        def take():
            if self.failing:
                raise DeviceError("the transport has stopped")
            taken, self.waiting[topic] = self.waiting[topic], []
            return taken

        return take

    def topics(self):
        return {"/somebody": "std_msgs/msg/Bool"}

    def close(self):
        self.closed = True

    def put(self, topic, message, at=None):
        data = message if isinstance(message, bytes) else self.messages.encode(message)
        self.waiting[topic].append((data, self.clock() if at is None else at))
