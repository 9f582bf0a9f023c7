"""The eight steps of a commissioning; each yields its results and the requirements for them
(docs/commissioning.md)."""

import math
import signal
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from softfin.core.errors import ConfigurationError, RigError, SafetyStop, SoftfinError
from softfin.core.quantities import RATE_HZ
from softfin.gaits.reachable import PAPER_PEAK_N, force_decimals, round_size
from softfin.rig.check import check_currents, check_rig
from softfin.rig.commissioning.form import Item
from softfin.rig.commissioning.motion import (
    Death,
    DriveWatch,
    Stopped,
    changed,
    die_by_signal,
    die_in_process,
    epos2_config,
    move,
    narrowed,
    stroke_ticks,
    swings,
)
from softfin.rig.commissioning.operator import Operator
from softfin.rig.computer import COMPUTER, Computer
from softfin.rig.config import RigConfig
from softfin.rig.devices.axia80.stream import BUFFER_BYTES
from softfin.rig.devices.epos2 import procedures, protocol
from softfin.rig.devices.epos2.drive import Epos2
from softfin.rig.machine import Target
from softfin.rig.prove import check_proof, prove_stop
from softfin.rig.rig import Rig, zero_angle, zero_force
from softfin.rig.safety import FORCE_PEAK_N
from softfin.rig.stop import StopRequest

CHECKS = 10
"""Number of times that `rig check` must pass in a row."""

RECEIVE_BUFFER_SETTING = Path("/proc/sys/net/core/rmem_max")

ANGLE_TOLERANCE_RAD = 0.02
WEIGHT_KG = 1.0
"""Default weight for a rig with the default of `safety.force_peak_n` [kg]."""
WEIGHT_GRAVITY_M_S2 = 9.81
WEIGHT_TOLERANCE = 0.02

SMALL_RAD = 0.3
SLOW_RAD_S = 1.0
"""Amplitude [rad] and velocity [rad/s] of the first motions."""

TRIALS = 5
"""Number of trials for each way to stop."""

UNPOWERED_S = 0.5
"""Longest time from the last good reading to the confirmed stop [s]."""

DEADLY_SIGNALS = (signal.SIGKILL, signal.SIGSTOP)
"""Signals after which softfin no longer runs. For a simulated rig, the host simply stops
sending."""

REST_MARGIN_S = 0.05
"""Time in addition to heartbeat and braking within which the fin of a dead host must stop [s]; the
drive acts in discrete steps."""

STROKES = 50
SWINGS = 10
FOLLOWING_RAD = 0.05

MIN_MARGIN = 1.2
MAX_MARGIN = 2.5
ADVISED_MARGIN = 1.5
"""Ratios of the force, torque and current limits to the peaks measured in water."""

SENSOR_NOISE = 1e-3
"""Peaks below this are noise [N, N m, A]."""

MAX_DRIFT_N = 0.1
"""Maximum change in the force at rest within the hour [N], for a fin with the peak force of the
paper's fin."""


class Way(NamedTuple):
    """A way to stop the swinging fin, triggered by the operator."""

    instruction: str
    causes: frozenset[str]
    """Accepted causes of the stop."""
    is_cut: bool = False
    """Whether softfin then loses contact with the drive, so that the operator judges the stop by
    eye and hand."""


BY_A_PERSON = frozenset({"emergency_stop"})
SENSOR_GONE = frozenset({"force_stale", "device"})
DRIVE_GONE = frozenset({"angle_stale", "device"})

WAYS_TO_STOP = {
    "Ctrl-C": Way("press Ctrl-C", BY_A_PERSON),
    "Enter": Way("press Enter", BY_A_PERSON),
    "sensor cable": Way("pull the force sensor's cable", SENSOR_GONE),
    "CAN cable": Way("unplug the CAN cable from the drive", DRIVE_GONE, is_cut=True),
    "CAN adapter": Way("pull the CAN adapter from the computer", DRIVE_GONE, is_cut=True),
    "switch": Way("switch off the motor's supply", DRIVE_GONE, is_cut=True),
}
"""Ways to stop, by name."""

BLOCKED_CAUSES = frozenset({"following", "current_peak", "current_sustained", "device"})
"""Accepted causes of the stop when the shaft is blocked."""


@dataclass(frozen=True)
class StepContext:
    """The rig, the operator and the folder for recordings of one step."""

    config: RigConfig
    operator: Operator
    folder: Path
    """Folder for the step's recordings."""
    clock: Computer
    random: np.random.Generator
    hour_s: float
    """Duration of the long motion [s]; shorter only in tests."""
    weight_kg: float
    """Mass of the known weight that pulls on the force sensor [kg]."""

    @property
    def is_simulated(self) -> bool:
        """Whether the rig is emulated in simulated time, where no process can be killed."""
        return self.clock.is_simulated

    def rig(self, config: RigConfig | None = None) -> Rig:
        """Return the rig with its own or another configuration."""
        return Rig(config or self.config, self.clock if self.is_simulated else COMPUTER)

    def bag(self, name: str) -> Path:
        """Return the path of a recording file for this step."""
        return self.folder / f"{name}.mcap"


def choose_weight(config: RigConfig, weight_kg: float | None = None) -> float:
    """Return the mass of the known weight for step 3 [kg]: the given one, or one that suits
    `safety.force_peak_n`.

    Raises:
        ConfigurationError: its force exceeds that limit, which protects the sensor.
    """
    peak_n = config.safety.force_peak_n
    if weight_kg is None:
        return WEIGHT_KG * round_size(peak_n / FORCE_PEAK_N)
    weight_n = weight_kg * WEIGHT_GRAVITY_M_S2
    # Written so that NaN fails.
    if not 0 < weight_n <= peak_n:
        raise ConfigurationError(
            f"--weight {weight_kg:g}: must be positive, and its force ({weight_n:.3g} N) at most "
            f"safety.force_peak_n = {peak_n:g} N; use up to {peak_n / WEIGHT_GRAVITY_M_S2:.2g} kg"
        )
    return weight_kg


def check_range(config: RigConfig) -> None:
    """Raise ConfigurationError if the fin cannot swing about angle 0, as most steps require."""
    low, high, *_ = config.drive.limits
    if not low <= -SMALL_RAD < SMALL_RAD <= high:
        raise ConfigurationError(
            f"commissioning: the fin must swing at least {SMALL_RAD:g} rad to both sides of angle "
            f"0, but the rig's range is {low:g} to {high:g} rad; widen drive.angle_min_rad and "
            "drive.angle_max_rad, or carry out the steps of docs/commissioning.md by hand"
        )


def asked(operator: Operator, what: str, question: str) -> Item:
    """Ask a question that must be answered with yes."""
    answer = operator.confirm(question)
    return Item(what=what, value="yes" if answer else "no", required="yes", passed=answer)


def measured(what: str, value: float, required: str, passed: bool, unit: str) -> Item:
    """Return an item for a measured value, rounded to three digits."""
    return Item(what=what, value=f"{value:.3g} {unit}", required=required, passed=passed)


def compare_data_sheets(context: StepContext) -> Iterator[Item]:
    """Step 1: compare the rig's file with data sheets and check the drive settings and the switch
    of the motor's supply."""
    operator = context.operator
    drive = epos2_config(context.config)
    safety = context.config.safety
    for what, question, value in (
        (
            "encoder lines",
            "Encoder lines per motor turn, from the encoder's data sheet",
            drive.encoder_lines,
        ),
        (
            "gear ratio",
            "Motor turns per fin turn, from the gearbox's data sheet",
            drive.gear_ratio,
        ),
    ):
        answer = operator.number(question)
        passed = math.isclose(answer, value, rel_tol=1e-3)
        yield Item(
            what=what,
            value=f"{answer:g}",
            required=f"{value:g}, as in the rig's file",
            passed=passed,
        )
    nominal = operator.number("Nominal motor current [A], from its data sheet")
    sustained = safety.current_sustained_a or math.inf
    required = "at least safety.current_sustained_a"
    yield measured(
        "nominal current", nominal, f"{required}, {sustained:g} A", nominal >= sustained, "A"
    )
    yield from _settings(context)
    yield asked(
        operator,
        "switch",
        "Is a switch for the motor's supply within reach, and have you just tested it?",
    )


def check_and_prove(context: StepContext) -> Iterator[Item]:
    """Step 2: run `rig check` ten times, verify that a wrong file is refused, check the receive
    buffer and prove the stop."""
    context.operator.wait("Take the fin off the shaft")
    failures = []
    for _ in range(CHECKS):
        results = check_rig(
            context.rig(),
            context.folder.parent,
            1.0,
        )
        failures += [
            f"{result.what}: {result.text}" for result in results if result.state == "wrong"
        ]
    value = failures[0] if failures else f"{CHECKS} of {CHECKS}"
    yield Item(
        what="rig check",
        value=value,
        required=f"{CHECKS} times without an error",
        passed=not failures,
    )
    yield _refusal_of_wrong_lines(context)
    if not context.is_simulated:
        granted = int(RECEIVE_BUFFER_SETTING.read_text()) if RECEIVE_BUFFER_SETTING.exists() else 0
        yield Item(
            what="net.core.rmem_max",
            value=f"{granted} bytes",
            required=f"at least {BUFFER_BYTES} bytes: sudo sysctl net.core.rmem_max={BUFFER_BYTES}",
            passed=granted >= BUFFER_BYTES,
        )
    yield _proof(context)


def measure_by_hand(context: StepContext) -> Iterator[Item]:
    """Step 3: turn the shaft by a quarter and a full turn, and apply a weight along each axis of
    the force."""
    operator = context.operator
    operator.wait("Turn the shaft to zero by hand and release it")
    zero_angle(context.rig())
    with DriveWatch(context.config, context.clock) as watch:
        for what, degrees in (("a quarter turn", 90), ("a whole turn", 360)):
            operator.wait(
                f"Turn the shaft by hand to {degrees} degrees from zero, in the positive direction"
            )
            angle = watch.angle()
            wanted = math.radians(degrees)
            passed = abs(angle - wanted) <= ANGLE_TOLERANCE_RAD
            yield measured(what, angle, f"{wanted:.3f} +- {ANGLE_TOLERANCE_RAD} rad", passed, "rad")
    operator.wait("Turn the shaft back to zero, and do not touch the force sensor")
    zero_force(context.rig())
    rig = context.rig()
    rig.sensor.open()
    try:
        weight_n = context.weight_kg * WEIGHT_GRAVITY_M_S2
        decimals = force_decimals(weight_n)
        for number, axis in enumerate("xy"):
            operator.wait(
                f"Pull with {context.weight_kg:g} kg along +{axis} "
                "(see docs/rig.md for its direction)"
            )
            force = rig.sensor.measured(1.0)[0][:3]
            error = max(
                abs(value - (weight_n if place == number else 0.0))
                for place, value in enumerate(force)
            )
            value = ", ".join(f"{value:+.{decimals}f}" for value in force)
            required = (
                f"+{weight_n:.{decimals}f} N along {axis}, 0 along the other axes, "
                f"+-{WEIGHT_TOLERANCE:.0%}"
            )
            passed = error <= WEIGHT_TOLERANCE * weight_n
            yield Item(
                what=f"weight along {axis}", value=f"({value}) N", required=required, passed=passed
            )
            operator.wait("Take the weight off")
    finally:
        rig.close()


def stop_in_every_way(context: StepContext) -> Iterator[Item]:
    """Step 4: test every way to stop five times, within +-0.3 rad at 1 rad/s."""
    _require_proof(context)
    operator = context.operator
    operator.wait("Next, the shaft will swing slowly several times; keep your hands clear")
    narrow = narrowed(context.config, SMALL_RAD, SLOW_RAD_S)
    for name, way in WAYS_TO_STOP.items():
        yield from _try_way(context, narrow, name, way)
    for number in DEADLY_SIGNALS:
        has_stopped = yield from _try_signal(context, narrow, number)
        if not has_stopped:
            # Do not try again with a drive that does not stop by itself.
            return
    yield _zero_after_reset(context)
    for what, question in (
        (
            "stop topic",
            "If you use ROS 2, did `true` on the stop topic stop the fin all five times? (If "
            "not, answer yes)",
        ),
        (
            "computer off",
            "Did the fin stop all five times when you switched the computer off while it moved?",
        ),
    ):
        yield asked(operator, what, question)


def move_fully(context: StepContext) -> Iterator[Item]:
    """Step 5: make 50 strokes through the full range, then hold the shaft."""
    _require_proof(context)
    drive = context.config.drive
    amplitude = min(drive.angle_max_rad, -drive.angle_min_rad)
    ticks = stroke_ticks(amplitude, drive.fastest_rad_s)
    targets = swings(amplitude, drive.fastest_rad_s, STROKES)
    context.operator.wait("Next, the shaft will make full strokes; keep your hands clear")
    request = StopRequest()
    with context.operator.moving(
        f"The shaft is now making {STROKES} full strokes; stand clear", request
    ):
        stopped = move(context.rig(), targets, ticks, request, context.bag("strokes"))
    passed = stopped.cause == "none"
    yield Item(
        what=f"{STROKES} strokes", value=stopped.reason, required="end by themselves", passed=passed
    )
    if not passed:
        # If the operator stopped the fin, it must not move again unexpectedly.
        return
    peaks = stopped.peaks
    passed = peaks.following_rad <= FOLLOWING_RAD
    yield measured(
        "following error", peaks.following_rad, f"at most {FOLLOWING_RAD} rad", passed, "rad"
    )
    narrow = narrowed(context.config, SMALL_RAD, SLOW_RAD_S)
    context.operator.wait("Put on a glove; next, the shaft will swing slowly")
    stopped = _provoke(context, narrow, "held", "hold the shaft with a glove until it stops")
    context.operator.wait("Let go of the shaft")
    _reset(context)
    passed = stopped.cause in BLOCKED_CAUSES and stopped.is_confirmed
    yield Item(
        what="held shaft",
        value=stopped.reason,
        required="stopped by following error or current",
        passed=passed,
    )
    limit_a = context.config.safety.current_peak_a or math.inf
    current_a = stopped.peaks.current_a
    yield measured(
        "current when held", current_a, f"at most {limit_a:g} A", current_a <= limit_a, "A"
    )


def move_in_water(context: StepContext) -> Iterator[Item]:
    """Step 6: move the fin in air, then in water, from small to full strokes, and compare the
    safety limits with its peaks."""
    _require_proof(context)
    drive = context.config.drive
    safety = context.config.safety
    full = min(drive.angle_max_rad, -drive.angle_min_rad)
    for medium in ("air", "water"):
        context.operator.wait(
            f"Mount the fin on the shaft in {medium}, at rest at zero; then stand clear, because "
            "it will swing next"
        )
        for amplitude in (SMALL_RAD, full / 2, full):
            velocity = SLOW_RAD_S if amplitude == SMALL_RAD else drive.fastest_rad_s
            request = StopRequest()
            with context.operator.moving(
                f"The fin is now swinging by +-{amplitude:.2f} rad in {medium}; stand clear",
                request,
            ):
                ticks = stroke_ticks(amplitude, velocity)
                bag = context.bag(f"{medium}-{amplitude:.1f}")
                stopped = move(
                    context.rig(), swings(amplitude, velocity, SWINGS), ticks, request, bag
                )
            passed = stopped.cause == "none"
            what = f"{medium}, {amplitude:.2f} rad"
            yield Item(what=what, value=stopped.reason, required="ends by itself", passed=passed)
            if not passed:
                return
    peaks = stopped.peaks
    for what, peak, limit, unit in (
        ("force_peak_n", peaks.force_n, safety.force_peak_n, "N"),
        ("torque_peak_nm", peaks.torque_nm, safety.torque_peak_nm, "N m"),
        ("current_peak_a", peaks.current_a, safety.current_peak_a, "A"),
    ):
        if peak < SENSOR_NOISE or limit is None:
            # This rig does not measure it, e.g. an emulated rig without torque.
            continue
        required = (
            f"safety.{what} = {limit:g} must be {MIN_MARGIN} to {MAX_MARGIN} times the peak; set "
            f"it to {ADVISED_MARGIN * peak:.2g}"
        )
        passed = MIN_MARGIN * peak <= limit <= MAX_MARGIN * peak
        yield measured(f"peak for safety.{what}", peak, required, passed, unit)


def move_for_an_hour(context: StepContext) -> Iterator[Item]:
    """Step 7: send random commands for one hour, without lost records, skipped ticks or a change in
    the force at rest."""
    _require_proof(context)
    rig = context.rig()
    request = StopRequest()
    context.operator.wait(
        "Next, the fin will move at random for one hour; make sure that no one can reach it"
    )
    before = _force_at_rest(context)
    targets = _random_targets(context)
    with context.operator.moving("The fin moves at random", request):
        stopped = move(rig, targets, RATE_HZ // 3, request, context.bag("hour"))
    passed = stopped.cause == "none"
    yield Item(what="random motion", value=stopped.reason, required="ends by itself", passed=passed)
    counters = rig.counters()
    counters["skipped_ticks"] = stopped.skipped_ticks
    for name in ("sensor_lost", "drive_syncs_without_all_answers", "skipped_ticks"):
        count = counters.get(name, 0)
        yield Item(what=name, value=str(count), required="0", passed=count == 0)
    change_n = float(np.max(np.abs(_force_at_rest(context) - before)))
    limit_n = MAX_DRIFT_N * round_size(stopped.peaks.force_n / PAPER_PEAK_N)
    yield measured(
        "change of the force at rest",
        change_n,
        f"at most {limit_n:g} N",
        change_n <= limit_n,
        "N",
    )
    yield asked(context.operator, "motor", "Is the motor cool enough to keep your hand on it?")


def ask_about_robot(context: StepContext) -> Iterator[Item]:
    """Step 8: ask about properties of a robot with several fins."""
    operator = context.operator
    if not operator.confirm("Is this fin one of several on a robot, or does it run unattended?"):
        yield Item(what="robot", value="one fin, attended", required="-", passed=True)
        return
    for what, question in (
        (
            "buses",
            "Does each fin have its own CAN bus, or its own drive.host_node that `rig check` "
            "accepted?",
        ),
        (
            "each fin killed",
            "Did each fin stop when you killed its softfin in the water, regardless of whether "
            "the others continued?",
        ),
        ("radio off", "Did all fins stop when the radio or the network to the operator was cut?"),
        (
            "no suspend",
            "Is suspending the computer disabled (systemd-inhibit, or masked sleep targets)?",
        ),
        (
            "no restart",
            "Are restarts after exit code 3 disabled (systemd: RestartPreventExitStatus=3)?",
        ),
    ):
        yield asked(operator, what, question)


STEP_FUNCTIONS: dict[int, Callable[[StepContext], Iterator[Item]]] = {
    1: compare_data_sheets,
    2: check_and_prove,
    3: measure_by_hand,
    4: stop_in_every_way,
    5: move_fully,
    6: move_in_water,
    7: move_for_an_hour,
    8: ask_about_robot,
}
"""The steps by number, as in the form."""


def run_step(number: int, context: StepContext) -> tuple[Item, ...]:
    """Run a step to its end or to the first error, which is also reported as an item."""
    items = []
    try:
        for item in STEP_FUNCTIONS[number](context):
            mark = "passed" if item.passed else "FAILED"
            context.operator.tell(
                f"{mark:>6}  {item.what}: {item.value} (required: {item.required})"
            )
            items.append(item)
    except SafetyStop:
        # The motor may still be on: do not ask the operator to sign anything now.
        raise
    except SoftfinError as error:
        context.operator.tell(f"FAILED  {error}")
        items.append(Item(what="error", value=str(error), required="none", passed=False))
    return tuple(items)


def _settings(context: StepContext) -> Iterator[Item]:
    """Check the drive's own reactions, and whether its current limits allow the safety limits to
    trip."""
    rig = context.rig()
    try:
        rig.drive.open()
        assert isinstance(rig.drive, Epos2), "checked by `compare_data_sheets`"
        connection = rig.drive.connection
        for entry, wanted in protocol.REACTIONS.items():
            value = procedures.read_optional(connection, entry)
            yield Item(
                what=str(entry),
                value="no such object" if value is None else str(value),
                required=f"{wanted}, or no such object (then the proof in step 2 decides)",
                passed=value in (None, wanted),
            )
        useless_limits = [result.text for result in check_currents(rig)]
    finally:
        rig.close()
    found = "; ".join(useless_limits) or "can trip"
    yield Item(what="current limits", value=found, required="can trip", passed=not useless_limits)


def _require_proof(context: StepContext) -> None:
    """Raise RigError unless it has been proved that this drive stops by itself if softfin dies."""
    rig = context.rig()
    try:
        rig.drive.connect()
        check_proof(context.config, rig.drive)
    finally:
        rig.close()


def _proof(context: StepContext) -> Item:
    """Prove that the drive stops if softfin's heartbeats end."""
    rig = context.rig()
    try:
        rig.drive.open()
        proof = prove_stop(context.config, rig.drive)
    finally:
        rig.close()
    longest_s = context.config.drive.heartbeat_s + procedures.LOSS_MARGIN_S
    required = f"fault within {longest_s:.1f} s of the last heartbeat"
    return measured("proof of the stop", proof.faulted_after_s, required, True, "s")


def _refusal_of_wrong_lines(context: StepContext) -> Item:
    """Open the drive with a different number of encoder lines, which must be refused."""
    lines = epos2_config(context.config).encoder_lines
    rig = context.rig(changed(context.config, drive={"encoder_lines": 2 * lines}))
    try:
        rig.drive.open()
        value = "accepted"
    except RigError:
        value = "refused"
    finally:
        rig.close()
    return Item(
        what="wrong encoder_lines", value=value, required="refused", passed=value == "refused"
    )


def _try_way(context: StepContext, config: RigConfig, name: str, way: Way) -> Iterator[Item]:
    """Try one way to stop several times."""
    operator = context.operator
    stops = []
    left_on = 0
    for trial in range(TRIALS):
        stops.append(_provoke(context, config, f"{name}-{trial + 1}", way.instruction))
        operator.wait(
            f"After {name}: put everything back and wait until the devices run again; then "
            "keep your hands clear, because the shaft may swing next"
        )
        left_on += _reset(context)
    yield _compare_stops(name, way, stops)
    value = f"still on after {left_on} of {TRIALS}" if left_on else "off"
    yield Item(what=f"motor after {name}", value=value, required="off", passed=not left_on)
    if way.is_cut:
        question = (
            f"In all {TRIALS} trials, did the fin stop within a quarter of a second, and "
            "could you turn it by hand half a second later?"
        )
        yield asked(operator, f"{name}, by eye and hand", question)


def _try_signal(
    context: StepContext, config: RigConfig, number: signal.Signals
) -> Generator[Item, None, bool]:
    """End softfin with a signal several times; return whether the drive stopped by itself in
    time."""
    operator = context.operator
    # The drive notices the death of its host after heartbeat_s, and then brakes for v / a.
    braking_s = SLOW_RAD_S / epos2_config(config).quick_stop_rad_s2
    allowed_s = config.drive.heartbeat_s + braking_s + REST_MARGIN_S
    operator.wait(
        f"Next, the shaft will swing {TRIALS} times, and {number.name} ends softfin each "
        "time; no key stops it then, so keep your hands clear and the switch within reach"
    )
    deaths = []
    is_left_on = False
    for trial in range(TRIALS):
        death = _die(context, config, number, context.bag(f"{number.name}-{trial + 1}"))
        deaths.append(death)
        is_left_on = _reset(context)
        fault = death.fault or "no fault"
        operator.tell(f"        {number.name} {trial + 1}: {death.seconds:.2f} s, {fault}")
        if is_left_on or death.seconds > allowed_s:
            break
    what = f"softfin ended by {number.name}"
    worst_s = max(death.seconds for death in deaths)
    passed = worst_s <= allowed_s and not is_left_on
    yield measured(
        f"{what}: fin at rest, no power", worst_s, f"at most {allowed_s:.2f} s", passed, "s"
    )
    if not passed:
        return False
    faults = {death.fault or "no fault" for death in deaths}
    is_expected = all("0x8130" in fault for fault in faults)
    yield Item(
        what=f"{what}: fault",
        value="; ".join(sorted(faults)),
        required="0x8130",
        passed=is_expected,
    )
    return True


def _provoke(context: StepContext, config: RigConfig, name: str, instruction: str) -> Stopped:
    """Swing slowly until the operator, or the provoked fault, stops the fin."""
    request = StopRequest()
    amplitude = config.drive.angle_max_rad
    velocity = config.drive.fastest_rad_s
    with context.operator.moving(f"The fin is now swinging: {instruction}", request):
        rig = context.rig(config)
        stopped = move(
            rig,
            swings(amplitude, velocity),
            stroke_ticks(amplitude, velocity),
            request,
            context.bag(name),
        )
    context.operator.tell(f"        {name}: {stopped.reason}")
    return stopped


def _compare_stops(name: str, way: Way, stops: list[Stopped]) -> Item:
    """Compare the results of the trials for one way to stop with the requirement."""
    causes = {stopped.cause for stopped in stops}
    value = "; ".join(sorted(causes))
    passed = causes <= way.causes
    if way.is_cut:
        required = f"{' or '.join(sorted(way.causes))}; softfin reports an unconfirmed stop"
        # The message of an unconfirmed stop contains "; BUT" and the fix.
        passed = passed and all(
            stopped.is_confirmed or "; BUT " in stopped.reason for stopped in stops
        )
        return Item(what=name, value=value, required=required, passed=passed)
    worst_s = max(stopped.seconds for stopped in stops)
    passed = passed and worst_s <= UNPOWERED_S and all(stopped.is_confirmed for stopped in stops)
    required = (
        f"{' or '.join(sorted(way.causes))}, motor off within {UNPOWERED_S} s of the last "
        "good reading"
    )
    return Item(
        what=name,
        value=f"{value}, motor off within {worst_s:.2f} s",
        required=required,
        passed=passed,
    )


def _die(context: StepContext, config: RigConfig, number: signal.Signals, bag: Path) -> Death:
    """Make the host die at a random moment while the fin moves."""
    if context.is_simulated:
        return die_in_process(config, context.clock, int(context.random.integers(5, 200)), bag)
    return die_by_signal(config, number, float(context.random.uniform(0.0, 1.0)), bag)


def _reset(context: StepContext) -> bool:
    """Switch off the motor if it is still on, and acknowledge any fault; return whether the motor
    was on."""
    with DriveWatch(context.config, context.clock) as watch:
        is_powered = watch.is_powered()
    rig = context.rig()
    try:
        if is_powered:
            rig.drive.switch_off()
        rig.drive.connect()
        rig.drive.reset_fault()
    finally:
        rig.close()
    return is_powered


def _zero_after_reset(context: StepContext) -> Item:
    """Return whether the drive still has its zero after all faults were reset without a power
    cycle."""
    with DriveWatch(context.config, context.clock) as watch:
        is_known = watch.is_referenced() or not context.config.drive.zero_needed
    return Item(
        what="zero after the faults",
        value="known" if is_known else "lost",
        required="known",
        passed=is_known,
    )


def _force_at_rest(context: StepContext) -> np.ndarray:
    rig = context.rig()
    try:
        rig.sensor.open()
        return np.array(rig.sensor.measured(1.0)[0][:3])
    finally:
        rig.close()


def _random_targets(context: StepContext) -> Iterator[Target]:
    """Yield random commands within the rig's limits, three per second, for the duration of the long
    motion."""
    limits = context.config.drive.limits
    for _ in range(round(3 * context.hour_s)):
        angle = context.random.uniform(limits.angle_min, limits.angle_max)
        velocity = context.random.uniform(limits.velocity_min, limits.velocity_max)
        yield Target(float(angle), float(velocity))
