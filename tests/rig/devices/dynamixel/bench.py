"""What the tests of the servo share: a configuration, a drive with its emulator behind it."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any, NamedTuple

from softfin.emulation.clock import SimulatedClock
from softfin.emulation.dynamixel import EmulatedServo
from softfin.rig.devices.dynamixel.config import DynamixelConfig
from softfin.rig.devices.dynamixel.drive import Dynamixel
from tests.rig.braking_fin import BrakingFin

QUICK_STOP_RAD_S2 = 60.0


def servo_config(**changes: Any) -> DynamixelConfig:
    values = {
        "port": "simulated",
        "model": "XM430-W350",
        "id": 7,
        "acceleration_rad_s2": 30.0,
        "quick_stop_rad_s2": QUICK_STOP_RAD_S2,
    }
    return DynamixelConfig(**{**values, **changes})


class Bench(NamedTuple):
    drive: Dynamixel
    servo: EmulatedServo
    fin: BrakingFin
    clock: SimulatedClock

    def loop(self, seconds: float) -> None:
        """The loop for a time [s]."""
        for _ in range(round(seconds / 0.01)):
            self.clock.sleep(0.01)
            self.drive.read()


@contextmanager
def bench(**changes: Any) -> Iterator[Bench]:
    clock = SimulatedClock()
    config = servo_config(**changes)
    fin = BrakingFin(config.quick_stop_rad_s2, clock)
    with closing(EmulatedServo(config, fin, clock)) as servo:
        drive = Dynamixel(config, clock)
        try:
            yield Bench(drive, servo, fin, clock)
        finally:
            drive.close()


@contextmanager
def enabled(**changes: Any) -> Iterator[Bench]:
    with bench(**changes) as made:
        made.drive.open()
        made.drive.zero()
        made.drive.enable()
        yield made
