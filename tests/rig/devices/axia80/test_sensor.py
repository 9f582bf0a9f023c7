import contextlib
import itertools
import re

import numpy as np
import pytest

from softfin.core.errors import DeviceError, RigError
from softfin.emulation import network as simulated_network
from softfin.emulation.axia80 import EmulatedAxia80, sensor_pages
from softfin.emulation.clock import SimulatedClock
from softfin.emulation.fin import FinMotion
from softfin.emulation.network import SimulatedSocket
from softfin.rig.devices.axia80.config import Axia80Config
from softfin.rig.devices.axia80.rdt import BUSY, OVER_RANGE, RdtCommand, encode_request
from softfin.rig.devices.axia80.sensor import axia80_sensor
from softfin.rig.safety import SafetyConfig
from tests.rig.devices.axia80.faulty_network import FaultyNetwork
from tests.rig.still_fin import StillFin


def config_of(sensor, **changes):
    values = {"http_port": sensor.http_port, "rdt_port": sensor.rdt_port, "frame": "x,y", **changes}
    return Axia80Config(address="127.0.0.1", **values)


@contextlib.contextmanager
def emulated(*wrench, **options):
    fin = StillFin(*wrench)
    clock = SimulatedClock()
    sensor = EmulatedAxia80(fin, clock=clock, **options)
    sensor.fin = fin
    sensor.clock = clock
    try:
        yield sensor
    finally:
        sensor.close()


@contextlib.contextmanager
def opened(sensor, **changes):
    client = axia80_sensor(config_of(sensor, **changes), sensor.clock)
    try:
        client.open()
        yield client
    finally:
        client.close()


@pytest.fixture
def pair():
    with emulated() as sensor, opened(sensor) as client:
        yield sensor, client


def read_for(client, seconds):
    readings = []
    for _ in range(round(seconds / 0.01)):
        readings.append(client.read())
        client.clock.sleep(0.01)
    return readings


def read_until(client, condition, seconds=10.0):
    for _ in range(round(seconds / 0.01)):
        reading = client.read()
        if condition():
            return reading
        client.clock.sleep(0.01)
    pytest.fail(f"did not come about in {seconds} s; {client.counters()}, {client.complaints()}")


@pytest.mark.parametrize("frame", ["x,y", "y,-x", "-y,-x"])
def test_the_force_arrives_in_softfins_axes(frame):
    wrench = (1.5, -2.5, 3.5, 0.1, -0.2, 0.3)
    with emulated(*wrench, frame=frame) as sensor, opened(sensor, frame=frame) as client:
        assert client.read().wrench == pytest.approx(wrench, abs=1e-3)
        assert client.measured(0.1)[0] == pytest.approx(wrench, abs=1e-3)


def test_the_force_is_converted_to_newton():
    with emulated(1.5, -2.5, 3.5, 0.1, -0.2, 0.3) as sensor:
        sensor.pages.update(sensor_pages("lbf", "N-mm"))
        with opened(sensor) as client:
            wrench = client.read().wrench
    assert wrench[:3] == pytest.approx(4.4482216152605 * np.array([1.5, -2.5, 3.5]), abs=1e-3)
    assert wrench[3:] == pytest.approx((1e-4, -2e-4, 3e-4), abs=1e-5)


def test_nothing_is_lost_and_the_time_goes_on(pair):
    sensor, client = pair
    readings = read_for(client, 0.5)
    times = [reading.force_time for reading in readings]
    assert times == sorted(times)
    assert times[-1] <= sensor.clock() - client.delay_s
    counters = client.counters()
    assert counters.pop("sensor_records") > 100
    assert not any(counters.values())
    assert client.complaints() == client.notes() == ()
    assert client.times.rate_hz == pytest.approx(sensor.rate_hz, rel=0.01)


def test_a_process_that_was_held_up_does_not_take_the_sensor_for_silent_and_loses_nothing(pair):
    sensor, client = pair
    sensor.clock.sleep(0.5)
    client.read()
    assert client.complaints() == ()
    counters = client.counters()
    assert counters["sensor_records"] > 900
    assert counters["sensor_lost"] == 0


@pytest.mark.parametrize("pause_s", [0.2, 1.0, 3.0, 60.0])
def test_after_a_pause_no_old_force_passes_for_fresh(pair, pause_s):
    """What the socket kept is the start of the pause, of which each record carries its time."""
    sensor, client = pair
    client.read()
    sensor.fin.wrench = (5.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    sensor.clock.sleep(pause_s)
    sensor.fin.wrench = (60.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    changed = sensor.clock()
    for _ in range(30):
        reading = client.read()
        force = reading.wrench[0]
        if reading.force_time < changed - 0.035:
            assert force < 6.0
        elif reading.force_time > changed + 0.035:
            assert force > 59.0
        sensor.clock.sleep(0.01)
    assert sensor.clock() - reading.force_time < 0.05
    assert force > 59.0


def test_after_a_pause_old_and_new_records_are_never_joined_in_the_filter(pair):
    sensor, client = pair
    sensor.fin.wrench = (5.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    read_for(client, 0.2)
    sensor.clock.sleep(2.0)
    sensor.fin.wrench = (0.0,) * 6
    # From the moment at which nobody felt 5 N any more.
    sensor.clock.sleep(1.0)
    forces = {round(reading.wrench[0], 3) for reading in read_for(client, 0.3)}
    assert forces == {0.0, 5.0}
    counters = client.counters()
    assert counters["sensor_discarded"] > 400
    assert counters["sensor_lost"] > 2000


def test_records_that_nobody_took_are_counted_as_lost(monkeypatch):
    with emulated() as sensor:
        monkeypatch.setattr(simulated_network, "RMEM_MAX_BYTES", 10_000)
        client = axia80_sensor(config_of(sensor), sensor.clock)
        client.open()
        sensor.clock.sleep(0.5)
        stale = client.read()
        fresh = read_until(client, lambda: not client._filter.full)
        client.close()
    assert client.counters()["sensor_lost"] > 100
    assert fresh.force_time >= stale.force_time


@pytest.mark.parametrize(
    ("fault", "counted", "injected"),
    [
        ({"drop": 0.05}, "sensor_lost", "dropped"),
        ({"duplicate": 0.1}, "sensor_late", "doubled"),
        ({"reorder": 0.1}, "sensor_late", "swapped"),
    ],
)
def test_what_the_network_does_is_counted_bridged_and_no_complaint(pair, fault, counted, injected):
    sensor, client = pair
    network = FaultyNetwork.between(sensor)
    network.disturb(**fault)
    read_for(client, 0.5)
    network.disturb()
    read_for(client, 0.2)
    counters = client.counters()
    assert counters[counted] == getattr(network, injected) > 0
    assert counters["sensor_lost"] == network.dropped + network.swapped
    assert client.complaints() == ()


def test_late_packets_make_a_late_force_and_nothing_else(pair):
    sensor, client = pair
    FaultyNetwork.between(sensor).disturb(late=100)
    readings = read_for(client, 0.5)
    assert all(b.force_time >= a.force_time for a, b in itertools.pairwise(readings))
    assert client.counters()["sensor_lost"] == 0


def test_an_error_status_is_a_complaint_as_long_as_it_lasts(pair):
    sensor, client = pair
    sensor.status = OVER_RANGE
    read_until(client, client.complaints)
    assert client.complaints() == (
        "force sensor 127.0.0.1: force or torque is out of range; remove the load and check "
        "the mount of the fin",
    )
    sensor.status = 0
    read_until(client, lambda: not client.complaints())


def test_an_error_of_a_single_record_is_not_missed(pair):
    sensor, client = pair
    sensor.status = OVER_RANGE
    sensor.clock.sleep(0.1)
    sensor.status = 0
    sensor.clock.sleep(0.1)
    client.read()
    assert client.complaints()
    read_until(client, lambda: not client.complaints())


@pytest.mark.parametrize(("status", "words"), [(BUSY, "busy"), (0x10000000, "simulated")])
def test_what_is_no_error_is_a_note(pair, status, words):
    sensor, client = pair
    sensor.status = status
    sensor.clock.sleep(0.05)
    read_until(client, client.notes)
    assert words in client.notes()[0]
    assert client.complaints() == ()


def test_a_force_beyond_the_range_is_a_complaint(pair):
    sensor, client = pair
    sensor.fin.wrench = (0.0, 0.0, 0.0, 25.0, 0.0, 0.0)
    read_until(client, client.complaints)
    assert "out of range" in client.complaints()[0]


def test_a_silent_sensor_is_a_complaint_until_it_sends_again(pair):
    sensor, client = pair
    sensor.silence()
    sensor.clock.sleep(0.05)
    before = client.read()
    read_until(client, client.complaints)
    assert re.search(
        r"no usable record for \d+\.\d s; check its power and cable", client.complaints()[0]
    )
    after = client.read()
    assert after.force_time == before.force_time
    sensor.silence(0.0)
    assert read_until(client, lambda: not client.complaints()).force_time >= before.force_time


@pytest.mark.parametrize("seconds", [0.05, 3.0])
def test_a_sensor_that_restarted_is_a_complaint_and_keeps_softfins_zero(pair, seconds):
    sensor, client = pair
    sensor.fin.wrench = (5.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    read_for(client, 0.2)
    client.zero()
    sensor.reboot(seconds)
    read_for(client, seconds + 1.0)
    assert client.complaints() == (
        "force sensor 127.0.0.1: restarted; check its supply and cable, then start again",
    )
    assert client.read().wrench[0] == pytest.approx(0.0, abs=1e-3)
    zero = client.zero_wrench
    client.open()
    client.restore_zero(zero)
    assert client.complaints() == ()
    assert client.read().wrench[0] == pytest.approx(0.0, abs=1e-3)


def test_a_sensor_that_is_still_busy_after_power_up_is_waited_for():
    with emulated() as sensor:
        sensor.reboot(0.0)
        sensor.busy_s = 2.0
        began = sensor.clock()
        with opened(sensor) as client:
            assert 2.0 <= sensor.clock() - began < 2.7
            read_for(client, 0.1)
            assert client.complaints() == client.notes() == ()


def test_a_sensor_that_stays_busy_is_refused_in_one_line():
    with emulated() as sensor:
        sensor.busy_s = 1e9
        with pytest.raises(
            DeviceError, match="busy for more than 5 s; do not use its web pages"
        ) as refused:
            axia80_sensor(config_of(sensor), sensor.clock).open()
    assert "\n" not in str(refused.value)


def _freeze(sensor):
    sensor.are_values_frozen = True


def _freeze_one_channel(sensor):
    def transmit(datagram):
        yield datagram[:16] + (7).to_bytes(4, "big") + datagram[20:]

    sensor.transmit = transmit


def _be_busy(sensor):
    sensor.status = BUSY


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (_freeze, "frozen (force_x, force_y, force_z, torque_x, torque_y, torque_z);"),
        (_freeze_one_channel, "frozen (force_y);"),
        (_be_busy, "busy for too long"),
    ],
)
@pytest.mark.parametrize("rate_hz", [200.0, 1000.0, 4000.0])
def test_values_that_stand_still_are_a_complaint_within_a_fifth_of_a_second(fault, words, rate_hz):
    with emulated(rate_hz=rate_hz) as sensor, opened(sensor, rate_hz=rate_hz) as client:
        read_for(client, 0.2)
        assert client.complaints() == ()
        fault(sensor)
        read_for(client, 0.08)
        assert not any(words in line for line in client.complaints())
        read_for(client, 0.12)
        assert any(words in line for line in client.complaints())


def test_values_that_move_again_and_a_moment_of_busy_are_no_complaint(pair):
    sensor, client = pair
    sensor.are_values_frozen = True
    read_for(client, 0.3)
    assert client.complaints()
    sensor.are_values_frozen = False
    read_for(client, 0.05)
    assert client.complaints() == ()
    sensor.status = BUSY
    read_for(client, 0.05)
    assert client.complaints() == ()


@pytest.mark.parametrize("lost", [1, 10, 11, 15, 40])
def test_a_gap_delays_the_force_by_less_than_the_default_limit(pair, lost):
    sensor, client = pair
    limit = SafetyConfig().force_stale_s
    left = itertools.chain([True] * lost, itertools.repeat(False))
    ages = []
    read_for(client, 0.2)
    sensor.transmit = lambda datagram: () if next(left) else (datagram,)
    for _ in range(300):
        sensor.clock.sleep(0.001)
        ages.append(sensor.clock() - client.read().force_time)
    assert client.counters()["sensor_lost"] == lost
    assert max(ages) < limit
    if lost <= 10:
        assert max(ages) < 0.035 + lost / 1000 + 0.003
    else:
        assert max(ages) > 0.1


def test_a_second_client_takes_the_stream_and_ends_it(pair):
    sensor, client = pair
    other = SimulatedSocket(sensor.clock, "127.0.0.1")
    for command in (RdtCommand.START, RdtCommand.STOP):
        other.sendto(encode_request(command), ("127.0.0.1", sensor.rdt_port))
        sensor.clock.sleep(0.01)
        client.read()
        before = client.counters()["sensor_records"]
        read_for(client, 0.05)
        assert client.counters()["sensor_records"] == before
    # It is taken back after a while, so a program that only looked once does no harm.
    read_for(client, 0.3)
    assert sensor.clock() - client.read().force_time < 0.05
    assert client.complaints() == ()


@pytest.mark.parametrize("step_s", [-3600.0, -0.5, 0.5, 3600.0])
def test_a_date_that_is_set_makes_no_force_newer_than_it_is(pair, step_s):
    sensor, client = pair
    read_for(client, 0.2)
    sensor.clock.wall_set_s = step_s
    readings = read_for(client, 0.3)
    assert all(b.force_time >= a.force_time for a, b in itertools.pairwise(readings))
    assert sensor.clock() - client.read().force_time < 0.06
    # In a pause: what is taken then is of its beginning, before the date was set.
    sensor.clock.sleep(1.0)
    sensor.clock.wall_set_s = 0.0
    assert sensor.clock() - client.read().force_time > 0.5


def test_the_zero_is_set_to_what_is_felt_now_and_what_changes_from_then_on_is_measured():
    with emulated(1, 2, 3, 0.1, 0.2, 0.3) as sensor, opened(sensor) as client:
        client.zero()
        assert client.read().wrench == pytest.approx((0,) * 6, abs=1e-5)
        ticks = itertools.count()
        sensor.fin.now = lambda: FinMotion(
            0.0, 0.0, 0.0, 0.0, (1 + 0.01 * (-1) ** next(ticks), 2.0, 3.0, 0.1, 0.2, 0.3)
        )
        mean, deviation = client.measured(0.3)
    assert mean == pytest.approx((0,) * 6, abs=0.005)
    assert deviation == pytest.approx((0.01, 0, 0, 0, 0, 0), abs=0.001)


def test_a_sensor_at_another_rate_is_refused():
    with (
        emulated(rate_hz=500.0) as sensor,
        pytest.raises(RigError, match=r"sends \d+ records per second, but rate_hz is"),
    ):
        axia80_sensor(config_of(sensor), sensor.clock).open()


def test_a_sensor_that_sends_nothing_is_said_with_what_was_tried():
    with emulated() as sensor:
        deaf = SimulatedSocket(sensor.clock, "127.0.0.1")
        port = deaf.address[1]
        client = axia80_sensor(config_of(sensor, rdt_port=port), sensor.clock)
        with pytest.raises(
            DeviceError, match=rf"no record arrived from UDP port {port} .*firewall"
        ):
            client.open()
        with pytest.raises(DeviceError, match="not open"):
            client.read()


def test_a_sensor_is_opened_again_after_it_was_closed(pair):
    _, client = pair
    client.close()
    client.close()
    with pytest.raises(DeviceError, match="not open; open it first"):
        client.read()
    client.open()
    client.read()
    assert client.counters()["sensor_lost"] == 0


def test_before_it_is_open_there_is_nothing_to_say():
    client = axia80_sensor(Axia80Config(address="192.0.2.1", frame="x,y"))
    client.close()
    assert (client.counters(), client.complaints(), client.notes()) == (
        dict.fromkeys(client.counters(), 0),
        (),
        (),
    )


def test_a_blow_shows_at_once_unfiltered_in_softfins_axes() -> None:
    with (
        emulated(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, frame="y,-x") as sensor,
        opened(sensor, frame="y,-x") as client,
    ):
        client.read()
        sensor.fin.wrench = (-20.0, 3.0, 0.0, 0.0, 0.0, 0.0)
        reading = next(r for r in read_for(client, 0.5) if max(r.peak) > 1)
        assert reading.peak == pytest.approx((20.0, 3.0, 0.0, 0.0, 0.0, 0.0), abs=1e-3)
        assert abs(reading.wrench[0]) < 10
        sensor.fin.wrench = (0.0,) * 6
        assert max(read_for(client, 0.5)[-1].peak) == pytest.approx(0.0, abs=1e-3)
