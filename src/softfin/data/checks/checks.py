"""Checks of logs: each check is a function that yields issues; the list at the end of this file
contains the checks of a single log."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from softfin.core.quantities import AXES, MAX_ANGLE_RAD, RATE_HZ, REST_FIX, TICK_S, command_limits
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
"""Shortest constant run that is reported [s]."""

PLAUSIBLE_LAG_MS = {"command": (0.0, 100.0), "force": (0.0, 60.0)}
"""Plausible lags from a command to the angle, through computer, bus and drive (32 ms in the virtual
tank, 5 ms in the published fin), and from the angle to the force (20 ms in the tank, 45 ms in the
published fin)."""

LAG_SPREAD_MS = {"command": 40.0, "force": 25.0}
"""Largest plausible difference of a log's lag from the median."""

USUAL_LAG_MS = 30.0
"""Usual value of both lags if the clocks agree."""

FRAME_LEAST = 0.12
"""Lowest plausible correlation of a fin's force in any frame; the roughest log of the published
networks has 0.2."""

COUNTS_FIX = (
    "convert them in the file: angles are (count - count at rest) * 2 * pi / counts per turn, "
    "velocities are also in the drive's own unit; a Dynamixel X has 4096 counts per turn, 2048 at "
    "its centre, and 0.229 rpm per unit"
)
"""Fix for raw values of a drive's registers; only the drive's manual says what they mean."""

CHANNEL_UNITS = {"angle": "rad", "force_x": "N", "force_y": "N"}


class CheckedLog(NamedTuple):
    """A log as the checks see it."""

    raw: LogColumns
    """The channels as read."""
    columns: LogColumns
    """Channels in radians."""
    calm: LogColumns
    """The channels in radians, without spikes."""
    statistics: LogStatistics
    """Statistics of `calm`."""
    config: ImportConfig
    """Options with which the log was read; suggested fixes build on them."""

    def issue(
        self,
        severity: Severity,
        name: str,
        column: str,
        message: str,
        fix: str,
        row: int | None = None,
    ) -> Issue:
        """Make an issue of this log."""
        return Issue(severity, name, self.statistics.name, message, fix, column, row)


def check_counts(log: CheckedLog) -> Iterator[Issue]:
    """Angles in counts of an encoder that were read as radians."""
    for channel in channels_in_counts(log.raw):
        values = getattr(log.raw, channel)
        message = (
            f"spans {values.min():.4g} .. {values.max():.4g}: counts of an encoder, neither "
            "rad nor degrees"
        )
        yield log.issue("error", "counts", channel, message, COUNTS_FIX)


def check_degrees(log: CheckedLog) -> Iterator[Issue]:
    """Angles in degrees that were read as radians."""
    if wrong := channels_in_degrees(log.raw, log.config.velocity_rad_s is not None):
        ranges = {name: getattr(log.raw, name) for name in wrong}
        spans = "; ".join(
            f"{name} spans {values.min():.4g} .. {values.max():.4g}"
            for name, values in ranges.items()
        )
        option = (
            "deg" if set(wrong) == set(ANGLES) else ",".join(f"{channel}=deg" for channel in wrong)
        )
        fix = f"--angles {option}"
        if all((values == np.round(values)).all() for values in ranges.values()):
            fix = f"{fix}; if these whole numbers are counts of an encoder instead, {COUNTS_FIX}"
        yield log.issue("error", "degrees", wrong[0], f"{spans}: degrees, not rad", fix)


def check_spikes(log: CheckedLog) -> Iterator[Issue]:
    """Outliers of one or two samples."""
    for channel, unit in CHANNEL_UNITS.items():
        values = getattr(log.columns, channel)
        calm = getattr(log.calm, channel)
        rows = np.flatnonzero(values != calm)
        if rows.size:
            message = (
                f"{counted(rows.size, 'spike')}, up to {np.abs(values - calm)[rows].max():.3g} "
                f"{unit} off the neighbouring samples, where 98% of all lie within "
                f"{np.ptp(np.percentile(values, [1, 99])):.3g}"
            )
            fix = (
                "check the cable and the sensor's range; repair these samples in the file, or "
                "record again"
            )
            severity: Severity = "error" if rows.size > 1e-3 * len(values) else "warning"
            yield log.issue(severity, "spikes", channel, message, fix, int(rows[0]))


def check_jumps(log: CheckedLog) -> Iterator[Issue]:
    """Jumps of the angle that no fin can make between two samples: two logs joined, or an encoder
    that lost its count."""
    steps = np.abs(np.diff(log.calm.angle))
    # 200 rad/s; the jumps of the published networks reach 1.5 rad.
    rows = np.flatnonzero(steps > 2.0)
    if rows.size:
        message = (
            f"{counted(rows.size, 'jump')} of up to {steps.max():.2f} rad from one sample to the "
            "next"
        )
        fix = (
            "--rows-per-log 20000, if logs of so many rows stand end to end; else cut the file "
            "at these rows"
        )
        yield log.issue("warning", "jumps", "angle", message, fix, int(rows[0]))


def check_stuck(log: CheckedLog) -> Iterator[Issue]:
    """Channels that stay at one value although they should change."""
    columns = log.columns
    # The force on a fin that moves at 0.2 rad/s changes; a drive that is 0.1 rad from its target
    # also moves.
    moving = np.abs(measure_rate(columns.angle)) > 0.2
    behind = np.abs(columns.command_angle - columns.angle) > 0.1
    for channel, unit in CHANNEL_UNITS.items():
        driven, cause = (
            (behind, "the command is elsewhere")
            if channel == "angle"
            else (moving, "the fin moves")
        )
        values = getattr(columns, channel)
        # A fifth of a second of dead time; for the force, a blocked drive may push without moving.
        runs = []
        for start, last in true_runs(np.diff(values) == 0):
            rows = last + 1 - start
            num_driven = driven[start + round(0.2 * RATE_HZ) : last + 1].sum()
            if rows >= STUCK_S * RATE_HZ and num_driven > 0.5 * STUCK_S * RATE_HZ:
                runs.append((rows, -start))
        if runs:
            # The first of the longest.
            longest, start = max(runs)
            message = (
                f"stuck at {values[-start]:.4g} {unit} for {longest * TICK_S:.2f} s while {cause}; "
                f"{counted(len(runs), 'such run')}, {sum(rows for rows, _ in runs) * TICK_S:.2f} s "
                "in total"
            )
            fix = "check sensor and drive; cut these rows off, or record again"
            yield log.issue("error", "stuck", channel, message, fix, -start)


def check_saturation(log: CheckedLog) -> Iterator[Issue]:
    """Force that repeatedly stays at its extreme: the sensor's range ends there."""
    for channel in ("force_x", "force_y"):
        values = getattr(log.columns, channel)
        for extreme in sorted({float(values.min()), float(values.max())}):
            runs = [(start, end) for start, end in true_runs(values == extreme) if end - start >= 3]
            rows = sum(end - start for start, end in runs)
            if len(runs) >= 2 and 10 <= rows < len(values):
                message = (
                    f"clipped at {extreme:.4g} N: {rows:,} samples in {len(runs):,} runs of "
                    "3 or more stay at it"
                )
                fix = "choose a wider range of the sensor, and record again"
                yield log.issue("warning", "saturated", channel, message, fix, runs[0][0])


def check_velocity(log: CheckedLog) -> Iterator[Issue]:
    """A velocity that is not the rate of the angle."""
    correlation, slope = velocity_slope(log.columns)
    if slope == 0:
        # Many publishers of joint states leave the velocity at 0. One sample in a hundred may be a
        # spike; an angle may also change steadily.
        velocity = log.columns.velocity[0]
        if np.percentile(np.abs(measure_rate(log.calm.angle) - velocity), 99) > REST_RATE_RAD_S:
            message = f"the velocity is {velocity:.3g} rad/s throughout while the angle changes"
            fix = "--columns velocity=- derives it from the angle"
            yield log.issue("error", "constant velocity", "velocity", message, fix)
        return
    message = f"velocity is {slope:.3g} times the angle's rate (correlation {correlation:.2f})"
    if correlation < -0.5:
        yield log.issue(
            "error",
            "velocity sign",
            "velocity",
            f"{message}: of the wrong sign",
            "--negate velocity",
        )
    elif correlation < 0.5:
        fix = "map another column, or none, so that it is derived: --columns velocity=-"
        yield log.issue("warning", "velocity", "velocity", f"{message}: it is something else", fix)
    elif not 0.5 < slope < 2:
        fix = "give its unit, as --angles velocity=deg for 57 times, or map another"
        yield log.issue("error", "velocity unit", "velocity", f"{message}: another unit", fix)


def check_commanded_velocity(log: CheckedLog) -> Iterator[Issue]:
    """A profile velocity that is not positive."""
    wrong = np.flatnonzero(log.columns.command_velocity <= 0)
    if wrong.size:
        message = (
            f"0 or negative in {wrong.size:,} of {len(log.raw.angle):,} rows; a profile "
            "velocity is positive"
        )
        fix = "choose the column of the drive's profile velocity"
        yield log.issue(
            "warning", "command velocity", "command_velocity", message, fix, int(wrong[0])
        )


def check_following(log: CheckedLog) -> Iterator[Issue]:
    """An angle that does not follow its command."""
    following = log.statistics.following
    command = log.calm.command_angle
    column = "command_angle"
    if len(command) < MIN_ALIGNED_S * RATE_HZ:
        return
    if np.ptp(command) == 0:
        fix = (
            "choose the column of the commanded angle; a log without commands is useless for "
            "training"
        )
        message = f"the commanded angle is {command[0]:.3g} rad throughout"
        yield log.issue("error", "constant command", column, message, fix)
    elif following < -0.3:
        message = f"the angle goes against its command: correlation {following:.2f}"
        if _is_mirrored(log.statistics):
            column = "angle"
            message = f"{message}, and the force fits the mirrored angle"
        # The option as it must be now: a channel that is already negated is removed from it.
        names = [name for name in SIGNED if (name in log.config.negate) != (name == column)]
        fix = f"--negate {','.join(names)}" if names else "leave --negate out"
        yield log.issue("error", "command sign", column, message, fix)
    elif following < 0.3:
        message = f"the angle hardly follows its command: correlation {following:.2f} after 150 ms"
        fix = "map other columns for angle and command_angle, or check the clocks"
        yield log.issue("warning", "not following", column, message, fix)


def check_force_axes(log: CheckedLog) -> Iterator[Issue]:
    """Axes of force that are swapped or negated, or a force that has nothing to do with the
    motion."""
    frames = log.statistics.frames
    if frames is None or (log.statistics.following < -0.3 and _is_mirrored(log.statistics)):
        return
    best = max(frames, key=frames.__getitem__)
    given = frames["x,y"]
    if frames[best] > max(given + 0.1, FRAME_LEAST):
        message = (
            f"axes swapped or negated: correlation with the force of a model fin {given:.2f} as "
            f"they are, {frames[best]:.2f} as {best}"
        )
        fix = f"--force={compose_frames(log.config.force, best)}"
        yield log.issue("error", "force axes", "force_x, force_y", message, fix)
    elif given < FRAME_LEAST:
        message = f"the force is almost unrelated to the motion: correlation {given:.2f} at best"
        fix = "check the clocks, and that force and angle are from the same experiment"
        yield log.issue("warning", "unexplained force", "force_x, force_y", message, fix)


def check_force_offset(log: CheckedLog) -> Iterator[Issue]:
    """A non-zero force on the fin at rest."""
    found = log.statistics
    for axis, offset, deviation in zip(AXES, found.offset_n or (), found.force_std_n, strict=False):
        if abs(offset) > max(0.3, 0.2 * deviation):
            message = (
                f"{offset:+.2f} N on the fin at rest, with a standard deviation of "
                f"{deviation:.2f} N"
            )
            fix = "tare the sensor in still water before each log, or subtract this from the column"
            yield log.issue("warning", "force offset", f"force_{axis}", message, fix)


def check_lags(statistics: Sequence[LogStatistics], config: ImportConfig) -> Iterator[Issue]:
    """Implausible lags between clocks, and lags that differ between logs."""
    for name, (least, most) in PLAUSIBLE_LAG_MS.items():
        measured = known_lags(statistics, name)
        # A lag is accurate to a tick.
        low = least - 10.0
        high = most + 10.0
        usual = np.median([lag for lag, _ in measured] or [USUAL_LAG_MS])
        for lag, log in measured:
            is_far = abs(lag - usual) > LAG_SPREAD_MS[name]
            is_plausible = low <= lag <= high
            # A log is wrong if all are, or if it stands out; the lag of a noisy log is uncertain.
            if not is_far and (is_plausible or low <= usual <= high):
                continue
            first, second = (
                ("the angle", "its command") if name == "command" else ("the force", "the angle")
            )
            relation = (
                f"follows {second} by {lag:.0f} ms"
                if lag >= 0
                else f"is {-lag:.0f} ms ahead of {second}"
            )
            usually = ""
            if len(measured) > 1:
                usually = f", {usual:.0f} ms in the median of {len(measured)} logs"
            message = (
                f"{first} {relation}{usually}; plausible are {least:.0f} to {most:.0f} ms: a "
                "clock is off"
            )
            # If commands are stamped late, the angle seems early; if the force is stamped late, the
            # force seems late.
            late = lag - USUAL_LAG_MS if name == "force" else USUAL_LAG_MS - lag
            late += getattr(config, f"{name}_lag_ms")
            fix = (
                f"--{name}-lag {10 * round(late / 10):d} moves the {name} so that about "
                f"{USUAL_LAG_MS:.0f} ms remain"
            )
            column = "command_angle" if name == "command" else "force_x, force_y"
            yield Issue(
                "warning" if is_plausible else "error", f"{name} lag", log, message, fix, column
            )


def check_dataset(logs: Sequence[NamedLog]) -> Iterator[Issue]:
    """Recordings without test logs, and training commands that leave much of their own range
    empty."""
    if not any(one.part == "test" for one in logs):
        fix = "choose some: --test PATTERN; or put them into a folder test"
        yield Issue("note", "no test logs", "all logs", "no test logs", fix)
    training = [one.log for one in logs if one.part == "train"]
    if training:
        limits = command_limits(training)
        # Larger values are not in radians, which is another issue.
        is_in_radians = max(abs(limits.angle_min), abs(limits.angle_max)) <= MAX_ANGLE_RAD
        if is_in_radians and limits.angle_min < limits.angle_max and not limits.contains_rest:
            message = (
                f"the commanded angles are {limits.angle_min:.3g} to {limits.angle_max:.3g} rad, "
                "without angle 0, at which a fin rests"
            )
            yield Issue("error", "no rest", "all logs", message, REST_FIX, "command_angle")
    steps = []
    for log in training:
        pairs = np.stack(log.command, axis=1).astype(np.float64)
        steps.append(pairs[1:][(np.diff(pairs, axis=0) != 0).any(axis=1)])
    # With 300 random commands hardly any of the 36 cells stays empty.
    if sum(map(len, steps)) < 300:
        return
    angle, velocity = np.concatenate(steps).T
    filled = float((np.histogram2d(angle, velocity, bins=6)[0] > 0).mean())
    if filled < 0.5:
        message = (
            f"{filled:.0%} of the commanded range of angle and velocity, in 36 cells, was ever "
            "commanded"
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
"""Checks of one log."""
