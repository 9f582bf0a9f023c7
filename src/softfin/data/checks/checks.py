"""Checks of logs: each is a function that yields issues, and stands in one of the lists at the end of this file."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from softfin.core.quantities import AXES, RATE_HZ, TICK_S
from softfin.data.checks.alignment import COMMAND_LAG_MS, FORCE_LAG_MS, SHORTEST_S, motion
from softfin.data.checks.channels import Columns, channels_in_degrees, constant_runs, find_spikes, velocity_slope
from softfin.data.checks.statistics import LogStatistics
from softfin.data.importing.importing import ANGLES, ImportConfig, compose_frames
from softfin.data.importing.recording import NamedLog
from softfin.data.issues import Issue, Severity, counted

MANY_SPIKES = 1e-3
"""Fraction of samples from which spikes are an error."""

STUCK_S = 1.0
"""Shortest constant run that is reported [s]."""

MOVING_RAD_S = 0.2
"""Rate of a fin above which the force on it cannot be constant."""

JUMP_RAD = 2.0
"""Largest plausible step of the angle: 200 rad/s; the published nets' own jumps reach 1.5."""

DRIVEN_RAD = 0.1
"""Distance from the target at which a drive must be moving."""

LAG_TOLERANCE_MS = 10.0
"""Accuracy of a lag: a tick."""

LAG_SPREAD_MS = {"command": 40.0, "force": 25.0}
"""Largest plausible difference of a log's lag from the median. A log of a minute shows the command's lag to within 8 ms
where the fin moves as roughly as the published nets do."""

USUAL_LAG_MS = 30.0
"""Either lag in a fin whose clocks agree."""

LAGGING = {"command": "command_angle", "force": "force_x, force_y"}
"""Columns that the issue of a lag names."""

FRAME_MARGIN = 0.1
"""Least advantage in correlation at which another frame is taken for the right one."""

FRAME_LEAST = 0.12
"""Least correlation of a fin's force in any frame; the roughest log of the published nets has 0.2."""

FEW_CELLS = 0.5
"""Fraction of a 6 x 6 grid of commanded angles and velocities that must be filled."""

UNITS = {"angle": "rad", "force_x": "N", "force_y": "N"}

COVERED_STEPS = 300
"""Number of commands from which empty cells mean something: 36 random cells then stay empty with odds of 1 in 4000."""


class CheckedLog(NamedTuple):
    """A log as the checks see it."""

    raw: Columns
    """Channels as they were read."""
    columns: Columns
    """Channels in radians."""
    calm: Columns
    """Channels in radians without spikes."""
    statistics: LogStatistics
    """Statistics of `calm`."""
    config: ImportConfig
    """Options with which the log was read: fixes go on from them."""

    def issue(
        self, severity: Severity, name: str, column: str | None, message: str, fix: str, row: int | None = None
    ) -> Issue:
        """Make an issue of this log."""
        return Issue(severity, name, self.statistics.name, message, fix, column, row)


def check_degrees(log: CheckedLog) -> Iterator[Issue]:
    """Angles in degrees that were read as radians."""
    wrong = channels_in_degrees(log.raw, log.config.velocity_rad_s is not None)
    if wrong:
        ranges = {name: getattr(log.raw, name) for name in wrong}
        spans = "; ".join(f"{name} spans {values.min():.4g} .. {values.max():.4g}" for name, values in ranges.items())
        option = "deg" if set(wrong) == set(ANGLES) else ",".join(f"{channel}=deg" for channel in wrong)
        yield log.issue("error", "degrees", wrong[0], f"{spans}: degrees, not rad", f"--angles {option}")


def check_spikes(log: CheckedLog) -> Iterator[Issue]:
    """Outliers of one or two samples."""
    for channel, unit in UNITS.items():
        values = getattr(log.columns, channel)
        rows, calm = find_spikes(values)
        if rows.size:
            message = (
                f"{counted(rows.size, 'spike')}, up to {np.abs(values - calm)[rows].max():.3g} {unit} "
                f"off the samples beside, where 98% of all lie within {np.ptp(np.percentile(values, [1, 99])):.3g}"
            )
            fix = "check the cable and the sensor's range; repair these samples in the file, or record again"
            severity: Severity = "error" if rows.size > MANY_SPIKES * len(values) else "warning"
            yield log.issue(severity, "spikes", channel, message, fix, int(rows[0]))


def check_jumps(log: CheckedLog) -> Iterator[Issue]:
    """Angles that no fin can have between two samples: the seam of two logs, or an encoder that lost its count."""
    steps = np.abs(np.diff(log.calm.angle))
    rows = np.flatnonzero(steps > JUMP_RAD)
    if rows.size:
        message = f"{counted(rows.size, 'jump')} of up to {steps.max():.2f} rad from one sample to the next"
        fix = "--rows-per-log 20000, if logs of so many rows stand end to end; else cut the file at these rows"
        yield log.issue("warning", "jumps", "angle", message, fix, int(rows[0]))


def check_stuck(log: CheckedLog) -> Iterator[Issue]:
    """Runs of one value in a channel that should have changed."""
    columns = log.columns
    moving = np.abs(motion(columns.angle).velocity) > MOVING_RAD_S
    behind = np.abs(columns.command_angle - columns.angle) > DRIVEN_RAD
    for channel, unit in UNITS.items():
        driven, cause = (behind, "the command is elsewhere") if channel == "angle" else (moving, "the fin moves")
        # A fifth of a second for the dead time, and for the force a drive may press in vain.
        runs = [
            (start, end)
            for start, end in constant_runs(getattr(columns, channel), round(STUCK_S * RATE_HZ))
            if driven[start + round(0.2 * RATE_HZ) : end].sum() > 0.5 * STUCK_S * RATE_HZ
        ]
        if runs:
            start, end = max(runs, key=lambda run: run[1] - run[0])
            message = (
                f"stuck at {getattr(columns, channel)[start]:.4g} {unit} for {(end - start) * TICK_S:.2f} s "
                f"while {cause}; {counted(len(runs), 'such run')}, {sum(b - a for a, b in runs) * TICK_S:.2f} s in all"
            )
            fix = "check sensor and drive; cut these rows off, or record again"
            yield log.issue("error", "stuck", channel, message, fix, start)


def check_saturation(log: CheckedLog) -> Iterator[Issue]:
    """Force that stays at its extreme again and again: the sensor's range ends there."""
    for channel in ("force_x", "force_y"):
        values = getattr(log.columns, channel)
        for extreme in sorted({float(values.min()), float(values.max())}):
            runs = constant_runs(np.where(values == extreme, extreme, np.arange(len(values)) + extreme + 1.0), 3)
            rows = sum(end - start for start, end in runs)
            if len(runs) >= 2 and 10 <= rows < len(values):
                message = f"clipped at {extreme:.4g} N: {rows:,} samples in {len(runs):,} runs of 3 or more stay there"
                fix = "choose a wider range of the sensor, and record again"
                yield log.issue("warning", "saturated", channel, message, fix, runs[0][0])


def check_velocity(log: CheckedLog) -> Iterator[Issue]:
    """A velocity that is not the angle's rate."""
    correlation, slope = velocity_slope(log.columns)
    if slope == 0:
        return
    message = f"velocity is {slope:.3g} times the angle's rate (correlation {correlation:.2f})"
    if correlation < -0.5:
        yield log.issue("error", "velocity sign", "velocity", f"{message}: of the wrong sign", "--negate velocity")
    elif correlation < 0.5:
        fix = "map another column, or none, so that it is derived: --columns velocity=-"
        yield log.issue("warning", "velocity", "velocity", f"{message}: it is something else", fix)
    elif not 0.5 < slope < 2:
        unit = "degrees" if 30 < slope < 100 else "degrees in the angle" if 0.01 < slope < 0.03 else "another unit"
        fix = "--angles velocity=deg, or map another"
        yield log.issue("error", "velocity unit", "velocity", f"{message}: {unit}", fix)


def check_commanded_velocity(log: CheckedLog) -> Iterator[Issue]:
    """A profile velocity that is not positive."""
    wrong = np.flatnonzero(log.columns.command_velocity <= 0)
    if wrong.size:
        message = f"0 or negative in {wrong.size:,} of {len(log.raw.angle):,} rows; a profile velocity is positive"
        fix = "map the column of the drive's profile velocity"
        yield log.issue("warning", "command velocity", "command_velocity", message, fix, int(wrong[0]))


def check_following(log: CheckedLog) -> Iterator[Issue]:
    """An angle that does not follow its command."""
    found, column = log.statistics, "command_angle"
    if found.rows < SHORTEST_S * RATE_HZ:
        return
    if found.command_steps == 0:
        message = f"the commanded angle is {found.command_angle_rad[0]:.3g} rad throughout"
        fix = "map the column of the commanded angle; nothing is learnt from a log without commands"
        yield log.issue("error", "constant command", column, message, fix)
    elif found.following < -0.3:
        message = f"the angle goes against its command: correlation {found.following:.2f}"
        if _is_mirrored(found):
            column, message = "angle", f"{message}, and the force fits the mirrored angle"
        # The option as it must be now: a channel that is negated already is so no more.
        negated = set(log.config.negate) ^ {column}
        names = ",".join(name for name in (*log.config.negate, column) if name in negated)
        fix = f"--negate {names}" if names else "leave --negate out"
        yield log.issue("error", "command sign", column, message, fix)
    elif found.following < 0.3:
        message = f"the angle hardly follows its command: correlation {found.following:.2f} after 150 ms"
        fix = "map other columns for angle and command_angle, or check the clocks"
        yield log.issue("warning", "not following", column, message, fix)


def check_force_axes(log: CheckedLog) -> Iterator[Issue]:
    """Axes of force that are swapped or negated, or a force that has nothing to do with the motion."""
    frames = log.statistics.frames
    if frames is None or (log.statistics.following < -0.3 and _is_mirrored(log.statistics)):
        return
    best, given = max(frames, key=frames.__getitem__), frames["x,y"]
    if frames[best] > max(given + FRAME_MARGIN, FRAME_LEAST):
        x, y = best.split(",")
        negated = [axis for axis, term in zip(AXES, (x, y), strict=True) if term.startswith("-")]
        words = ["swapped"] * (x[-1] == "y") + [f"negated ({', '.join(negated)})"] * bool(negated)
        message = (
            f"axes {' and '.join(words)}: correlation with the force of a model fin {given:.2f} as they are, "
            f"{frames[best]:.2f} as {best}"
        )
        fix = f"--force={compose_frames(log.config.force, best)}"
        yield log.issue("error", "force axes", "force_x, force_y", message, fix)
    elif given < FRAME_LEAST:
        message = f"the force has little to do with the motion: correlation {given:.2f} at best"
        fix = "check that force and angle are of one experiment, and the clocks"
        yield log.issue("warning", "unexplained force", "force_x, force_y", message, fix)


def check_force_offset(log: CheckedLog) -> Iterator[Issue]:
    """A force on the fin at rest."""
    found = log.statistics
    for axis, offset, deviation in zip(AXES, found.offset_n or (), found.force_std_n, strict=False):
        if abs(offset) > max(0.3, 0.2 * deviation):
            message = f"{offset:+.2f} N on the fin at rest, beside a standard deviation of {deviation:.2f} N"
            fix = "tare the sensor in still water before each log, or subtract this from the column"
            yield log.issue("warning", "force offset", f"force_{axis}", message, fix)


def check_lags(statistics: Sequence[LogStatistics], config: ImportConfig) -> Iterator[Issue]:
    """Clocks that lie where no fin and drive put them, and clocks that differ between logs."""
    for name, (least, most) in (("command", COMMAND_LAG_MS), ("force", FORCE_LAG_MS)):
        lags = [(one.command_lag if name == "command" else one.force_lag, one.name) for one in statistics]
        measured = [(lag.milliseconds, log) for lag, log in lags if lag is not None]
        low, high, usual = (
            least - LAG_TOLERANCE_MS,
            most + LAG_TOLERANCE_MS,
            np.median([lag for lag, _ in measured] or [0]),
        )
        far = [one for one in measured if abs(one[0] - usual) > LAG_SPREAD_MS[name]]
        # A log is wrong where all are, or where it stands out; a rough one may show its lag badly.
        wrong = [one for one in measured if not low <= one[0] <= high and (one in far or not low <= usual <= high)]
        for lag, log in wrong:
            first, second = ("the angle", "its command") if name == "command" else ("the force", "the angle")
            relation = f"follows {second} by {lag:.0f} ms" if lag >= 0 else f"is {-lag:.0f} ms ahead of {second}"
            message = f"{first} {relation}; plausible are {least:.0f} to {most:.0f} ms: a clock is off"
            # A command that is stamped late makes the angle early, a force that is stamped late is late itself.
            late = lag - USUAL_LAG_MS if name == "force" else USUAL_LAG_MS - lag
            late += config.command_lag_ms if name == "command" else config.force_lag_ms
            fix = f"--{name}-lag {10 * round(late / 10):d} moves the {name} so that about {USUAL_LAG_MS:.0f} ms remain"
            yield Issue("error", f"{name} lag", log, message, fix, LAGGING[name])
        if others := [one for one in far if one not in wrong]:
            lag, log = max(others, key=lambda one: abs(one[0] - usual))
            message = f"the {name}'s lag is {lag:.0f} ms, where the median of {len(measured)} logs is {usual:.0f} ms"
            fix = f"import these logs by themselves with --{name}-lag, or leave them out"
            names = tuple(log for _, log in others)
            yield Issue("warning", "lags differ", log, message, fix, LAGGING[name], logs=names)


def check_coverage(logs: Sequence[NamedLog]) -> Iterator[Issue]:
    """Commands of the training logs that leave much of their own range empty."""
    commands = [one.log.command for one in logs if one.part == "train"]
    pairs = [np.stack([command.angle, command.velocity], axis=1).astype(np.float64) for command in commands]
    steps = [pair[1:][(np.diff(pair, axis=0) != 0).any(axis=1)] for pair in pairs]
    if sum(map(len, steps)) < COVERED_STEPS:
        return
    angle, velocity = np.concatenate(steps).T
    filled = float((np.histogram2d(angle, velocity, bins=6)[0] > 0).mean())
    if filled < FEW_CELLS:
        message = f"{filled:.0%} of the commands' range of angle and velocity, in 36 cells, has been commanded at all"
        fix = "excite with random angles and velocities: softfin collect shows how"
        yield Issue("warning", "coverage", "all logs", message, fix, "command_angle")


def check_test_logs(logs: Sequence[NamedLog]) -> Iterator[Issue]:
    """Recordings without test logs."""
    if not any(one.part == "test" for one in logs):
        fix = "choose some: --test PATTERN; or put them into a folder test"
        yield Issue("note", "no test logs", "all logs", "no test logs", fix)


def _is_mirrored(found: LogStatistics) -> bool:
    return found.frames is not None and max(found.frames, key=found.frames.__getitem__) == "x,-y"


LogCheck = Callable[[CheckedLog], Iterator[Issue]]

CHANNEL_CHECKS: tuple[LogCheck, ...] = (
    check_degrees, check_spikes, check_jumps, check_stuck, check_saturation, check_velocity, check_commanded_velocity,
)  # fmt: skip
"""Checks of the channels of one log."""

STATISTICS_CHECKS: tuple[LogCheck, ...] = (check_following, check_force_axes, check_force_offset)
"""Checks of the statistics of one log; of logs that are too short by themselves, they see all together."""

DATASET_CHECKS: tuple[Callable[[Sequence[NamedLog]], Iterator[Issue]], ...] = (check_coverage, check_test_logs)
"""Checks of all logs beside one another."""
