"""Checks of logs: each check is a function that yields issues.

`LOG_CHECKS`, at the end of this file, lists the checks of a single log.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from softfin.core.log_channels import CURRENT_CHANNEL, LOAD_CHANNELS
from softfin.core.quantities import AXES, MAX_ANGLE_RAD, RATE_HZ, TICK_S, AnyArray, command_limits
from softfin.data.checks.alignment import MIN_ALIGNED_S, measure_rate
from softfin.data.checks.signals import (
    clipped_rows,
    drift,
    frozen_runs,
    repeated_share,
    roughness,
    speed_ratio,
    usual_range,
    velocity_ratio,
)
from softfin.data.checks.statistics import (
    REST_RATE_RAD_S,
    LogColumns,
    LogStatistics,
    channels_in_counts,
    channels_in_degrees,
    known_lags,
)
from softfin.data.importing.clocks import NamedLog
from softfin.data.importing.importing import (
    ANGLES,
    SIGNED,
    AngleChannel,
    ImportConfig,
    compose_frames,
)
from softfin.data.importing.names import FURTHER, UNITS
from softfin.data.issues import Issue, Severity, counted

PLAUSIBLE_LAG_MS = {"command": (0.0, 100.0), "force": (0.0, 60.0)}
"""Plausible lags [ms].

The lag from command to angle, caused by computer, bus and drive, is 32 ms in the virtual tank and 5
ms for the published fin. The lag from angle to force is 20 ms in the tank and 45 ms for the
published fin.
"""

LAG_SPREAD_MS = {"command": 40.0, "force": 25.0}
"""Maximum plausible difference between the lag of a log and the median [ms]."""

USUAL_LAG_MS = 30.0
"""Typical value of both lags when the clocks agree [ms]."""

MIN_FRAME_CORRELATION = 0.2
"""Minimum plausible correlation between the force and a model fin in the best axes; the noisiest
log of the published networks has 0.31."""

MIN_REACH_RAD = 0.06
"""Range below which an angle that is read as degrees must be in radians [rad]."""

MIN_TURN_DEG = 15
"""Minimum rotation of the force axes that is reported [degrees]; in good logs, the best axes are
rotated by up to 10 degrees."""

MAX_REST_ERROR_DEG = 10.0
"""Largest plausible difference between the angle and its command while the fin is at rest
[degrees]; the published networks' logs have up to 8."""

MIN_REST_S = 5
"""Minimum time at rest for comparing the angle with its command [s]; with less, 4 of 40 pieces of
the published networks' logs exceeded the limit."""

REST_SLOPES = (0.7, 1.4)
"""Plausible slopes of the angle against its command while the fin is at rest; the published
networks' logs have 0.79 to 0.85."""

SHAFT_GAIN = 0.03
"""Increase in correlation above which the sensor is reported to turn with the shaft; in good logs,
the correlation decreases."""

OFFSET_SHARE = 0.2
"""Maximum plausible mean force of the fin at rest, divided by the standard deviation of the
force."""

DRIFT_SHARE = 0.7
"""Maximum plausible drift of a force over a log, divided by its standard deviation; good logs of 60
s have up to 0.56. In logs under 50 s, random motion adds to the drift, so twice this value is
plausible."""

MIN_ROUGHNESS = 0.3
"""Minimum plausible ratio of the third to the first differences of the force. Good logs have 0.5 to
2.5; after a 2 Hz low-pass filter, they have 0.01 to 0.25."""

FIN_LENGTHS_M = (0.03, 1.0)
"""Plausible range of the fin length estimated from the size of the forces [m]."""

VELOCITY_UNITS = ("deg/s", "rpm", "rad/s", "dynamixel")
"""Units that may be suggested for a velocity."""

TEN_BIT_RATIOS = (0.3, 0.145)
"""Ratios of the speed to the commanded velocity if 10-bit registers (XL-320, AX) were read as
X-series registers: 1,023 counts are 300 degrees, not 90, and a velocity of 1 is 0.111 rpm, not
0.229."""

MAX_LEVER_M = 2.0
"""Maximum plausible torque about the shaft divided by the force [m]; 0.16 in the virtual tank."""

MAX_FORCE_SHARE = 0.985
"""Maximum plausible fraction of the variance of the torque about the shaft that the forces explain
[-]; 0.88 to 0.93 in the virtual tank."""

FRAME_TURNS = {"x,y": 0, "-y,x": 90, "-x,-y": 180, "y,-x": -90}
MIRRORED_TURNS = {"x,-y": 0, "y,x": 90, "-x,y": 180, "-y,-x": -90}
"""Rotation [degrees] that is equivalent to each frame after y is reversed."""

COUNTS_FIX = (
    "for a Dynamixel of the X series (4,096 counts per turn), use --angles dynamixel; for another "
    "drive, convert the counts in the file: angle = (count - count at angle 0) * 2 * pi / counts "
    "per turn (XL-320 and AX: 300 degrees are 1,023 counts), and the velocities as well"
)
"""Fix for raw register values of a drive, whose manual contains the conversion factors."""

CAUSES = {
    "angle": "the command has a different value",
    "command_angle": "the fin is at a different angle",
}
"""Reasons why channels should change, apart from the motion of the fin."""

CHANNEL_UNITS = {"angle": "rad", "force_x": "N", "force_y": "N"}


class CheckedLog(NamedTuple):
    """A log, and the series derived from it for the checks."""

    raw: LogColumns
    """Channels as read from the file."""
    columns: LogColumns
    """Channels in radians."""
    calm: LogColumns
    """Channels in radians, without spikes."""
    statistics: LogStatistics
    """Statistics of `calm`."""
    config: ImportConfig
    """Options with which the log was read; suggested fixes add to them."""
    channels: Mapping[str, Float[AnyArray, "ticks"]] = MappingProxyType({})
    """Further channels, by column (`softfin.core.log_channels`)."""

    def issue(
        self,
        severity: Severity,
        name: str,
        column: str,
        message: str,
        fix: str,
        row: int | None = None,
    ) -> Issue:
        """Return an issue with this log's name."""
        return Issue(severity, name, self.statistics.name, message, fix, column, row)

    @property
    def moving(self) -> Bool[np.ndarray, "ticks"]:
        """Rows in which the force must change because the fin moves by more than 0.2 rad/s."""
        return np.asarray(np.abs(measure_rate(self.calm.angle)) > 0.2)


def check_counts(log: CheckedLog) -> Iterator[Issue]:
    """Find angles in encoder counts that were read as radians."""
    raw = log.raw
    channels = channels_in_counts(raw)
    if not channels:
        return
    fix = COUNTS_FIX
    count = UNITS["angle"]["dynamixel"]
    ratio = speed_ratio(
        count * raw.command_angle,
        UNITS["velocity"]["dynamixel"] * raw.command_velocity,
        count * raw.angle,
    )
    if ratio is not None and 0.9 < ratio < 1.1:
        # The middle of the range is 0, or half a turn.
        zero = 2048 if np.median(raw.angle) > 1024 else 0
        fix = f"--angles dynamixel --angle-zero {zero}"
    for channel in channels:
        values = getattr(raw, channel)
        message = (
            f"ranges from {values.min():.4g} to {values.max():.4g}: these look like encoder "
            "counts, not rad or degrees"
        )
        yield log.issue("error", "counts", channel, message, fix)


def check_degrees(log: CheckedLog) -> Iterator[Issue]:
    """Find angles in degrees that were read as radians."""
    wrong = channels_in_degrees(log.raw, log.config.velocity_rad_s is not None)
    reach = float(np.ptp(log.raw.angle))
    if log.config.angles.get("angle") == "deg" and reach < MIN_REACH_RAD:
        message = f"the angle ranges over {reach:.2g} rad: these look like rad, not degrees"
        yield log.issue("error", "radians", "angle", message, "--angles rad")
    if not wrong:
        return
    ranges = []
    are_integers = True
    for channel in wrong:
        values = getattr(log.raw, channel)
        ranges.append(f"{channel} ranges from {values.min():.4g} to {values.max():.4g}")
        are_integers = are_integers and bool((values == np.round(values)).all())
    fix = "--angles deg"
    if set(wrong) != set(ANGLES):
        fix = _angles_option({channel: "deg" for channel in ANGLES if channel in wrong})
    if are_integers:
        fix = f"{fix}; if these integers are encoder counts instead, {COUNTS_FIX}"
    message = f"{'; '.join(ranges)}: these look like degrees, not rad"
    yield log.issue("error", "degrees", wrong[0], message, fix)


def check_spikes(log: CheckedLog) -> Iterator[Issue]:
    """Find outliers of one or two samples."""
    for channel, unit in CHANNEL_UNITS.items():
        values = getattr(log.columns, channel)
        calm = getattr(log.calm, channel)
        rows = np.flatnonzero(values != calm)
        if rows.size:
            highest = np.abs(values - calm)[rows].max()
            message = (
                f"{counted(rows.size, 'spike')} of up to {highest:.3g} {unit} relative to the "
                f"neighbouring samples; 98% of all samples lie within a range of "
                f"{usual_range(values):.3g}"
            )
            fix = (
                "check the cable and the sensor range; repair these samples in the file or record "
                "again"
            )
            # Single spikes can be repaired; more than one in a thousand samples is a fault.
            severity: Severity = "error" if rows.size > 1e-3 * len(values) else "warning"
            yield log.issue(severity, "spikes", channel, message, fix, int(rows[0]))


def check_jumps(log: CheckedLog) -> Iterator[Issue]:
    """Find jumps of the angle that are too fast for a fin; they indicate two joined logs or an
    encoder that lost count."""
    steps = np.abs(np.diff(log.calm.angle))
    # 200 rad/s; jumps in the logs of the published networks reach 1.5 rad.
    rows = np.flatnonzero(steps > 2.0)
    if rows.size:
        message = (
            f"{counted(rows.size, 'jump')} of up to {steps.max():.2f} rad between consecutive "
            "samples"
        )
        fix = (
            "use --rows-per-log 20000 if the file consists of logs of this length; otherwise, "
            "split the file at these rows"
        )
        yield log.issue("warning", "jumps", "angle", message, fix, int(rows[0]))


def check_stuck(log: CheckedLog) -> Iterator[Issue]:
    """Find channels that keep their value although they should change."""
    columns = log.columns
    # The force on a moving fin changes, and a drive moves if it is 0.1 rad away from its target.
    behind = np.abs(columns.command_angle - columns.angle) > 0.1
    # The fin does not move away from its commanded angle.
    away = columns.angle - columns.command_angle
    leaves = (np.abs(away) > 0.2) & (np.sign(away) * measure_rate(log.calm.angle) > 0.2)
    leaves &= log.statistics.following > 0
    channels = {"angle": behind, "command_angle": leaves}
    for channel, unit in {**CHANNEL_UNITS, "command_angle": "rad"}.items():
        driven = channels.get(channel, log.moving)
        values = getattr(columns, channel)
        runs = []
        for start, end in frozen_runs(values):
            # The first 0.2 s are dead time. More than half a second of the run must count as
            # driven, because a blocked drive may push without moving. The published fin moves away
            # from its command for up to 1.6 s.
            least = 2.5 if channel == "command_angle" else 0.5
            if driven[start + RATE_HZ // 5 : end].sum() > least * RATE_HZ:
                runs.append((end - start, -start))
        if runs:
            # The first of the longest runs: starts are negated for max().
            longest, start = max(runs)
            cause = CAUSES.get(channel, "the fin is moving")
            message = (
                f"stuck at {values[-start]:.4g} {unit}, or within one count of it, for "
                f"{longest * TICK_S:.2f} s while {cause}; {counted(len(runs), 'such run')}"
            )
            fix = "check the sensor and the drive; remove these rows or record again"
            yield log.issue("error", "stuck", channel, message, fix, -start)


def check_saturation(log: CheckedLog) -> Iterator[Issue]:
    """Find forces that repeatedly stay at their extreme, where the sensor range ends."""
    for channel in ("force_x", "force_y"):
        for sign in (-1, 1):
            values = sign * getattr(log.calm, channel)
            runs = clipped_rows(values, log.moving)
            if len(runs) >= 2:
                message = f"clipped at {sign * values.max():.4g} N in {len(runs):,} runs"
                fix = "select a larger range on the sensor and record again"
                yield log.issue("warning", "saturated", channel, message, fix, runs[0][0])


def check_force_sensor(log: CheckedLog) -> Iterator[Issue]:
    """Find forces that repeat, were filtered, or are implausible for any fin."""
    column = "force_x, force_y"
    force = log.columns.force
    repeated = repeated_share(force, log.moving)
    if repeated > 0.1:
        # Single repeated rows hardly affect a fit.
        severity: Severity = "note" if repeated < 0.4 else "warning"
        message = f"{repeated:.0%} of the rows of the moving fin repeat the previous row"
        fix = "read the sensor once per row, at 100 Hz or faster, and record again"
        yield log.issue(severity, "repeated values", column, message, fix)
    elif roughness(force) < MIN_ROUGHNESS:
        message = "low-pass filtered: contains almost no frequencies above a few hertz"
        fix = (
            "switch off the filter of the sensor, its driver or its broadcaster, or set it to 20 "
            "Hz or more, and record again"
        )
        yield log.issue("warning", "filtered force", column, message, fix)
    low, high = FIN_LENGTHS_M
    length = log.statistics.fin_length_m
    if np.ptp(log.columns.angle) > 0.1 and not low < length < high:
        severity = "warning" if low / 2.5 < length < 2.5 * high else "error"
        message = f"forces of this size correspond to a fin length of about {length:.2g} m"
        fix = "if the fin has a different size, set --force-unit or convert the columns to N"
        yield log.issue(severity, "force size", column, message, fix)


def check_velocity(log: CheckedLog) -> Iterator[Issue]:
    """Find a velocity that is not the rate of the angle."""
    correlation, ratio = velocity_ratio(log.calm.angle, log.columns.velocity)
    severity: Severity = "error"
    message = f"velocity is {ratio:.3g} times the rate of the angle (correlation {correlation:.2f})"
    if ratio == 0:
        # Many publishers of joint states leave the velocity at 0. A constant velocity is correct if
        # the angle changes at this rate. One sample in a hundred may be a spike.
        velocity = log.columns.velocity[0]
        rest = np.percentile(np.abs(measure_rate(log.calm.angle) - velocity), 99)
        if rest <= REST_RATE_RAD_S:
            return
        name = "constant velocity"
        message = f"the velocity stays at {velocity:.3g} rad/s while the angle changes"
        fix = "use --columns velocity=- to derive it from the angle"
    elif correlation < -0.5:
        name = "velocity sign"
        fix = "--negate velocity"
    elif correlation < 0.5:
        severity = "warning"
        name = "velocity"
        fix = "map a different column, or use --columns velocity=- to derive it from the angle"
    elif not 0.95 < ratio < 1.05:
        severity = "warning" if 0.5 < ratio < 2 else "error"
        name = "velocity unit"
        fix = _unit_option(log, "velocity", 1 / ratio) or (
            "check the velocity unit, and check the clock, because a loop that is slower than its "
            "timestamps causes such a ratio"
        )
    else:
        return
    yield log.issue(severity, name, "velocity", message, fix)


def check_speed(log: CheckedLog) -> Iterator[Issue]:
    """Find commanded velocities at which the fin does not move."""
    ratio = log.statistics.speed_ratio
    if ratio is None or 0.9 < ratio < 1.1:
        return
    name = "command velocity unit"
    severity: Severity = "error"
    option = _unit_option(log, "command_velocity", ratio)
    fix = option or (
        f"find the unit in the drive manual; if multiplied by {ratio:.3g}, the column would fit"
    )
    # Such ratios may be caused by a clock, the scale of the angle or a slow drive.
    if option is None and 0.05 < ratio < 20:
        name = "speed"
        severity = "warning"
        fix = "compare the column with the drive manual, and the clock with the loop rate"
        if any(0.93 < ratio / expected < 1.07 for expected in TEN_BIT_RATIOS):
            fix = (
                "if the drive is an XL-320 or AX, convert its registers in the file: 1,023 counts "
                "are 300 degrees, and a velocity of 1 is 0.111 rpm"
            )
    message = f"the fin moves at {ratio:.3g} times the commanded velocity"
    yield log.issue(severity, name, "command_velocity", message, fix)


def _unit_option(log: CheckedLog, channel: AngleChannel, factor: float) -> str | None:
    """Return the option for the unit that scales a velocity by this factor, or None."""
    angles = dict(log.config.angles)
    # `factor` applies to the column after the conversion that check_degrees suggests.
    wrong = channels_in_degrees(log.raw, log.config.velocity_rad_s is not None)
    angles |= {each: "deg" for each in ANGLES if each in wrong}
    units = UNITS["velocity"]
    current = angles.get(channel, "rad/s")
    # An angle unit for a velocity, such as deg, means that unit per second.
    factor *= units[current if current in units else f"{current}/s"]
    for unit in VELOCITY_UNITS:
        if 0.93 < factor / units[unit] < 1.07:
            return _angles_option(angles | {channel: unit})
    return None


def _angles_option(angles: Mapping[AngleChannel, str]) -> str:
    return "--angles " + ",".join(f"{channel}={unit}" for channel, unit in angles.items())


def check_commanded_velocity(log: CheckedLog) -> Iterator[Issue]:
    """Find commanded velocities that are not positive."""
    wrong = np.flatnonzero(log.columns.command_velocity <= 0)
    if wrong.size:
        message = (
            f"0 or negative in {wrong.size:,} of {len(log.raw.angle):,} rows; a profile "
            "velocity must be positive"
        )
        fix = "map the column with the profile velocity of the drive"
        yield log.issue(
            "warning", "command velocity", "command_velocity", message, fix, int(wrong[0])
        )


def check_following(log: CheckedLog) -> Iterator[Issue]:
    """Find an angle that does not follow its command."""
    following = log.statistics.following
    command = log.calm.command_angle
    column = "command_angle"
    if len(command) < MIN_ALIGNED_S * RATE_HZ:
        return
    if np.ptp(command) == 0:
        fix = (
            "map the column with the commanded angle; a log without commands cannot be used for "
            "training"
        )
        message = f"the commanded angle stays at {command[0]:.3g} rad"
        yield log.issue("error", "constant command", column, message, fix)
    elif following < -0.3:
        message = f"the angle moves opposite to its command: correlation {following:.2f}"
        if log.statistics.frame == "x,-y":
            column = "angle"
            message = f"{message}, and the force fits the mirrored angle"
        fix = _negate_option(log.config, [column])
        yield log.issue("error", "command sign", column, message, fix)
    elif following < 0.3:
        message = f"the angle hardly follows its command: correlation {following:.2f} after 150 ms"
        fix = "map other columns to angle and command_angle, or check the clocks"
        yield log.issue("warning", "not following", column, message, fix)


def check_rest(log: CheckedLog) -> Iterator[Issue]:
    """Find an angle that differs from its command while the fin is at rest."""
    columns = log.calm
    is_held = np.abs(measure_rate(columns.command_angle)) == 0
    at_rest = is_held & (np.abs(measure_rate(columns.angle)) < REST_RATE_RAD_S)
    command = columns.command_angle[at_rest]
    angle = columns.angle[at_rest]
    if (
        len(angle) < MIN_REST_S * RATE_HZ
        or np.ptp(command) < 1e-3
        or abs(log.statistics.following) < 0.3
    ):
        return
    # A blocked drive is also at rest, so the median is used instead of the mean.
    offset = np.degrees(np.median(angle - command))
    slope = float(np.polyfit(command, angle, 1)[0])
    message = ""
    if not REST_SLOPES[0] < abs(slope) < REST_SLOPES[1]:
        message = f"at rest, the angle changes by {slope:.3g} times the change of its command"
        fix = "check the units of both columns, and set the unit of the wrong column with --angles"
    elif slope > 0 and abs(offset) > MAX_REST_ERROR_DEG:
        message = f"at rest, the angle is {offset:+.0f} degrees from its command"
        fix = (
            "find out which of the two is 0 when the fin points along -x, and correct the zero of "
            "the other column in the file; --angle-zero changes both"
        )
    if message:
        yield log.issue("error", "rest angle", "angle", message, fix)


def check_force_axes(log: CheckedLog) -> Iterator[Issue]:
    """Find swapped, negated or rotated force axes, a sensor that turns with the shaft, and a force
    that is unrelated to the motion."""
    found = log.statistics
    is_angle_mirrored = found.following < -0.3 and found.frame == "x,-y"
    if found.frames is None or is_clock_off(found) or is_angle_mirrored:
        return
    given = found.frames["x,y"]
    in_frame = found.frames[found.frame]
    # If the angle is too small by a factor, the force seems to turn with a reversed shaft.
    ratio = found.speed_ratio
    is_scale_wrong = found.is_shaft_reversed and ratio is not None and not 0.9 < ratio < 1.1
    severity: Severity = "error"
    if found.correlation < MIN_FRAME_CORRELATION:
        severity = "warning"
        name = "unexplained force"
        reading = f"at most {found.correlation:.2f} in other axes"
        fix = "check the clocks, and check that force and angle are from the same experiment"
    elif found.shaft_correlation > found.correlation + SHAFT_GAIN and not is_scale_wrong:
        name = "shaft frame"
        reading = f"{found.shaft_correlation:.2f} if the sensor turns with the shaft"
        formula = "x cos(a) + y sin(a), y cos(a) - x sin(a)"
        if found.is_shaft_reversed:
            formula = "x cos(a) - y sin(a), y cos(a) + x sin(a)"
        fix = (
            f"rotate the forces in the file back by the angle a: {formula}; or fix the sensor to "
            "the mount and record again"
        )
    elif abs(found.turn_deg) >= MIN_TURN_DEG and found.correlation > in_frame + 0.02:
        name = "turned force"
        reading = f"{found.correlation:.2f} turned by {found.turn_deg} degrees, as {found.frame}"
        fix = (
            f"rotate the forces in the file by a = {found.turn_deg} degrees: x cos(a) - y sin(a), "
            "x sin(a) + y cos(a); then use "
            f"{_axes_options(log.config, found.frame, found.turn_deg)}"
        )
    elif in_frame > given + 0.1:
        name = "force axes"
        reading = f"{in_frame:.2f} as {found.frame}"
        fix = _axes_options(log.config, found.frame, 0)
    else:
        return
    low, high = np.degrees([log.calm.command_angle.min(), log.calm.command_angle.max()])
    # The correct axes depend on angle 0, which is uncertain if no command reaches it.
    excludes_zero = (low > 0 or high < 0) and not log.config.angle_zero
    if excludes_zero and name in ("turned force", "force axes"):
        name = "angle zero"
        reading = f"and the commands range from {low:.0f} to {high:.0f} degrees, without 0"
        centre = _angle_zero_option(log.config, 5 * round((low + high) / 10))
        fix = (
            "set the angle at which the fin points along -x; if this is the middle of its range, "
            f"use {centre}"
        )
    message = f"correlation with the force of a model fin {given:.2f} as recorded, {reading}"
    yield log.issue(severity, name, "force_x, force_y", message, fix)


def _axes_options(config: ImportConfig, frame: str, turn_deg: int) -> str:
    """Return the option for a frame, and other options that may fix a force that fits this frame
    after a rotation."""
    option = f"--force={compose_frames(config.force, frame)}"
    turn = FRAME_TURNS.get(frame, 0) + turn_deg
    mirrored = ""
    if frame in MIRRORED_TURNS:
        turn = MIRRORED_TURNS[frame] - turn_deg
        mirrored = f" --force={compose_frames(config.force, 'x,-y')}"
    if turn:
        zero = _angle_zero_option(config, -turn)
        return (
            f"{option}; or, if the fin is at {turn} degrees where the log has 0, {zero}{mirrored}"
        )
    negated = _negate_option(config, ("command_angle", "angle"))
    return f"{option}; or, if positive angles turn the fin towards -y, {negated}"


def _negate_option(config: ImportConfig, names: Sequence[str]) -> str:
    # The option gets its complete new value, without channels that are negated twice.
    changed = [name for name in (*SIGNED, *FURTHER) if (name in config.negate) != (name in names)]
    return f"--negate {','.join(changed)}" if changed else "remove --negate"


def _angle_zero_option(config: ImportConfig, degrees: float | int) -> str:
    """Return the option that makes a recorded angle the new angle 0."""
    unit = config.angles.get("angle", "rad")
    shift = np.radians(degrees) / UNITS["angle"][unit]
    if "angle" in config.negate:
        shift = -shift
    return f"--angle-zero={config.angle_zero + shift:.4g}"


def is_clock_off(found: LogStatistics) -> bool:
    """Return whether only a lag beyond 0.2 s explains the force. In good logs of at least 10 s, a
    lag beyond 0.2 s explains at most 3% more than one within 0.2 s, by chance."""
    return found.far_share > found.force_share + 0.1


def check_force_clock(log: CheckedLog) -> Iterator[Issue]:
    """Find a force whose clock is misaligned in all or part of the log."""
    found = log.statistics
    fix = (
        "synchronize the clocks, or timestamp the sensor and the drive on one computer, and record "
        "again"
    )
    if is_clock_off(found):
        message = (
            f"no lag within 0.2 s explains the force: {found.force_share:.0%} of its variance, "
            f"and {found.far_share:.0%} at {found.far_lag_ms / 1e3:.1f} s"
        )
        yield log.issue("error", "force clock", "force_x, force_y", message, fix)
    elif found.axis_lags_ms is not None:
        x, y = found.axis_lags_ms
        message = f"force_x lags the angle by {x:.0f} ms, and force_y by {y:.0f} ms"
        yield log.issue("error", "force clock", "force_x, force_y", message, fix)
    elif found.late_force_s:
        starts = ", ".join(f"{start:.0f}" for start in found.late_force_s)
        message = f"a different lag than in the rest of the log, in the 6 s from {starts} s"
        row = round(found.late_force_s[0] * RATE_HZ)
        yield log.issue("error", "changing lag", "force_x, force_y", message, fix, row)


def check_force_offset(log: CheckedLog) -> Iterator[Issue]:
    """Find a force that is not zero while the fin is at rest, or that drifts."""
    found = log.statistics
    offsets = found.offset_n or (0.0, 0.0)
    for axis, offset, deviation in zip(AXES, offsets, found.force_std_n, strict=True):
        column = f"force_{axis}"
        change = drift(getattr(log.calm, column))
        of_deviation = f"the standard deviation over the log is {deviation:.2g} N"
        share = DRIFT_SHARE if found.rows >= 50 * RATE_HZ else 2 * DRIFT_SHARE
        if abs(change) > share * deviation and found.rows >= MIN_ALIGNED_S * RATE_HZ:
            message = f"drifts by {change:+.2g} N over the log; {of_deviation}"
            fix = "let the sensor warm up, or subtract the drift from the column"
            yield log.issue("warning", "force drift", column, message, fix)
        elif abs(offset) > OFFSET_SHARE * deviation:
            message = f"{offset:+.2g} N while the fin is at rest; {of_deviation}"
            fix = (
                "tare the sensor in still water before each log, or subtract this offset from the "
                "column"
            )
            yield log.issue("warning", "force offset", column, message, fix)


def check_power(log: CheckedLog) -> Iterator[Issue]:
    """Find torques and currents with which power would be wrong."""
    if log.moving.sum() < MIN_ALIGNED_S * RATE_HZ:
        return
    moving = {name: np.asarray(values)[log.moving] for name, values in log.channels.items()}
    column = LOAD_CHANNELS[-1]
    for name in (column, CURRENT_CHANNEL):
        values = np.unique(moving.get(name, [0.0, 1.0]))
        if np.isfinite(values).sum() < 2:
            message = f"always {moving.pop(name)[0]:.4g} while the fin is moving: not measured"
            yield log.issue("warning", "constant", name, message, "remove the column")
    if column not in moving:
        return
    force = log.columns.force[log.moving]
    velocity = log.columns.velocity[log.moving]
    rows = np.stack([moving[column], force.real, force.imag, velocity], axis=1)
    rows = rows[np.isfinite(rows).all(axis=1)]
    if len(rows) < MIN_ALIGNED_S * RATE_HZ or not np.ptp(rows[:, 1:3], axis=0).any():
        return
    rows = rows - rows.mean(axis=0)
    torque = rows[:, 0]
    parts = rows[:, 1:3]
    share = 1 - (torque - parts @ np.linalg.lstsq(parts, torque)[0]).var() / torque.var()
    lever_m = torque.std() / np.linalg.norm(parts.std(axis=0))
    power_w = torque * rows[:, 3]
    seconds = power_w[: len(power_w) // RATE_HZ * RATE_HZ].reshape(-1, RATE_HZ).mean(axis=1)
    error_w = seconds.std(ddof=1) / len(seconds) ** 0.5
    if lever_m > MAX_LEVER_M:
        message = f"a torque of this size corresponds to a lever of {lever_m:.3g} m"
        fix = "if it is in N mm, name its unit, e.g. torque_mNm, or divide the column by 1,000"
        yield log.issue("warning", "torque unit", column, message, fix)
    elif share > MAX_FORCE_SHARE:
        message = f"proportional to the force ({share:.1%}), like a torque about x or y"
        fix = "use the torque about the shaft, with --columns torque=COLUMN"
        yield log.issue("warning", "torque axis", column, message, fix)
    elif seconds.mean() < -3 * error_w:
        message = f"opposes the motion of the fin: {seconds.mean():.2g} W on average"
        fix = _negate_option(log.config, ("torque",))
        yield log.issue("warning", "torque sign", column, message, fix)


def check_lags(statistics: Sequence[LogStatistics], config: ImportConfig) -> Iterator[Issue]:
    """Find implausible lags between clocks, and lags that differ between logs."""
    for name, (least, most) in PLAUSIBLE_LAG_MS.items():
        measured = known_lags(statistics, name)
        lags = [lag for lag, _ in measured]
        # Lags are accurate to one tick.
        low = least - 10.0
        high = most + 10.0
        usual = np.median(lags or [USUAL_LAG_MS])
        for lag, log in measured:
            is_far = abs(lag - usual) > LAG_SPREAD_MS[name]
            is_plausible = low <= lag <= high
            # Report a log if it differs from the others or if all are implausible. The lag of a
            # single noisy log is uncertain, so it may be slightly implausible while the median is
            # plausible.
            if not is_far and (is_plausible or low <= usual <= high):
                continue
            # Late time stamps of commands make the lag appear shorter; late time stamps of forces
            # make it appear longer.
            late = lag - USUAL_LAG_MS
            column = "force_x, force_y"
            ends = "angle to force"
            if name == "command":
                late = -late
                column = "command_angle"
                ends = "command to angle"
            usually = ""
            if len(measured) > 1:
                usually = f" (median of {len(measured)} logs: {usual:.0f} ms)"
            message = (
                f"{lag:.0f} ms from {ends}{usually}; plausible are {least:.0f} to {most:.0f} ms, "
                "so a clock is off"
            )
            late += getattr(config, f"{name}_lag_ms")
            fix = (
                f"--{name}-lag {10 * round(late / 10):d} shifts the {name} so that a lag of about "
                f"{USUAL_LAG_MS:.0f} ms remains"
            )
            yield Issue(
                "warning" if is_plausible else "error", f"{name} lag", log, message, fix, column
            )


def check_dataset(logs: Sequence[NamedLog]) -> Iterator[Issue]:
    """Find a dataset without test logs, and training commands that exclude angle 0 or cover too
    little of their own range."""
    if not any(one.part == "test" for one in logs):
        fix = "select test logs with --test PATTERN, or put them into a folder named test"
        yield Issue("note", "no test logs", "all logs", "no test logs", fix)
    training = [one.log for one in logs if one.part == "train"]
    if training:
        limits = command_limits(training)
        # Larger values are not in radians and are reported by check_degrees and check_counts.
        is_in_radians = max(abs(limits.angle_min), abs(limits.angle_max)) <= MAX_ANGLE_RAD
        if is_in_radians and limits.angle_min < limits.angle_max and limits.rest_angle != 0:
            message = (
                f"the commanded angles range from {limits.angle_min:.3g} to "
                f"{limits.angle_max:.3g} rad and do not include 0"
            )
            fix = (
                f"if the fin cannot point along -x, ignore this: its experiments start at "
                f"{limits.rest_angle:.3g} rad; otherwise correct the zero: on a rig, turn the fin "
                "to point along -x and run softfin rig zero --arm; in logs, use --angle-zero"
            )
            yield Issue("warning", "no rest", "all logs", message, fix, "command_angle")
    steps = []
    for log in training:
        pairs = np.stack(log.command, axis=1).astype(np.float64)
        steps.append(pairs[1:][(np.diff(pairs, axis=0) != 0).any(axis=1)])
    # 300 random commands leave hardly any of the 36 cells empty (6 cells if there is only one
    # velocity).
    if sum(map(len, steps)) < 300:
        return
    angle, velocity = np.concatenate(steps).T
    cells = np.histogram2d(angle, velocity, bins=(6, 6 if np.ptp(velocity) > 0 else 1))[0]
    filled = float((cells > 0).mean())
    if filled < 0.5:
        message = (
            f"the commands fall into only {filled:.0%} of the {cells.size} cells of their range of "
            "angle and velocity"
        )
        fix = "record random angles and velocities, as softfin collect does"
        yield Issue("warning", "coverage", "all logs", message, fix, "command_angle")


LOG_CHECKS: tuple[Callable[[CheckedLog], Iterator[Issue]], ...] = (
    check_degrees,
    check_spikes,
    check_jumps,
    check_stuck,
    check_saturation,
    check_force_sensor,
    check_velocity,
    check_commanded_velocity,
    check_speed,
    check_following,
    check_rest,
    check_force_clock,
    check_force_axes,
    check_force_offset,
    check_power,
)
"""Checks of a single log, in the order in which they run."""
