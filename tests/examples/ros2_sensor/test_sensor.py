"""A sensor behind a ROS 2 topic, in simulated time: what it reads, and each of its faults."""

import re
from contextlib import contextmanager
from math import inf, nan

import pytest
from examples.ros2_sensor.softfin_ros2_sensor import TopicSensorConfig, topic_sensor

from softfin.core.errors import DeviceError, RigError
from softfin.emulation.clock import SimulatedClock
from softfin.storage.bag.messages import SECOND_NS
from softfin.testing import check_force_sensor
from tests.examples.ros2_sensor.emulated_topic import EmulatedTopic
from tests.examples.ros2_sensor.installed import simulate_topics
from tests.rig.simulated_topics import SimulatedTransport
from tests.rig.still_fin import StillFin

LOAD = (2.0, -1.0, 0.0, 0.0, 0.0, 0.0)
TOPIC = "/ft_sensor/wrench"


@contextmanager
def bench(rate_hz=320.0, **changes):
    clock = SimulatedClock()
    emulated = EmulatedTopic(SimulatedTransport(clock), StillFin(*LOAD), rate_hz, clock, TOPIC)
    values = {"rate_hz": rate_hz, "filter_delay_s": 0.0, "frame": "y,-x", "topic": TOPIC}
    sensor = topic_sensor(TopicSensorConfig.build(values | changes), clock)
    with pytest.MonkeyPatch.context() as patches:
        simulate_topics(patches, clock)
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


def later(message, seconds):
    """The message with another stamp."""
    return message._replace(stamp_ns=message.stamp_ns + round(seconds * SECOND_NS))


def notes_of(sensor):
    return [row.text for row in sensor.checks() if row.state == "note"]


@pytest.mark.parametrize("rate_hz", [10.0, 80.0, 320.0, 1000.0])
def test_it_meets_the_contract_of_a_force_sensor_at_every_rate(rate_hz):
    with bench(rate_hz) as (emulated, sensor, _):
        check_force_sensor(sensor, emulated.silence)


@pytest.mark.parametrize(("rate_hz", "is_noted"), [(80.0, True), (100.0, False), (320.0, False)])
def test_forces_are_turned_into_softfins_axes_and_a_slow_sensor_is_noted(rate_hz, is_noted):
    with bench(rate_hz) as (_, sensor, clock):
        sensor.open()
        assert run(sensor, clock, 0.2).wrench[:3] == pytest.approx((2.0, -1.0, 0.0), abs=0.01)
        assert [
            f"{rate_hz:g} messages per second are fewer" in note for note in sensor.notes()
        ] == [True] * is_noted
        (described, *_) = sensor.checks()
        assert described.text.startswith(f"WrenchStamped in the frame 'ft_sensor', {rate_hz:.0f}/s")


def test_the_zero_is_kept_by_softfin():
    with bench() as (_, sensor, clock):
        sensor.open()
        sensor.zero()
        assert run(sensor, clock, 0.1).wrench[:2] == pytest.approx((0.0, 0.0), abs=0.01)
        kept = sensor.zero_wrench
        sensor.open()
        assert run(sensor, clock, 0.1).wrench[:2] == pytest.approx((2.0, -1.0), abs=0.01)
        sensor.restore_zero(kept)
        assert run(sensor, clock, 0.1).wrench[:2] == pytest.approx((0.0, 0.0), abs=0.01)


@pytest.mark.parametrize("ahead_s", [0.0, 3600.0, -86400.0])
def test_the_time_of_the_force_does_not_depend_on_the_drivers_clock(ahead_s):
    with bench(filter_delay_s=0.02) as (emulated, sensor, clock):
        emulated.transmit = lambda message: (later(message, ahead_s),)
        sensor.open()
        reading = run(sensor, clock, 1.0)
        age = clock() - reading.force_time
        # A message is up to 2 periods of the emulator old.
        assert sensor.delay_s > 0.02
        assert sensor.delay_s - 1e-6 <= age <= sensor.delay_s + 2 / 320
        assert sensor.counters()["sensor_lost"] == 0
        assert any("from another clock" in note for note in notes_of(sensor)) == bool(ahead_s)


def test_a_delay_between_stamp_and_arrival_is_noted():
    with bench() as (emulated, sensor, _):
        emulated.transmit = lambda message: (later(message, -0.05),)
        sensor.open()
        (note,) = notes_of(sensor)
        # The emulator is up to a period late.
        assert re.fullmatch(
            "messages arrive 5[0-4] ms after their time stamps; if both clocks agree, include this "
            "delay in filter_delay_s",
            note,
        )
        emulated.transmit = lambda message: (message,)
        sensor.open()
        assert notes_of(sensor) == []


def test_a_growing_lag_ages_the_force():
    with bench() as (emulated, sensor, clock):
        sensor.open()
        before = run(sensor, clock, 0.5).force_time
        started = clock()
        emulated.transmit = lambda message: (later(message, (started - clock()) / 2),)
        after = run(sensor, clock, 0.5).force_time
        assert after - before == pytest.approx(0.25, abs=0.01)
        assert sensor.counters()["sensor_late"] == 0


def test_a_driver_that_stamps_its_messages_in_pairs_loses_none():
    with bench(125.0) as (emulated, sensor, clock):
        waiting = []

        def in_pairs(message):
            waiting.append(message)
            if len(waiting) < 2:
                return ()
            first, second = waiting
            waiting.clear()
            # Equal stamps would mean a doubled message.
            return first._replace(stamp_ns=second.stamp_ns - 100_000), second

        emulated.transmit = in_pairs
        sensor.open()
        lost = sensor.counters()["sensor_lost"]
        # The first message may be the second one of a pair.
        assert lost <= 1
        reading = run(sensor, clock, 2.0)
        assert sensor.counters()["sensor_lost"] == lost
        assert sensor.complaints() == ()
        assert clock() - reading.force_time < 0.1
        emulated.transmit = lambda message: ()
        clock.sleep(0.1)
        emulated.transmit = in_pairs
        run(sensor, clock, 0.1)
        assert sensor.counters()["sensor_lost"] - lost in (11, 12, 13)


@pytest.mark.parametrize("speed", [0.5, 0.85])
def test_a_clock_that_is_too_slow_is_refused(speed):
    with bench() as (emulated, sensor, clock):
        start_ns = round(clock.wall() * SECOND_NS)
        emulated.transmit = lambda message: (
            message._replace(stamp_ns=start_ns + round(speed * (message.stamp_ns - start_ns))),
        )
        rate_hz = round(320 / speed)
        reason = (
            rf"3\d\d messages arrive per second, but according to their timestamps .* is {rate_hz};"
        )
        with pytest.raises(RigError, match=reason):
            sensor.open()


def test_silence_ages_the_force_and_is_a_fault():
    with bench() as (emulated, sensor, clock):
        sensor.open()
        before = run(sensor, clock, 0.2)
        emulated.silence()
        after = run(sensor, clock, 1.6)
        assert after.force_time - before.force_time < 0.05
        (complaint,) = sensor.complaints()
        assert complaint.startswith(f"force sensor {TOPIC}: no usable message for 1.")
        assert complaint.endswith("; check its driver and the network")


def test_a_publisher_that_is_gone_is_a_fault_at_once():
    with bench() as (emulated, sensor, clock):
        sensor.open()
        run(sensor, clock, 0.2)
        emulated.unplug()
        run(sensor, clock, 0.01)
        assert sensor.complaints() == (
            f"force sensor {TOPIC}: no longer has a publisher; restart its driver",
        )


@pytest.mark.parametrize(
    ("transmit", "counter"),
    [
        (
            lambda message: (message._replace(wrench=(nan, *message.wrench[1:])),),
            "sensor_malformed",
        ),
        (
            lambda message: (message._replace(wrench=(*message.wrench[:5], inf)),),
            "sensor_malformed",
        ),
        (lambda message: (message._replace(stamp_ns=0),), "sensor_malformed"),
        (lambda message: (message._replace(frame_id="camera"),), "sensor_malformed"),
        (lambda message: (message, message), "sensor_late"),
        (lambda message: (message, later(message, -0.01)), "sensor_late"),
        (lambda message: (), "sensor_lost"),
    ],
)
def test_single_messages_that_are_nonsense_doubled_old_or_lost_are_counted_and_bridged(
    transmit, counter
):
    with bench(frame_id="ft_sensor") as (emulated, sensor, clock):
        sensor.open()
        before = sensor.counters()[counter]
        numbers = iter(range(10**9))
        emulated.transmit = lambda message: (
            transmit(message) if next(numbers) % 50 == 49 else (message,)
        )
        for _ in range(100):
            reading = run(sensor, clock, 0.01)
            assert reading.wrench[:2] == pytest.approx((2.0, -1.0), abs=0.01)
            assert max(reading.peak) < 2.01
            assert clock() - reading.force_time < 0.15
        assert sensor.counters()[counter] - before == 6
        assert sensor.complaints() == ()


@pytest.mark.parametrize(
    ("transmit", "words"),
    [
        (
            lambda message: (message._replace(wrench=(nan, *message.wrench[1:])),),
            "message rejected: its force x is nan, not finite; correct its publisher",
        ),
        (
            lambda message: (message._replace(stamp_ns=0),),
            "message rejected: its header.stamp is 0, but must be the time of the sample; correct",
        ),
        (
            lambda message: (message._replace(frame_id="camera"),),
            "message rejected: its frame is 'camera', expected 'ft_sensor'; correct its publisher",
        ),
        (
            lambda message: (later(message, -60.0),),
            "time stamps do not increase; check its driver's clock, then start again",
        ),
    ],
)
def test_messages_that_are_never_usable_are_a_fault(transmit, words):
    with bench(frame_id="ft_sensor") as (emulated, sensor, clock):
        sensor.open()
        assert sensor.complaints() == ()
        emulated.transmit = transmit
        before = run(sensor, clock, 0.01).force_time
        assert run(sensor, clock, 0.2).force_time - before < 0.02
        (complaint,) = sensor.complaints()
        assert f"{TOPIC}: {words}" in complaint


def test_unusable_messages_between_good_ones_are_no_fault():
    with bench(80.0) as (emulated, sensor, clock):
        sensor.open()
        numbers = iter(range(10**9))
        nonsense = (nan,) * 6
        emulated.transmit = lambda message: (
            message._replace(wrench=nonsense) if next(numbers) % 8 == 7 else message,
        )
        for _ in range(100):
            run(sensor, clock, 0.01)
            assert sensor.complaints() == ()
        assert sensor.counters()["sensor_malformed"] == 10


def test_messages_without_a_stamp_are_refused_with_the_reason():
    with bench() as (emulated, sensor, _):
        emulated.transmit = lambda message: (message._replace(stamp_ns=0),)
        with pytest.raises(
            DeviceError,
            match=r"^force sensor /ft_sensor/wrench: message rejected: its header\.stamp is 0, .*; correct its publisher",
        ):
            sensor.open()


def test_values_that_stand_still_are_a_fault():
    with bench() as (emulated, sensor, clock):
        sensor.open()
        emulated.are_values_frozen = True
        run(sensor, clock, 1.2)
        assert "values are frozen" in sensor.complaints()[0]


def with_channel(index, value):
    """Replace the value of one channel in each message."""

    def change(message):
        wrench = list(message.wrench)
        wrench[index] = value
        return (message._replace(wrench=tuple(wrench)),)

    return change


@pytest.mark.parametrize(
    ("index", "channel"), [(0, "force_x"), (1, "force_y"), (2, "force_z"), (5, "torque_z")]
)
@pytest.mark.parametrize("value", [1.25, 1000.0, 0.0])
def test_one_frozen_channel_is_a_fault_within_a_second(index, channel, value):
    with bench() as (emulated, sensor, clock):
        sensor.open()
        run(sensor, clock, 0.5)
        emulated.transmit = with_channel(index, value)
        run(sensor, clock, 0.85)
        assert sensor.complaints() == ()
        run(sensor, clock, 0.15)
        assert f"values are frozen ({channel}); check the sensor" in sensor.complaints()[0]


@pytest.mark.parametrize(
    ("dead", "words"), [(range(2, 6), None), (range(1, 6), "frozen (force_y);")]
)
def test_channels_that_are_always_0_are_not_a_fault_except_force_x_and_y(dead, words):
    with bench() as (emulated, sensor, clock):

        def transmit(message):
            wrench = tuple(
                0.0 if index in dead else value for index, value in enumerate(message.wrench)
            )
            return (message._replace(wrench=wrench),)

        emulated.transmit = transmit
        sensor.open()
        run(sensor, clock, 2.0)
        complaints = sensor.complaints()
        assert bool(complaints) == (words is not None)
        assert words is None or words in complaints[0]


def test_a_pause_of_the_loop_does_not_make_old_messages_look_new():
    with bench() as (emulated, sensor, clock):
        sensor.open()
        run(sensor, clock, 0.2)
        emulated.silence()
        clock.sleep(5.0)
        assert clock() - sensor.read().force_time > 4.9


def test_a_pause_of_the_loop_loses_no_messages():
    with bench(1000.0) as (_, sensor, clock):
        sensor.open()
        clock.sleep(1.5)
        reading = run(sensor, clock, 0.01)
        assert clock() - reading.force_time < 0.05
        assert sensor.counters()["sensor_lost"] == 0


@pytest.mark.parametrize("actual_hz", [160.0, 640.0])
def test_a_wrong_rate_is_refused(actual_hz):
    with bench() as (emulated, sensor, _):
        emulated.rate_hz = actual_hz
        message = rf"sends {actual_hz:.0f} messages per second, but rate_hz is 320; change one"
        with pytest.raises(RigError, match=message):
            sensor.open()


def test_a_wrong_topic_is_refused_with_the_topics_that_were_found():
    with bench(topic="/wrench") as (_, sensor, _):
        found = rf"found {TOPIC} \(geometry_msgs/msg/WrenchStamped\); start its driver, or correct"
        with pytest.raises(
            DeviceError, match=f"^force sensor /wrench: no .*WrenchStamped within 5 s; {found}"
        ):
            sensor.open()
        with pytest.raises(DeviceError, match="not open; open it first"):
            sensor.read()


def test_two_publishers_on_one_topic_are_refused_and_are_a_fault_later_on():
    with bench() as (_, sensor, clock):
        sensor.open()
        run(sensor, clock, 0.2)
        second = EmulatedTopic(SimulatedTransport(clock), StillFin(*LOAD), 320.0, clock, TOPIC)
        try:
            run(sensor, clock, 0.01)
            assert len(set(sensor.complaints())) == 1
            two = rf"{TOPIC}: has 2 publishers \(node \d+, node \d+\); stop all but one"
            with pytest.raises(DeviceError, match=two):
                sensor.open()
        finally:
            second.close()
        sensor.open()
