"""Emulated rigs for tests: in simulated time, but for the few that are reached over sockets from
another process."""

import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml

from softfin.cli import main
from softfin.emulation.clock import SimulatedClock
from softfin.emulation.epos2.objects import values as drive_values
from softfin.emulation.rig import EmulatedRig, rigs
from softfin.rig.computer import COMPUTER
from softfin.rig.config import RigConfig, load_rig
from softfin.rig.devices.epos2 import protocol
from softfin.rig.record import RigRecord, StopProof, save_record
from softfin.rig.rig import Rig
from softfin.rig.robot_setup import RobotSetup
from softfin.tank import Tank
from tests.rig.simple_fin import SimpleFin

SAFETY = {"current_peak_a": 20.0, "current_sustained_a": 10.0, "acceleration_rad_s2": 1e5}
"""The simple fin is as fast as it likes at once."""

WIDE = {
    "overrun_s": 1.0,
    "stale_s": 1.0,
    "force_stale_s": 1.0,
    "watchdog_s": 2.0,
    "following_s": 2.0,
}
"""For real time, because the machine that runs the tests is shared."""


def values_of(behind: EmulatedRig, **safety: Any) -> dict[str, Any]:
    """What the file of an emulated rig holds, for this process."""
    values = behind.values(safety=SAFETY | safety, settle_s=0.1)
    values["drive"] |= {"zero_needed": False}
    return values


def config_of(behind: EmulatedRig, **values: Any) -> RigConfig:
    """The configuration for this process: in real time, too, the bus is within it."""
    bus = {"interface": "virtual", "channel": behind.channel}
    return RigConfig.build(behind.values(bus=bus, **values), "emulated rig")


@contextmanager
def emulated(
    tank: Tank | None = None, drive: str = "epos2", **safety: Any
) -> Iterator[tuple[EmulatedRig, RobotSetup]]:
    """With a fin that needs no JAX, unless a tank is given."""
    with simulated(tank, drive=drive) as behind:
        values = values_of(behind, **safety)
        yield (
            behind,
            robot_of(behind, **{name: value for name, value in values.items() if name != "bus"}),
        )


@contextmanager
def simulated(
    tank: Tank | None = None, sensor: str = "axia80", drive: str = "epos2"
) -> Iterator[EmulatedRig]:
    """Likewise, without the host's side."""
    clock = SimulatedClock()
    fin = None if tank else SimpleFin(clock)
    with EmulatedRig(tank, fin=fin, clock=clock, sensor=sensor, drive=drive) as behind:
        yield behind


def robot_of(behind: EmulatedRig, **values: Any) -> RobotSetup:
    config = config_of(behind, **values)
    return RobotSetup(
        Rig(config, behind.clock),
        config.safety,
        config.fin,
        config.settle_s,
        config.feedback,
        config.model_dump(mode="json"),
    )


@contextmanager
def filed(behind: EmulatedRig, path: Path, **safety: Any) -> Iterator[Path]:
    """Its file, for the command line in this process."""
    path.write_text(yaml.safe_dump(values_of(behind, **safety) | {"emulation": {}}))
    prove(path)
    rigs[path.resolve()] = behind
    try:
        yield path
    finally:
        del rigs[path.resolve()]


@contextmanager
def over_sockets(path: Path, sensor: str = "axia80") -> Iterator[EmulatedRig]:
    """A rig in real time and its file, for the command line in another process; a sensor that sends
    lines is on a pseudo-terminal."""
    with (
        patient(),
        unshared_loopback(),
        EmulatedRig(fin=SimpleFin(), clock=COMPUTER, sensor=sensor) as behind,
    ):
        values = behind.values(safety=SAFETY | WIDE, settle_s=0.1)
        values["drive"] |= {"heartbeat_s": 1.0, "sync_s": 0.02, "zero_needed": False}
        path.write_text(yaml.safe_dump(values))
        prove(path)
        yield behind


def prove(path: Path) -> None:
    """Record that the emulated drive of a rig's file stops by itself, as `softfin rig check
    --prove` would."""
    config = load_rig(path)
    proof = StopProof(
        date="2026-01-01T00:00:00+00:00",
        drive={
            "type": config.drive.type,
            "node": config.drive.node,
            "serial": drive_values(config.drive)[protocol.SERIAL_NUMBER],
        },
        heartbeat_s=config.drive.heartbeat_s,
        host_node=config.drive.host,
        faulted_after_s=config.drive.heartbeat_s,
    )
    save_record(config.file, RigRecord(stop_proof=proof))


@contextmanager
def emulated_by_command(file: Path, *options: str) -> Iterator[Path]:
    """The file of a rig that `softfin rig emulate` has written; emulation ends afterwards."""
    main(["rig", "emulate", "--rig", str(file), *options])
    yield file
    emulated = rigs.pop(file.resolve(), None)
    if emulated is not None:
        emulated.close()


@contextmanager
def unshared_loopback() -> Iterator[None]:
    """Put emulated Axia80s at an address of their own. A sensor streams to whoever asked last, and
    a client whose sensor is gone keeps asking: in other tests on this computer, that may be at the
    same port. All of 127/8 is local."""
    address = ".".join(["127", *(str(secrets.randbelow(253) + 1) for _ in range(3))])
    with pytest.MonkeyPatch.context() as patches:
        patches.setattr("softfin.emulation.axia80.LOOPBACK", address)
        yield


@contextmanager
def patient() -> Iterator[None]:
    """On a busy machine an emulated sensor in real time is silent at times; no more than its age is
    judged then."""
    with pytest.MonkeyPatch.context() as patches:
        patches.setattr("softfin.rig.streamed_sensor.SILENT_S", 2.0)
        yield
