"""A recording as it was read, and its conversion to logs at 100 Hz.

Rows without a valid time or value are left out, gaps split the recording, and time begins at 0. A
piece on a steady 100 Hz clock is otherwise unchanged; any other is resampled: commands are held,
and readings are interpolated, after a low-pass filter if the source is faster.
"""

import itertools
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from softfin.core.errors import LogError
from softfin.core.quantities import RATE_HZ, TICK_S, Command, Log, Reading
from softfin.data.importing.importing import ImportConfig
from softfin.data.issues import Issue, counted
from softfin.storage.log_file import RATE_TOLERANCE, check_columns

COMMAND_CHANNELS = {"command_angle", "command_velocity"}

RATES_HZ = (5.0, 20_000.0)
"""Plausible rates; outside them the unit of the time must be wrong."""

CUTOFF_HZ = 40.0
"""Frequency at which the amplitude is halved: below 50 Hz, the Nyquist frequency of 100 Hz, and
above anything a fin does."""

KERNEL_S = 0.1
"""Length of the filter [s]; 25 Hz pass, and 56 Hz are suppressed."""

TURN_RAD = 2 * np.pi

TURN_TOLERANCE_RAD = 0.5
"""Tolerance around a jump of one turn [rad]: the motion of a fast fin in 20 ms."""

EARLY_S = 1e-6
"""Lateness up to which a stamp counts as on time [s]; clocks in double precision are no better."""

Span = tuple[float, float]
"""Time from one gap to the next [s]."""

Part = Literal["train", "test"]

Channels = dict[str, Float[np.ndarray, "rows"]]
"""Values by the name of the channel."""


class Track(NamedTuple):
    """Channels that share a clock: a whole table, or one topic of a bag."""

    time: Float[np.ndarray, "rows"]
    """Time as recorded [s]; it may repeat, jump or lack values."""
    channels: Channels
    """Values in SI units and softfin's axes; NaN where a value is missing."""

    def take(self, rows: slice | Bool[np.ndarray, "rows"]) -> "Track":
        """Return the track with some of its rows."""
        return Track(
            self.time[rows], {name: values[rows] for name, values in self.channels.items()}
        )


class Recording(NamedTuple):
    """One recording, not yet checked."""

    name: str
    part: Part
    tracks: tuple[Track, ...]
    issues: tuple[Issue, ...] = ()
    """Issues found while reading it."""


class NamedLog(NamedTuple):
    """A log at 100 Hz with its name."""

    name: str
    part: Part
    log: Log
    start_s: float = 0.0
    """Time of the recording's clock at the log's time 0 [s]."""


def build_logs(recording: Recording, config: ImportConfig) -> tuple[list[NamedLog], list[Issue]]:
    """Convert a recording to logs at 100 Hz; raises LogError if it has no usable clock."""
    logs: list[NamedLog] = []
    issues = list(recording.issues)
    for name, run in _split_at_restarts(recording):
        # Times count from the first row of any track: on a Unix clock doubles are coarse.
        times = [track.time[np.isfinite(track.time)] for track in run]
        start = min((float(time[0]) for time in times if len(time)), default=0.0)
        tracks = []
        for track in run:
            valid, found = _valid_rows(track._replace(time=track.time - start), name, config)
            issues += found
            tracks += _shifted(valid, config)
        spans, found = _split_at_gaps(tracks, name, config)
        issues += found
        for number, span in enumerate(spans):
            piece = f"{name}, piece {number + 1} of {len(spans)}" if len(spans) > 1 else name
            logs.append(NamedLog(piece, recording.part, _at_100_hz(tracks, span), start))
    return logs, issues


def _split_at_restarts(recording: Recording) -> list[tuple[str, tuple[Track, ...]]]:
    """Split a table whose clock goes back by more than a second: it contains several logs end to
    end."""
    name = recording.name
    (track, *others) = recording.tracks
    edges = [0, *(np.flatnonzero(np.diff(track.time) < -1.0) + 1).tolist(), len(track.time)]
    if others or len(edges) == 2:
        return [(name, recording.tracks)]
    return [
        (f"{name} rows {a}..{b - 1}", (track.take(slice(a, b)),))
        for a, b in itertools.pairwise(edges)
    ]


def _valid_rows(track: Track, name: str, config: ImportConfig) -> tuple[Track, list[Issue]]:
    """Leave out rows without a value, or whose time repeats or goes back; check the rate of the
    others."""
    finite, rows, issues = _finite_rows(track, name, config)
    if len(finite.time) < 2:
        raise LogError(f"{name}: {len(finite.time)} rows with a time and values; record it again")
    valid, rows, found = _forward_rows(finite, rows, name)
    issues += found
    if valid.channels.keys() <= COMMAND_CHANNELS:
        return valid, issues
    if len(valid.time) < 2:
        raise LogError(f"{name}: its time stays at {valid.time[0]:g} s; record it again")
    # Before anything is differentiated, filtered or interpolated across a jump.
    valid, found = _unwrapped_angle(valid, rows, name)
    issues += found
    issues += _check_rate(valid, name)
    return valid, issues


Rows = Int[np.ndarray, "_"]
"""Rows of the track as read."""


def _finite_rows(track: Track, name: str, config: ImportConfig) -> tuple[Track, Rows, list[Issue]]:
    issues = []
    is_finite = np.ones(len(track.time), bool)
    for channel, values in {"time": track.time, **track.channels}.items():
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            is_finite[bad] = False
            message = f"no value, or not a finite one, in {bad.size:,} of {len(values):,} rows"
            fix = (
                "record again or cut them; with errors ignored they are left out, and holes over "
                f"{config.gap_s:g} s split the log"
            )
            issues.append(Issue("error", "not a number", name, message, fix, channel, int(bad[0])))
    return track.take(is_finite), np.flatnonzero(is_finite), issues


def _forward_rows(track: Track, rows: Rows, name: str) -> tuple[Track, Rows, list[Issue]]:
    latest = np.maximum.accumulate(track.time)
    forward = np.append(True, track.time[1:] > latest[:-1])
    late = np.flatnonzero(~forward)
    if not late.size:
        return track, rows, []
    message = (
        f"time repeats or goes back in {late.size:,} of {len(forward):,} rows, first at "
        f"{track.time[late[0]]:.4f} s after {latest[late[0]]:.4f} s"
    )
    fix = (
        "sort by time and remove repeated rows; with errors ignored, rows not later than all "
        "before are left out"
    )
    issue = Issue("error", "repeated time", name, message, fix, "time", int(rows[late[0]]))
    return track.take(forward), rows[forward], [issue]


def _unwrapped_angle(track: Track, rows: Rows, name: str) -> tuple[Track, list[Issue]]:
    if "angle" not in track.channels:
        return track, []
    wraps = find_wraps(track.channels["angle"])
    if not wraps.size:
        return track, []
    message = (
        f"jumps by a whole turn in {wraps.size:,} of {len(track.time):,} rows: the encoder wraps"
    )
    fix = (
        "set the encoder's zero to where the fin rests, so that it does not wrap within the fin's "
        "range, and record again; with errors ignored the angle is unwrapped, to about 0"
    )
    issue = Issue("error", "wraps", name, message, fix, "angle", int(rows[wraps[0]]))
    angle = unwrapped(track.channels["angle"])
    return Track(track.time, track.channels | {"angle": angle}), [issue]


def _check_rate(track: Track, name: str) -> list[Issue]:
    rate = 1 / float(np.median(np.diff(track.time)))
    if not RATES_HZ[0] <= rate <= RATES_HZ[1]:
        raise LogError(
            f"{name}: column time: a row every {1 / rate:g} s ({rate:g} Hz); allowed are "
            f"{RATES_HZ[0]:g} to {RATES_HZ[1]:g} Hz; is it in another unit? Then give it, as "
            "--time-unit ms"
        )
    if rate < (1 - RATE_TOLERANCE) * RATE_HZ:
        message = f"{rate:.1f} Hz, less than {RATE_HZ} Hz: rows between are interpolated"
        fix = f"record at {RATE_HZ:g} Hz or faster"
        return [Issue("warning", "slow rate", name, message, fix, "time")]
    if rate > (1 + RATE_TOLERANCE) * RATE_HZ:
        message = f"faster than {RATE_HZ} Hz: resampled behind a low-pass at {CUTOFF_HZ:g} Hz"
        return [Issue("note", "resampled", name, message, column="time")]
    return []


def find_wraps(angle: Float[np.ndarray, "rows"]) -> Int[np.ndarray, "wraps"]:
    """Find the rows in which an angle within one turn has jumped by a turn, which neither a fin nor
    lost counts would do."""
    if np.ptp(angle) > TURN_RAD + TURN_TOLERANCE_RAD:
        return np.array([], int)
    return np.flatnonzero(np.abs(np.diff(angle)) > TURN_RAD - TURN_TOLERANCE_RAD) + 1


def unwrapped(angle: Float[np.ndarray, "rows"]) -> Float[np.ndarray, "rows"]:
    """Remove an angle's jumps by a turn; choose the turn that puts the median nearest to angle 0,
    the rest position."""
    continuous = np.unwrap(angle)
    return np.asarray(continuous - TURN_RAD * np.round(np.median(continuous) / TURN_RAD))


def _shifted(track: Track, config: ImportConfig) -> list[Track]:
    """Split a track if the user shifts the clock of some channels."""
    lags = {"command": config.command_lag_ms / 1e3, "force": config.force_lag_ms / 1e3}
    groups: dict[float, Channels] = {}
    for channel, values in track.channels.items():
        groups.setdefault(lags.get(channel.split("_")[0], 0.0), {})[channel] = values
    return [Track(track.time - lag, channels) for lag, channels in groups.items()]


def _split_at_gaps(
    tracks: list[Track], name: str, config: ImportConfig
) -> tuple[list[Span], list[Issue]]:
    """Find the spans in which all clocks have readings; only gaps in readings count, since a
    command holds until the next one."""
    reading = [track for track in tracks if not track.channels.keys() <= COMMAND_CHANNELS]
    begin = max(float(track.time[0]) for track in tracks)
    end = min(float(track.time[-1]) for track in reading)
    if end - begin < TICK_S:
        times = (
            f"{'/'.join(track.channels)} {track.time[0]:.2f} .. {track.time[-1]:.2f} s"
            for track in tracks
        )
        raise LogError(f"{name}: no time in common: {'; '.join(times)}; stamp all with one clock")
    gaps = []
    for track in reading:
        steps = np.diff(track.time)
        widest = max(1.5 * TICK_S, 1.5 * float(np.median(steps)), config.gap_s + 1e-9)
        for row in np.flatnonzero(steps > widest).tolist():
            a, b = track.time[row : row + 2].tolist()
            if b > begin and a < end:
                gaps.append((a, b, row))
    if not gaps:
        return [(begin, end)], []
    spans = list[Span]()
    edge = begin
    for a, b, _ in sorted(gaps):
        spans.append((edge, a))
        edge = max(edge, b)
    spans.append((edge, end))
    kept = [(a, b) for a, b in spans if b - a >= config.shortest_s]
    dropped = [b - a for a, b in spans if 0 < b - a < config.shortest_s]
    a, b, row = min(gaps)
    message = (
        f"{counted(len(gaps), 'gap')} over {1e3 * config.gap_s:.0f} ms, the first of {b - a:.3f} s "
        f"after {a:.2f} s; {sum(b - a for a, b, _ in gaps):.2f} s are missing: the log is split "
        "there"
    )
    fix = f"record again if much is lost; --gap {1.01 * (b - a):.2g} would bridge the first"
    if dropped:
        message += (
            f"; {counted(len(dropped), 'piece')} between gaps, shorter than {config.shortest_s:g} "
            f"s, left out: {sum(dropped):.2f} s in all"
        )
        fix += "; --shortest 1 would keep more"
    return kept, [Issue("warning", "gap", name, message, fix, "time", row)]


def _at_100_hz(tracks: list[Track], span: Span) -> Log:
    columns = _unchanged(tracks, span) or _resampled(tracks, span)
    if "velocity" not in columns:
        columns["velocity"] = np.gradient(columns["angle"], TICK_S)
    # The time stays in double precision.
    time = columns.pop("time")
    single = {name: values.astype(np.float32) for name, values in columns.items()}
    force = np.stack([single["force_x"], single["force_y"]], axis=1)
    reading = Reading(time, single["angle"], single["velocity"], force)
    return Log(Command(single["command_angle"], single["command_velocity"]), reading)


def _unchanged(tracks: list[Track], span: Span) -> Channels | None:
    """Take the rows unchanged if they share one clock that is valid for a log."""
    time, channels = tracks[0].take((tracks[0].time >= span[0]) & (tracks[0].time <= span[1]))
    try:
        check_columns({"time_s": time}, "")
    except LogError:
        return None
    return {"time": time, **channels} if len(tracks) == 1 else None


def _resampled(tracks: list[Track], span: Span) -> Channels:
    start, end = span
    grid = start + np.arange(int((end - start + EARLY_S) * RATE_HZ) + 1) / RATE_HZ
    columns = {"time": grid}
    for track in tracks:
        # The low-pass filter must not see anything beyond a gap, so it gets the rows from the last
        # one before the start to the first one after the end, between which there is no wide gap. A
        # command holds, no matter how long ago it was issued.
        first = int(np.searchsorted(track.time, start, "right")) - 1
        within = track.take(slice(max(0, first), int(np.searchsorted(track.time, end)) + 1))
        for name, values in track.channels.items():
            columns[name] = (
                held_command(track.time, values, grid)
                if name in COMMAND_CHANNELS
                else interpolated(within.time, within.channels[name], grid)
            )
    return columns


def interpolated(
    time: Float[np.ndarray, "rows"],
    values: Float[np.ndarray, "rows"],
    grid: Float[np.ndarray, "ticks"],
) -> Float[np.ndarray, "ticks"]:
    """Interpolate a reading at other times; `time` rises strictly.

    The low-pass filter for a faster source is a windowed sinc without delay; at the ends it uses
    the available samples.
    """
    step = float(np.median(np.diff(time))) if len(time) > 1 else TICK_S
    if step < 0.67 * TICK_S:
        even = np.linspace(time[0], time[-1], max(2, round((time[-1] - time[0]) / step) + 1))
        values = np.interp(even, time, values)
        half = round(KERNEL_S / 2 / step)
        offset = np.arange(-half, half + 1) * step
        # sin(2 pi f t) / (2 pi f t), the ideal low-pass, times a Hann window cos^2 that ends just
        # outside the kernel. Near the ends the weights are those of the samples that exist.
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
    """Take the last value issued before each time; no time in `grid` is before the first value."""
    return np.asarray(values[np.searchsorted(time, grid + EARLY_S, side="right") - 1])
