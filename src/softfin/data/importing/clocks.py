"""Conversion of a recording to logs at 100 Hz: rows without a valid time or value are left out, gaps split it.

Time begins at 0. A piece on a steady 100 Hz clock passes unchanged otherwise; any other is
resampled.
"""

import itertools

import numpy as np
from jaxtyping import Float

from softfin.core.errors import LogError
from softfin.core.quantities import RATE_HZ, TICK_S, Command, Log, Reading
from softfin.data.importing.importing import ImportConfig
from softfin.data.importing.names import UNITS
from softfin.data.importing.recording import Channels, NamedLog, Recording, Track
from softfin.data.importing.resample import EARLY_S, held, interpolated
from softfin.data.issues import Issue, counted
from softfin.storage.log_file import RATE_TOLERANCE

COMMANDS = ("command_angle", "command_velocity")

RESTART_S = 1.0
"""Step back of a clock that counts as a restart: another log begins [s]."""

RATES_HZ = (5.0, 20_000.0)
"""Plausible rates; beyond them the unit of the time must be wrong."""


Span = tuple[float, float]
"""Time from one gap to the next [s]."""


def logs_of(recording: Recording, config: ImportConfig) -> tuple[list[NamedLog], list[Issue]]:
    """Make the logs at 100 Hz of a recording; raises LogError where it has no usable clock."""
    logs: list[NamedLog] = []
    issues = list(recording.issues)
    for run in _split_at_restarts(recording):
        # Time from the first row of any track on: on a Unix clock doubles are coarse.
        starts = [
            float(track.time[np.isfinite(track.time)][0]) for track in run.tracks if np.isfinite(track.time).any()
        ]
        start = min(starts, default=0.0)
        tracks = []
        for track in run.tracks:
            valid, found = _valid_rows(track._replace(time=track.time - start), run, config)
            issues += found
            tracks += _shifted(valid, config)
        spans, found = _split_at_gaps(tracks, run.name, config)
        issues += found
        for number, span in enumerate(spans):
            name = f"{run.name}, piece {number + 1} of {len(spans)}" if len(spans) > 1 else run.name
            logs.append(NamedLog(name, run.part, _at_100_hz(tracks, span), start))
    return logs, issues


def _split_at_restarts(recording: Recording) -> list[Recording]:
    """Split a table whose clock starts anew: it is several logs end to end."""
    track = recording.tracks[0]
    edges = [0, *(np.flatnonzero(np.diff(track.time) < -RESTART_S) + 1).tolist(), len(track.time)]
    if len(recording.tracks) > 1 or len(edges) == 2:
        return [recording]
    return [
        recording._replace(name=f"{recording.name} rows {a}..{b - 1}", tracks=(track.take(slice(a, b)),), issues=())
        for a, b in itertools.pairwise(edges)
    ]


def _valid_rows(track: Track, recording: Recording, config: ImportConfig) -> tuple[Track, list[Issue]]:
    """Leave out rows that hold no value or whose time repeats or goes back."""
    name, issues = recording.name, []
    good = np.ones(len(track.time), bool)
    for channel, values in {"time": track.time, **track.channels}.items():
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            good[bad] = False
            message = f"no value, or not a finite one, in {bad.size:,} of {len(values):,} rows"
            fix = (
                "record again or cut them; with errors ignored they are left out, and holes over "
                f"{config.gap_s:g} s split the log"
            )
            issues.append(Issue("error", "not a number", name, message, fix, channel, int(bad[0])))
    finite = track.take(good)
    if len(finite.time) < 2:
        raise LogError(f"{name}: {len(finite.time)} rows with a time and values; record it again")
    latest = np.maximum.accumulate(finite.time)
    forward = np.append(True, finite.time[1:] > latest[:-1])
    if not forward.all():
        first = int(np.flatnonzero(~forward)[0])
        repeats, late = int((np.diff(finite.time) == 0).sum()), int((~forward).sum())
        message = (
            f"time repeats in {repeats:,} and goes back in {late - repeats:,} of {len(forward):,} rows, "
            f"first at {finite.time[first]:.4f} s after {latest[first]:.4f} s"
        )
        fix = "sort by time and remove repeated rows; with errors ignored, rows not later than all before are left out"
        row = int(np.flatnonzero(good)[first])
        issues.append(Issue("error", "repeated time", name, message, fix, "time", row))
    valid = finite.take(forward)
    return valid, issues + _rate(valid, name, recording.time_unit)


def _rate(track: Track, name: str, time_unit: str) -> list[Issue]:
    if not track.channels.keys() - set(COMMANDS):
        return []
    steps = np.diff(track.time)
    rate = 1 / float(np.median(steps)) if len(steps) else 0.0
    if not RATES_HZ[0] <= rate <= RATES_HZ[1]:
        rates = {unit: rate * UNITS["time"][time_unit] / seconds for unit, seconds in UNITS["time"].items()}
        fitting = [f"{unit} ({r:.4g} Hz)" for unit, r in rates.items() if RATES_HZ[0] <= r <= RATES_HZ[1]]
        raise LogError(
            f"{name}: column time: a row every {1 / rate if rate else 0:g} s ({rate:g} Hz) in {time_unit}; allowed are "
            f"{RATES_HZ[0]:g} to {RATES_HZ[1]:g} Hz; give its unit: --time-unit {' or '.join(fitting or rates)}"
        )
    if rate < (1 - RATE_TOLERANCE) * RATE_HZ:
        message = f"{rate:.1f} Hz, less than {RATE_HZ} Hz: rows between are interpolated"
        return [Issue("warning", "slow rate", name, message, f"record at {RATE_HZ} Hz or faster", "time")]
    if rate > (1 + RATE_TOLERANCE) * RATE_HZ:
        message = f"from {rate:.1f} Hz to {RATE_HZ} Hz, behind a low-pass at 40 Hz"
        return [Issue("note", "resampled", name, message, column="time")]
    return []


def _shifted(track: Track, config: ImportConfig) -> list[Track]:
    """Split a track where the user moves the clock of some channels."""
    lags = {"command": config.command_lag_ms / 1e3, "force": config.force_lag_ms / 1e3}
    groups: dict[float, Channels] = {}
    for channel, values in track.channels.items():
        groups.setdefault(lags.get(channel.split("_")[0], 0.0), {})[channel] = values
    return [Track(track.time - lag, channels) for lag, channels in groups.items()]


def _split_at_gaps(tracks: list[Track], name: str, config: ImportConfig) -> tuple[list[Span], list[Issue]]:
    """Find where all clocks have readings; only gaps in readings count, since a command holds until the next."""
    reading = [track for track in tracks if track.channels.keys() - set(COMMANDS)]
    begin = max(float(track.time[0]) for track in tracks)
    end = min(float(track.time[-1]) for track in reading)
    if end - begin < TICK_S:
        times = "; ".join(
            f"{'/'.join(track.channels)} {track.time[0]:.2f} .. {track.time[-1]:.2f} s" for track in tracks
        )
        raise LogError(f"{name}: no time in common: {times}; stamp all with one clock")
    gaps = [gap for track in reading for gap in _gaps(track.time) if gap[1] > begin and gap[0] < end]
    wide = sorted(gap for gap in gaps if gap[1] - gap[0] > config.gap_s + 1e-9)
    narrow = [b - a for a, b, _ in gaps if b - a <= config.gap_s + 1e-9]
    issues = []
    if narrow:
        message = f"{counted(len(narrow), 'gap')} of up to {1e3 * max(narrow):.0f} ms, bridged by interpolation"
        issues.append(Issue("note", "short gaps", name, message, column="time"))
    if wide:
        a, b, row = wide[0]
        message = (
            f"{counted(len(wide), 'gap')} over {1e3 * config.gap_s:.0f} ms, the first of {b - a:.3f} s after "
            f"{a:.2f} s; {sum(b - a for a, b, _ in wide):.2f} s are missing: the log is split there"
        )
        fix = f"record again if much is lost; --gap {1.01 * (b - a):.2g} would bridge the first"
        issues.append(Issue("warning", "gap", name, message, fix, "time", row))
    spans, edge = list[Span](), begin
    for a, b, _ in wide:
        spans.append((edge, a))
        edge = max(edge, b)
    spans.append((edge, end))
    kept = [(a, b) for a, b in spans if len(spans) == 1 or b - a >= config.shortest_s]
    dropped = [b - a for a, b in spans if (a, b) not in kept and b > a]
    if dropped:
        message = (
            f"{counted(len(dropped), 'piece')} between gaps, shorter than {config.shortest_s:g} s, left out: "
            f"{sum(dropped):.2f} s in all"
        )
        issues.append(Issue("warning", "short piece", name, message, "--shortest 1 would keep more"))
    return kept, issues


def _gaps(time: Float[np.ndarray, "rows"]) -> list[tuple[float, float, int]]:
    """Find steps longer than the usual one, and than 15 ms: their beginning, end, and the row before."""
    steps = np.diff(time)
    usual = float(np.median(steps)) if len(steps) else TICK_S
    rows = np.flatnonzero(steps > 1.5 * max(TICK_S, usual))
    return [(float(time[row]), float(time[row + 1]), int(row)) for row in rows]


def _at_100_hz(tracks: list[Track], span: Span) -> Log:
    columns = _unchanged(tracks, span) or _resampled(tracks, span)
    if "velocity" not in columns:
        columns["velocity"] = (
            np.gradient(columns["angle"], TICK_S) if len(columns["angle"]) > 1 else columns["angle"] * 0
        )
    single = {name: values.astype(np.float32) for name, values in columns.items()}
    force = np.stack([single["force_x"], single["force_y"]], axis=1)
    reading = Reading(columns["time"], single["angle"], single["velocity"], force)
    return Log(Command(single["command_angle"], single["command_velocity"]), reading)


def _unchanged(tracks: list[Track], span: Span) -> dict[str, Float[np.ndarray, "rows"]] | None:
    """Take the rows themselves, where they share one steady clock of 100 Hz."""
    if len(tracks) > 1:
        return None
    track = tracks[0]
    rows = slice(int(np.searchsorted(track.time, span[0])), int(np.searchsorted(track.time, span[1], "right")))
    time, channels = track.take(rows)
    steps = np.diff(time)
    even = len(steps) > 0 and bool((np.abs(steps - TICK_S) <= 0.5 * TICK_S).all())
    # As `read_log`: a handful of rows on a clock with jitter does not show a rate.
    is_100_hz = len(steps) < RATE_HZ or abs(len(steps) / float(time[-1] - time[0]) / RATE_HZ - 1) <= RATE_TOLERANCE
    return {"time": time, **channels} if even and is_100_hz else None


def _resampled(tracks: list[Track], span: Span) -> dict[str, Float[np.ndarray, "ticks"]]:
    start, end = span
    count = int((end - start + EARLY_S) * RATE_HZ) + 1
    grid = start + np.arange(count) / RATE_HZ
    columns = {"time": grid}
    for track in tracks:
        # The low-pass must see nothing from beyond a gap: from the last row by the start to the first from its
        # end on, between which no wide gap lies. A command holds, however long ago it was issued.
        first = int(np.searchsorted(track.time, start, "right")) - 1
        within = track.take(slice(max(0, first), int(np.searchsorted(track.time, end)) + 1))
        for name, values in track.channels.items():
            columns[name] = (
                held(track.time, values, grid)
                if name in COMMANDS
                else interpolated(within.time, within.channels[name], grid)
            )
    return columns
