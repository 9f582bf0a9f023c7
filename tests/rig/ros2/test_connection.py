import os

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfin.rig.ros2.connection import CREEP, StampClock, Stamped, Subscription
from softfin.rig.ros2.messages import JOINT, WRENCH, Messages, joint_of, wrench_of
from tests.rig.ros2_memory import MemoryTransport

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
        assert time == pytest.approx(100 + 0.1 * tick + min(delays[: tick + 1]), abs=CREEP * 0.1 * len(delays) + 1e-6)


def test_a_sender_whose_clock_drifts_is_followed():
    clock, drift = StampClock(), 5e-5
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
    transport, messages = MemoryTransport(), Messages()
    subscription = Subscription(
        transport, messages, "/joint", JOINT, lambda message: joint_of(message, "fin"), best_effort=True
    )
    assert transport.asked == {"/joint": (JOINT, True)}
    transport.put("/joint", messages.joint(START, "", "fin", 1.0, 2.0), 5.0)
    transport.put("/joint", messages.joint(START, "", "fin", 1.0, 2.0), 5.0)
    transport.put("/joint", messages.joint(START + 1, "", "fin", np.nan, 2.0), 5.0)
    transport.put("/joint", b"\x00\x01\x00\x00no", 5.0)
    assert subscription.take() == [Stamped(5.0, 5.0, (1.0, 2.0))]
    assert (subscription.received, subscription.refused, subscription.not_newer) == (4, 2, 1)
    assert subscription.refusal is not None
    assert subscription.refusal.startswith("/joint: refused: 6 bytes that are no sensor_msgs/msg/JointState")
    transport.put("/joint", messages.joint(START + 2, "", "fin", 1.0, 2.0), 6.0)
    assert len(subscription.take()) == 1
    assert subscription.refusal is None


def test_damaged_messages_are_told_or_refused_and_nothing_else():
    cases = 100_000 if os.environ.get("SOFTFIN_LONG") == "1" else 2_000
    generator, messages, transport = np.random.default_rng(7), Messages(), MemoryTransport()
    kinds = {JOINT: lambda message: joint_of(message, "fin"), WRENCH: wrench_of}
    whole = {JOINT: messages.joint(START, "fin_mount", "fin", 1.0, 2.0),
             WRENCH: messages.wrench(START, "fin_mount", (1.0, 2.0, 3.0, 4.0, 5.0, 6.0))}  # fmt: skip
    subscriptions = [Subscription(transport, messages, f"/{kind}", kind, value) for kind, value in kinds.items()]
    for case in range(cases):
        subscription = subscriptions[case % 2]
        data = bytearray(messages.encode(whole[subscription.kind]))
        for _ in range(generator.integers(1, 6)):
            data[generator.integers(len(data))] = generator.choice([0, 1, 127, 128, 255, generator.integers(256)])
        transport.put(subscription.topic, bytes(data[: generator.integers(len(data) + 1)]), 1.0 + case)
        for told in subscription.take():
            assert np.isfinite([number for number in told.value if number is not None]).all()
            assert told.time <= told.received
    assert sum(subscription.received for subscription in subscriptions) == cases
    assert all(subscription.refused > subscription.received / 4 for subscription in subscriptions)
