import os

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfin.rig.ros2.connection import (
    BOOL,
    CREEP,
    StampClock,
    Subscription,
    decode_ros_message,
    read_joint,
    read_reference_message,
    read_stamp,
    read_wrench,
)
from softfin.storage.bag.messages import cdr
from tests.rig.ros2_memory import JOINT, WRENCH, MemoryTransport, Messages

MESSAGES = Messages()
numbers = st.floats(allow_nan=False, allow_infinity=False)


@given(numbers, numbers, st.integers(1, 2**31 * 10**9 - 1), st.text(max_size=5))
def test_a_joint_comes_back_as_it_went(angle, velocity, stamp, frame):
    frame = frame.replace("\0", "")
    message = decode_ros_message(cdr(JOINT, stamp, (angle, velocity), frame), JOINT)
    assert read_joint(message, "fin") == (angle, velocity)
    assert read_stamp(message) == stamp
    assert message.header.frame_id == frame


@given(st.tuples(*[numbers] * 6))
def test_a_wrench_comes_back_as_it_went(wrench):
    message = decode_ros_message(cdr(WRENCH, 1, wrench, ""), WRENCH)
    assert read_wrench(message) == wrench


@given(st.binary(max_size=300), st.sampled_from([JOINT, WRENCH, BOOL]))
def test_any_bytes_are_a_message_or_refused(data, kind):
    told = kind
    try:
        decode_ros_message(data, kind)
    except ValueError as error:
        told = str(error)
    assert kind in told
    assert "\n" not in told


def test_a_joint_among_others_is_found_by_its_name():
    message = MESSAGES.joint(1, "", "fin", 1.0, 2.0)
    message.name = ["a", "fin"]
    message.position = np.array([0.0, 3.0])
    message.velocity = np.zeros(0)
    assert read_joint(message, "fin") == (3.0, None)
    with pytest.raises(ValueError, match=r"no joint 'tail'; its joints are 'a', 'fin'"):
        read_joint(message, "tail")
    message.position = np.zeros(1)
    with pytest.raises(ValueError, match="2 names, 1 positions"):
        read_joint(message, "fin")


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_what_is_no_number_is_refused(bad):
    with pytest.raises(ValueError, match="velocity is"):
        read_joint(MESSAGES.joint(1, "", "fin", 0.0, bad), "fin")
    for index in range(6):
        wrench = [0.0] * 6
        wrench[index] = bad
        with pytest.raises(ValueError, match=r"(force|torque) [xyz] is"):
            read_wrench(MESSAGES.wrench(1, "", tuple(wrench)))
    with pytest.raises(ValueError, match="y is"):
        read_reference_message(MESSAGES.wrench(1, "", (0.0, bad, 0.0, 0.0, 0.0, 0.0)), "fin_mount")


def test_references_are_of_our_frame():
    wrench = MESSAGES.wrench(1, "fin_mount", (1.0, -2.0, 9.0, 9.0, 9.0, 9.0))
    unnamed = MESSAGES.wrench(1, "", (3.0, 4.0, 0.0, 0.0, 0.0, 0.0))
    assert read_reference_message(wrench, "fin_mount") == (1.0, -2.0)
    assert read_reference_message(unnamed, "fin_mount") == (3.0, 4.0)
    with pytest.raises(ValueError, match="frame is 'fin_mount', expected 'base'"):
        read_reference_message(wrench, "base")


START = 1_700_000_000 * 10**9


@given(st.lists(st.floats(0, 0.05), min_size=2, max_size=60))
def test_a_reading_is_never_later_than_its_message_nor_older_than_the_delay(delays):
    clock = StampClock()
    for tick, delay in enumerate(delays):
        received = 100 + 0.1 * tick + delay
        time = clock.time(START + tick * 10**8, received)
        assert time is not None
        assert time <= received + 1e-6
        # The smallest delay so far counts as none.
        assert time == pytest.approx(
            100 + 0.1 * tick + min(delays[: tick + 1]), abs=CREEP * 0.1 * len(delays) + 1e-6
        )


def test_a_sender_whose_clock_drifts_is_followed():
    clock = StampClock()
    drift = 5e-5
    for tick in range(100 * 600):
        received = tick * 0.01
        time = clock.time(START + round(received * (1 - drift) * 1e9), received)
    assert time == pytest.approx(received, abs=1e-3)


def test_a_frozen_stamp_or_a_date_that_was_set_back_gives_no_new_readings():
    clock = StampClock()
    assert clock.time(START, 1.0) == 1.0
    assert clock.time(START, 1.1) is None
    assert clock.time(START - 10**9, 1.2) is None
    # Set forward, it counts from when it comes.
    assert clock.time(START + 3600 * 10**9, 1.3) == pytest.approx(1.3)
    assert clock.time(START + 3600 * 10**9, 1.4) is None


def test_messages_without_stamps_count_from_when_they_come():
    clock = StampClock()
    assert [clock.time(0, at) for at in (1.0, 2.0)] == [1.0, 2.0]


def test_what_cannot_be_used_is_counted_and_told_until_the_next_that_can():
    transport = MemoryTransport()
    messages = Messages()
    subscription = Subscription(
        transport,
        "/joint",
        JOINT,
        lambda message: read_joint(message, "fin"),
        quality="best_effort",
    )
    assert transport.asked == {"/joint": [(JOINT, "best_effort")]}
    transport.put("/joint", messages.joint(START, "", "fin", 1.0, 2.0), 5.0)
    transport.put("/joint", messages.joint(START, "", "fin", 1.0, 2.0), 5.0)
    transport.put("/joint", messages.joint(START + 1, "", "fin", np.nan, 2.0), 5.0)
    transport.put("/joint", b"\x00\x01\x00\x00no", 5.0)
    assert subscription.take() == [(5.0, (1.0, 2.0))]
    assert (subscription.received, subscription.refused, subscription.not_newer) == (4, 2, 1)
    assert subscription.refusal is not None
    assert subscription.refusal.startswith(
        "/joint: message rejected: 6 bytes are not a valid sensor_msgs/msg/JointState"
    )
    transport.put("/joint", messages.joint(START + 2, "", "fin", 1.0, 2.0), 6.0)
    assert len(subscription.take()) == 1
    assert subscription.refusal is None


def test_damaged_messages_are_told_or_refused_and_nothing_else():
    cases = 100_000 if os.environ.get("SOFTFIN_LONG") == "1" else 2_000
    generator = np.random.default_rng(7)
    messages = Messages()
    transport = MemoryTransport()
    kinds = {
        JOINT: lambda message: read_joint(message, "fin"),
        WRENCH: read_wrench,
        BOOL: lambda message: (message.data,),
    }
    whole = {
        JOINT: messages.joint(START, "fin_mount", "fin", 1.0, 2.0),
        WRENCH: messages.wrench(START, "fin_mount", (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)),
        BOOL: messages.make(BOOL, True),
    }
    subscriptions = [
        Subscription(transport, f"/{kind}", kind, value) for kind, value in kinds.items()
    ]
    for case in range(cases):
        subscription = subscriptions[case % len(subscriptions)]
        data = bytearray(messages.encode(whole[subscription.kind]))
        for _ in range(generator.integers(1, 6)):
            data[generator.integers(len(data))] = generator.choice(
                [0, 1, 127, 128, 255, generator.integers(256)]
            )
        transport.put(
            subscription.topic, bytes(data[: generator.integers(len(data) + 1)]), 1.0 + case
        )
        for told in subscription.take():
            assert np.isfinite([number for number in told[1] if number is not None]).all()
            assert told[0] <= 1.0 + case
    assert sum(subscription.received for subscription in subscriptions) == cases
    assert all(subscription.refused > subscription.received / 4 for subscription in subscriptions)


def test_a_reader_in_memory_keeps_as_many_messages_as_asked_for():
    transport = MemoryTransport()
    takes = [transport.subscribe("/x", BOOL, depth=depth).take for depth in (3, 10)]
    for number in range(12):
        transport.put("/x", bytes([number]))
    first = [[data[0] for data, _ in take()] for take in takes]
    assert first == [[9, 10, 11], list(range(2, 12))]
    assert [take() for take in takes] == [[], []]
