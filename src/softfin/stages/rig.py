"""Commands for one rig: check, prove, zero, stop and emulate it."""

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from softfin.core.configuration import read_yaml
from softfin.core.errors import ConfigurationError, DeviceError
from softfin.core.json_object import JsonObject
from softfin.core.option_types import FILE, PathLike
from softfin.core.result import Result
from softfin.rig.arming import Arming, say
from softfin.rig.check import check_rig
from softfin.rig.computer import COMPUTER
from softfin.rig.config import RigConfig, load_rig
from softfin.rig.device import CheckResult, failing
from softfin.rig.drive_safety import UNCONFIRMED
from softfin.rig.prove import prove_stop
from softfin.rig.prove_moving import DEATHS, SWING_RAD, prove_moving
from softfin.rig.rig import Rig, zero_angle, zero_force
from softfin.rig.robot_setup import RobotSetup
from softfin.rig.stop import SIGNAL_CHECK_S, ignored_termination, interrupted_by_signals
from softfin.stages.machines import find_rig
from softfin.storage.paths import RIG_FILE

PROVING = (
    "the motor is powered and holds its position; softfin then sends no heartbeats until the "
    "drive stops by itself"
)
MOVING = (
    f"{PROVING}; then the fin swings by {SWING_RAD:g} rad to both sides, and softfin is killed or "
    f"suspended {2 * DEATHS} times, so keep a hand on the power switch of the motor"
)
ZEROING = "softfin sets the zero at the current angle of the fin"
ZEROING_POWERED = f"the motor is powered briefly and holds the fin; {ZEROING}"

ZERO_TEXTS = {
    "angle_before_rad": "angle before: {:z.3f} rad",
    "angle_after_rad": "angle now: {:z.3f} rad",
    "own_stop": "stop of the drive: {}",
    "force_before_n": "force at rest before: {0[0]:z.3f}, {0[1]:z.3f}, {0[2]:z.3f} N",
    "force_after_n": "force at rest now: {0[0]:z.3f}, {0[1]:z.3f}, {0[2]:z.3f} N",
    "noise_n": "noise: {0[0]:z.3f}, {0[1]:z.3f}, {0[2]:z.3f} N",
}
"""Lines printed by `zero`, keyed by result name."""


def check(
    *,
    rig: Annotated[PathLike, FILE] = RIG_FILE,
    reset_fault: bool = False,
    prove: bool = False,
    moving: bool = False,
    arm: bool = False,
    yes: bool = False,
) -> Iterator[CheckResult] | Result:
    """Check the bus, drive, sensor and settings of a rig, and print a table; nothing moves.

    With --prove, only prove that the drive stops by itself if softfin dies.

    Args:
        rig: Rig configuration file.
        reset_fault: Print and acknowledge the drive fault before the checks.
        prove: Prove that the drive stops if softfin dies. Powers the motor at rest; needs --arm.
        moving: With --prove, also kill and suspend softfin while it swings the fin.
        arm: Allow the real fin to move, after you confirm on the terminal.
        yes: With --arm, skip the confirmation. For scripts; make sure that no one can touch the
            fin.

    Returns:
        The results, each as soon as it is available; the proof with `prove`.

    Raises:
        DeviceError: If a check has failed, or the drive does not stop by itself.
    """
    if moving and not prove:
        raise ConfigurationError("--moving: applies only to the proof; add --prove")
    config = load_rig(Path(rig))
    if reset_fault:
        with contextlib.closing(find_rig(config)) as machine:
            machine.drive.connect()
            fault = machine.drive.reset_fault()
        say("no fault to reset" if fault is None else f"reset: {fault}")
    if prove:
        return _prove(config, moving, Arming(arm, yes))
    results = check_rig(find_rig(config), Path(rig).absolute().parent)
    return failing(results, lambda text: DeviceError(f"{rig}: {text}"))


def _prove(config: RigConfig, moving: bool, arming: Arming) -> Result:
    # If the terminal closes, the motor must not stay powered, because it is not proved that the
    # drive stops by itself.
    with interrupted_by_signals(), contextlib.closing(find_rig(config)) as rig:
        rig.drive.open()
        motion = MOVING if moving else PROVING
        arming.confirm(RobotSetup(rig, config.safety), motion, needs_proof=False)
        proof = prove_stop(config, rig.drive)
        # The program that swings the fin needs the devices.
        rig.drive.close()
        if moving:
            proof = prove_moving(rig, tell=say)
    text = (
        f"{rig.name}: its drive stopped by itself {1000 * proof.faulted_after_s:.0f} ms after the "
        "last heartbeat from softfin"
    )
    if proof.moving is not None:
        text += f"; in motion, {proof.moving.text}"
    return Result(proof.model_dump(mode="json"), text)


def stop(*, rig: Annotated[PathLike, FILE] = RIG_FILE) -> Result:
    """Stop the motor and switch it off, no matter which program powered it.

    Args:
        rig: Rig configuration file.

    Returns:
        Confirmation that the motor is off.

    Raises:
        DeviceError: If the drive does not confirm that its motor is off.
    """
    with ignored_termination(), contextlib.closing(find_rig(load_rig(Path(rig)))) as machine:
        try:
            machine.drive.switch_off()
        except KeyboardInterrupt:
            raise DeviceError(f"{UNCONFIRMED} (interrupted)") from None
    return Result({"motor": "off"}, "the motor is off")


def zero(
    *,
    rig: Annotated[PathLike, FILE] = RIG_FILE,
    angle: bool = False,
    force: bool = False,
    arm: bool = False,
    yes: bool = False,
) -> Result:
    """Set the present angle and force to zero.

    Args:
        rig: Rig configuration file.
        angle: Zero only the angle. Powers the motor briefly; needs --arm.
        force: Zero only the force.
        arm: Allow the real fin to move, after you confirm on the terminal.
        yes: With --arm, skip the confirmation. For scripts; make sure that no one can touch the
            fin.

    Returns:
        The angle before and after, and the force at rest.
    """
    config = load_rig(Path(rig))
    is_both = angle == force
    result: JsonObject = {}

    def confirm(machine: Rig) -> None:
        is_powered = config.drive.ZERO_POWERS_MOTOR
        motion = ZEROING_POWERED if is_powered else ZEROING
        setup = RobotSetup(machine, config.safety)
        Arming(arm, yes).confirm(setup, motion, needs_proof=is_powered)

    if is_both or angle:
        with interrupted_by_signals():
            result |= zero_angle(find_rig(config), confirm)
    if is_both or force:
        result |= zero_force(find_rig(config))
    lines = [ZERO_TEXTS[name].format(value) for name, value in result.items()]
    return Result(result, "\n".join(lines))


def emulate(
    *,
    rig: Annotated[PathLike, FILE] = RIG_FILE,
    tank: Annotated[PathLike | None, FILE] = None,
    seed: int = 0,
    drive: str = "epos2",
    sensor: str = "axia80",
    real_time: bool = False,
    overwrite: bool = False,
) -> Result | None:
    """Write the configuration file of an emulated rig. Each command emulates its drive, sensor and
    tank, as fast as the computer allows.

    Args:
        rig: Rig configuration file to write.
        tank: Tank configuration file (default: the built-in tank).
        seed: Seed for the tank noise.
        drive: Type of the emulated drive: epos2 or dynamixel.
        sensor: Type of the emulated force sensor: axia80 or lines.
        real_time: Instead, emulate a drive and a sensor in real time on local sockets, until
            Ctrl-C.
        overwrite: Replace an existing file.

    Returns:
        The file.
    """
    rig = Path(rig)
    if rig.exists() and not overwrite:
        raise ConfigurationError(
            f"{rig}: already exists; set a different --rig, or use --overwrite to replace it"
        )
    from softfin.emulation.rig import EmulatedRig, state_file, write_rig, write_simulated
    from softfin.tank import Tank, TankConfig

    values = {} if tank is None else read_yaml(Path(tank))
    emulated_tank = Tank(TankConfig.build(values, str(tank)))
    if real_time:
        # The user may press Ctrl-C as soon as the message appears.
        with (
            contextlib.suppress(KeyboardInterrupt),
            EmulatedRig(
                emulated_tank, seed, clock=COMPUTER, drive=drive, sensor=sensor
            ) as emulated,
        ):
            write_rig(
                rig,
                emulated.values(),
                "An emulated rig, available while `softfin rig emulate --real-time` runs",
            )
            sys.stdout.write(
                f"{rig}: written; this emulated rig runs until you press Ctrl-C\n"
                f"{emulated.description()}\n"
            )
            sys.stdout.flush()
            while True:
                COMPUTER.sleep(SIGNAL_CHECK_S)
        return None
    # A new rig must not inherit the state of the previous rig.
    state_file(rig).unlink(missing_ok=True)
    write_simulated(rig, emulated_tank, values, seed, drive, sensor)
    return Result({"rig": str(rig)}, _next_steps(rig))


def _next_steps(rig: Path) -> str:
    """Return the next steps for a new emulated rig."""
    is_default = rig == RIG_FILE
    plant = "rig" if is_default else f"rig:{rig}"
    option = "" if is_default else f" --rig {rig}"
    prove = f"softfin rig check{option} --prove --arm"
    zero_it = f"softfin rig zero{option} --arm"
    # If zeroing powers the motor, the proof must come first. Otherwise, the drive stores the zero,
    # on which the proof depends.
    is_proved_first = load_rig(rig).drive.ZERO_POWERS_MOTOR
    steps = [prove, zero_it] if is_proved_first else [zero_it, prove]
    return (
        f"{rig}: written; each command emulates this rig in simulated time. Next: "
        f"{', then '.join(steps)}, then softfin collect --plant {plant} --arm"
    )
