"""Configuration of the force sensor in a rig file."""

from typing import Literal

import pydantic

from softfin.rig.streamed_sensor import StreamedSensorConfig


class Axia80Config(StreamedSensorConfig):
    """An ATI Axia80 with an Ethernet interface; the address and the ports default to its factory
    settings."""

    type: Literal["axia80"] = "axia80"
    """An Axia80."""
    address: str = pydantic.Field(min_length=1)
    """IP address or host name of the sensor; the factory setting is 192.168.1.1."""
    http_port: int = pydantic.Field(default=80, ge=1, le=65535)
    """TCP port of the sensor web pages, from which units and scale are read."""
    rdt_port: int = pydantic.Field(default=49152, ge=1, le=65535)
    """UDP port of the sensor stream."""
    rate_hz: float = pydantic.Field(default=1000.0, ge=200, le=8000)
    """RDT output rate set in the sensor [Hz]; the default is ten records per log row, which leaves
    room for the filter. softfin measures the rate when it opens the sensor and rejects a deviation
    of more than 10%."""
    filter_delay_s: float = pydantic.Field(default=0.0, ge=0, le=0.5)
    """Delay of the filter set in the sensor [s], by which softfin corrects the time of the force; 0
    if it is turned off."""
