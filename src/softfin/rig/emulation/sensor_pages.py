"""The web pages of an emulated Axia80, in the form of the real ones, and the server of them."""

import contextlib
import threading
from collections.abc import Mapping
from xml.sax.saxutils import escape

from softfin.rig.axia80.xml import CALIBRATION, SETTINGS
from softfin.rig.web_server import BoundedServer, OneRequest

STALLED_S = 30.0


def page(root: str, fields: Mapping[str, object]) -> bytes:
    """One element a field, under a root."""
    rows = "\r\n".join(f"<{name}>{escape(str(value))}</{name}>" for name, value in fields.items())
    return f'<?xml version="1.0" encoding="UTF-8"?>\r\n<{root}>\r\n{rows}\r\n</{root}>\r\n'.encode()


class PageServer:
    """Serves bytes by path from a daemon thread until it is closed."""

    def __init__(self, host: str, port: int, pages: Mapping[str, bytes]) -> None:
        self.pages = dict(pages)
        """Path: what is there; may be changed at any time."""
        self.stalled = threading.Event()
        """Set: takes requests and never answers."""
        self._closing = threading.Event()
        self._server = _Server((host, port), _handler(self.pages, self.stalled, self._closing))
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.05,), daemon=True, name="emulated sensor's pages"
        )
        self._thread.start()

    def close(self) -> None:
        """Any number of times."""
        if not self._closing.is_set():
            self._closing.set()
            self._server.shutdown()
            self._server.server_close()
            self._thread.join()


class _Server(BoundedServer):
    allow_reuse_address = True


def _handler(pages: Mapping[str, bytes], stalled: threading.Event, closing: threading.Event) -> type[OneRequest]:
    class Handler(OneRequest):
        def do_GET(self) -> None:
            if stalled.is_set():
                closing.wait(STALLED_S)
                return
            body = pages.get(self.path)
            with contextlib.suppress(OSError):
                if body is None:
                    self.send_error(404)
                    return
                self.send_response(200)
                self.send_header("Content-Type", "text/xml")
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

    return Handler


def sensor_pages(
    product: str,
    serial: str,
    units: tuple[str, str],
    counts: tuple[float, float],
    adc_rate_hz: float,
    rdt_rate_hz: float,
) -> dict[str, bytes]:
    """The two pages that clients read, by path."""
    scale = {"cfgcpf": f"{counts[0]:.10g}", "cfgcpt": f"{counts[1]:.10g}"}
    settings = {
        "prodname": product,
        "setrate": f"{adc_rate_hz:.10g}",
        "scfgfu": units[0],
        "scfgtu": units[1],
        "comrdtrate": f"{rdt_rate_hz:.10g}",
    }
    calibration = {"calsn": serial, "calcpf": scale["cfgcpf"], "calcpt": scale["cfgcpt"]}
    return {SETTINGS: page("netft", {**settings, **scale}), CALIBRATION: page("netftCalibration", calibration)}
