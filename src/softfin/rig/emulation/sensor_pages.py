"""The web pages of an emulated Axia80, in the form of the real ones, and the server of them in real time."""

import threading
from collections.abc import Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from xml.sax.saxutils import escape

from softfin.rig.axia80.pages import CALIBRATION, SETTINGS


def sensor_pages(
    units: tuple[str, str], counts: tuple[float, float], product: str = "Emulated Axia80-M20", serial: str = "FT00000"
) -> dict[str, bytes]:
    """The two pages that clients read, by path; units and counts of force and torque."""
    settings = {"prodname": product, "scfgfu": units[0], "scfgtu": units[1],
                "cfgcpf": f"{counts[0]:.10g}", "cfgcpt": f"{counts[1]:.10g}"}  # fmt: skip
    return {SETTINGS: _xml("netft", settings), CALIBRATION: _xml("netftCalibration", {"calsn": serial})}


def serve_pages(host: str, port: int, pages: Mapping[str, bytes]) -> ThreadingHTTPServer:
    """Serve bytes by path from a daemon thread, until the server's `shutdown` and `server_close`."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            body = pages.get(self.path)
            self.send_response(404 if body is None else 200)
            self.send_header("Content-Length", str(len(body or b"")))
            self.end_headers()
            self.wfile.write(body or b"")

        def log_message(self, format: str, *args: object) -> None:
            """Nothing is logged."""

    server = ThreadingHTTPServer((host, port), Handler)
    threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True, name="emulated sensor's pages").start()
    return server


def _xml(root: str, fields: Mapping[str, str]) -> bytes:
    rows = "\r\n".join(f"<{name}>{escape(value)}</{name}>" for name, value in fields.items())
    return f'<?xml version="1.0" encoding="UTF-8"?>\r\n<{root}>\r\n{rows}\r\n</{root}>\r\n'.encode()
