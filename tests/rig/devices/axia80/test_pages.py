import contextlib
import os
import random
import socket
import threading

import pytest

from softfin.core.errors import DeviceError, RigError
from softfin.emulation.axia80 import sensor_pages, serve_pages
from softfin.rig import web_page
from softfin.rig.computer import COMPUTER
from softfin.rig.devices.axia80.pages import (
    SETTINGS,
    parse_settings,
    read_settings,
)
from softfin.rig.web_page import MAX_PAGE_BYTES, fetch_page
from tests.patience import HANG_S

CASES = 100_000 if os.environ.get("SOFTFIN_LONG") == "1" else 1_000

FIELDS = {
    "prodname": "Axia80-M20",
    "cfgcpf": "1000000",
    "cfgcpt": "1000000",
    "scfgfu": "N",
    "scfgtu": "N-m",
}


def page(**changes):
    fields = {name: value for name, value in {**FIELDS, **changes}.items() if value is not None}
    body = "".join(f"<{name}>{value}</{name}>" for name, value in fields.items())
    return f'<?xml version="1.0"?><netft>{body}</netft>'.encode()


@contextlib.contextmanager
def answering(*chunks, pause_s=0.0):
    """A server that reads a request, then sends chunks, and keeps the line open until the test is
    over."""
    over = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve():
            with contextlib.suppress(OSError):
                client, _ = server.accept()
                with client:
                    client.recv(4096)
                    for chunk in chunks:
                        client.sendall(chunk)
                        over.wait(pause_s)
                    over.wait(HANG_S)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield server.getsockname()[1]
        over.set()
        thread.join(HANG_S)


@contextlib.contextmanager
def serving(content):
    server = serve_pages(0, content)
    try:
        yield server.server_port
    finally:
        server.shutdown()
        server.server_close()


@pytest.mark.parametrize(
    ("unit", "newton"),
    [("N", 1), ("kN", 1000), ("lbf", 4.4482216152605), ("klbf", 4448.2216152605), ("kgf", 9.80665)],
)
def test_forces_of_any_unit_become_newton(unit, newton):
    settings = parse_settings(page(scfgfu=unit, cfgcpf="500"), None, "")
    assert settings.scale[0] == pytest.approx(newton / 500)


@pytest.mark.parametrize(
    ("unit", "newton_metre"),
    [
        ("N-m", 1),
        ("N-mm", 1e-3),
        ("kN-m", 1e3),
        ("lbf-in", 0.1129848),
        ("lbf-ft", 1.3558179),
        ("kgf-cm", 0.0980665),
    ],
)
def test_torques_of_any_unit_become_newton_metre(unit, newton_metre):
    settings = parse_settings(page(scfgtu=f" {unit.upper()}\n"), None, "")
    assert settings.scale[5] * 1e6 == pytest.approx(newton_metre)


def test_the_serial_number_may_be_missing():
    assert parse_settings(page(), None, "").calsn is None
    assert parse_settings(page(), b"<netftCalibration/>", "").calsn is None


@pytest.mark.parametrize("name", FIELDS)
def test_a_missing_field_is_named(name):
    with pytest.raises(
        RigError,
        match=rf"sensor: {name}: missing required key; correct it on the "
        r"configuration page of the sensor",
    ):
        parse_settings(page(**{name: None}), None, "sensor")


@pytest.mark.parametrize(
    ("name", "unit"), [("scfgfu", "dyn"), ("scfgtu", "N"), ("scfgtu", "Newton")]
)
def test_an_unknown_unit_is_named_with_those_that_are_known(name, unit):
    with pytest.raises(RigError, match=rf"{name} = '{unit}': .* use one of N"):
        parse_settings(page(**{name: unit}), None, "")


@pytest.mark.parametrize(
    "counts", ["0", "-1000000", "nan", "inf", "1e400", "many", "0.001", "0x10"]
)
def test_counts_that_cannot_be_are_refused(counts):
    with pytest.raises(RigError, match=rf"cfgcpf = '{counts}': Input should be"):
        parse_settings(page(cfgcpf=counts), None, "")


LAUGHS = "".join(f'<!ENTITY l{k} "{f"&l{k - 1};" * 10}">' for k in range(1, 10))


@pytest.mark.parametrize(
    "hostile",
    [
        f'<!DOCTYPE netft [<!ENTITY l0 "ha">{LAUGHS}]><netft>&l9;</netft>'.encode(),
        b'<!DOCTYPE netft [<!ENTITY f SYSTEM "file:///etc/passwd">]><netft><prodname>&f;</prodname></netft>',
        b'<!DOCTYPE netft SYSTEM "http://127.0.0.1:9/netft.dtd"><netft/>',
        b"<netft><prodname>",
        b"",
        b"\xff\xfe\x00",
        b'<?xml version="1.0" encoding="no-such"?><netft/>',
        b"<a>" * 20_000,
        b"<a>" * 20_000 + b"</a>" * 20_000,
    ],
)
def test_a_hostile_or_broken_page_is_refused_in_one_line(hostile):
    with pytest.raises(
        RigError, match=r"sensor: .*(not a page of an Axia80|missing required key)"
    ) as refused:
        parse_settings(hostile, None, "sensor")
    assert "\n" not in str(refused.value)


def test_any_bytes_are_settings_or_refused():
    draw = random.Random(6)
    whole = page(setrate="7812")
    for _ in range(CASES):
        data = bytearray(whole)
        for _ in range(draw.randrange(1, 6)):
            at = draw.randrange(len(data))
            data[at : at + draw.randrange(3)] = (
                draw.randbytes(draw.randrange(3)) or whole[: draw.randrange(40)]
            )
        with contextlib.suppress(RigError):
            settings = parse_settings(bytes(data), bytes(data), "")
            assert settings.scale[0] > 0


def test_the_pages_of_the_emulator_are_read():
    with serving(sensor_pages("N", "N-mm", serial="FT12345")) as port:
        settings = read_settings("127.0.0.1", port, COMPUTER)
    assert settings.calsn == "FT12345"
    assert settings.scale[5] == pytest.approx(1e-9)


def test_a_sensor_without_the_second_page_is_read_all_the_same():
    with serving({SETTINGS: page()}) as port:
        assert read_settings("127.0.0.1", port, COMPUTER).calsn is None


def test_another_device_is_told_from_a_sensor():
    with serving({}) as port, pytest.raises(RigError, match="page not found"):
        read_settings("127.0.0.1", port, COMPUTER)


def test_a_device_that_is_not_there_is_said_so():
    with pytest.raises(DeviceError, match=r"cannot read .*check its power, cable, address"):
        fetch_page("127.0.0.1", 1, SETTINGS)


@pytest.mark.parametrize("host", ["no such host", "\x00", "a" * 300])
def test_an_address_that_cannot_be_is_an_error_and_no_traceback(host):
    with pytest.raises((DeviceError, RigError), match=r"cannot read|is no address"):
        fetch_page(host, 80, SETTINGS)


def test_a_redirection_is_not_followed():
    elsewhere = b"HTTP/1.1 302 Found\r\nLocation: http://192.0.2.1/\r\nContent-Length: 0\r\n\r\n"
    with (
        answering(elsewhere) as port,
        pytest.raises(RigError, match="returned 302 Found with 0 bytes; expected 200"),
    ):
        fetch_page("127.0.0.1", port, SETTINGS)


@pytest.mark.parametrize("length", [b"", b"Content-Length: 99999999\r\n"])
def test_a_page_that_is_too_long_is_not_read_to_its_end(length):
    chunks = (b"HTTP/1.1 200 OK\r\n" + length + b"\r\n", b"x" * (MAX_PAGE_BYTES + 10))
    with (
        answering(*chunks) as port,
        pytest.raises(
            RigError, match=r"returned 200 .* with 262145 bytes; expected 200 and at most 262144"
        ),
    ):
        fetch_page("127.0.0.1", port, SETTINGS)


@pytest.mark.parametrize(
    "chunks", [(), (b"HTTP/1.1 200 OK\r\nContent-Length: 100\r\n\r\n", b"<netft>")]
)
def test_a_page_that_never_ends_is_given_up_in_time(chunks, monkeypatch):
    monkeypatch.setattr(web_page, "PAGE_TIMEOUT_S", 0.3)
    with answering(*chunks) as port, pytest.raises(DeviceError, match=r"no response within 0\.3 s"):
        fetch_page("127.0.0.1", port, SETTINGS)


@pytest.mark.parametrize(
    "answer", [b"", b"\x00\x01\x02\r\n\r\n", b"HTTP/1.1 abc\r\n\r\n", b"SSH-2.0-OpenSSH\r\n"]
)
def test_what_is_not_http_is_an_error_and_no_traceback(answer, monkeypatch):
    monkeypatch.setattr(web_page, "PAGE_TIMEOUT_S", 0.3)
    with answering(answer) as port, pytest.raises(DeviceError, match=r"cannot read"):
        fetch_page("127.0.0.1", port, SETTINGS)
