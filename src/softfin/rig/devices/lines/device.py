"""The type `lines`: a sensor that sends lines of text."""

from softfin.rig.device_type import ForceSensorType
from softfin.rig.devices.lines.config import LinesConfig
from softfin.rig.devices.lines.sensor import lines_sensor

LINES = ForceSensorType(LinesConfig, lines_sensor)
