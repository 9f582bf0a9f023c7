"""The type `lines`: a sensor that sends lines of text, and its emulator."""

from softfin.core.choices import LOOPBACK
from softfin.core.clock import Clock
from softfin.emulation.clock import SimulatedClock
from softfin.emulation.fin import SENSOR_MOUNTING, EmulatedFin
from softfin.rig.device import EmulatedDevice, ForceSensorType
from softfin.rig.devices.lines.config import LinesConfig
from softfin.rig.devices.lines.sensor import lines_sensor


def _emulated_config() -> LinesConfig:
    # Imported here because a real rig does not need it.
    from softfin.emulation.lines import EMULATED_COLUMNS, UDP_PORT

    values = {
        "columns": EMULATED_COLUMNS,
        "rate_hz": 320.0,
        "filter_delay_s": 0.0,
        "frame": SENSOR_MOUNTING,
        "address": LOOPBACK,
        "udp_port": UDP_PORT,
    }
    return LinesConfig.build(values, "emulated sensor")


def _emulate(config: LinesConfig, fin: EmulatedFin, clock: Clock) -> EmulatedDevice:
    from softfin.emulation.lines import EmulatedLines

    over = "udp" if isinstance(clock, SimulatedClock) else "serial"
    return EmulatedLines(fin, config.rate_hz, clock, over=over)


LINES = ForceSensorType(LinesConfig, lines_sensor, _emulated_config, _emulate)
