"""The sensor over UDP and HTTP, in real time: what simulated time cannot show."""

import contextlib

import pytest

from softfin.emulation.axia80 import EmulatedAxia80
from softfin.rig import streamed_sensor
from softfin.rig.devices.axia80.config import Axia80Config
from softfin.rig.devices.axia80.sensor import axia80_sensor
from tests.patience import HANG_S
from tests.rig.still_fin import StillFin


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """Opened as soon as the filter is full, and no complaint where a busy machine starves the
    emulator."""
    monkeypatch.setattr(streamed_sensor, "MEASURED_S", 0.2)
    monkeypatch.setattr(streamed_sensor, "SILENT_S", HANG_S)


@contextlib.contextmanager
def emulated(*wrench):
    sensor = EmulatedAxia80(StillFin(*wrench))
    try:
        yield sensor
    finally:
        sensor.close()


def config_of(sensor):
    return Axia80Config(
        address="127.0.0.1", http_port=sensor.http_port, rdt_port=sensor.rdt_port, frame="x,y"
    )


def test_the_force_arrives_over_sockets_too():
    wrench = (1.5, -2.5, 3.5, 0.1, -0.2, 0.3)
    with emulated(*wrench) as sensor:
        client = axia80_sensor(config_of(sensor))
        client.open()
        try:
            assert client.read().wrench == pytest.approx(wrench, abs=1e-3)
            assert client.measured(0.1)[0] == pytest.approx(wrench, abs=1e-3)
        finally:
            client.close()
