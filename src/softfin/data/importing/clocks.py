"""Recordings as read from files, and their conversion to logs at 100 Hz.

Rows without a valid time or value are dropped, gaps split the recording, and time starts at 0.
Pieces with a steady 100 Hz clock are otherwise unchanged. Other pieces are resampled: commands are
held and readings are interpolated, after a low-pass filter if the source rate is higher.
"""

import itertools
from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from softfin.core.errors import LogError
from softfin.core.quantities import RATE_HZ, TICK_S, Command, Log, Reading
from softfin.data.importing.importing import ImportConfig
from softfin.data.importing.names import CHANNELS, UNITS
from softfin.data.issues import MAX_ODD_SHARE, Issue, counted, row_severity
from softfin.storage.log_file import RATE_TOLERANCE, check_columns

COMMAND_CHANNELS = {"command_angle", "command_velocity"}

RATES_HZ = (5.0, 20_000.0)
"""Plausible sampling rates [Hz]; outside this range, the time unit must be wrong."""

MAX_GRID_S = 0.002
"""Coarsest plausible clock resolution, unless the clock counts rows [s]."""

MAX_UNUSED_S = 0.2
"""Longest part of a recording that is left out without a note [s]."""

MAX_LONG_STEPS = 0.15
"""Largest plausible share of such a clock's steps that are longer than the others."""

CUTOFF_HZ = 40.0
"""Frequency at which the low-pass filter halves the amplitude [Hz]: below the Nyquist frequency
(50 Hz) of the logs and above the frequencies of fin motion."""

KERNEL_S = 0.1
"""Length of the filter kernel [s], which passes 25 Hz and suppresses 56 Hz."""

TURN_RAD = 2 * np.pi

TURN_TOLERANCE_RAD = 0.5
"""Tolerance around a jump of one turn [rad]: how far a fast fin moves in 20 ms."""

EARLY_S = 1e-6
"""Maximum deviation at which a time stamp is treated as on time [s]: the resolution of Unix times
in double precision."""

Span = tuple[float, float]
"""Start and end of a piece between two gaps [s]."""

Part = Literal["train", "test"]

Channels = dict[str, Float[np.ndarray, "rows"]]
"""Values by channel name."""


class Track(NamedTuple):
    """Channels that share a clock: a complete table or one topic of a bag."""

    time: Float[np.ndarray, "rows"]
    """Time as recorded [s]; it may repeat, jump or be NaN."""
    channels: Channels
    """Values in SI units and in softfin's axes; missing values are NaN. Additional channels have
    their column names from log files."""

    def take(self, rows: slice | Bool[np.ndarray, "rows"]) -> "Track":
        """Return a track with the selected rows."""
        channels = {name: values[rows] for name, values in self.channels.items()}
        return Track(self.time[rows], channels)


class Recording(NamedTuple):
    """One recording, before any checks."""

    name: str
    part: Part
    tracks: tuple[Track, ...]
    issues: tuple[Issue, ...] = ()
    """Issues found while reading the file."""
    units: Mapping[str, str] = MappingProxyType({})
    """Units of the channels in the file, unless they are SI units."""


class NamedLog(NamedTuple):
    """A log at 100 Hz with its name."""

    name: str
    part: Part
    log: Log
    start_s: float = 0.0
    """Time on the recording's clock at which the log starts [s]."""
    units: Mapping[str, str] = MappingProxyType({})
    """Units of the channels in the file, unless they are SI units."""


def build_logs(recording: Recording, config: ImportConfig) -> tuple[list[NamedLog], list[Issue]]:
    """Convert a recording to logs at 100 Hz; raises LogError if it has no usable clock."""
    logs: list[NamedLog] = []
    issues = list(recording.issues)
    time_unit = config.time_unit or recording.units.get("time")
    config = config.model_copy(update={"time_unit": time_unit})
    for name, run in _split_at_restarts(recording):
        # Subtract the first time of any track, because doubles resolve Unix times only to 0.24 us.
        starts = []
        for track in run:
            times = track.time[np.isfinite(track.time)]
            if len(times):
                starts.append(float(times[0]))
        start = min(starts, default=0.0)
        tracks = []
        further = []
        for track in run:
            from_start = track._replace(time=track.time - start)
            needed, others = _split_further(from_start)
            for other in others:
                further += _shifted(other, config)
            if needed.channels:
                valid, found = _valid_rows(needed, name, config)
                issues += found
                tracks += _shifted(valid, config)
        spans, found = _split_at_gaps(tracks, name, config)
        issues += found
        for number, span in enumerate(spans):
            piece = f"{name}, piece {number + 1} of {len(spans)}" if len(spans) > 1 else name
            log = _at_100_hz(tracks, span)
            channels, found = _further_channels(
                further, span, np.asarray(log.reading.time), piece, config
            )
            issues += found
            log = log._replace(channels=channels)
            logs.append(NamedLog(piece, recording.part, log, start, recording.units))
    return logs, issues


def _split_at_restarts(recording: Recording) -> list[tuple[str, tuple[Track, ...]]]:
    """Split a recording at each place where the clock of every track goes back by more than a
    second; a new log starts there."""
    split = []
    for track in recording.tracks:
        restarts = np.flatnonzero(np.diff(track.time) < -1.0) + 1
        edges = [0, *restarts.tolist(), len(track.time)]
        split.append([track.take(slice(*pair)) for pair in itertools.pairwise(edges)])
    num_logs = len(split[0])
    if num_logs == 1 or any(len(pieces) != num_logs for pieces in split):
        return [(recording.name, recording.tracks)]
    runs = []
    row = 0
    for tracks in zip(*split, strict=True):
        rows = max(len(track.time) for track in tracks)
        runs.append((f"{recording.name} rows {row}..{row + rows - 1}", tracks))
        row += rows
    return runs


def _split_further(track: Track) -> tuple[Track, list[Track]]:
    """Split a track into the channels of every log and one track per additional channel, so that
    values missing in the latter cost no rows of the log."""
    needed = {}
    further = []
    for name, values in track.channels.items():
        if name in CHANNELS:
            needed[name] = values
            continue
        one = Track(track.time, {name: values})
        # A log is in single precision.
        one = one.take(np.isfinite(one.time) & (np.abs(values) <= np.finfo(np.float32).max))
        forward, _, _ = _forward_rows(one, np.arange(len(one.time)), name)
        further.append(forward)
    return Track(track.time, needed), further


def _valid_rows(track: Track, name: str, config: ImportConfig) -> tuple[Track, list[Issue]]:
    """Drop rows with missing values and rows whose time repeats or goes back, and check the rate of
    the remaining rows."""
    finite, rows, issues = _finite_rows(track, name, config)
    is_command = track.channels.keys() <= COMMAND_CHANNELS
    # A single command is enough, because it is valid until the next one.
    if len(finite.time) < 2 - is_command:
        raise LogError(
            f"{name}: only {counted(len(finite.time), 'row')} with a time and values for "
            f"{', '.join(track.channels)}; check these columns"
        )
    valid, rows, found = _forward_rows(finite, rows, name)
    issues += found
    if is_command:
        return valid, issues
    _check_digits(finite, valid, name)
    # Unwrap first, because jumps must not affect derivatives, filters and interpolation.
    valid, found = _unwrapped_angle(valid, rows, name)
    issues += found
    if not any(issue.name == "coarse clock" for issue in issues):
        issues += _check_rate(valid, name, config)
    return valid, issues


Rows = Int[np.ndarray, "_"]
"""Row numbers in the track as read."""


def _finite_rows(track: Track, name: str, config: ImportConfig) -> tuple[Track, Rows, list[Issue]]:
    issues = []
    is_finite = np.ones(len(track.time), bool)
    for channel, values in {"time": track.time, **track.channels}.items():
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            is_finite[bad] = False
            message = f"missing or non-finite values in {bad.size:,} of {len(values):,} rows"
            fix = f"these rows are dropped, and gaps over {config.gap_s:g} s split the log"
            severity = row_severity(bad.size, len(values))
            issues.append(Issue(severity, "not a number", name, message, fix, channel, int(bad[0])))
    # A selection of all rows would copy them.
    finite = track.take(is_finite) if issues else track
    return finite, np.flatnonzero(is_finite), issues


def _forward_rows(track: Track, rows: Rows, name: str) -> tuple[Track, Rows, list[Issue]]:
    # A row is valid only if it is later than all previous rows, not just the last one.
    latest = np.maximum.accumulate(track.time)
    forward = np.append(True, track.time[1:] > latest[:-1])
    late = np.flatnonzero(~forward)
    if not late.size:
        return track, rows, []
    kind = "repeated time"
    message = (
        f"time repeats or goes back in {late.size:,} of {len(forward):,} rows, first at "
        f"{track.time[late[0]]:.4f} s after {latest[late[0]]:.4f} s"
    )
    fix = "rows that are not later than all previous rows are dropped; sort the rows by time"
    repeated = int((np.diff(track.time) == 0).sum())
    span_s = float(track.time[-1] - track.time[0])
    if repeated > MAX_ODD_SHARE * len(forward) and span_s > 0:
        kind = "coarse clock"
        message = (
            f"the clock is coarser than the rows: {repeated:,} of {len(forward):,} rows have the "
            "same time as the row before"
        )
        rate = (len(forward) - 1) / span_s
        fix = (
            f"if the rows of a table are evenly spaced, use --rate {rate:.4g} --columns time=-; "
            "otherwise, record the time with more digits"
        )
    severity = row_severity(late.size, len(forward))
    issue = Issue(severity, kind, name, message, fix, "time", int(rows[late[0]]))
    return track.take(forward), rows[forward], [issue]


def _check_digits(track: Track, valid: Track, name: str) -> None:
    """Raise LogError if a clock has so few digits that most rows share their time with a different
    row."""
    num_times = len(valid.time)
    if num_times > 1:
        step_s = float(np.median(np.diff(valid.time)))
        if num_times > len(track.time) / 2 or step_s <= 1 / RATES_HZ[0]:
            return
    raise LogError(
        f"{name}: time has too few digits: {len(track.time):,} rows have "
        f"{counted(num_times, 'different time')} (6 digits or single precision cannot resolve a "
        "time since 1970); if the rows of a table are evenly spaced, use --rate 100 --columns "
        "time=- for one row every 10 ms"
    )


def _unwrapped_angle(track: Track, rows: Rows, name: str) -> tuple[Track, list[Issue]]:
    if "angle" not in track.channels:
        return track, []
    wraps = find_wraps(track.channels["angle"])
    if not wraps.size:
        return track, []
    message = (
        f"jumps by a full turn in {wraps.size:,} of {len(track.time):,} rows: the encoder wraps"
    )
    fix = (
        "set the encoder zero at the rest position of the fin, so that the angle does not wrap "
        "within the range of the fin, and record again; with --ignore-errors wraps, the angle is "
        "unwrapped so that its median is close to 0"
    )
    issue = Issue("error", "wraps", name, message, fix, "angle", int(rows[wraps[0]]))
    angle = unwrapped(track.channels["angle"])
    return Track(track.time, track.channels | {"angle": angle}), [issue]


def _check_rate(track: Track, name: str, config: ImportConfig) -> list[Issue]:
    steps = np.diff(track.time)
    # The mean without gaps, because the median of rounded times is also rounded.
    rate = 1 / float(steps[steps < 1.5 * np.median(steps)].mean())
    if not RATES_HZ[0] <= rate <= RATES_HZ[1]:
        raise LogError(
            f"{name}: column time: one row every {1 / rate:g} s ({rate:g} Hz); must be "
            f"{RATES_HZ[0]:g} to {RATES_HZ[1]:g} Hz; {_rate_fix(rate, config)}"
        )
    grid = float(steps.min())
    is_on_grid = bool((np.abs(steps % grid - grid / 2) > 0.49 * grid).all())
    # A steady clock has all its steps on a grid, too, but few longer ones.
    if is_on_grid and grid > MAX_GRID_S and np.mean(steps > 1.5 * grid) > MAX_LONG_STEPS:
        message = f"all steps of the clock are multiples of {1e3 * grid:.3g} ms"
        fix = (
            "record the time with more digits; if the rows of a table are evenly spaced, use "
            "--rate 100 --columns time=- for one row every 10 ms"
        )
        return [Issue("warning", "coarse clock", name, message, fix, "time")]
    if rate < (1 - RATE_TOLERANCE) * RATE_HZ:
        message = f"sampled at {rate:.1f} Hz, below {RATE_HZ} Hz: missing rows are interpolated"
        fix = f"record at {RATE_HZ:g} Hz or faster"
        return [Issue("warning", "slow rate", name, message, fix, "time")]
    if rate > (1 + RATE_TOLERANCE) * RATE_HZ:
        message = (
            f"sampled faster than {RATE_HZ} Hz: low-pass filtered at {CUTOFF_HZ:g} Hz and resampled"
        )
        return [Issue("note", "resampled", name, message, column="time")]
    return []


def _rate_fix(rate: float, config: ImportConfig) -> str:
    """Return a fix for an implausible rate: a unit that makes it plausible, if there is one."""
    given = UNITS["time"][config.time_unit or "s"]
    for unit, factor in UNITS["time"].items():
        if RATES_HZ[0] <= rate * given / factor <= RATES_HZ[1]:
            return f"if the time is in {unit}, use --time-unit {unit}"
    return "map the column with the time of each row"


def find_wraps(angle: Float[np.ndarray, "rows"]) -> Int[np.ndarray, "wraps"]:
    """Find the rows at which an angle jumps by one turn.

    Returns no rows if the angle exceeds one turn, because its encoder does not wrap.
    """
    if np.ptp(angle) > TURN_RAD + TURN_TOLERANCE_RAD:
        return np.array([], int)
    return np.flatnonzero(np.abs(np.diff(angle)) > TURN_RAD - TURN_TOLERANCE_RAD) + 1


def unwrapped(angle: Float[np.ndarray, "rows"]) -> Float[np.ndarray, "rows"]:
    """Remove jumps by one turn, and shift the median into the turn around the rest position 0."""
    continuous = np.unwrap(angle)
    return np.asarray(continuous - TURN_RAD * np.round(np.median(continuous) / TURN_RAD))


def _shifted(track: Track, config: ImportConfig) -> list[Track]:
    """Shift clocks by the configured lags; channels with different lags become separate tracks."""
    force_lag_s = config.force_lag_ms / 1e3
    # Torque and force are measured by the same sensor.
    lags = {"command": config.command_lag_ms / 1e3, "force": force_lag_s, "torque": force_lag_s}
    groups: dict[float, Channels] = {}
    for channel, values in track.channels.items():
        groups.setdefault(lags.get(channel.split("_")[0], 0.0), {})[channel] = values
    return [Track(track.time - lag, channels) for lag, channels in groups.items()]


def _split_at_gaps(
    tracks: list[Track], name: str, config: ImportConfig
) -> tuple[list[Span], list[Issue]]:
    """Find the spans without a gap in any track.

    Gaps between commands do not matter, because a command is valid until the next one.
    """
    reading = [track for track in tracks if not track.channels.keys() <= COMMAND_CHANNELS]
    begin = max(float(track.time[0]) for track in tracks)
    end = min(float(track.time[-1]) for track in reading)
    if end - begin < TICK_S:
        times = []
        for track in tracks:
            channels = "/".join(track.channels)
            times.append(f"{channels} {track.time[0]:.2f} .. {track.time[-1]:.2f} s")
        raise LogError(
            f"{name}: the channels have no time in common: {'; '.join(times)}; timestamp all "
            "channels with the same clock"
        )
    issues = []
    start_s = begin - min(float(track.time[0]) for track in reading)
    end_s = max(float(track.time[-1]) for track in reading) - end
    if start_s + end_s > MAX_UNUSED_S:
        message = (
            f"{start_s:.2f} s at the start and {end_s:.2f} s at the end are not used, because a "
            "channel has no value there yet, or no more"
        )
        issues.append(Issue("note", "unused rows", name, message, column="time"))
    gaps = _find_gaps(reading, (begin, end), config)
    if not gaps:
        return [(begin, end)], issues
    kept = []
    dropped = []
    edge = begin
    # Gaps of different tracks may overlap, so the next span starts after the latest end so far.
    for a, b, _ in [*sorted(gaps), (end, end, 0)]:
        if a - edge >= config.shortest_s:
            kept.append((edge, a))
        elif a > edge:
            dropped.append(a - edge)
        edge = max(edge, b)
    missing_s = sum(b - a for a, b, _ in gaps)
    a, b, row = min(gaps)
    message = (
        f"{counted(len(gaps), 'gap')} over {1e3 * config.gap_s:.0f} ms, the first of {b - a:.3f} s "
        f"after {a:.2f} s; {missing_s:.2f} s are missing in total; the log is split at the gaps"
    )
    fix = f"record again if too much is lost; --gap {1.01 * (b - a):.2g} would bridge the first"
    if dropped:
        message += (
            f"; {counted(len(dropped), 'piece')} between gaps, shorter than {config.shortest_s:g} "
            f"s, dropped: {sum(dropped):.2f} s in total"
        )
        fix += "; --shortest 1 would keep shorter pieces"
    issues.append(Issue("warning", "gap", name, message, fix, "time", row))
    return kept, issues


def _find_gaps(
    tracks: list[Track], span: Span, config: ImportConfig
) -> list[tuple[float, float, int]]:
    """Return (start, end, row before it) of each gap that overlaps the span [s]."""
    gaps = []
    for track in tracks:
        steps = np.diff(track.time)
        # A slow but steady clock has no gaps, so the limit is at least 1.5 periods.
        widest = max(1.5 * TICK_S, 1.5 * float(np.median(steps)), config.gap_s + 1e-9)
        for row in np.flatnonzero(steps > widest).tolist():
            a, b = track.time[row : row + 2].tolist()
            if b > span[0] and a < span[1]:
                gaps.append((a, b, row))
    return gaps


def _at_100_hz(tracks: list[Track], span: Span) -> Log:
    columns = _unchanged(tracks, span) or _resampled(tracks, span)
    if "velocity" not in columns:
        columns["velocity"] = np.gradient(columns["angle"], TICK_S)
    # Time stays in double precision; the other columns of a log are float32.
    time = columns.pop("time")
    single = {name: values.astype(np.float32) for name, values in columns.items()}
    force = np.stack([single["force_x"], single["force_y"]], axis=1)
    reading = Reading(time, single["angle"], single["velocity"], force)
    return Log(Command(single["command_angle"], single["command_velocity"]), reading)


def _unchanged(tracks: list[Track], span: Span) -> Channels | None:
    """Return the rows unchanged if all tracks share a clock that is valid for a log; otherwise
    None."""
    time, channels = tracks[0].take((tracks[0].time >= span[0]) & (tracks[0].time <= span[1]))
    try:
        check_columns({"time_s": time}, "")
    except LogError:
        return None
    return {"time": time, **channels} if len(tracks) == 1 else None


def _further_channels(
    tracks: list[Track],
    span: Span,
    grid: Float[np.ndarray, "ticks"],
    name: str,
    config: ImportConfig,
) -> tuple[dict[str, Float[np.ndarray, "ticks"]], list[Issue]]:
    """Return the additional channels at the times of a log, and a warning for each channel with
    gaps."""
    channels = {}
    issues = []
    for track in tracks:
        ((channel, _),) = track.channels.items()
        within = _around(track, span)
        inside = within.time[(within.time >= span[0]) & (within.time <= span[1])]
        longest_s = float(np.diff(inside, prepend=span[0], append=span[1]).max())
        if longest_s > config.gap_s + TICK_S:
            text = f"no values for up to {longest_s:.3g} s"
            fix = "missing values are interpolated, and the first and last values are held"
            if not inside.size:
                fix = "the channel is left out"
            issues.append(Issue("warning", "channel gap", name, text, fix, channel))
        if inside.size:
            values = interpolated(within.time, within.channels[channel], grid)
            channels[channel] = values.astype(np.float32)
    return channels, issues


def _around(track: Track, span: Span) -> Track:
    """Return the rows from the last one before a span to the first one after it."""
    first = int(np.searchsorted(track.time, span[0], "right")) - 1
    return track.take(slice(max(0, first), int(np.searchsorted(track.time, span[1])) + 1))


def _resampled(tracks: list[Track], span: Span) -> Channels:
    start, end = span
    grid = start + np.arange(int((end - start + EARLY_S) * RATE_HZ) + 1) / RATE_HZ
    columns = {"time": grid}
    for track in tracks:
        # The low-pass filter must not use rows beyond a gap, so it gets only the rows from the last
        # one before the start to the first one after the end. Commands need all rows, because a
        # command is valid until the next one.
        within = _around(track, span)
        for name, values in track.channels.items():
            if name in COMMAND_CHANNELS:
                columns[name] = held_command(track.time, values, grid)
            else:
                columns[name] = interpolated(within.time, within.channels[name], grid)
    return columns


def interpolated(
    time: Float[np.ndarray, "rows"],
    values: Float[np.ndarray, "rows"],
    grid: Float[np.ndarray, "ticks"],
) -> Float[np.ndarray, "ticks"]:
    """Interpolate a reading at the times of `grid`; `time` must increase strictly.

    The low-pass filter for faster sources is a windowed sinc without delay. At the ends, it uses
    only the available samples.
    """
    step = float(np.median(np.diff(time))) if len(time) > 1 else TICK_S
    # Sources below about 150 Hz are only interpolated.
    if step < 0.67 * TICK_S:
        # The kernel needs an even clock.
        even = np.linspace(time[0], time[-1], max(2, round((time[-1] - time[0]) / step) + 1))
        values = np.interp(even, time, values)
        half = round(KERNEL_S / 2 / step)
        offset = np.arange(-half, half + 1) * step
        # The ideal low-pass sin(2 pi f t) / (2 pi f t) times a Hann window cos^2 that ends just
        # outside the kernel. Near the ends, only the weights of existing samples are summed.
        kernel = (
            np.sinc(2 * CUTOFF_HZ * offset) * np.cos(np.pi * offset / (KERNEL_S + 2 * step)) ** 2
        )
        if len(values) < len(kernel):
            return np.full_like(grid, values.mean())
        weight = np.convolve(np.ones_like(values), kernel, "same")
        time = even
        values = np.convolve(values, kernel, "same") / weight
    return np.asarray(np.interp(grid, time, values))


def held_command(
    time: Float[np.ndarray, "rows"],
    values: Float[np.ndarray, "rows"],
    grid: Float[np.ndarray, "ticks"],
) -> Float[np.ndarray, "ticks"]:
    """Return the last value issued before each time; no time in `grid` precedes the first value."""
    return np.asarray(values[np.searchsorted(time, grid + EARLY_S, side="right") - 1])
