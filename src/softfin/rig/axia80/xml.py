"""What an Axia80 says of itself on its web pages: product, scale and units, read over HTTP before its stream.

``/netftapi2.xml`` must be there, with the five fields that every client needs; ``/netftcalapi.xml`` adds the serial
number of the calibration where the sensor has that page. The names of the five are those that public drivers read, that
of the serial number is from memory; none was seen on a real Axia80.
"""

import contextlib
import http.client
import math
import socket
import threading
from collections.abc import Callable
from typing import NamedTuple
from xml.etree.ElementTree import Element, ParseError

import defusedxml
import defusedxml.ElementTree

from softfin.core.errors import DeviceError, RigError

SETTINGS = "/netftapi2.xml"
CALIBRATION = "/netftcalapi.xml"

LARGEST_PAGE = 256 * 1024
"""[bytes]; the real pages have a few thousand."""

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
"""In newton."""

TORQUE_UNITS = {
    "N-m": 1.0,
    "N-mm": 1e-3,
    "kN-m": 1e3,
    "lbf-in": POUND_FORCE_N * INCH_M,
    "lbf-ft": POUND_FORCE_N * FOOT_M,
    "kgf-cm": KILOGRAM_FORCE_N / 100,
}
"""In newton metre."""


class SensorSettings(NamedTuple):
    """What the sensor's pages say."""

    product: str
    serial: str | None
    """Of its calibration; None where it has no such page or field."""
    force_unit: str
    torque_unit: str
    newton_per_count: float
    newton_metre_per_count: float
    adc_rate_hz: float | None
    """Rate at which it measures [Hz]; None where it does not say."""
    rdt_rate_hz: float | None
    """Rate at which it is set to send [Hz]; None where it does not say."""


def read_settings(
    host: str, port: int, timeout_s: float = 3.0, page_of: Callable[[str], bytes | None] | None = None
) -> SensorSettings:
    """From a sensor; raises DeviceError where it does not answer, RigError where it says what cannot be used.

    `page_of(path)` is asked in place of the network.
    """
    page_of = page_of or (lambda path: fetch(host, port, path, timeout_s))
    page = page_of(SETTINGS)
    if page is None:
        raise RigError(f"http://{host}:{port}{SETTINGS}: there is no such page; is this the address of an Axia80?")
    calibration = page_of(CALIBRATION)
    return parse_settings(page, calibration, f"http://{host}:{port}")


def parse_settings(page: bytes, calibration: bytes | None, source: str) -> SensorSettings:
    """From the two pages' bytes; raises RigError that names the field, its value and what is allowed."""
    settings = _parsed(page, source + SETTINGS)
    at = source + SETTINGS
    force_unit, force = _unit(settings, "scfgfu", FORCE_UNITS, at)
    torque_unit, torque = _unit(settings, "scfgtu", TORQUE_UNITS, at)
    serial = None if calibration is None else _text(_parsed(calibration, source + CALIBRATION), "calsn")
    return SensorSettings(
        product=_needed(settings, "prodname", at),
        serial=serial,
        force_unit=force_unit,
        torque_unit=torque_unit,
        newton_per_count=force / _counts(settings, "cfgcpf", at),
        newton_metre_per_count=torque / _counts(settings, "cfgcpt", at),
        adc_rate_hz=_rate(settings, "setrate"),
        rdt_rate_hz=_rate(settings, "comrdtrate"),
    )


def fetch(host: str, port: int, path: str, timeout_s: float) -> bytes | None:
    """A page of the sensor itself, never of where it may redirect to; None where it has no such page.

    Takes `timeout_s` to connect and as long again for the whole answer, however slowly that drips.
    """
    where = f"http://{host}:{port}{path}"
    late = threading.Event()
    try:
        connection = http.client.HTTPConnection(host, port, timeout=timeout_s)
    except http.client.InvalidURL:
        raise RigError(f"{host!r} is no address of a force sensor; write one such as 192.168.1.1") from None
    timer: threading.Timer | None = None
    try:
        connection.connect()
        # The socket itself: the connection forgets it while the answer is still coming.
        timer = threading.Timer(timeout_s, _cut, (connection.sock, late))
        timer.daemon = True
        timer.start()
        connection.request("GET", path, headers={"Connection": "close"})
        response = connection.getresponse()
        body = response.read(LARGEST_PAGE + 1)
    except (OSError, http.client.HTTPException, ValueError) as error:
        timed_out = late.is_set() or isinstance(error, TimeoutError)
        reason = f"no whole answer in {timeout_s:g} s" if timed_out else f"{error}" or type(error).__name__
        raise DeviceError(
            f"{where}: the force sensor's page cannot be read ({' '.join(reason.split())}); "
            "check its power, cable and address, and http_port"
        ) from None
    finally:
        if timer is not None:
            timer.cancel()
        connection.close()
    if late.is_set():
        raise DeviceError(f"{where}: no whole answer in {timeout_s:g} s; check the address and the network")
    if response.status == http.client.NOT_FOUND:
        return None
    if response.status != http.client.OK:
        raise RigError(
            f"{where}: answers {response.status} {response.reason[:80]}, not 200; is this the address of an Axia80?"
        )
    if len(body) > LARGEST_PAGE:
        raise RigError(f"{where}: longer than {LARGEST_PAGE} bytes; this is no page of an Axia80, check the address")
    return body


def _cut(answering: socket.socket, late: threading.Event) -> None:
    late.set()
    with contextlib.suppress(OSError):
        answering.shutdown(socket.SHUT_RDWR)


def _parsed(page: bytes, where: str) -> Element:
    try:
        root: Element = defusedxml.ElementTree.fromstring(page, forbid_dtd=True)
    except defusedxml.DefusedXmlException as error:
        raise RigError(
            f"{where}: has a document type or entities ({type(error).__name__}); this is no page of an Axia80"
        ) from None
    except (ParseError, ValueError, LookupError, RecursionError) as error:
        raise RigError(
            f"{where}: not XML ({' '.join(str(error).split())}); is this the address of an Axia80?"
        ) from None
    return root


def _text(root: Element, name: str) -> str | None:
    element = next(root.iter(name), None)
    text = "" if element is None or element.text is None else " ".join(element.text.split())
    return text or None


def _needed(root: Element, name: str, where: str) -> str:
    text = _text(root, name)
    if text is None:
        raise RigError(f"{where}: has no <{name}>; an Axia80 has prodname, cfgcpf, cfgcpt, scfgfu and scfgtu")
    return text


def _unit(root: Element, name: str, units: dict[str, float], where: str) -> tuple[str, float]:
    text = _needed(root, name, where)
    for unit, factor in units.items():
        if text.casefold() == unit.casefold():
            return unit, factor
    raise RigError(
        f"{where}: <{name}> is {text[:40]!r}; softfin knows {', '.join(units)}: set one of them in the sensor"
    )


def _counts(root: Element, name: str, where: str) -> float:
    text = _needed(root, name, where)
    counts = _number(text)
    if counts is None or not 1 <= counts <= 1e12:
        raise RigError(
            f"{where}: <{name}> is {text[:40]!r}; it must be a number of counts from 1 to 1e12 (1000000 as delivered): "
            "set it on the sensor's configuration page"
        )
    return counts


def _rate(root: Element, name: str) -> float | None:
    rate = _number(_text(root, name) or "")
    return rate if rate is not None and rate > 0 else None


def _number(text: str) -> float | None:
    try:
        number = float(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None
