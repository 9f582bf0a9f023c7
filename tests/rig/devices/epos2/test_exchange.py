import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfin.rig.devices.epos2.exchange import Handshake

FIRST = (1, 1)
SECOND = (2, 2)
THIRD = (3, 3)


def test_a_target_is_raised_acknowledged_and_lowered() -> None:
    shake = Handshake(0.06)
    shake.waiting = FIRST
    assert shake.step(False, 0.0) == FIRST
    assert shake.step(False, 0.01) is None
    assert shake.step(True, 0.02) is True
    assert shake.step(True, 0.03) is None
    assert shake.step(False, 0.04) is None
    shake.waiting = SECOND
    assert shake.step(False, 0.05) == SECOND


def test_the_newest_target_wins() -> None:
    shake = Handshake(0.06)
    for each in (FIRST, SECOND, THIRD):
        shake.waiting = each
        shake.step(False, 0.0)
    assert shake.current == FIRST
    assert shake.step(True, 0.01) is True
    assert shake.step(False, 0.02) == THIRD


def test_a_target_without_acknowledge_is_lowered_and_raised_again() -> None:
    shake = Handshake(0.06)
    shake.waiting = FIRST
    assert shake.step(False, 0.0) == FIRST
    assert shake.step(False, 0.1) is True
    assert shake.step(False, 0.11) == FIRST
    assert (shake.repeated, shake.unanswered) == (1, 1)
    assert shake.step(True, 0.12) is True
    assert shake.unanswered == 0


def test_a_newer_target_is_not_overtaken_by_the_one_that_was_lost() -> None:
    shake = Handshake(0.06)
    shake.waiting = FIRST
    shake.step(False, 0.0)
    shake.waiting = SECOND
    assert shake.step(False, 0.1) is True
    assert shake.step(False, 0.11) == SECOND


def test_a_lowering_that_was_lost_is_sent_again() -> None:
    shake = Handshake(0.06)
    shake.waiting = FIRST
    shake.step(False, 0.0)
    assert shake.step(True, 0.01) is True
    shake.waiting = SECOND
    assert shake.step(True, 0.02) is None
    assert shake.step(True, 0.1) is True
    assert shake.step(False, 0.11) == SECOND


@pytest.mark.parametrize("raised", [True, False], ids=["after a target", "before the first target"])
def test_a_drive_whose_acknowledgement_never_falls_is_counted(raised: bool) -> None:
    shake = Handshake(0.06)
    now = 5.0
    shake.waiting = FIRST
    if raised:
        assert shake.step(False, now) == FIRST
        assert shake.step(True, now) is True
        shake.waiting = SECOND
    while shake.unanswered < 3:
        now += 0.01
        assert now < 6
        assert not isinstance(shake.step(True, now), tuple)


@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.floats(0.001, 0.1)), max_size=60))
def test_whatever_the_drive_says_the_last_offer_is_current_or_waiting(
    steps: list[tuple[bool, bool, float]],
) -> None:
    shake = Handshake(0.06)
    now = 0.0
    last = None
    count = 0
    for offered, acknowledged, passed in steps:
        now += passed
        if offered:
            count += 1
            last = (count, 1)
            shake.waiting = last
        shake.step(acknowledged, now)
    # A drive that answers as it should then takes it, at the latest when it is repeated.
    acknowledged = False
    for _ in range(20):
        now += 0.01
        step = shake.step(acknowledged, now)
        acknowledged = isinstance(step, tuple) or (acknowledged and step is not True)
    if last is not None:
        assert shake.current == last
