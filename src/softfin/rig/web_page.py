"""Web pages of a device, read over HTTP."""

import contextlib
import http.client

from softfin.core.errors import DeviceError, RigError, one_line

MAX_PAGE_BYTES = 256 * 1024
"""Maximum page size [bytes]; real pages are a few thousand bytes."""

PAGE_TIMEOUT_S = 3.0
"""Maximum wait for the connection and for each part of the response [s]."""


def fetch_page(host: str, port: int, path: str) -> bytes | None:
    """Return a page of the sensor without following redirects; None if the sensor does not have
    this page."""
    where = f"http://{host}:{port}{path}"
    try:
        connection = http.client.HTTPConnection(host, port, timeout=PAGE_TIMEOUT_S)
        with contextlib.closing(connection):
            connection.request("GET", path, headers={"Connection": "close"})
            response = connection.getresponse()
            body = response.read(MAX_PAGE_BYTES + 1)
    except (OSError, http.client.HTTPException, ValueError) as error:
        reason = one_line(error)
        if isinstance(error, TimeoutError):
            reason = f"no response within {PAGE_TIMEOUT_S:g} s"
        raise DeviceError(
            f"{where}: cannot read the web page of the force sensor ({reason}); check its power, "
            "cable, address and http_port"
        ) from None
    if response.status == http.client.NOT_FOUND:
        return None
    if response.status != http.client.OK or len(body) > MAX_PAGE_BYTES:
        raise RigError(
            f"{where}: returned {response.status} {response.reason[:80]} with {len(body)} bytes; "
            f"expected 200 and at most {MAX_PAGE_BYTES} bytes; check that this is the address of "
            "an Axia80"
        )
    return body
