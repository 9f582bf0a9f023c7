"""A whole emulated rig on this computer: drive, sensor and the virtual tank behind both, and the rig's file for it.

In simulated time, the default, everything is within the process. In real time softfin reaches the drive over
python-can's virtual bus within one process, over socketcand on loopback from another, and the sensor over UDP and HTTP.
"""

import uuid
from pathlib import Path
from typing import Any

import yaml

from softfin.core.clock import Clock
from softfin.rig.config import RigConfig
from softfin.rig.emulation.bus import SocketcandServer
from softfin.rig.emulation.drive import EmulatedDrive
from softfin.rig.emulation.fin import EmulatedFin
from softfin.rig.emulation.sensor import EmulatedAxia80
from softfin.rig.emulation.tank import TankFin
from softfin.rig.epos2.config import BusConfig, Epos2Config
from softfin.rig.simulated_bus import SIMULATED
from softfin.rig.simulated_clock import SimulatedClock
from softfin.storage import artifact as artifacts
from softfin.tank import Tank

HOST = "127.0.0.1"

FRAME = "y,-x"
"""How the emulated sensor is mounted; not as softfin's axes, so that nobody's frame is right by chance."""


RDT_PORT, HTTP_PORT = 49152, 80
"""Of a sensor as it is delivered."""

PATIENT = {"overrun_s": 0.3, "stale_s": 0.3, "force_stale_s": 0.4, "watchdog_s": 0.8}
"""Limits for emulators in real time that share their computer with browsers and compilers; a real fin deserves the
defaults, and in simulated time nothing is late."""

HEARTBEAT_S = 1.0
"""Likewise."""


class EmulatedRig:
    """Serves from `start` until `close`; in simulated time unless it is given a real clock."""

    def __init__(
        self,
        tank: Tank | None = None,
        seed: int = 0,
        fin: EmulatedFin | None = None,
        channel: str | None = None,
        clock: Clock | None = None,
    ) -> None:
        """`fin` in place of a tank, on the same clock; `channel` of the bus, a new one for each rig by default.

        Without a clock, on a simulated one of its own.
        """
        tank = (tank or Tank()) if fin is None else None
        self.clock = clock or SimulatedClock()
        self.fin = fin or TankFin(tank, seed, self.clock)
        channel = channel or f"emulated-{uuid.uuid4().hex[:8]}"
        simulated = isinstance(self.clock, SimulatedClock)
        drive = _drive(tank, real_time=not simulated)
        self.drive = EmulatedDrive(BusConfig(interface="virtual", channel=channel), drive, self.fin, self.clock)
        self.server = None if simulated else SocketcandServer(channel)
        # Within the process nobody else has the ports that a real one has.
        ports = (0, 0) if self.server else (RDT_PORT, HTTP_PORT)
        self.sensor = EmulatedAxia80(self.fin, HOST, *ports, frame=FRAME, clock=self.clock)
        self._channel, self._config = channel, drive
        self._ended = self.clock.event()

    def start(self) -> None:
        """Power-up."""
        self.drive.start()
        if self.server is not None:
            self.server.start()

    def close(self) -> None:
        """Power-down; any number of times."""
        self._ended.set()
        if self.server is not None:
            self.server.close()
        self.drive.close()
        self.sensor.close()

    def __enter__(self) -> "EmulatedRig":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def wait(self) -> None:
        """Until `close`, or Ctrl-C."""
        while not self._ended.wait(0.5):
            pass

    def described(self) -> str:
        """Where it listens, in words."""
        bus = f"socketcand {HOST}:{self.server.port}" if self.server else "in this process"
        return (
            f"drive: {bus}, node {self._config.node}; sensor: {HOST}, RDT port "
            f"{self.sensor.rdt_port}, pages at http://{HOST}:{self.sensor.http_port}"
        )

    def bus(self, same_process: bool) -> dict[str, Any]:
        """Of the rig's file."""
        if self.server is None:
            return {"interface": SIMULATED, "channel": self._channel}
        if same_process:
            return {"interface": "virtual", "channel": self._channel}
        return {"interface": "socketcand", "channel": self._channel,
                "options": {"host": HOST, "port": self.server.port, "tcp_tune": True}}  # fmt: skip

    def values(self, same_process: bool = False, **changes: Any) -> dict[str, Any]:
        """What the rig's file holds."""
        sensor = {"http_port": self.sensor.http_port, "rdt_port": self.sensor.rdt_port}
        values = _values(self._config, self.bus(same_process), sensor)
        if self.server is not None:
            values["safety"] |= PATIENT
        return values | changes

    def config(self, **changes: Any) -> RigConfig:
        """For this process."""
        return RigConfig.build(self.values(same_process=True, **changes), "emulated rig")

    def write(self, path: Path) -> None:
        """The rig's file, for other processes; of a rig in real time."""
        _write(path, "An emulated rig, while `softfin rig emulate --real-time` runs", self.values())


def write_simulated(path: Path, tank: Tank, values: dict[str, Any], seed: int) -> None:
    """The file of a rig that each command emulates itself, in simulated time; `values` are the tank's, as in a file."""
    emulation = {"seed": seed, "tank": values}
    rig = _values(_drive(tank, real_time=False), {"interface": SIMULATED, "channel": "emulated"}, {})
    _write(path, "An emulated rig in simulated time, within each command", {**rig, "emulation": emulation})


def _write(path: Path, what: str, values: dict[str, Any]) -> None:
    text = f"# {what}; a real one is described in docs/rig.md.\n"
    artifacts.write_file(path, text + yaml.safe_dump(values, sort_keys=False))


def _values(drive: Epos2Config, bus: dict[str, Any], sensor: dict[str, Any]) -> dict[str, Any]:
    return {
        "fin": "emulated",
        "bus": bus,
        "drive": drive.model_dump(mode="json", exclude_defaults=True),
        "sensor": {"address": HOST, **sensor, "frame": FRAME},
        "safety": {"current_peak_a": 6.0, "current_sustained_a": 3.0},
        "settle_s": 1.0,
    }


def _drive(tank: Tank | None, real_time: bool) -> Epos2Config:
    """As the tank's drive is: 500 lines at a reduction of 111:1 are its encoder's steps."""
    changes: dict[str, float] = {"heartbeat_s": HEARTBEAT_S} if real_time else {}
    if tank is not None:
        limits = tank.limits
        changes |= {
            "angle_min_rad": limits.angle_min, "angle_max_rad": limits.angle_max,
            "slowest_rad_s": limits.velocity_min, "fastest_rad_s": limits.velocity_max,
            "acceleration_rad_s2": float(tank.drive.acceleration),
        }  # fmt: skip
    return Epos2Config.build(
        {"node": 1, "encoder_lines": 500, "gear_ratio": 111.0, "acceleration_rad_s2": 80.0, "quick_stop_rad_s2": 80.0,
         "following_error_rad": 0.5, **changes},
        "emulated drive",
    )  # fmt: skip
