"""A transport without a network, for tests of what stands on it, and messages made by rosbags'
general serialiser."""

from collections import defaultdict

import numpy as np
from rosbags.interfaces import Nodetype

from softfin.core.errors import DeviceError
from softfin.rig.ros2.connection import DEPTH, Publisher, Subscriber
from softfin.rig.ros2.plant import define_types
from softfin.storage.bag.messages import build_message

HEARD_BY = {
    "reliable": ("reliable", "best_effort"),
    "best_effort": ("best_effort",),
    "latched": ("reliable", "best_effort", "latched"),
    "from before": ("latched",),
}
"""Readers that hear a publisher, by what it offers; "from before" is latched and was sent before
they were there."""

JOINT = "sensor_msgs/msg/JointState"
WRENCH = "geometry_msgs/msg/WrenchStamped"


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
            "std_msgs/msg/Header",
            self.make("builtin_interfaces/msg/Time", *divmod(stamp_ns, 10**9)),
            frame,
        )

    def joint(self, stamp_ns, frame, name, angle, velocity):
        return self.make(
            JOINT,
            self.header(stamp_ns, frame),
            [name],
            np.array([angle]),
            np.array([velocity]),
            np.zeros(0),
        )

    def wrench(self, stamp_ns, frame, wrench):
        parts = (
            self.make("geometry_msgs/msg/Vector3", *map(float, part))
            for part in (wrench[:3], wrench[3:])
        )
        return self.make(
            WRENCH, self.header(stamp_ns, frame), self.make("geometry_msgs/msg/Wrench", *parts)
        )


class MemoryTransport:
    """Meets the Transport contract: what others say is put by the test, what is sent is kept."""

    notes = ("in memory",)

    def __init__(self, clock=lambda: 0.0):
        self.messages = Messages()
        self.clock = clock
        self.sent = defaultdict(list)
        self.sent_at = defaultdict(list)
        self.order = []
        """Topics of all messages, in the order in which they were sent."""
        self.waiting = defaultdict(list)
        self.asked = defaultdict(list)
        self.latched = {}
        self.deadlines = {}
        self.mismatched = defaultdict(int)
        self.readers = defaultdict(lambda: 1)
        self.publishing = defaultdict(lambda: ["somebody"])
        self.commanders = []
        self.closed = False
        self.failing = False
        self.is_deaf = False
        """Whether nothing is received any more, while messages are still sent."""

    def publish(self, topic, kind, deadline_s=None, latched=False):
        self.latched[topic] = latched
        self.deadlines[topic] = deadline_s

        def send(data):
            if self.failing:
                raise DeviceError(f"{topic}: not sent")
            known = kind in self.messages.types.fielddefs
            self.sent[topic].append(self.messages.decode(data, kind) if known else data)
            self.sent_at[topic].append(self.clock())
            self.order.append(topic)

        return Publisher(send, lambda: self.readers[topic])

    def subscribe(self, topic, kind, quality="reliable", depth=DEPTH):
        self.asked[topic].append((kind, quality))
        taken = 0

        def take():
            nonlocal taken
            if self.failing or self.is_deaf:
                raise DeviceError("the transport has stopped")
            news = self.waiting[topic][taken:]
            taken = len(self.waiting[topic])
            heard = [(data, at) for data, at, offered in news if quality in HEARD_BY[offered]]
            return heard[-depth:]

        return Subscriber(take, lambda: self.mismatched[topic], lambda: self.publishing[topic])

    def topics(self):
        return {"/somebody": "std_msgs/msg/Bool"}

    def publishers(self, topic):
        return self.commanders if topic == "/command" else []

    def close(self):
        self.closed = True

    def put(self, topic, message, at=None, offered="reliable"):
        """Publish a message with an offered quality of service, each reader of which hears it."""
        data = message if isinstance(message, bytes) else self.messages.encode(message)
        self.waiting[topic].append((data, self.clock() if at is None else at, offered))


class TopicDriver:
    """A fin and its driver behind a transport in memory, in simulated time, which can fail as
    drivers do."""

    STEP_S = 0.005

    def __init__(self, clock, transport, delay_s=0.02, acceleration=100.0, dead_man_s=None):
        """`delay_s` is the time from a message to its effect; without a command for `dead_man_s`
        the fin stops."""
        self.clock = clock
        self.transport = transport
        self.delay_s = delay_s
        self.acceleration = acceleration
        self.dead_man_s = dead_man_s
        self.is_there = self.takes_commands = self.takes_stops = True
        self.is_blocked = False
        self.angle = self.velocity = self.target = 0.0
        self.speed = 0.0
        self.commanded_at = -1.0
        self.is_stopped = False
        self.done = defaultdict(int)
        clock.spawn(self._run, "driver")

    def _run(self):
        while True:
            if self.is_there:
                self._listen()
                for _ in range(2):
                    self._move()
                    self.clock.sleep(self.STEP_S)
                self._say()
            else:
                self.clock.sleep(2 * self.STEP_S)

    def _new(self, topic):
        """Messages whose effect is due."""
        times = self.transport.sent_at[topic]
        while (
            self.done[topic] < len(times) and times[self.done[topic]] <= self.clock() - self.delay_s
        ):
            self.done[topic] += 1
            yield self.transport.sent[topic][self.done[topic] - 1]

    def _listen(self):
        for command in self._new("/command"):
            if self.takes_commands:
                self.target = command.position[0]
                self.speed = command.velocity[0]
                self.commanded_at = self.clock()
        for stop in self._new("/stop"):
            if self.takes_stops:
                self.is_stopped = stop.data

    def _move(self):
        rest = self.target - self.angle
        wanted = np.sign(rest) * min(
            self.speed, np.sqrt(2 * self.acceleration * abs(rest)), abs(rest) / self.STEP_S
        )
        is_alone = (
            self.dead_man_s is not None and self.clock() - self.commanded_at > self.dead_man_s
        )
        if self.is_stopped or is_alone:
            wanted = 0.0
        change = self.acceleration * self.STEP_S
        self.velocity += np.clip(wanted - self.velocity, -change, change)
        if self.is_blocked:
            self.velocity = 0.0
        self.angle += self.velocity * self.STEP_S

    def _say(self):
        stamp = round(self.clock.wall() * 1e9)
        messages = self.transport.messages
        self.transport.put("/joint", messages.joint(stamp, "", "fin", self.angle, self.velocity))
        self.transport.put("/wrench", messages.wrench(stamp, "", (0.0,) * 6))
