"""A sensor that sends lines, in simulated time: what it reads, and each of its faults."""

from contextlib import contextmanager

import pytest

from softfin.core.errors import DeviceError, RigError
from softfin.rig.devices.lines.config import LinesConfig
from softfin.rig.devices.lines.emulated_sensor import EmulatedLines
from softfin.rig.devices.lines.sensor import lines_sensor
from softfin.rig.simulated_clock import SimulatedClock
from softfin.testing import check_force_sensor
from tests.rig.still_fin import StillFin

LOAD = (2.0, -1.0, 0.0, 0.0, 0.0, 0.0)


@contextmanager
def bench(rate_hz=320.0, **changes):
    clock = SimulatedClock()
    emulated = EmulatedLines(StillFin(*LOAD), rate_hz, clock)
    values = {
        "columns": ("count", "force_x", "force_y"),
        "rate_hz": rate_hz,
        "filter_delay_s": 0.0,
        "frame": "y,-x",
    }
    sensor = lines_sensor(LinesConfig.build(values | emulated.address() | changes), clock)
    try:
        yield emulated, sensor, clock
    finally:
        sensor.close()
        emulated.close()


def run(sensor, clock, seconds):
    """Read at 100 Hz; returns the latest reading."""
    for _ in range(round(100 * seconds)):
        clock.sleep(0.01)
        reading = sensor.read()
    return reading


@pytest.mark.parametrize("rate_hz", [10.0, 80.0, 320.0, 1000.0])
def test_it_meets_the_contract_of_a_force_sensor_at_every_rate(rate_hz):
    with bench(rate_hz) as (emulated, sensor, _):
        check_force_sensor(sensor, emulated.silence)


@pytest.mark.parametrize(("rate_hz", "is_noted"), [(80.0, True), (100.0, False), (320.0, False)])
def test_forces_are_turned_into_softfins_axes_and_a_slow_sensor_is_noted(rate_hz, is_noted):
    with bench(rate_hz) as (_, sensor, clock):
        sensor.open()
        assert run(sensor, clock, 0.2).wrench[:3] == pytest.approx((2.0, -1.0, 0.0), abs=0.01)
        assert bool(sensor.notes()) == is_noted


@pytest.mark.parametrize("rate_hz", [80.0, 320.0])
def test_the_time_of_the_force_is_earlier_by_the_delay_of_the_sensors_filter(rate_hz):
    ages = []
    for delay_s in (0.0, 0.05):
        with bench(rate_hz, filter_delay_s=delay_s) as (_, sensor, clock):
            sensor.open()
            ages.append(clock() - run(sensor, clock, 1.0).force_time)
    assert ages[1] - ages[0] == pytest.approx(0.05, abs=0.001)


def test_the_zero_is_kept_by_softfin_and_survives_a_restart_of_the_sensor():
    with bench() as (emulated, sensor, clock):
        sensor.open()
        sensor.zero()
        assert run(sensor, clock, 0.1).wrench[:2] == pytest.approx((0.0, 0.0), abs=0.01)
        kept = sensor.zero_wrench
        emulated.reboot()
        sensor.open()
        sensor.restore_zero(kept)
        assert run(sensor, clock, 0.1).wrench[:2] == pytest.approx((0.0, 0.0), abs=0.01)
        assert sensor.complaints() == ()


def test_a_restart_while_in_use_is_a_fault():
    with bench() as (emulated, sensor, clock):
        sensor.open()
        run(sensor, clock, 0.5)
        emulated.reboot()
        run(sensor, clock, 0.1)
        assert "its counter went back" in sensor.complaints()[0]


def test_silence_ages_the_force_and_is_a_fault():
    with bench() as (emulated, sensor, clock):
        sensor.open()
        before = run(sensor, clock, 0.2)
        emulated.silence()
        after = run(sensor, clock, 1.6)
        assert after.force_time - before.force_time < 0.05
        assert "no usable line for 1." in sensor.complaints()[0]


@pytest.mark.parametrize(
    ("transmit", "counter"),
    [
        (lambda line: (line[:7],), "sensor_malformed"),
        (lambda line: (line.replace(b".", b"?"),), "sensor_malformed"),
        (lambda line: (line.strip() + line,), "sensor_malformed"),
        (lambda line: (line, line), "sensor_late"),
        (lambda line: (), "sensor_lost"),
    ],
)
def test_single_lines_that_are_cut_doubled_no_numbers_or_lost_are_counted_and_bridged(
    transmit, counter
):
    with bench() as (emulated, sensor, clock):
        sensor.open()
        numbers = iter(range(10**9))
        emulated.transmit = lambda line: transmit(line) if next(numbers) % 50 == 49 else (line,)
        for _ in range(100):
            reading = run(sensor, clock, 0.01)
            assert reading.wrench[:2] == pytest.approx((2.0, -1.0), abs=0.01)
            assert clock() - reading.force_time < 0.15
        assert sensor.counters()[counter] >= 4
        assert sensor.complaints() == ()


def test_lines_that_are_never_usable_are_a_fault():
    with bench() as (emulated, sensor, clock):
        sensor.open()
        emulated.transmit = lambda line: (b"\x1b[31mready\r\n",)
        run(sensor, clock, 0.1)
        (complaint,) = sensor.complaints()
        assert "do not match columns" in complaint
        assert "\x1b" not in complaint


def test_values_that_stand_still_are_a_fault():
    with bench() as (emulated, sensor, clock):
        sensor.open()
        emulated.are_values_frozen = True
        run(sensor, clock, 1.2)
        assert "values are frozen" in sensor.complaints()[0]


def test_a_pause_of_the_loop_does_not_make_old_lines_look_new():
    with bench() as (emulated, sensor, clock):
        sensor.open()
        run(sensor, clock, 0.2)
        emulated.silence()
        clock.sleep(5.0)
        assert clock() - sensor.read().force_time > 4.9


@pytest.mark.parametrize("actual_hz", [160.0, 640.0])
def test_a_wrong_rate_is_refused(actual_hz):
    with bench() as (emulated, sensor, _):
        emulated.rate_hz = actual_hz
        with pytest.raises(RigError, match=r"lines per second, but rate_hz is 320; change one"):
            sensor.open()


def test_a_wrong_device_or_none_is_refused_with_what_it_sends():
    with bench() as (emulated, sensor, _):
        emulated.transmit = lambda line: (b"$GPGGA,1,2,3,4\r\n",)
        with pytest.raises(DeviceError, match=r"no line with columns count, .*GPGGA.*; check"):
            sensor.open()
        emulated.silence()
        with pytest.raises(DeviceError, match="no line within 5 s; check its cable"):
            sensor.open()
        with pytest.raises(DeviceError, match="not open; open it first"):
            sensor.read()


def test_lines_from_another_address_are_ignored():
    with bench(address="192.0.2.7") as (_, sensor, _), pytest.raises(DeviceError, match="no line"):
        sensor.open()
