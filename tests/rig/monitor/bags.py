"""Bags as a run records them, with the bytes at hand."""

import io

from softfin.storage.bag.messages import (
    COMMAND,
    CURRENT,
    ESTIMATE,
    EVENTS,
    HALF_WIDTH,
    JOINT,
    LEVEL,
    REFERENCE,
    WRENCH,
    BagWriter,
)

START_NS = 1_700_000_000 * 10**9


class Recording:
    """Rows at 100 Hz, chunk by chunk."""

    def __init__(self):
        self.stream = io.BytesIO()
        self.bag = BagWriter(self.stream)
        self.bag.flush()
        self.ends = [len(self.stream.getvalue())]
        self.tick = 0

    def at(self, tick):
        return START_NS + tick * 10_000_000

    def chunk(
        self, ticks, force=(1.0, -0.5), reference=None, event=None, estimate=None, load=(0.1, 0.25)
    ):
        """`load` is the velocity [rad/s] and the torque about the shaft [N m], or a function of the
        tick."""
        if reference is not None:
            self.bag.write(REFERENCE, self.at(self.tick), (*reference, 0.0, 0.0, 0.0, 0.0))
        if event is not None:
            self.bag.write(EVENTS, self.at(self.tick), event)
        for _ in range(ticks):
            now = self.at(self.tick)
            if self.tick % 33 == 0 and estimate is not None:
                force_n, half_width_n, level = estimate
                self.bag.write(ESTIMATE, now, (*force_n, 0.0, 0.0, 0.0, 0.0))
                self.bag.write(HALF_WIDTH, now, (*half_width_n, 0.0, 0.0, 0.0, 0.0))
                self.bag.write(LEVEL, now, (level,))
            if self.tick % 33 == 0:
                self.bag.write(COMMAND, now, (0.5, 2.0))
            velocity, torque = load(self.tick) if callable(load) else load
            self.bag.write(JOINT, now, (0.001 * self.tick, velocity))
            self.bag.write(CURRENT, now, (0.25,))
            self.bag.write(WRENCH, now, (*force, 0.0, 0.0, 0.0, torque))
            self.tick += 1
        self.bag.flush()
        self.ends.append(len(self.stream.getvalue()))
        return self

    def skip(self, ticks):
        self.tick += ticks
        return self

    def finish(self):
        self.bag.finish()
        return self

    @property
    def bytes(self):
        return self.stream.getvalue()
