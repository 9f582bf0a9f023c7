"""The whole commissioning on the emulated rig, and one failure per step that it must find."""

import io
import json
import queue
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest
import yaml

from softfin.cli import main
from softfin.core.errors import ConfigurationError, RigError, RunError, SafetyStop
from softfin.rig.commissioning import steps
from softfin.rig.commissioning.commission import commission_step
from softfin.rig.commissioning.form import (
    STEP_TITLES,
    Form,
    Item,
    SignedStep,
    config_values,
    form_file,
    load_form,
    save_form,
)
from softfin.rig.commissioning.motion import DriveWatch, die_by_signal, narrowed
from softfin.rig.commissioning.operator import TerminalOperator
from softfin.rig.commissioning.steps import STEP_FUNCTIONS
from softfin.rig.config import RigConfig, load_rig
from softfin.rig.devices.epos2.protocol import State
from softfin.rig.simulated_clock import SimulatedClock
from softfin.rig.stop import StopRequest
from tests.cli.test_cli import fails
from tests.patience import wait_until
from tests.rig.devices.axia80.faulty_network import FaultyNetwork
from tests.rig.emulated_operator import EmulatedOperator
from tests.rig.rigs import over_sockets, simulated, values_of

LIMITS = {
    "force_peak_n": 2.5,
    "force_sustained_n": 2.0,
    "current_peak_a": 2.0,
    "current_sustained_a": 1.5,
}
"""Limits that suit the simple fin: 0.5 N and 0.4 A per rad/s."""

RATE_HZ = 200.0

HOUR_S = 10.0
"""Stands for the hour of the long motion."""


class Site:
    """An emulated rig, its file and the operator beside it."""

    def __init__(self, behind, folder):
        self.behind = behind
        self.file = folder / "rig.yaml"
        self.operator = EmulatedOperator(behind)
        self.values = values_of(behind, **LIMITS)
        # Fewer records than usual: simulated time passes sooner.
        behind.sensor.rate_hz = RATE_HZ
        behind.sensor._socket.timeout = 1 / RATE_HZ
        self.values["sensor"]["rate_hz"] = RATE_HZ
        # The bus is that of this process.
        self.values["bus"] = {"interface": "virtual", "channel": behind.channel}

    @property
    def config(self):
        return RigConfig.build(self.values, "rig.yaml")

    def run(self, number, weight_kg=None):
        return commission_step(
            self.file, self.config, number, self.operator, self.behind.clock, HOUR_S, weight_kg
        )

    def pass_until(self, number):
        """Sign the steps before one."""
        item = Item(what="any", value="1", required="1", passed=True)
        steps = [
            SignedStep(
                number=each, date="-", signed_by="-", items=(item,), rig=config_values(self.config)
            )
            for each in range(1, number)
        ]
        save_form(self.file, Form(attempts=tuple(steps)))


@pytest.fixture
def site(tmp_path, monkeypatch):
    """With fewer repetitions: each takes a second of simulated time or more."""
    monkeypatch.setattr(steps, "CHECKS", 2)
    monkeypatch.setattr(steps, "TRIALS", 1)
    monkeypatch.setattr(steps, "STROKES", 4)
    monkeypatch.setattr(steps, "SWINGS", 2)
    with simulated() as behind:
        yield Site(behind, tmp_path)


def failures(step):
    return {item.what: item.value for item in step.items if not item.passed}


def test_every_step_passes_on_a_good_rig_and_the_form_says_so(site):
    for number in STEP_TITLES:
        assert load_form(site.file).next_step(site.config) == number
        step = site.run(number)
        assert step.passed, failures(step)
    form = load_form(site.file)
    assert form.next_step(site.config) is None
    assert form.warning(site.config) is None
    assert {"step-4-1", "step-5-1", "step-6-1", "step-7-1"} <= {
        bag.split("/")[1] for each in form.attempts for bag in each.bags
    }
    assert all((site.file.parent / bag).exists() for each in form.attempts for bag in each.bags)
    text = form_file(site.file).with_suffix(".md").read_text()
    assert text.count("Passed; signed by A. Engineer") == len(STEP_TITLES)
    assert "failed" not in text


def wrong_gear_on_the_data_sheet(site):
    site.operator.answers["Motor turns"] = 66.0
    return "gear ratio"


def a_broken_sensor(site):
    site.behind.sensor.status = 0x88000000
    return "rig check"


def a_wrong_frame(site):
    site.values["sensor"]["frame"] = "x,y"
    return "weight along x"


def a_drive_that_ignores_the_loss(site):
    site.behind.drive.fault = lambda code: None
    return "motor after CAN cable"


def a_loose_shaft(site):
    now = site.behind.fin.now
    site.behind.fin.now = lambda: now()._replace(demand=now().demand + 0.06)
    return "following error"


def a_wide_force_limit(site):
    site.values["safety"]["force_peak_n"] = 30.0
    return "peak for safety.force_peak_n"


def a_loose_connector(site):
    FaultyNetwork.between(site.behind.sensor).disturb(drop=0.002)
    return "sensor_lost"


def a_robot_that_restarts_softfin(site):
    site.operator.answers["restart"] = False
    return "no restart"


FAILURES = {
    1: wrong_gear_on_the_data_sheet,
    2: a_broken_sensor,
    3: a_wrong_frame,
    4: a_drive_that_ignores_the_loss,
    5: a_loose_shaft,
    6: a_wide_force_limit,
    7: a_loose_connector,
    8: a_robot_that_restarts_softfin,
}


@pytest.mark.parametrize("number", STEP_FUNCTIONS)
def test_a_failure_in_a_step_is_found_there(site, number):
    what = FAILURES[number](site)
    site.pass_until(number)
    step = site.run(number)
    assert what in failures(step), step.items
    form = load_form(site.file)
    assert form.next_step(site.config) == number
    assert "failed" in form_file(site.file).with_suffix(".md").read_text()
    assert f"step {number} of 8" in form.warning(site.config)


@pytest.mark.parametrize(
    ("limit_n", "given_kg", "kg", "newtons"),
    [
        (30.0, None, "1", "9.81"),
        (2.5, None, "0.1", "0.981"),
        (0.3, None, "0.01", "0.0981"),
        (300.0, None, "10", "98.1"),
        (2.5, 0.04, "0.04", "0.392"),
    ],
)
def test_the_weight_suits_the_force_limit_unless_it_is_given(site, limit_n, given_kg, kg, newtons):
    site.values["safety"] |= {"force_peak_n": limit_n, "force_sustained_n": limit_n / 2}
    site.pass_until(3)
    step = site.run(3, given_kg)
    pulls = [told for told in site.operator.asked if told.startswith("Pull")]
    assert [pull.split(" along")[0] for pull in pulls] == [f"Pull with {kg} kg"] * 2
    weights = [item for item in step.items if item.what.startswith("weight")]
    assert all(item.passed and item.required.startswith(f"+{newtons} N") for item in weights)


def test_another_weight_than_the_one_named_is_found(site):
    site.pass_until(3)
    site.operator.weight_kg = 0.105
    assert {*failures(site.run(3))} == {"weight along x", "weight along y"}


@pytest.mark.parametrize("weight_kg", [0.0, 0.3, float("nan")])
def test_a_weight_beyond_the_force_limit_is_refused_before_the_step(site, weight_kg):
    site.pass_until(3)
    with pytest.raises(ConfigurationError, match=r"--weight \S+: .* = 2\.5 N; use up to 0\.25 kg"):
        site.run(3, weight_kg)
    assert site.operator.asked == []


@pytest.mark.parametrize(("low", "high"), [(0.2, 1.2), (-1.5, -0.3), (-0.2, 1.2)])
def test_a_fin_that_cannot_swing_about_angle_0_is_refused_before_any_step(site, low, high):
    site.values["drive"] |= {"angle_min_rad": low, "angle_max_rad": high}
    with pytest.raises(ConfigurationError, match=rf"range is {low} to {high} rad; widen drive"):
        site.run(1)
    assert site.operator.asked == []


def test_a_shaft_that_a_person_stopped_does_not_move_again(site):
    site.pass_until(5)
    site.operator.interrupts.add("full strokes")
    step = site.run(5)
    assert "stopped by a key" in failures(step)["4 strokes"]
    assert not any("glove" in instruction for instruction in site.operator.asked)


def test_a_person_is_told_before_softfin_is_killed_with_the_shaft_in_motion(site, monkeypatch):
    die = steps._die

    def die_as_told(context, config, number, bag):
        assert f"{number.name} ends softfin" in site.operator.asked[-1]
        assert "no key stops it" in site.operator.asked[-1]
        return die(context, config, number, bag)

    monkeypatch.setattr(steps, "_die", die_as_told)
    monkeypatch.setattr(steps, "WAYS_TO_STOP", {})
    site.pass_until(4)
    assert site.run(4).passed


def test_a_drive_that_once_went_on_without_softfin_is_not_tried_again(site, monkeypatch):
    monkeypatch.setattr(steps, "TRIALS", 3)
    monkeypatch.setattr(steps, "WAYS_TO_STOP", {})
    site.pass_until(4)
    site.behind.drive.fault = lambda code: None
    step = site.run(4)
    assert "softfin ended by SIGKILL: fin at rest, no power" in failures(step)
    assert [bag for bag in step.bags if "SIG" in bag] == [
        "rig-commissioning/step-4-1/SIGKILL-1.mcap"
    ]


def test_nobody_is_asked_to_sign_while_a_motor_may_be_on(site, monkeypatch):
    def stop(_):
        raise SafetyStop("interrupted; BUT drive did not confirm that its motor is off")

    monkeypatch.setitem(STEP_FUNCTIONS, 1, stop)
    with pytest.raises(SafetyStop, match="BUT"):
        site.run(1)
    assert load_form(site.file).attempts == ()


def test_a_drive_that_stands_and_keeps_its_power_is_not_at_rest_without_power():
    class LateDrive(DriveWatch):
        """Stands from 0.1 s on, without power from 0.5 s on."""

        def __init__(self):
            self._clock = SimulatedClock()
            self.died = self._clock()

        def angle(self):
            return min(self._clock() - self.died, 0.1)

        def is_powered(self):
            return self._clock() - self.died < 0.5

        def fault(self):
            return None

    watch = LateDrive()
    death = watch.watch(watch.died, 0.0)
    assert death.seconds == pytest.approx(0.5, abs=0.01)
    assert death.way_rad == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("strength", "change_n", "required", "passed"),
    [(1.0, 0.02, "at most 0.01 N", False), (100.0, 0.9, "at most 1 N", True)],
)
def test_the_force_at_rest_may_change_by_a_share_of_the_peak_force(
    site, monkeypatch, strength, change_n, required, passed
):
    now = site.behind.fin.now

    def stronger():
        state = now()
        return state._replace(wrench=tuple(strength * load for load in state.wrench))

    site.behind.fin.now = stronger
    site.values["safety"] |= {"force_peak_n": 500.0, "force_sustained_n": 400.0}
    site.pass_until(7)
    at_rest = iter([np.zeros(3), np.array([0.0, change_n, 0.0])])
    monkeypatch.setattr(steps, "_force_at_rest", lambda context: next(at_rest))
    (item,) = (item for item in site.run(7).items if item.what == "change of the force at rest")
    assert (item.required, item.passed) == (required, passed)


@pytest.mark.parametrize("number", [4, 5, 6, 7])
def test_no_step_moves_a_fin_whose_drive_is_not_proved(site, number):
    site.pass_until(number)
    site.file.write_text(yaml.safe_dump(site.values))
    step = commission_step(
        site.file, load_rig(site.file), number, site.operator, site.behind.clock, HOUR_S
    )
    assert "no proof yet that its drive stops" in failures(step)["error"]
    assert site.behind.drive.state is not State.OPERATION_ENABLED
    assert site.operator.asked == []


def test_steps_are_run_in_order(site):
    site.pass_until(2)
    with pytest.raises(
        ConfigurationError, match=r"step 4: step 2 \(Checks and proof .*\) has not been passed"
    ):
        site.run(4)


def test_another_drive_or_sensor_voids_the_steps_and_other_limits_do_not(site):
    site.pass_until(9)
    assert load_form(site.file).warning(site.config) is None
    site.values["safety"]["force_peak_n"] = 3.0
    site.values["sensor"]["address"] = "localhost"
    assert load_form(site.file).warning(site.config) is None
    site.values["drive"]["gear_ratio"] = 66.0
    assert "no longer commissioned" in load_form(site.file).warning(site.config)


def test_every_attempt_is_kept_and_the_latest_counts(site):
    site.operator.answers["switch"] = False
    assert not site.run(1).passed
    del site.operator.answers["switch"]
    assert site.run(1).passed
    assert [step.passed for step in load_form(site.file).attempts] == [False, True]


def test_an_error_in_a_step_is_a_finding_and_the_step_can_be_repeated(site):
    site.pass_until(3)
    site.behind.drive.go_silent()
    step = site.run(3)
    assert failures(step)["error"].startswith("no drive answers")
    site.behind.drive.plug_in()
    assert site.run(3).passed


def test_a_damaged_form_is_refused_in_one_line(site):
    form_file(site.file).write_text(json.dumps({"attempts": 1}))
    with pytest.raises(RigError, match=r"rig.commissioning.json: not a commissioning form"):
        load_form(site.file)


class TestCommand:
    @pytest.fixture
    def command(self, site, monkeypatch):
        site.file.write_text(yaml.safe_dump(site.values))
        monkeypatch.setattr("softfin.cli.rig.REAL", site.behind.clock)
        monkeypatch.setattr(
            "softfin.rig.commissioning.operator.TerminalOperator", lambda: site.operator
        )
        monkeypatch.setattr("softfin.cli.common.on_terminal", lambda: True)
        monkeypatch.setattr("sys.stdin", io.StringIO("move\n" * 2))
        return ["rig", "commission", "--rig", str(site.file)]

    def test_it_goes_from_step_to_step_ends_at_one_that_fails_and_resumes_there(
        self, site, command, capsys
    ):
        a_broken_sensor(site)
        with pytest.raises(SystemExit, match="1"):
            main([*command, "--arm"])
        told = capsys.readouterr().err
        assert told.endswith(
            "step 2: rig check: requirement not met; fix the cause, then run this command again\n"
        )
        assert load_form(site.file).next_step(site.config) == 2
        site.behind.sensor.status = 0
        main([*command, "--arm", "--step", "2"])
        assert capsys.readouterr().out.endswith("rig.commissioning.md: next is step 3\n")
        assert load_form(site.file).next_step(site.config) == 3

    def test_a_signal_interrupts_a_step_so_that_its_motor_is_stopped(
        self, command, monkeypatch, capsys
    ):
        ends = []

        def powered(*_, **__):
            try:
                signal.raise_signal(signal.SIGTERM)
            finally:
                ends.append("stopped")

        monkeypatch.setattr("softfin.rig.commissioning.commission.commission_step", powered)
        with pytest.raises(SystemExit):
            main([*command, "--arm"])
        assert ends == ["stopped"]

    @pytest.mark.parametrize(
        ("options", "told"),
        [
            ([], "nothing moves without --arm"),
            (["--arm", "--weight", "5"], "use up to 0.25 kg"),
            (["--arm", "--yes"], "--yes: commissioning needs an operator; leave out --yes"),
            (["--arm", "--step", "9"], "--step 9: unknown step; use a number from 1 to 8"),
        ],
    )
    def test_a_wrong_option_is_one_clear_line(self, site, command, capsys, options, told):
        line, code = fails(capsys, *command, *options)
        assert line.endswith(told)
        assert code == 2
        assert site.operator.asked == []


class TestTerminal:
    def test_answers_are_read_again_until_they_can_be_used(self):
        shown = []
        operator = TerminalOperator(
            iter(["maybe\n", "yes\n", "much\n", "2.5\n", "\n", "A. Engineer\n", "\n"]), shown.append
        )
        assert operator.confirm("Is it on?")
        assert operator.number("How much?") == 2.5
        assert operator.text("Signed by") == "A. Engineer"
        operator.wait("Let go")
        assert "'much': not a number; type a number, e.g. 2.5\n" in shown

    def test_the_end_of_its_input_is_one_clear_line(self):
        operator = TerminalOperator(iter([]), lambda _: None)
        for _ in range(2):
            with pytest.raises(
                RunError, match="input has ended; run the command again to resume at this step"
            ):
                operator.confirm("Is it on?")

    def test_a_line_that_was_typed_ahead_answers_no_question(self, monkeypatch):
        typed = queue.Queue()
        shown = []
        monkeypatch.setattr("sys.stdin", iter(typed.get, None))
        operator = TerminalOperator(write=shown.append)
        typed.put("\n")
        wait_until(lambda: not operator._answers.empty())
        typed_later = threading.Timer(0.5, typed.put, ["yes\n"])
        typed_later.start()
        assert operator.confirm("Is it on?")
        # Asked once: the earlier Enter, which is neither yes nor no, was not taken for an answer.
        assert len(shown) == 1

    def test_enter_stops_the_fin_while_it_moves_and_other_lines_do_not(self):
        typed = queue.Queue()
        request = StopRequest()
        operator = TerminalOperator(iter(typed.get, None), lambda _: None)
        with operator.moving("It moves", request):
            typed.put("2,1\n")
            typed.put("\n")
            wait_until(lambda: request.trip is not None)
        assert request.trip.reason == "stopped by a key"

    def test_the_end_of_its_input_stops_the_fin_while_it_moves(self):
        typed = queue.Queue()
        request = StopRequest()
        operator = TerminalOperator(iter(typed.get, None), lambda _: None)
        with operator.moving("It moves", request):
            typed.put(None)
            wait_until(lambda: request.trip is not None)
        assert "input ended" in request.trip.reason


@pytest.mark.real_time
def test_a_host_that_is_to_die_stops_its_fin_when_the_commissioning_is_gone(tmp_path):
    with over_sockets(tmp_path / "rig.yaml") as behind:
        config = narrowed(load_rig(tmp_path / "rig.yaml"), 0.3, 1.0)
        host = subprocess.Popen(
            [sys.executable, "-m", "softfin.rig.commissioning.host", str(tmp_path / "host.mcap")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            host.stdin.write(f"{json.dumps(config.model_dump(mode='json'))}\n")
            host.stdin.flush()
            assert host.stdout.readline() == "moves\n"
            # As the kernel closes it when the commissioning is killed.
            host.stdin.close()
            assert "the commissioning has ended" in host.stdout.read()
            assert behind.drive.state is not State.OPERATION_ENABLED
        finally:
            host.kill()
            host.wait()
            host.stdout.close()


@pytest.mark.real_time
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_softfin_that_dies_leaves_a_fin_at_rest_in_real_time_too(tmp_path, number):
    with over_sockets(tmp_path / "rig.yaml") as behind:
        config = load_rig(tmp_path / "rig.yaml")
        death = die_by_signal(narrowed(config, 0.3, 1.0), number, 0.2, tmp_path / "died.mcap")
        assert "0x8130" in death.fault
        assert behind.drive.state is State.FAULT
        where = behind.fin.now().angle
        assert behind.fin.now().angle == where
