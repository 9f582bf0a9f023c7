"""A CAN bus within the process, in simulated time; `open_bus` gives that or the one that python-can reaches."""

import copy
from collections import deque
from weakref import WeakKeyDictionary

import can

from softfin.core.clock import Clock
from softfin.core.configuration import Configuration
from softfin.rig.simulated_clock import SimulatedClock

SIMULATED = "simulated"
"""Interface of a rig's file."""

_channels: WeakKeyDictionary[SimulatedClock, dict[str, list["SimulatedBus"]]] = WeakKeyDictionary()


def open_bus(config: Configuration, clock: Clock) -> can.BusABC:
    """Open the bus of an `epos2.config.BusConfig`, whose fields are the arguments of python-can, and raise its errors.

    On a simulated clock it is that of this process, whatever the interface.
    """
    settings = config.model_dump()
    if isinstance(clock, SimulatedClock):
        return SimulatedBus(clock, settings["channel"])
    return can.Bus(**settings.pop("options"), **settings)


class SimulatedBus(can.BusABC):
    """Everybody on a channel of a clock gets what the others send, at once and in order."""

    def __init__(self, clock: SimulatedClock, channel: str) -> None:
        super().__init__(channel)
        self.channel_info = f"{SIMULATED} {channel}"
        self._clock = clock
        self._news = clock.event()
        self._frames: deque[can.Message] = deque()
        self._all = _channels.setdefault(clock, {}).setdefault(channel, [])
        self._all.append(self)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame; raises CanOperationError once the bus is shut down."""
        self._check_open()
        for bus in list(self._all):
            if bus is not self:
                message = copy.copy(msg)
                message.timestamp = self._clock()
                bus._frames.append(message)
                bus._news.set()

    def shutdown(self) -> None:
        """Shut down, any number of times; whoever waits for a frame is woken."""
        super().shutdown()
        if self in self._all:
            self._all.remove(self)
        self._news.set()

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next frame, None where none comes in so many seconds; raises CanOperationError once it is shut down."""
        # Cleared before the look, so that what comes in between wakes it.
        self._news.clear()
        if not self._frames and self in self._all:
            self._news.wait(timeout)
        self._check_open()
        return self._frames.popleft() if self._frames else None

    def _check_open(self) -> None:
        if self not in self._all:
            raise can.CanOperationError("the bus is shut down")
