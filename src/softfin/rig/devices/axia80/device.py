"""The type `axia80`: an ATI Axia80 and its emulator."""

from softfin.core.choices import LOOPBACK
from softfin.core.clock import Clock
from softfin.rig.device import EmulatedDevice, ForceSensorType
from softfin.rig.devices.axia80.config import Axia80Config
from softfin.rig.devices.axia80.sensor import axia80_sensor
from softfin.rig.emulated_fin import SENSOR_MOUNTING, EmulatedFin
from softfin.rig.simulated_clock import SimulatedClock


def _emulated_config() -> Axia80Config:
    return Axia80Config(address=LOOPBACK, frame=SENSOR_MOUNTING)


def _emulate(config: Axia80Config, fin: EmulatedFin, clock: Clock) -> EmulatedDevice:
    # Imported here because a real rig does not need it.
    from softfin.rig.devices.axia80.emulated_sensor import EmulatedAxia80

    # In simulated time, the sensor can use its factory ports, because they exist only within this
    # process.
    ports = (49152, 80) if isinstance(clock, SimulatedClock) else (0, 0)
    return EmulatedAxia80(fin, *ports, frame=SENSOR_MOUNTING, clock=clock)


AXIA80 = ForceSensorType(Axia80Config, axia80_sensor, _emulated_config, _emulate)
