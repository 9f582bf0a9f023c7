"""A transport without a network, for tests of what stands on it."""

from collections import defaultdict

from softfin.core.errors import DeviceError
from softfin.rig.ros2.messages import Messages
from softfin.rig.ros2.transport import Received


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
        return MemoryPublisher(self, topic, kind)

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
        self.waiting[topic].append(Received(data, self.clock() if at is None else at))


class MemoryPublisher:
    def __init__(self, transport, topic, kind):
        self.transport, self.topic, self.kind = transport, topic, kind

    def send(self, data):
        if self.transport.failing:
            raise DeviceError(f"{self.topic}: not sent")
        if self.kind in self.transport.messages.types.fielddefs:
            self.transport.sent[self.topic].append(self.transport.messages.decode(data, self.kind))
        else:
            self.transport.sent[self.topic].append(data)

    def readers(self):
        return self.transport.readers[self.topic]
