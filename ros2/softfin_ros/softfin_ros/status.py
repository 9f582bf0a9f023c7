"""Publishes the state of a fin and the reason of its stop, in every state of the life cycle. Does
not import rclpy. All calls are made from the thread of the loop."""

import time
from collections.abc import Callable

from softfin.core.errors import DeviceError
from softfin.rig.ros2.connection import Publisher, Transport
from softfin.rig.ros2.inputs import OnceReporter
from softfin.rig.session import SessionState
from softfin.storage.bag.messages import STRING, cdr
from softfin_ros.diagnostics import DIAGNOSTICS, FinDiagnostics, encode_diagnostics

DIAGNOSTICS_TOPIC = "/diagnostics"
"""All fins of a robot use this topic."""


class FinStatus(FinDiagnostics):
    """Diagnostics once per second and after each change, and the latched reason of the stop."""

    def __init__(
        self,
        transport: Transport,
        stop_reason_topic: str,
        source: str,
        report: Callable[[str], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Publish that there is no stop; `source` is the name of the fin."""
        super().__init__(clock)
        self._stop_reason = transport.publish(stop_reason_topic, STRING, latched=True)
        self._diagnostics = transport.publish(DIAGNOSTICS_TOPIC, DIAGNOSTICS)
        self._source = source
        self._once = OnceReporter(report)
        self._send(self._stop_reason, cdr(STRING, 0, ""))

    def update(self, state: SessionState, reason: str) -> None:
        """Publish a change of the state or of the reason of the stop, which is empty if there is
        none, and the diagnostics if they are due."""
        is_new = (state, reason) != (self.state, self.reason)
        if reason != self.reason:
            self._send(self._stop_reason, cdr(STRING, 0, reason))
        self.state = state
        self.reason = reason
        if is_new or self.is_due():
            message = encode_diagnostics(time.time_ns(), self._source, self.take())
            self._send(self._diagnostics, message)

    def _send(self, publisher: Publisher, data: bytes) -> None:
        try:
            publisher.send(data)
        except DeviceError as error:
            self._once(str(error))
