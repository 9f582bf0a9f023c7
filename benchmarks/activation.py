"""Activations after pauses in which nobody reads the force sensor, over real sockets, with several
receive buffers.

A person types "move" for up to a minute, or a log is written. By default Linux keeps the first 0.5
s of that, so a pause of 1 s is as bad as one of 60 s; the pauses here are 0 to 2 s. A buffer of 4
MiB is not full after them: it then holds the whole pause. Reported are the activations that failed
and the oldest force on which the motor was powered. Options by environment: SOFTFIN_ACTIVATIONS in
all (200).
"""

import itertools
import os
import random
import socket
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.measure import entry
from benchmarks.rig import emulators
from softfin.core.errors import SoftfinError
from softfin.rig.config import RigConfig
from softfin.rig.machine import Sample, Target
from softfin.rig.rig import Rig
from softfin.rig.safety import Guard, SafetyConfig
from softfin.rig.session import Session

ACTIVATIONS = int(os.environ.get("SOFTFIN_ACTIVATIONS", "200"))

BUFFERS_BYTES = (64 * 1024, 212_992, 4 * 1024 * 1024)

PAUSES_S = (0.0, 0.1, 0.3, 0.6, 1.0, 2.0)


class NotedRig(Rig):
    """Notes the age of the force each time that the motor gets its power."""

    def __init__(self, config: RigConfig, room_bytes: int) -> None:
        super().__init__(config)
        self.ages_s: list[float] = []
        self._room_bytes = room_bytes
        self._sample: Sample | None = None

    def open(self) -> None:
        super().open()
        receiver = self.sensor.stream.client._socket
        assert isinstance(receiver, socket.socket)
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, self._room_bytes)

    def read(self) -> Sample:
        self._sample = super().read()
        return self._sample

    def enable(self) -> None:
        assert self._sample is not None
        self.ages_s.append(self.clock() - self._sample.force_time)
        super().enable()


def main() -> list[dict[str, Any]]:
    rows = []
    with tempfile.TemporaryDirectory() as folder, emulators(Path(folder) / "rig.yaml") as wide:
        # The force's limit is the default; the others are wide, for emulators on a shared computer.
        safety = wide.safety.model_copy(update={"force_stale_s": SafetyConfig().force_stale_s})
        config = wide.model_copy(update={"safety": safety})
        for room_bytes in BUFFERS_BYTES:
            rows += _activate(config, room_bytes, ACTIVATIONS // len(BUFFERS_BYTES) + 1)
    return rows


def _activate(config: RigConfig, room_bytes: int, count: int) -> list[dict[str, Any]]:
    draw = random.Random(0)
    pauses = itertools.cycle(draw.sample(PAUSES_S, len(PAUSES_S)))
    ages_s: list[float] = []
    reasons: list[str] = []
    attempts = 0
    while attempts < count:
        rig = NotedRig(config, room_bytes)
        try:
            with Session(rig, Guard(config.safety, rig.limits)) as session:
                while attempts < count:
                    attempts += 1
                    time.sleep(next(pauses))
                    session.activate()
                    session.hold(Target(0.1 * (-1) ** attempts, 1.0), 5)
                    session.deactivate()
        except SoftfinError as error:
            reasons.append(str(error))
        ages_s += rig.ages_s
    name = f"activation, buffer of {room_bytes // 1024} KiB"
    oldest_ms = 1e3 * max(ages_s, default=0.0)
    return [
        entry(
            f"{name}: failures",
            len(reasons),
            "",
            0,
            at_least=False,
            count=attempts,
            reasons=reasons,
        ),
        entry(
            f"{name}: oldest force at power-up",
            oldest_ms,
            "ms",
            50,
            at_least=False,
            count=len(ages_s),
        ),
    ]
