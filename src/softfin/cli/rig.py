"""Commands for a rig, such as ``rig check`` and ``rig zero``, and ``monitor``, which watches a
recording."""

import contextlib
import json
import sys
import time
from pathlib import Path
from typing import Annotated

from softfin.cli.common import Armed, CommandOptions, Common, File, YamlFile
from softfin.cli.options import Option
from softfin.core.choices import LOOPBACK
from softfin.core.configuration import read_yaml
from softfin.core.errors import ConfigurationError, DeviceError
from softfin.core.json_object import JsonObject
from softfin.core.printable import printable
from softfin.rig.check import check_rig
from softfin.rig.computer import COMPUTER
from softfin.rig.config import RigConfig, load_rig
from softfin.rig.drive_safety import UNCONFIRMED
from softfin.rig.prove import prove_stop
from softfin.rig.rig import Rig, zero_angle, zero_force
from softfin.rig.robot_setup import RobotSetup
from softfin.rig.stop import SIGNAL_CHECK_S, ignored_termination, interrupted_by_signals
from softfin.stages.machines import find_rig
from softfin.storage.paths import RIG_FILE

PROVING = (
    "the motor is powered and holds its position; softfin then sends no heartbeats until the "
    "drive stops by itself"
)
COMMISSIONING = "each step announces what moves before it moves"
ZEROING = "softfin sets the zero at the fin's current angle"
ZEROING_POWERED = f"the motor is powered briefly and holds the fin; {ZEROING}"


class RigCheckArguments(Armed, CommandOptions):
    """Check a rig's bus, drive, sensor and settings, and print a table; nothing moves.

    With --prove, only prove that the drive stops by itself if softfin dies.
    """

    rig: File = RIG_FILE
    """Rig configuration file."""
    reset_fault: bool = False
    """Print and acknowledge the drive's fault before the checks."""
    prove: bool = False
    """Prove that the drive stops if softfin dies. Powers the motor at rest; needs --arm."""

    def __call__(self) -> None:
        config = load_rig(self.rig)
        if self.reset_fault:
            with contextlib.closing(find_rig(config)) as rig:
                rig.drive.connect()
                fault = rig.drive.reset_fault()
            sys.stderr.write(
                f"{'no fault to reset' if fault is None else f'reset: {printable(fault)}'}\n"
            )
        if self.prove:
            self._prove(config)
            return
        if wrong := self.tell_findings(check_rig(find_rig(config), self.rig.absolute().parent)):
            raise DeviceError(f"{self.rig}: failed: {wrong}")

    def _prove(self, config: RigConfig) -> None:
        # If the terminal closes, the motor must not stay powered: the drive's own stop is unproven.
        with interrupted_by_signals(), contextlib.closing(find_rig(config)) as rig:
            rig.drive.open()
            self.confirm(RobotSetup(rig, config.safety), PROVING, needs_proof=False)
            proof = prove_stop(config, rig.drive)
        after_ms = 1000 * proof.faulted_after_s
        text = (
            f"{rig.name}: its drive stopped by itself {after_ms:.0f} ms after softfin's last "
            "heartbeat"
        )
        self.tell(proof.model_dump(mode="json"), text)


class RigStopArguments(CommandOptions):
    """Stop the motor and switch it off, no matter which program powered it."""

    rig: File = RIG_FILE
    """Rig configuration file."""

    def __call__(self) -> None:
        with ignored_termination(), contextlib.closing(find_rig(load_rig(self.rig))) as rig:
            try:
                rig.drive.switch_off()
            except KeyboardInterrupt:
                raise DeviceError(f"{UNCONFIRMED} (interrupted)") from None
        self.tell({"motor": "off"}, "the motor is off")


class RigZeroArguments(Armed, CommandOptions):
    """Set the present angle and force to zero."""

    rig: File = RIG_FILE
    """Rig configuration file."""
    angle: bool = False
    """Zero only the angle. Powers the motor briefly; needs --arm."""
    force: bool = False
    """Zero only the force."""

    def __call__(self) -> None:
        config = load_rig(self.rig)
        both = self.angle == self.force
        result: JsonObject = {}
        if both or self.angle:
            with interrupted_by_signals():
                result |= zero_angle(find_rig(config), self._confirm_zeroing)
        if both or self.force:
            result |= zero_force(find_rig(config))
        self.tell(result, "\n".join(f"{name}: {value}" for name, value in result.items()))

    def _confirm_zeroing(self, rig: Rig) -> None:
        is_powered = rig.config.drive.ZERO_POWERS_MOTOR
        motion = ZEROING_POWERED if is_powered else ZEROING
        self.confirm(RobotSetup(rig, rig.config.safety), motion, needs_proof=is_powered)


class RigCommissionArguments(Armed, CommandOptions):
    """Run the acceptance steps for a new rig (docs/commissioning.md), and record and sign each
    one."""

    rig: File = RIG_FILE
    """Rig configuration file."""
    step: int | None = None
    """Number of the step to run (default: the first one not yet passed)."""
    weight: float | None = None
    """Mass of the weight for step 3 in kg (default: 1 for a force limit of 30 N, in proportion)."""

    def __call__(self) -> None:
        from softfin.rig.commissioning.commission import commission_step
        from softfin.rig.commissioning.form import STEP_TITLES, form_file, load_form
        from softfin.rig.commissioning.operator import TerminalOperator
        from softfin.rig.commissioning.steps import choose_weight

        config = load_rig(self.rig)
        if config.emulation is not None:
            raise ConfigurationError(
                f"{self.rig}: an emulated rig cannot be commissioned, because it has no shaft or "
                "cables; use the file of a real rig (docs/commissioning.md)"
            )
        if self.step not in (None, *STEP_TITLES):
            raise ConfigurationError(
                f"--step {self.step}: unknown step; use a number from 1 to {len(STEP_TITLES)}"
            )
        if self.yes:
            raise ConfigurationError("--yes: commissioning needs an operator; leave out --yes")
        weight_kg = choose_weight(config, self.weight)
        self.confirm(RobotSetup(find_rig(config), config.safety), COMMISSIONING, needs_proof=False)
        operator = TerminalOperator()
        number = self.step or load_form(self.rig).next_step(config)
        while number is not None:
            # Some steps power the motor here, others move it from a child process.
            with interrupted_by_signals():
                step = commission_step(
                    self.rig, config, number, operator, COMPUTER, weight_kg=weight_kg
                )
            if not step.passed:
                failed = next(item.what for item in step.items if not item.passed)
                raise DeviceError(
                    f"step {number}: {failed}: requirement not met; fix the cause, then run this "
                    "command again"
                )
            number = None if self.step else load_form(self.rig).next_step(config)
        form = form_file(self.rig).with_suffix(".md")
        left = load_form(self.rig).next_step(config)
        rest = "all steps are passed and signed" if left is None else f"next is step {left}"
        self.tell({"form": str(form), "next_step": left}, f"{form}: {rest}")


class RigEmulateArguments(Common):
    """Write the configuration file of an emulated rig. Each command emulates its drive, sensor and
    tank, as fast as the computer allows."""

    rig: File = RIG_FILE
    """Rig configuration file to write."""
    tank: YamlFile | None = None
    """Tank configuration file (default: softfin's own tank)."""
    seed: int = 0
    """Seed for the tank's noise."""
    drive: str = "epos2"
    """Type of the emulated drive: epos2 or dynamixel."""
    sensor: str = "axia80"
    """Type of the emulated force sensor: axia80, lines or ros2."""
    real_time: bool = False
    """Instead, emulate a drive and a sensor in real time on local sockets, until Ctrl-C."""

    def __call__(self) -> None:
        if self.rig.exists() and not self.overwrite:
            raise ConfigurationError(
                f"{self.rig}: already exists; set another --rig, or use --overwrite to replace it"
            )
        from softfin.emulation.rig import EmulatedRig, state_file, write_rig, write_simulated
        from softfin.tank import Tank, TankConfig

        values = {} if self.tank is None else read_yaml(self.tank)
        tank = Tank(TankConfig.build(values, str(self.tank)))
        if self.real_time:
            # The user may press Ctrl-C as soon as the message mentions it.
            with (
                contextlib.suppress(KeyboardInterrupt),
                EmulatedRig(
                    tank, self.seed, clock=COMPUTER, drive=self.drive, sensor=self.sensor
                ) as emulated,
            ):
                write_rig(
                    self.rig,
                    emulated.values(),
                    "An emulated rig, available while `softfin rig emulate --real-time` runs",
                )
                told = (
                    f"{self.rig}: written; this emulated rig runs until you press "
                    f"Ctrl-C\n{emulated.description()}\n"
                )
                sys.stdout.write(told)
                sys.stdout.flush()
                while True:
                    COMPUTER.sleep(SIGNAL_CHECK_S)
            return
        # A new rig must not inherit the state of the rig that it replaces.
        state_file(self.rig).unlink(missing_ok=True)
        write_simulated(self.rig, tank, values, self.seed, self.drive, self.sensor)
        plant, option = (
            ("rig", "") if self.rig == RIG_FILE else (f"rig:{self.rig}", f" --rig {self.rig}")
        )
        prove = f"softfin rig check{option} --prove --arm"
        zero = f"softfin rig zero{option} --arm"
        # If zeroing powers the motor, it needs the proof first. Otherwise, the drive stores the
        # zero, and the proof depends on it.
        is_proved_first = load_rig(self.rig).drive.ZERO_POWERS_MOTOR
        steps = [prove, zero] if is_proved_first else [zero, prove]
        sys.stdout.write(
            f"{self.rig}: written; each command emulates this rig in simulated time. Next: "
            f"{', then '.join(steps)}, then softfin collect --plant {plant} --arm\n"
        )


class MonitorArguments(CommandOptions):
    """Watch a recording in progress. Ctrl-C ends the monitor, not the recording."""

    run_folder: Annotated[Path, Option("RECORDING", positional=True)]
    """Bag (.mcap) to watch, or a folder of bags (the newest is watched)."""
    web: bool = False
    """Serve a page with live traces instead of printing to the terminal."""
    port: int = 8080
    """Port of the page; 0 for any free port."""
    host: str = LOOPBACK
    """Address of the page. Anyone who can reach it can see the recording."""

    def __call__(self) -> None:
        from rich.console import Console

        from softfin.rig.monitor.follow import Follower
        from softfin.rig.monitor.terminal import watch
        from softfin.rig.monitor.web import Server

        follower = Follower(self.run_folder)
        # Ending a monitor is not a failure: exit code 0.
        with contextlib.suppress(KeyboardInterrupt):
            if self.json_:
                follower.poll()
                while (summary := follower.summary())["state"] == "reading" and summary[
                    "problem"
                ] is None:
                    follower.poll()
                sys.stdout.write(json.dumps(summary, indent=2, allow_nan=False) + "\n")
            elif self.web:
                with Server(follower, self.host, self.port) as server:
                    if self.host not in (LOOPBACK, "::1", "localhost"):
                        sys.stderr.write(
                            f"warning: {self.host}: the page has no password; others can watch\n"
                        )
                    sys.stderr.write(f"{server.address} shows the recording; press Ctrl-C to end\n")
                    server.serve_forever()
            else:
                watch(follower, Console(), sleep=time.sleep)
