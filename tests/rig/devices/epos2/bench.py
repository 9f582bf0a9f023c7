"""What the tests of the drive share: a configuration, a drive with its emulator behind it, frames
made by hand."""

import struct
import uuid
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import Any, NamedTuple

import can

from softfin.emulation.clock import SimulatedClock
from softfin.emulation.epos2.drive import USUAL, DriveTraits, EmulatedDrive
from softfin.rig.bus import BusConfig
from softfin.rig.devices.epos2.config import Epos2Config
from softfin.rig.devices.epos2.drive import Epos2
from tests.rig.simple_fin import SimpleFin

NODE = 5
LONG_S = 5.0


def drive_config(**changes: Any) -> Epos2Config:
    values = {
        "node": NODE,
        "encoder_lines": 500,
        "gear_ratio": 66.0,
        "acceleration_rad_s2": 30.0,
        "quick_stop_rad_s2": 60.0,
        "following_error_rad": 0.2,
    }
    return Epos2Config(**{**values, **changes})


def bus_config() -> BusConfig:
    return BusConfig(interface="virtual", channel=f"test {uuid.uuid4()}")


def block(fin: Any) -> None:
    """The fin stays where it is while its profile goes on."""
    free = fin.now
    angle = fin.now().angle
    fin.now = lambda: free()._replace(angle=angle, velocity=0.0)


def ignore_targets(drive: EmulatedDrive, count: int) -> None:
    """It takes none of the next targets, as if their frames were lost."""
    control = drive.motor.control
    left = [count]

    def partly(word: int, before: int) -> None:
        if word & ~before & 0x10 and left[0]:
            left[0] -= 1
        else:
            control(word, before)

    drive.motor.control = partly  # type: ignore[method-assign]


class Bench(NamedTuple):
    drive: Epos2
    emulated: EmulatedDrive
    fin: SimpleFin
    bus: BusConfig
    faults: list[str]
    clock: SimulatedClock

    def until(self, true: Callable[[], bool]) -> bool:
        """The loop, until something is true or the time is over."""
        for _ in range(round(LONG_S / 0.005)):
            self.drive.send_heartbeat()
            self.drive.sync_and_read(0.02)
            if true():
                return True
            self.clock.sleep(0.005)
        return False


@contextmanager
def bench(
    emulated: Epos2Config | None = None, traits: DriveTraits = USUAL, **changes: Any
) -> Iterator[Bench]:
    clock = SimulatedClock()
    config = drive_config(**changes)
    bus = bus_config()
    fin = SimpleFin(clock)
    faults = []
    with closing(EmulatedDrive(bus, emulated or config, fin, clock, traits)) as behind:
        drive = Epos2(bus, config, clock, on_fault=faults.append)
        try:
            yield Bench(drive, behind, fin, bus, faults, clock)
        finally:
            drive.close()


@contextmanager
def enabled(**changes: Any) -> Iterator[Bench]:
    with bench(**changes) as made:
        made.drive.open()
        made.drive.zero()
        made.drive.enable()
        yield made


class Sniffer:
    """All frames of a bus, each with the time that it came."""

    def __init__(self, made: Bench) -> None:
        self._bus = made.clock.open_bus(made.bus)
        self._clock = made.clock
        self._frames: list[tuple[float, int, bytes]] = []

    @property
    def frames(self) -> list[tuple[float, int, bytes]]:
        """Until now."""
        while message := self._bus.recv(0.0):
            self._frames.append((message.timestamp, message.arbitration_id, bytes(message.data)))
        return self._frames

    def send(self, cob_id: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))

    def controlwords(self) -> list[int]:
        """By process data."""
        return [
            struct.unpack("<Hi", data)[0]
            for _, cob_id, data in self.frames
            if cob_id == 0x200 + NODE
        ]

    def __enter__(self) -> "Sniffer":
        return self

    def __exit__(self, *_: object) -> None:
        self._bus.shutdown()
