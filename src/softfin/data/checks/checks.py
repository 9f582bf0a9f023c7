"""Checks of logs: each check is a function that yields issues.

`LOG_CHECKS`, at the end of this file, lists the checks of a single log.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from softfin.core.quantities import AXES, MAX_ANGLE_RAD, RATE_HZ, TICK_S, command_limits
from softfin.data.checks.alignment import MIN_ALIGNED_S, measure_rate
from softfin.data.checks.statistics import (
    REST_RATE_RAD_S,
    LogColumns,
    LogStatistics,
    channels_in_counts,
    channels_in_degrees,
    known_lags,
    true_runs,
    velocity_slope,
)
from softfin.data.importing.clocks import NamedLog
from softfin.data.importing.importing import ANGLES, SIGNED, ImportConfig, compose_frames
from softfin.data.issues import Issue, Severity, counted

STUCK_S = 1.0
"""Shortest run of a constant value that is reported [s]."""

PLAUSIBLE_LAG_MS = {"command": (0.0, 100.0), "force": (0.0, 60.0)}
"""Plausible lags [ms].

Command to angle, through computer, bus and drive: 32 ms in the virtual tank, 5 ms in the published
fin. Angle to force: 20 ms in the tank, 45 ms in the published fin.
"""

LAG_SPREAD_MS = {"command": 40.0, "force": 25.0}
"""Largest plausible difference between a log's lag and the median [ms]."""

USUAL_LAG_MS = 30.0
"""Typical value of both lags when the clocks agree [ms]."""

MIN_FRAME_CORRELATION = 0.12
"""Lowest plausible correlation between the force and a model fin, in the best frame; the noisiest
of the published networks' logs has 0.2."""

OFFSET_SHARE = 0.2
"""Largest plausible mean force on the fin at rest, divided by the standard deviation of the
force."""

COUNTS_FIX = (
    "convert the counts in the file: angle = (count - count at angle 0) * 2 * pi / counts per "
    "turn; convert the velocities from the unit of the drive as well"
)
"""Fix for raw register values of a drive; the conversion factors are in the drive's manual."""

CHANNEL_UNITS = {"angle": "rad", "force_x": "N", "force_y": "N"}


class CheckedLog(NamedTuple):
    """A log with the derived series that the checks need."""

    raw: LogColumns
    """Channels as read."""
    columns: LogColumns
    """Channels in radians."""
    calm: LogColumns
    """Channels in radians, without spikes."""
    statistics: LogStatistics
    """Statistics of `calm`."""
    config: ImportConfig
    """Options with which the log was read; suggested fixes extend them."""

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


def check_counts(log: CheckedLog) -> Iterator[Issue]:
    """Find angles in encoder counts that were read as radians."""
    for channel in channels_in_counts(log.raw):
        values = getattr(log.raw, channel)
        message = (
            f"ranges from {values.min():.4g} to {values.max():.4g}: these look like encoder "
            "counts, not rad or degrees"
        )
        yield log.issue("error", "counts", channel, message, COUNTS_FIX)


def check_degrees(log: CheckedLog) -> Iterator[Issue]:
    """Find angles in degrees that were read as radians."""
    wrong = channels_in_degrees(log.raw, log.config.velocity_rad_s is not None)
    if not wrong:
        return
    ranges = []
    are_integers = True
    for channel in wrong:
        values = getattr(log.raw, channel)
        ranges.append(f"{channel} ranges from {values.min():.4g} to {values.max():.4g}")
        are_integers = are_integers and bool((values == np.round(values)).all())
    option = "deg"
    if set(wrong) != set(ANGLES):
        option = ",".join(f"{channel}=deg" for channel in wrong)
    fix = f"--angles {option}"
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
            usual_range = np.ptp(np.percentile(values, [1, 99]))
            message = (
                f"{counted(rows.size, 'spike')} of up to {highest:.3g} {unit} relative to the "
                f"neighbouring samples; 98% of all samples lie within a range of {usual_range:.3g}"
            )
            fix = (
                "check the cable and the sensor's range; repair these samples in the file or "
                "record again"
            )
            # Single spikes can be repaired; more than one in a thousand samples is a fault.
            severity: Severity = "error" if rows.size > 1e-3 * len(values) else "warning"
            yield log.issue(severity, "spikes", channel, message, fix, int(rows[0]))


def check_jumps(log: CheckedLog) -> Iterator[Issue]:
    """Find jumps of the angle that are too fast for a fin: two joined logs, or an encoder that lost
    its count."""
    steps = np.abs(np.diff(log.calm.angle))
    # 200 rad/s; the jumps in the published networks' logs reach 1.5 rad.
    rows = np.flatnonzero(steps > 2.0)
    if rows.size:
        message = (
            f"{counted(rows.size, 'jump')} of up to {steps.max():.2f} rad between consecutive "
            "samples"
        )
        fix = (
            "use --rows-per-log 20000 if the file contains logs of that length end to end; "
            "otherwise, split the file at these rows"
        )
        yield log.issue("warning", "jumps", "angle", message, fix, int(rows[0]))


def check_stuck(log: CheckedLog) -> Iterator[Issue]:
    """Find channels that keep one value although they should change."""
    columns = log.columns
    # On a fin that moves at 0.2 rad/s the force changes, and a drive that is 0.1 rad away from its
    # target moves.
    moving = np.abs(measure_rate(columns.angle)) > 0.2
    behind = np.abs(columns.command_angle - columns.angle) > 0.1
    for channel, unit in CHANNEL_UNITS.items():
        driven = moving
        cause = "the fin is moving"
        if channel == "angle":
            driven = behind
            cause = "the command differs from it"
        values = getattr(columns, channel)
        runs = []
        total = 0
        for start, last in true_runs(np.diff(values) == 0):
            rows = last + 1 - start
            # The first 0.2 s are dead time. More than half a second of the run must count as
            # driven, because a blocked drive may push without moving.
            num_driven = driven[start + round(0.2 * RATE_HZ) : last + 1].sum()
            if rows >= STUCK_S * RATE_HZ and num_driven > 0.5 * STUCK_S * RATE_HZ:
                runs.append((rows, -start))
                total += rows
        if runs:
            # The first of the longest runs: starts are negated for max().
            longest, start = max(runs)
            message = (
                f"stuck at {values[-start]:.4g} {unit} for {longest * TICK_S:.2f} s while {cause}; "
                f"{counted(len(runs), 'such run')}, {total * TICK_S:.2f} s in total"
            )
            fix = "check the sensor and the drive; remove these rows or record again"
            yield log.issue("error", "stuck", channel, message, fix, -start)


def check_saturation(log: CheckedLog) -> Iterator[Issue]:
    """Find forces that repeatedly stay at their extreme, where the sensor's range ends."""
    for channel in ("force_x", "force_y"):
        values = getattr(log.columns, channel)
        # Any series has an extreme; only a clipped one stays there for several samples, repeatedly.
        for extreme in sorted({float(values.min()), float(values.max())}):
            runs = []
            rows = 0
            for start, end in true_runs(values == extreme):
                if end - start >= 3:
                    runs.append((start, end))
                    rows += end - start
            if len(runs) >= 2 and 10 <= rows < len(values):
                message = (
                    f"clipped at {extreme:.4g} N: {rows:,} samples, in {len(runs):,} runs of at "
                    "least 3"
                )
                fix = "select a larger range on the sensor and record again"
                yield log.issue("warning", "saturated", channel, message, fix, runs[0][0])


def check_velocity(log: CheckedLog) -> Iterator[Issue]:
    """Find a velocity that is not the rate of the angle."""
    correlation, slope = velocity_slope(log.columns)
    if slope == 0:
        # Many publishers of joint states leave the velocity at 0. A constant velocity is right if
        # the angle changes at that rate. One sample in a hundred may be a spike.
        velocity = log.columns.velocity[0]
        if np.percentile(np.abs(measure_rate(log.calm.angle) - velocity), 99) > REST_RATE_RAD_S:
            message = f"the velocity stays at {velocity:.3g} rad/s while the angle changes"
            fix = "use --columns velocity=- to derive it from the angle"
            yield log.issue("error", "constant velocity", "velocity", message, fix)
        return
    message = f"velocity is {slope:.3g} times the angle's rate (correlation {correlation:.2f})"
    if correlation < -0.5:
        yield log.issue(
            "error",
            "velocity sign",
            "velocity",
            f"{message}: wrong sign",
            "--negate velocity",
        )
    elif correlation < 0.5:
        fix = "map a different column, or use --columns velocity=- to derive it from the angle"
        message = f"{message}: probably not the fin's velocity"
        yield log.issue("warning", "velocity", "velocity", message, fix)
    elif not 0.5 < slope < 2:
        fix = "set its unit, e.g. --angles velocity=deg for a factor of 57, or map another column"
        yield log.issue("error", "velocity unit", "velocity", f"{message}: wrong unit", fix)


def check_commanded_velocity(log: CheckedLog) -> Iterator[Issue]:
    """Find commanded velocities that are not positive."""
    wrong = np.flatnonzero(log.columns.command_velocity <= 0)
    if wrong.size:
        message = (
            f"0 or negative in {wrong.size:,} of {len(log.raw.angle):,} rows; a profile "
            "velocity must be positive"
        )
        fix = "map the column with the drive's profile velocity"
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
        if _is_mirrored(log.statistics):
            column = "angle"
            message = f"{message}, and the force fits the mirrored angle"
        # The complete new value of the option: a channel that is already negated is removed.
        names = [name for name in SIGNED if (name in log.config.negate) != (name == column)]
        fix = f"--negate {','.join(names)}" if names else "remove --negate"
        yield log.issue("error", "command sign", column, message, fix)
    elif following < 0.3:
        message = f"the angle hardly follows its command: correlation {following:.2f} after 150 ms"
        fix = "map other columns to angle and command_angle, or check the clocks"
        yield log.issue("warning", "not following", column, message, fix)


def check_force_axes(log: CheckedLog) -> Iterator[Issue]:
    """Find force axes that are swapped or negated, and a force that is unrelated to the motion."""
    frames = log.statistics.frames
    if frames is None or (log.statistics.following < -0.3 and _is_mirrored(log.statistics)):
        return
    best = max(frames, key=frames.__getitem__)
    given = frames["x,y"]
    if frames[best] > max(given + 0.1, MIN_FRAME_CORRELATION):
        message = (
            f"axes swapped or negated: the correlation with the force of a model fin is "
            f"{given:.2f} as recorded and {frames[best]:.2f} as {best}"
        )
        fix = f"--force={compose_frames(log.config.force, best)}"
        yield log.issue("error", "force axes", "force_x, force_y", message, fix)
    elif given < MIN_FRAME_CORRELATION:
        message = (
            f"the force is almost unrelated to the motion: correlation {given:.2f} with the force "
            "of a model fin"
        )
        fix = "check the clocks, and check that force and angle are from the same experiment"
        yield log.issue("warning", "unexplained force", "force_x, force_y", message, fix)


def check_force_offset(log: CheckedLog) -> Iterator[Issue]:
    """Find a non-zero force while the fin is at rest."""
    found = log.statistics
    for axis, offset, deviation in zip(AXES, found.offset_n or (), found.force_std_n, strict=False):
        if abs(offset) > OFFSET_SHARE * deviation:
            message = (
                f"{offset:+.2g} N while the fin is at rest; the standard deviation over the log is "
                f"{deviation:.2g} N"
            )
            fix = (
                "tare the sensor in still water before each log, or subtract this offset from the "
                "column"
            )
            yield log.issue("warning", "force offset", f"force_{axis}", message, fix)


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
            # Report a log if it stands out or if all are implausible. The lag of one noisy log is
            # uncertain, so it may be slightly implausible if the median is not.
            if not is_far and (is_plausible or low <= usual <= high):
                continue
            # Commands that are stamped late make the lag look shorter; a force that is stamped late
            # makes it look longer.
            if name == "command":
                follower = "the angle"
                leader = "its command"
                column = "command_angle"
                late = USUAL_LAG_MS - lag
            else:
                follower = "the force"
                leader = "the angle"
                column = "force_x, force_y"
                late = lag - USUAL_LAG_MS
            relation = f"lags {leader} by {lag:.0f} ms"
            if lag < 0:
                relation = f"leads {leader} by {-lag:.0f} ms"
            usually = ""
            if len(measured) > 1:
                usually = f" (median of {len(measured)} logs: {usual:.0f} ms)"
            message = (
                f"{follower} {relation}{usually}; plausible lags are {least:.0f} to {most:.0f} ms, "
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
    """Find a dataset without test logs, and training commands that do not contain angle 0 or that
    cover too little of their own range."""
    if not any(one.part == "test" for one in logs):
        fix = "select some with --test PATTERN, or put them into a folder named test"
        yield Issue("note", "no test logs", "all logs", "no test logs", fix)
    training = [one.log for one in logs if one.part == "train"]
    if training:
        limits = command_limits(training)
        # Larger values are not in radians; check_degrees and check_counts report that.
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
    # 300 random commands leave hardly any of the 36 cells empty.
    if sum(map(len, steps)) < 300:
        return
    angle, velocity = np.concatenate(steps).T
    filled = float((np.histogram2d(angle, velocity, bins=6)[0] > 0).mean())
    if filled < 0.5:
        message = (
            f"the commands fall into only {filled:.0%} of the 36 cells of their range of angle and "
            "velocity"
        )
        fix = "record random angles and velocities, as softfin collect does"
        yield Issue("warning", "coverage", "all logs", message, fix, "command_angle")


def _is_mirrored(found: LogStatistics) -> bool:
    return found.frames is not None and max(found.frames, key=found.frames.__getitem__) == "x,-y"


LOG_CHECKS: tuple[Callable[[CheckedLog], Iterator[Issue]], ...] = (
    check_degrees,
    check_spikes,
    check_jumps,
    check_stuck,
    check_saturation,
    check_velocity,
    check_commanded_velocity,
    check_following,
    check_force_axes,
    check_force_offset,
)
"""Checks of a single log, in the order in which they run."""
