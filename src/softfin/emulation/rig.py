"""A complete emulated rig on this computer: drive, sensor and the virtual tank, and the rig file
for it.

In simulated time, the default, everything runs within one process. In real time, softfin reaches
the drive over python-can's virtual bus within the same process or over socketcand on loopback from
a different process, and the sensor over UDP and HTTP.
"""

import contextlib
import hashlib
import json
import uuid
from pathlib import Path
from typing import Any

import yaml

from softfin.core.choices import LOOPBACK
from softfin.core.errors import ConfigurationError, RigError, one_line
from softfin.core.json_object import JsonObject
from softfin.emulation.bus import SocketcandServer
from softfin.emulation.clock import SimulatedClock
from softfin.emulation.device import (
    DRIVES,
    SENSORS,
    drive_config,
    find_emulator,
    sensor_config,
)
from softfin.emulation.fin import EmulatedFin
from softfin.emulation.network import SIMULATED
from softfin.emulation.tank import TankFin
from softfin.rig.bus import BusConfig
from softfin.rig.computer import COMPUTER, Computer
from softfin.rig.config import RigConfig
from softfin.rig.device import DriveConfig, ForceSensorConfig
from softfin.rig.lock import DeviceLock
from softfin.rig.record import record_file
from softfin.rig.rig import Rig
from softfin.storage import artifact as artifacts
from softfin.tank import Tank, TankConfig

REAL_TIME_SAFETY = {"overrun_s": 0.3, "stale_s": 0.3, "force_stale_s": 0.4, "watchdog_s": 0.8}
"""Relaxed limits for real-time emulation on a computer that also runs browsers and compilers. A
real fin uses the defaults, and nothing is late in simulated time."""


class EmulatedRig(contextlib.ExitStack):
    """An emulated rig, running from construction until `close`, in simulated time unless `clock` is
    a real clock."""

    def __init__(
        self,
        tank: Tank | None = None,
        seed: int = 0,
        fin: EmulatedFin | None = None,
        channel: str | None = None,
        clock: Computer | None = None,
        drive: str = DriveConfig.DEFAULT_TYPE,
        sensor: str = ForceSensorConfig.DEFAULT_TYPE,
    ) -> None:
        """Start the emulation. `fin` replaces the tank and must use the same clock; `channel` is
        the channel of the bus (by default a new channel per rig); `drive` and `sensor` are device
        types."""
        super().__init__()
        self.clock: Computer = clock or SimulatedClock()
        if fin is None:
            tank = tank or Tank()
            fin = TankFin(tank, seed, self.clock)
        self.fin: Any = fin
        self.channel = channel or f"emulated-{uuid.uuid4().hex[:8]}"
        self._sensor = sensor_config(sensor)
        # The protocol type is not used because tests provoke the faults of each emulator.
        self.sensor: Any = find_emulator(SENSORS, sensor).start(self._sensor, self.fin, self.clock)
        self.callback(self.sensor.close)
        self._drive = drive_config(drive, tank, real_time=not self.clock.is_simulated)
        bus = BusConfig(interface="virtual", channel=self.channel)
        self.drive: Any = find_emulator(DRIVES, drive).start(self._drive, bus, self.fin, self.clock)
        self.callback(self.drive.close)
        self.server: SocketcandServer | None = None
        if not self.clock.is_simulated and self._drive.NEEDS_BUS:
            self.server = self.enter_context(SocketcandServer(self.channel))

    def save(self) -> None:
        """Save the state for the next command, if the rig has a file."""

    def connect(self, config: RigConfig) -> Rig:
        """Return the host side of this rig, which saves the state when it is closed."""
        return _HostSide(config, self)

    def description(self) -> str:
        """Describe the addresses of the rig."""
        place = "in this process " if self.clock.is_simulated else ""
        if self.server is not None:
            place = f"socketcand {LOOPBACK}:{self.server.port}"
        drive, sensor = (
            ", ".join(f"{name} {value}" for name, value in device.address().items() if value)
            for device in (self.drive, self.sensor)
        )
        return f"drive: {place}{drive}; sensor: {sensor}"

    def values(self, **changes: object) -> JsonObject:
        """Return the contents of the rig file, with `changes`."""
        bus: JsonObject = {"interface": SIMULATED, "channel": self.channel}
        if self.server is not None:
            options = {"host": LOOPBACK, "port": self.server.port, "tcp_tune": True}
            bus |= {"interface": "socketcand", "options": options}
        values = _rig_values(self._drive, bus, self._sensor)
        values["drive"] |= self.drive.address()
        values["sensor"] |= self.sensor.address()
        if not self.clock.is_simulated:
            values["safety"] |= REAL_TIME_SAFETY
        return values | changes


class _HostSide(Rig):
    """A rig that saves the state of its emulation for the next command."""

    def __init__(self, config: RigConfig, emulated: EmulatedRig) -> None:
        super().__init__(config, emulated.clock)
        self._emulated = emulated

    def close(self) -> None:
        """Stop, release both devices and save the state; raises RunError if it cannot be
        written."""
        super().close()
        self._emulated.save()


rigs: dict[Path, EmulatedRig] = {}
"""Emulated rigs running in this process, keyed by file."""


def kept_rig(config: RigConfig) -> EmulatedRig:
    """Return the emulated rig of a file in the state left by the previous command; raises RigError
    if the rig cannot be emulated."""
    if config.file is None:
        raise RigError(
            "an emulated rig needs a file; write one with softfin rig emulate and load it"
        )
    if config.file not in rigs:
        rigs[config.file] = _KeptRig(config, config.file)
    return rigs[config.file]


def state_file(rig: Path) -> Path:
    """Return the path of the state file, next to the rig file."""
    return rig.with_suffix(".state.json")


class _KeptRig(EmulatedRig):
    """A rig in simulated time with a state file next to its file, for the next command.

    The state consists of the fin position, the motion of the water and the zero of the drive.
    """

    def __init__(self, config: RigConfig, file: Path) -> None:
        assert config.emulation is not None
        try:
            tank = Tank(TankConfig.build(config.emulation.tank, f"{file}: emulation.tank"))
        except ConfigurationError as error:
            raise RigError(str(error)) from None
        # Two simultaneous commands would start from the same state, and the last to finish would
        # overwrite the other's state.
        lock = DeviceLock(
            f"{file}: emulated rig", "emulated", hashlib.sha256(bytes(file)).hexdigest()[:16]
        )
        lock.acquire(COMPUTER)
        super().__init__(
            tank,
            config.emulation.seed,
            channel=None if config.bus is None else config.bus.channel,
            drive=config.drive.type,
            sensor=config.sensor.type,
        )
        self.callback(lock.release)
        self._state = state_file(file)
        self._emulation = config.emulation.model_dump(mode="json")
        self._parts = {"fin": self.fin, "drive": self.drive}
        try:
            if self._state.exists():
                state = json.loads(self._state.read_bytes())
                if state["emulation"] != self._emulation:
                    raise ValueError("state of a different seed or tank")
                for name, part in self._parts.items():
                    part.recall(state[name])
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            self.close()
            raise RigError(
                f"{self._state}: not the state of this emulated rig ({one_line(error)}); remove "
                "it, then zero the rig again"
            ) from None

    def save(self) -> None:
        state = {"emulation": self._emulation} | {
            name: part.remembered() for name, part in self._parts.items()
        }
        artifacts.write_file(self._state, json.dumps(state) + "\n")


def write_simulated(
    path: Path,
    tank: Tank,
    values: JsonObject,
    seed: int,
    drive: str = DriveConfig.DEFAULT_TYPE,
    sensor: str = ForceSensorConfig.DEFAULT_TYPE,
) -> None:
    """Write the file of a rig that each command emulates in simulated time; `values` are the
    contents of the tank file, `drive` and `sensor` the types of its devices."""
    rig = _rig_values(
        drive_config(drive, tank, real_time=False),
        {"interface": SIMULATED, "channel": "emulated"},
        sensor_config(sensor),
    )
    rig["emulation"] = {"seed": seed, "tank": values}
    write_rig(path, rig, "An emulated rig, simulated by each command that uses it")


def write_rig(path: Path, values: JsonObject, comment: str) -> None:
    """Write a rig file, with a comment at the top."""
    # A new rig must not inherit the record of the previous rig.
    record_file(path).unlink(missing_ok=True)
    text = f"# {comment}; for a real rig, see docs/rig.md.\n"
    artifacts.write_file(path, text + yaml.safe_dump(values, sort_keys=False))


# The emulated fin draws 1.1 A at peak and 0.3 A on average over 0.5 s; the emulated drive allows 4
# A and 2 A.
EMULATED_SAFETY = {"current_peak_a": 3.0, "current_sustained_a": 1.5}
"""Current limits that an emulated fin does not exceed, and that trip before the drive limits the
current."""


def _rig_values(drive: DriveConfig, bus: JsonObject, sensor: ForceSensorConfig) -> JsonObject:
    return {
        "fin": "emulated",
        **({"bus": bus} if drive.NEEDS_BUS else {}),
        "drive": {"type": drive.type, **drive.model_dump(mode="json", exclude_defaults=True)},
        "sensor": {"type": sensor.type, **sensor.model_dump(mode="json", exclude_defaults=True)},
        "safety": dict(EMULATED_SAFETY),
        "settle_s": 1.0,
    }
