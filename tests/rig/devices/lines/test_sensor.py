"""A sensor that sends lines, in simulated time: what it reads, and each of its faults."""

from collections import deque
from contextlib import contextmanager
from itertools import chain, repeat

import numpy as np
import pytest

from softfin.core.choices import LOOPBACK
from softfin.core.errors import DeviceError, RigError
from softfin.emulation.clock import SimulatedClock
from softfin.emulation.lines import EmulatedLines
from softfin.emulation.network import SimulatedSocket
from softfin.rig.devices.lines.config import LinesConfig
from softfin.rig.devices.lines.parser import LagWatch
from softfin.rig.devices.lines.sensor import lines_sensor
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
        emulated.count = 0
        sensor.open()
        sensor.restore_zero(kept)
        assert run(sensor, clock, 0.1).wrench[:2] == pytest.approx((0.0, 0.0), abs=0.01)
        assert sensor.complaints() == ()


def test_a_restart_while_in_use_is_a_fault():
    with bench() as (emulated, sensor, clock):
        sensor.open()
        run(sensor, clock, 0.5)
        emulated.count = 0
        run(sensor, clock, 0.1)
        assert "its counter went back" in sensor.complaints()[0]


@pytest.mark.parametrize("rate_hz", [80.0, 320.0])
@pytest.mark.parametrize("before_s", [0.0, 0.02, 0.05, 0.4])
@pytest.mark.parametrize(
    "columns", [("count", "force_x", "force_y"), ("skip", "force_x", "force_y")]
)
def test_a_board_that_restarts_when_its_port_is_opened_opens(rate_hz, before_s, columns):
    with bench(rate_hz, columns=columns) as (emulated, sensor, clock):
        clock.sleep(60.0)
        opened = clock()

        def restart(line):
            # Lines from before the restart are still on their way.
            if clock() - opened < before_s:
                return (line,)
            if clock() - opened < before_s + 1.6:
                emulated.count = 0
                return ()
            return (line,)

        emulated.transmit = restart
        sensor.open()
        reading = run(sensor, clock, 1.0)
        assert reading.wrench[:2] == pytest.approx((2.0, -1.0), abs=0.01)
        assert sensor.complaints() == ()


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


def with_column(index, text):
    """Replace the text in one column of each line."""

    def change(line):
        columns = line.strip().split(b",")
        columns[index] = text
        return (b",".join(columns) + b"\r\n",)

    return change


@pytest.mark.parametrize("rate_hz", [80.0, 320.0])
@pytest.mark.parametrize(("index", "channel"), [(1, "force_x"), (2, "force_y")])
@pytest.mark.parametrize("text", [b"1.234567", b"16.777214", b"0.000000", b"-0"])
def test_one_frozen_column_is_a_fault_within_a_second(rate_hz, index, channel, text):
    with bench(rate_hz) as (emulated, sensor, clock):
        sensor.open()
        run(sensor, clock, 0.5)
        emulated.transmit = with_column(index, text)
        run(sensor, clock, 0.85)
        assert sensor.complaints() == ()
        run(sensor, clock, 0.15)
        assert f"values are frozen ({channel}); check the sensor" in sensor.complaints()[0]
        emulated.transmit = lambda line: (line,)
        run(sensor, clock, 0.05)
        assert sensor.complaints() == ()


def test_a_slow_sensor_needs_twenty_equal_lines():
    with bench(10.0) as (emulated, sensor, clock):
        sensor.open()
        run(sensor, clock, 1.0)
        emulated.transmit = with_column(1, b"1.234567")
        run(sensor, clock, 1.8)
        assert sensor.complaints() == ()
        run(sensor, clock, 0.3)
        assert "values are frozen (force_x)" in sensor.complaints()[0]


@pytest.mark.parametrize("first", [b"0.0", b"0.5"])
@pytest.mark.parametrize("dead", [b"0.0", b"0.5"])
def test_an_optional_column_that_never_changed_is_not_a_fault(first, dead):
    """A load cell may not be connected, or show one other value at the start."""
    columns = ("count", "force_x", "force_y", "torque_z")
    texts = chain([first], repeat(dead))
    with bench(columns=columns) as (emulated, sensor, clock):
        emulated.transmit = lambda line: (line.strip() + b"," + next(texts) + b"\r\n",)
        sensor.open()
        run(sensor, clock, 1.5)
        assert sensor.complaints() == ()


def test_an_optional_column_that_has_changed_and_freezes_is_a_fault():
    columns = ("count", "force_x", "force_y", "torque_z")
    values = chain(
        (f"{value:.3f}".encode() for value in np.arange(0.1, 0.4, 0.001)), repeat(b"0.0")
    )
    with bench(columns=columns) as (emulated, sensor, clock):
        emulated.transmit = lambda line: (line.strip() + b"," + next(values) + b"\r\n",)
        sensor.open()
        run(sensor, clock, 5.0)
        assert "values are frozen (torque_z)" in sensor.complaints()[0]


@pytest.mark.parametrize("rate_hz", [10.0, 80.0])
def test_noise_of_one_count_is_not_a_fault(rate_hz):
    noise = np.random.default_rng(0)
    with bench(rate_hz) as (emulated, sensor, clock):

        def transmit(line):
            count = line.split(b",")[0].decode()
            x, y = np.rint(noise.normal(0.0, 1.0, 2)) * 0.01
            return (f"{count},{x:.2f},{y:.2f}\r\n".encode(),)

        emulated.transmit = transmit
        sensor.open()
        for _ in range(round(6000 / rate_hz)):
            run(sensor, clock, 0.1)
            assert not any("frozen" in line for line in sensor.complaints())


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


def test_records_that_come_only_from_another_address_are_refused_with_it():
    with bench(address="192.0.2.7") as (emulated, sensor, _):
        with pytest.raises(DeviceError, match=r"records come only from 127.0.0.1:\d+; check addr"):
            sensor.open()
        # Whatever is not a record is not from a sensor.
        emulated.transmit = lambda line: (b"hello\r\n",)
        with pytest.raises(DeviceError, match="no line within 5 s"):
            sensor.open()


@contextmanager
def second_sender(sensor, host, rate_hz=320.0):
    """Another sensor that sends to the same port."""
    clock = sensor.clock
    second = SimulatedSocket(clock, host)
    ending = clock.event()

    def send():
        count = 0
        while not ending.wait(1 / rate_hz):
            count += 1
            second.sendto(f"{count},9.0,9.0\n".encode(), (LOOPBACK, sensor.config.udp_port))

    thread = clock.spawn(send, "second sensor")
    try:
        yield second
    finally:
        ending.set()
        thread.join()
        second.close()


@pytest.mark.parametrize(
    "columns", [("count", "force_x", "force_y"), ("skip", "force_x", "force_y")]
)
@pytest.mark.parametrize("host", [LOOPBACK, "127.0.0.2"])
def test_two_senders_are_a_fault_that_names_both(host, columns):
    with bench(columns=columns) as (emulated, sensor, clock):
        sensor.open()
        run(sensor, clock, 0.2)
        with second_sender(sensor, host) as second:
            reading = run(sensor, clock, 0.1)
        (complaint,) = sensor.complaints()
        first = f"{LOOPBACK}:{emulated.socket.address[1]}"
        assert f"records come from {first} and {host}:{second.address[1]}, so two" in complaint
        if host != LOOPBACK:
            # Its records are not used.
            assert reading.wrench[:2] == pytest.approx((2.0, -1.0), abs=0.01)
        sensor.open()
        assert sensor.complaints() == ()


def test_two_senders_that_double_the_rate_are_refused_with_both_names():
    with (
        bench(columns=("skip", "force_x", "force_y")) as (_, sensor, _),
        second_sender(sensor, LOOPBACK),
        pytest.raises(
            DeviceError, match=r"records come from 127.0.0.1:\d+ and 127.0.0.1:\d+, so two"
        ),
    ):
        sensor.open()


class Buffer:
    """A buffer between sensor and computer; `delay_s` may be changed at any time."""

    def __init__(self, clock, stamp=lambda line: line):
        self.delay_s = 0.0
        self._clock = clock
        self._stamp = stamp
        self._lines = deque()

    def __call__(self, line):
        self._lines.append((self._clock(), self._stamp(line)))
        while self._lines and self._clock() - self._lines[0][0] >= self.delay_s:
            yield self._lines.popleft()[1]


def in_milliseconds(line):
    """The line with its time instead of its count."""
    count, rest = line.split(b",", 1)
    return b"%d,%s" % (int(count) * 1000 // 320, rest)


COUNTED = {
    "count": lambda line: line,
    "time_ms": in_milliseconds,
}


@pytest.mark.parametrize("column", COUNTED)
@pytest.mark.parametrize("growth", ["at once", "slowly"])
def test_a_delay_that_grows_within_the_sensor_is_a_fault(column, growth):
    with bench(columns=(column, "force_x", "force_y")) as (emulated, sensor, clock):
        buffer = emulated.transmit = Buffer(clock, COUNTED[column])
        sensor.open()
        run(sensor, clock, 1.0)
        for tick in range(200):
            # By pauses that are too short for the limit on the force's age.
            buffer.delay_s = 0.1 if growth == "at once" else 0.001 * tick
            assert clock() - run(sensor, clock, 0.01).force_time < 0.15
        (complaint,) = sensor.complaints()
        assert "its lines arrive 0." in complaint
        assert "later than at the start" in complaint


@pytest.mark.parametrize("column", COUNTED)
@pytest.mark.parametrize("rate_hz", [318.0, 320.0, 322.0])
def test_single_late_lines_and_a_clock_that_is_off_are_no_lag(column, rate_hz):
    with bench(columns=(column, "force_x", "force_y")) as (emulated, sensor, clock):
        emulated.rate_hz = rate_hz
        buffer = emulated.transmit = Buffer(clock, COUNTED[column])
        sensor.open()
        for tick in range(2000):
            buffer.delay_s = 0.08 if tick % 50 < 10 else 0.0
            run(sensor, clock, 0.01)
        assert sensor.complaints() == ()


def test_lag_is_measured_from_the_line_with_the_least_delay():
    watch = LagWatch(0.01)
    for tick in range(300):
        delay = 0.2 if tick < 100 else 0.0
        # The delay at the start is unknown; it can only be seen to shrink.
        watch.take(0.01 * tick, 0.01 * tick + delay)
    assert not watch.is_lagging
    for tick in range(300, 400):
        watch.take(0.01 * tick, 0.01 * tick + 0.2)
    assert watch.is_lagging
    assert watch.lag_s == pytest.approx(0.2, abs=0.01)
