"""A transport without a network, for tests of what stands on it."""

from collections import defaultdict

from softfin.core.errors import DeviceError
from softfin.rig.ros2.messages import Messages
from softfin.rig.ros2.transport import Publisher, Received


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
        self.waiting[topic].append(Received(data, self.clock() if at is None else at))
