"""Web pages of an Axia80, read over HTTP before streaming: product, scale, units and the zero set
in the sensor.

``/netftapi2.xml`` is required, with the five fields that every client needs; ``/netftcalapi.xml``,
if present, adds the serial number of the calibration. The names of the five fields are taken from
public drivers; the name of the serial number is unverified. We have not seen either page on a real
Axia80.
"""

from typing import Annotated
from xml.etree.ElementTree import ParseError

import defusedxml.ElementTree
import pydantic

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError, RigError, one_line
from softfin.rig.computer import Computer

SETTINGS = "/netftapi2.xml"
CALIBRATION = "/netftcalapi.xml"

POUND_FORCE_N = 4.4482216152605
KILOGRAM_FORCE_N = 9.80665
INCH_M = 0.0254
FOOT_M = 0.3048

FORCE_UNITS = {
    "N": 1.0,
    "kN": 1e3,
    "lbf": POUND_FORCE_N,
    "klbf": 1e3 * POUND_FORCE_N,
    "kgf": KILOGRAM_FORCE_N,
}
"""Force units [N]."""

TORQUE_UNITS = {
    "N-m": 1.0,
    "N-mm": 1e-3,
    "kN-m": 1e3,
    "lbf-in": POUND_FORCE_N * INCH_M,
    "lbf-ft": POUND_FORCE_N * FOOT_M,
    "kgf-cm": KILOGRAM_FORCE_N / 100,
}
"""Torque units [N m]."""


def _read_factor(units: dict[str, float]) -> pydantic.BeforeValidator:
    factors = {unit.casefold(): value for unit, value in units.items()}

    def factor(text: str) -> float:
        if text.casefold() not in factors:
            raise ValueError(f"not a known unit; use one of {', '.join(units)}")
        return factors[text.casefold()]

    return pydantic.BeforeValidator(factor)


class SensorSettings(Configuration):
    """Product, scale and serial number as reported on the sensor pages."""

    prodname: str
    calsn: str | None = None
    """Serial number of the calibration; None if the page or field is missing."""
    cfgcpf: float = pydantic.Field(ge=1, le=1e12)
    """Counts per force unit."""
    cfgcpt: float = pydantic.Field(ge=1, le=1e12)
    """Counts per torque unit."""
    scfgfu: Annotated[float, _read_factor(FORCE_UNITS)]
    """Force unit [N]."""
    scfgtu: Annotated[float, _read_factor(TORQUE_UNITS)]
    """Torque unit [N m]."""
    setbias: str | None = None
    """Zero set in the sensor, e.g. ``0;0;0;0;0;0`` [counts]; None if not reported. Net F/T sensors
    report this field; unverified for an Axia80."""

    @property
    def scale(self) -> list[float]:
        """Scale of the six channels of a record [N/count, N m/count]."""
        return [self.scfgfu / self.cfgcpf] * 3 + [self.scfgtu / self.cfgcpt] * 3


def read_settings(host: str, port: int, computer: Computer) -> SensorSettings:
    """Read the settings of a sensor; raises DeviceError if it does not respond, and RigError if its
    pages cannot be used."""
    page = computer.fetch_page(host, port, SETTINGS)
    source = f"http://{host}:{port}{SETTINGS}"
    if page is None:
        raise RigError(f"{source}: page not found; check that this is the address of an Axia80")
    return parse_settings(page, computer.fetch_page(host, port, CALIBRATION), source)


def parse_settings(page: bytes, calibration: bytes | None, source: str) -> SensorSettings:
    """Parse the settings from both pages; if they are invalid, raises RigError with the field, its
    value and the allowed values."""
    found = {
        name: text
        for name, text in _fields(page, source).items()
        if name in SensorSettings.model_fields
    }
    if calibration is not None and (serial := _fields(calibration, source).get("calsn")):
        found["calsn"] = serial
    try:
        return SensorSettings.build(found, source)
    except ConfigurationError as error:
        raise RigError(
            f"{error}; correct it on the configuration page of the sensor, or check the address"
        ) from None


def _fields(page: bytes, source: str) -> dict[str, str]:
    """Return the non-empty texts of the XML elements by name."""
    try:
        # The page comes from the network, and entities of a document type could expand without a
        # limit.
        root = defusedxml.ElementTree.fromstring(page, forbid_dtd=True)
    except (ParseError, ValueError, LookupError, RecursionError) as error:
        # ValueError includes the defusedxml errors for document types and entities.
        reason = one_line(error)
        raise RigError(f"{source}: not a page of an Axia80 ({reason}); check the address") from None
    texts = {element.tag: " ".join((element.text or "").split()) for element in root.iter()}
    return {name: text for name, text in texts.items() if text}
