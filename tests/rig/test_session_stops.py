"""What a review found in sessions: stops that take their time, machines in doubt, an input that
ends."""

import io

import pytest

from softfin.core.errors import ConfigurationError, DeviceError, SafetyStop
from softfin.emulation.clock import SimulatedClock
from softfin.rig.arming import Arming, typed
from softfin.rig.machine import Machine, Sample, Target
from softfin.rig.rig import Rig
from softfin.rig.robot_setup import RobotSetup
from softfin.rig.safety import Guard, SafetyConfig
from softfin.rig.session import Session
from softfin.rig.stop import StopRequest, listen_to_keyboard
from tests.patience import HANG_S
from tests.rig.machines import FreeFin, Notes
from tests.rig.rigs import config_of, simulated

CALM = SafetyConfig()


class SlowToBrake(FreeFin):
    """Its first stop while enabled takes longer than the watchdog's patience."""

    def stop(self) -> None:
        slow = self.enabled
        super().stop()
        if slow:
            self.clock.sleep(0.6)


class Unsure(FreeFin):
    """Cannot say that its motor is off."""

    def stop(self) -> None:
        if self.enabled:
            self.stop_unconfirmed = "the motor may be on; pull the plug"
        super().stop()


def test_a_fin_that_brakes_slowly_can_be_activated_again():
    machine = SlowToBrake(SimulatedClock())
    with Session(machine, Guard(CALM, machine.limits)) as session:
        session.activate()
        session.deactivate()
        assert session.trip is None
        session.activate()
        session.hold(Target(0.2, 2.0), 2)


def test_the_reason_of_a_slow_stop_is_what_was_wrong_and_not_the_silence_meanwhile():
    machine = SlowToBrake(SimulatedClock())
    machine.command = lambda target: (_ for _ in ()).throw(ValueError("a frame was refused"))
    made = Session(machine, Guard(CALM, machine.limits))
    with made, pytest.raises(SafetyStop, match="a frame was refused"):
        made.activate()
    assert made.trip.cause == "device"


def test_a_motor_that_may_be_on_is_told_and_recorded():
    machine = Unsure(SimulatedClock())
    notes = Notes(machine)
    with Session(machine, Guard(CALM, machine.limits)) as session:
        session.recorder = notes
        session.activate()
        session.stop_request.ask("emergency_stop", "stopped by a key")
        with pytest.raises(SafetyStop) as stopped:
            session.tick()
    assert str(stopped.value) == "stopped: stopped by a key; BUT the motor may be on; pull the plug"
    assert notes.events[-1] == "but the motor may be on; pull the plug"


def test_a_rest_that_was_not_confirmed_ends_the_session():
    machine = Unsure(SimulatedClock())
    with Session(machine, Guard(CALM, machine.limits)) as session:
        session.activate()
        with pytest.raises(SafetyStop, match="BUT the motor may be on"):
            session.deactivate()
    assert session.state == "stopped"


def test_a_machine_that_never_knows_better_may_rest():
    machine = FreeFin(SimulatedClock())
    machine.stop_unconfirmed = "its driver alone knows"
    with Session(machine, Guard(CALM, machine.limits)) as session:
        session.activate()
        session.deactivate()
        assert session.state == "inactive"


def _gone():
    yield "2,1\n"
    raise OSError(5, "Input/output error")


@pytest.mark.parametrize("terminal", [_gone(), io.TextIOWrapper(io.BytesIO(b"\xfc\n"), "utf-8")])
def test_an_input_that_cannot_be_read_stops_the_fin(terminal):
    request = StopRequest()
    listen_to_keyboard(request, print, typed(request, terminal)).join(HANG_S)
    assert request.trip.cause == "emergency_stop"


def test_an_input_that_ends_stops_the_fin():
    request = StopRequest()
    lines = typed(request, ["2,1\n"])
    assert next(lines) == "2,1\n"
    assert request.trip is None
    assert list(lines) == []
    assert request.trip.cause == "emergency_stop"


def test_a_program_without_an_input_is_told_to_say_yes(monkeypatch):
    machine = FreeFin(SimulatedClock())
    monkeypatch.setattr("sys.stdin", None)
    with pytest.raises(ConfigurationError, match="in a script, add --yes"):
        Arming(arm=True).confirm(RobotSetup(machine, CALM))
    Arming(arm=True, yes=True).confirm(RobotSetup(machine, CALM))


def test_notes_are_told_before_anything_moves(capsys):
    machine = FreeFin(SimulatedClock())
    machine.notes = ("forces are simulated",)
    with pytest.raises(ConfigurationError, match="nothing moves without --arm"):
        Arming().confirm(RobotSetup(machine, CALM))
    assert capsys.readouterr().err == "note: forces are simulated\n"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"safety": {"force_stale_s": 0.04}},
            r"safety.force_stale_s = 0.04: .* the force may be older; use 0.13 or more",
        ),
        (
            {"safety": {"velocity_rad_s": 2.0}},
            r"drive.fastest_rad_s = 3.14159 exceeds safety.velocity_rad_s = 2",
        ),
    ],
)
def test_limits_that_would_trip_at_once_are_refused(changes, words):
    with simulated() as behind:
        safety = {"current_peak_a": 6.0, "current_sustained_a": 3.0, **changes["safety"]}
        with pytest.raises(Exception, match=words) as refused:
            config_of(behind, safety=safety)
        assert "\n" not in str(refused.value)


def test_a_rig_tells_the_notes_of_its_sensor():
    with simulated() as behind:
        rig = Rig(config_of(behind), behind.clock)
        assert isinstance(rig, Machine)
        assert rig.notes == ()
        assert rig.stop_unconfirmed is None
        behind.sensor.status = 1 << 28
        try:
            rig.open()
            assert "forces are simulated" in rig.notes[0]
        finally:
            rig.close()
        assert rig.notes == ()


def test_one_reading_after_a_restart_is_no_average():
    machine = FreeFin(SimulatedClock())
    guard = Guard(CALM, machine.limits)

    def felt(at: float, force: float) -> Sample:
        return Sample(at, 0.0, 0.0, None, None, at, (force, 0.0, 0.0, 0.0, 0.0, 0.0), ())

    for tick in range(100):
        assert guard.check(felt(tick / 100, 1.0), tick / 100) is None
    guard.restart()
    later = [guard.check(felt(20 + tick / 100, 20.0), 20 + tick / 100) for tick in range(60)]
    assert later[:45] == [None] * 45
    assert later[-1].cause == "force_sustained"


@pytest.mark.parametrize(
    "error", [None, KeyboardInterrupt(), DeviceError("the drive does not enable")]
)
def test_however_a_session_ends_a_motor_that_may_be_on_is_told(error):
    machine = Unsure(SimulatedClock())
    session = Session(machine, Guard(CALM, machine.limits))

    def work() -> None:
        with session:
            session.activate()
            if error is not None:
                raise error

    with pytest.raises(SafetyStop, match="BUT the motor may be on; pull the plug") as stopped:
        work()
    assert stopped.value.__cause__ is error
    assert machine.calls[-1] == "close"
