"""The part of a rig's file that describes its force sensor."""

from typing import Literal

import pydantic

from softfin.core.configuration import Configuration
from softfin.data.importing.importing import FORCE_FRAMES

ADDRESS_FIELDS = ("address", "http_port", "rdt_port")
"""Fields that only give the sensor's address, which may change at any time; the others determine
what its readings mean."""


class Axia80Config(Configuration):
    """An ATI Axia80 with an Ethernet socket; the defaults are its factory settings."""

    address: str = pydantic.Field(min_length=1)
    """IP address or name of the sensor; the factory setting is 192.168.1.1."""
    frame: Literal[FORCE_FRAMES]  # type: ignore[valid-type]
    """softfin's +x (thrust that pushes the robot forward) and +y in the sensor's own axes, as
    ``y,-x``; z follows by the right-hand rule. It depends on how the sensor is mounted, so it has
    no default."""
    http_port: int = pydantic.Field(default=80, ge=1, le=65535)
    """TCP port of the sensor's web pages, where its units and scale are read."""
    rdt_port: int = pydantic.Field(default=49152, ge=1, le=65535)
    """UDP port of the sensor's stream."""
    rate_hz: float = pydantic.Field(default=1000.0, ge=200, le=8000)
    """Records per second that the sensor is set to send [Hz]; ten per row of a log leave room for
    the filter. softfin measures the rate when it opens the sensor, and refuses one that differs by
    more than 10%."""
    cutoff_hz: float = pydantic.Field(default=30.0, ge=10, le=40)
    """Cut-off of the anti-alias filter, where its gain is 1/2 [Hz]; 30 passes signals below 10
    Hz and delays the force by 34 ms."""
    product: str | None = None
    """Product name that the sensor must report; None accepts any."""
    serial: str | None = None
    """Serial number of its calibration that the sensor must report; None accepts any."""
