"""What a drive may do that no fault of its own tells: each must be said, or nobody knows that the fin does not obey."""

import itertools

import can
import pytest

from softfin.core.errors import SafetyStop
from softfin.core.quantities import Limits
from softfin.rig.emulation import drive_states
from softfin.rig.epos2.power import REFUSED
from softfin.rig.epos2.seen import MISSING_S, Seen
from softfin.rig.epos2.target import Handshake, Setpoint
from softfin.rig.machine import Target
from softfin.rig.safety import Guard, SafetyConfig
from softfin.rig.session import Session
from tests.rig.epos2_bench import NODE, drive_config, enabled
from tests.rig.rigs import emulated


def test_velocity_and_current_that_stop_coming_are_a_complaint():
    seen = Seen(NODE)
    for tick in itertools.count():
        seen.synchronised(tick * 0.01)
        seen.take(0x180 + NODE, bytes(6), tick * 0.01)
        seen.take(0x380 + NODE, bytes(4), tick * 0.01)
        if tick < 10:
            seen.take(0x280 + NODE, bytes(6), tick * 0.01)
        if seen.missing():
            break
        assert tick * 0.01 <= 0.09 + MISSING_S + 0.011
    assert tick > 10
    assert "process data 2 are missing for 0.1" in seen.missing()
    seen.take(0x280 + NODE, bytes(6), 9.0)
    assert seen.missing() is None


def test_a_drive_that_answers_nothing_is_left_to_the_age_of_its_angle():
    seen = Seen(NODE)
    for number, length in ((0x180, 6), (0x280, 6), (0x380, 4)):
        seen.take(number + NODE, bytes(length), 0.0)
    seen.synchronised(10.0)
    assert seen.missing() is None


def test_a_drive_whose_acknowledgement_never_falls_is_told():
    shake, now = Handshake(patience=0.06), 0.0
    shake.offer(Setpoint(10, 100))
    assert shake.step(False, now) == Setpoint(10, 100)
    assert shake.step(True, now) is True
    shake.offer(Setpoint(20, 100))
    while shake.unanswered < 3:
        now += 0.01
        assert now < 1
        assert not isinstance(shake.step(True, now), Setpoint)


def test_one_that_is_acknowledging_already_when_the_first_target_comes_is_told_too():
    shake, now = Handshake(patience=0.06), 5.0
    shake.offer(Setpoint(10, 100))
    while shake.unanswered < 3:
        now += 0.01
        assert now < 6
        assert not isinstance(shake.step(True, now), Setpoint)


def test_a_stop_that_the_drive_does_not_confirm_is_in_doubt_and_a_complaint(monkeypatch):
    obey = drive_states.by_controlword
    with enabled() as made:
        assert made.until(lambda: True)
        made.drive.stop()
        assert made.drive.stop_unconfirmed is None
        made.drive.enable()
        monkeypatch.setattr(
            drive_states,
            "by_controlword",
            lambda state, word, before: state if word in (0, 2) else obey(state, word, before),
        )
        made.drive.stop()
        assert "press the emergency stop" in made.drive.stop_unconfirmed
        assert made.drive.complaints() == (made.drive.stop_unconfirmed,)
        monkeypatch.undo()
        made.drive.stop()
        assert made.drive.stop_unconfirmed is None


def test_a_stop_over_a_cut_cable_does_not_claim_that_the_motor_is_off():
    with emulated() as (behind, bench):
        guard = Guard(bench.safety, bench.machine.limits)
        with Session(bench.machine, guard) as session:
            session.activate()
            behind.drive.go_silent()
            session.stop_request.ask("emergency_stop", "stopped by a key")
            with pytest.raises(SafetyStop) as stopped:
                session.tick()
    assert str(stopped.value).startswith("stopped: stopped by a key; BUT drive did not confirm")
    assert stopped.value.exit_code == 3


def test_a_command_that_safety_lets_pass_is_taken_and_put_on_the_limit():
    # A controller for pi/2, and a rig's file that says 1.57.
    with enabled(angle_max_rad=1.57) as made:
        target = Target(1.5708, 3.14)
        config = made.drive.config
        limits = Limits(config.angle_min_rad, config.angle_max_rad, config.slowest_rad_s, config.fastest_rad_s)
        assert Guard(SafetyConfig(), limits).check_target(target) is None
        made.drive.command(target)
        assert made.until(lambda: made.drive.sync_and_read().angle == pytest.approx(1.57, abs=1e-3))
        assert made.emulated.state.words == "operation enabled"


def test_a_stop_over_a_bus_that_takes_no_frames_ends_soon(monkeypatch):
    with enabled() as made:
        bus, tried = made.drive._wire._bus, []

        def send(message, timeout=None):
            tried.append(message.arbitration_id)
            made.clock.sleep(0.001)
            raise can.CanOperationError("transmit buffer full")

        monkeypatch.setattr(bus, "send", send)
        made.drive.stop()
        assert 0 < tried.count(0x200 + NODE) <= 2 * REFUSED + 1
        assert "press the emergency stop" in made.drive.stop_unconfirmed
        monkeypatch.undo()


def test_a_quick_stop_that_takes_its_time_is_refused():
    with pytest.raises(ValueError, match=r"quick_stop_rad_s2 2 takes 1.6 s to stop from fastest_rad_s: .* give 6.3"):
        drive_config(quick_stop_rad_s2=2.0)
