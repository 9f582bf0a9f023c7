"""The type `axia80`: an ATI Axia80."""

from softfin.rig.device_type import ForceSensorType
from softfin.rig.devices.axia80.config import Axia80Config
from softfin.rig.devices.axia80.sensor import axia80_sensor

AXIA80 = ForceSensorType(Axia80Config, axia80_sensor)
