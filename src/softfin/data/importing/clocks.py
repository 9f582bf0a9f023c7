"""A recording's clocks: rows that cannot stand are left out and counted, gaps split it, the pieces come at 100 Hz.

Recording -> logs and findings. Time begins at 0. A piece on a steady 100 Hz clock passes as it is else; any other is
resampled.
"""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from softfin.core.errors import LogError
from softfin.core.quantities import RATE_HZ, TICK_S, Command, Log, Reading
from softfin.data.checks.findings import Finding, Place, counted
from softfin.data.importing.importing import ImportConfig
from softfin.data.importing.names import UNITS
from softfin.data.importing.recording import Channels, NamedLog, Recording, Track
from softfin.data.importing.resample import EARLY_S, held, interpolated
from softfin.storage.log_file import RATE_TOLERANCE

COMMANDS = ("command_angle", "command_velocity")

RESTART_S = 1.0
"""A clock that goes back by more than this has been started anew: another log begins."""

RATES_HZ = (5.0, 20_000.0)
"""Beyond these no clock is believed to be in the unit that was said."""


class Piece(NamedTuple):
    """From one gap to the next."""

    start: float
    end: float


def logs_of(recording: Recording, config: ImportConfig) -> tuple[list[NamedLog], list[Finding]]:
    """The logs at 100 Hz that a recording holds; raises LogError where it has no clock that can be followed."""
    logs: list[NamedLog] = []
    findings = list(recording.findings)
    for run, start in map(_from_zero, _runs(recording)):
        tracks = []
        for track in run.tracks:
            whole, found = _sound(track, run, config)
            findings += found
            tracks += _shifted(whole, config)
        pieces, found = _pieces(tracks, run.name, config)
        findings += found
        several = len(pieces) > 1
        for number, piece in enumerate(pieces):
            name = f"{run.name}, piece {number + 1} of {len(pieces)}" if several else run.name
            logs.append(NamedLog(name, run.part, _at_100_hz(tracks, piece), start))
    return logs, findings


def _runs(recording: Recording) -> list[Recording]:
    """A table whose clock starts anew is several logs end to end."""
    if len(recording.tracks) > 1:
        return [recording]
    track = recording.tracks[0]
    starts = np.flatnonzero(np.diff(track.time) < -RESTART_S) + 1
    edges = [0, *starts.tolist(), len(track.time)]
    if len(edges) == 2:
        return [recording]
    return [
        recording._replace(name=f"{recording.name} rows {a}..{b - 1}", tracks=(_rows(track, slice(a, b)),), findings=())
        for a, b in itertools.pairwise(edges)
    ]


def _from_zero(recording: Recording) -> tuple[Recording, float]:
    """With time from its first row on, of whichever track; and when that was. On a Unix clock doubles are coarse."""
    times = np.concatenate([track.time[np.isfinite(track.time)][:1] for track in recording.tracks])
    start = float(times.min(initial=np.inf))
    if not times.size:
        return recording, 0.0
    tracks = tuple(track._replace(time=track.time - start) for track in recording.tracks)
    return recording._replace(tracks=tracks), start


def _rows(track: Track, rows: slice | Bool[np.ndarray, "rows"]) -> Track:
    return Track(track.time[rows], {name: values[rows] for name, values in track.channels.items()})


def _sound(track: Track, recording: Recording, config: ImportConfig) -> tuple[Track, list[Finding]]:
    """Without rows that hold no value or whose time repeats or goes back."""
    name, findings = recording.name, []
    good = np.ones(len(track.time), bool)
    for channel, values in {"time": track.time, **track.channels}.items():
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            good[bad] = False
            sentence = f"no value, or not a finite one, in {bad.size:,} of {len(values):,} rows"
            remedy = (
                f"record again or cut them; accepted, they are left out: holes over {config.gap_s:g} s split the log"
            )
            findings.append(Finding("error", "not a number", Place(name, channel, int(bad[0])), sentence, remedy))
    finite = _rows(track, good)
    if len(finite.time) < 2:
        raise LogError(f"{name}: {len(finite.time)} rows with a time and values; record it again")
    latest = np.maximum.accumulate(finite.time)
    forward = np.append(True, finite.time[1:] > latest[:-1])
    if not forward.all():
        first = int(np.flatnonzero(~forward)[0])
        row = int(np.flatnonzero(good)[first])
        repeats = int((np.diff(finite.time) == 0).sum())
        late = int((~forward).sum())
        sentence = (
            f"time repeats in {repeats:,} and goes back in {late - repeats:,} of {len(forward):,} rows, "
            f"first at {finite.time[first]:.4f} s after {latest[first]:.4f} s"
        )
        remedy = "sort by time and remove repeated rows; accepted, rows that are not later than all before are left out"
        findings.append(Finding("error", "repeated time", Place(name, "time", row), sentence, remedy))
    sound = _rows(finite, forward)
    return sound, findings + _rate(sound, name, recording.time_unit)


def _rate(track: Track, name: str, time_unit: str) -> list[Finding]:
    if not track.channels.keys() - set(COMMANDS):
        return []
    steps = np.diff(track.time)
    rate = 1 / float(np.median(steps)) if len(steps) else 0.0
    place = Place(name, "time")
    if not RATES_HZ[0] <= rate <= RATES_HZ[1]:
        rates = {unit: rate * UNITS["time"][time_unit] / seconds for unit, seconds in UNITS["time"].items()}
        fitting = [f"{unit} ({r:.4g} Hz)" for unit, r in rates.items() if RATES_HZ[0] <= r <= RATES_HZ[1]]
        raise LogError(
            f"{name}: column time: a row every {1 / rate if rate else 0:g} s ({rate:g} Hz) in {time_unit}; allowed are "
            f"{RATES_HZ[0]:g} to {RATES_HZ[1]:g} Hz; say its unit: --time-unit {' or '.join(fitting or rates)}"
        )
    if rate < (1 - RATE_TOLERANCE) * RATE_HZ:
        sentence = f"{rate:.1f} Hz, less than {RATE_HZ} Hz: rows between are interpolated"
        return [Finding("warning", "slow rate", place, sentence, f"record at {RATE_HZ} Hz or faster")]
    if rate > (1 + RATE_TOLERANCE) * RATE_HZ:
        return [Finding("note", "resampled", place, f"from {rate:.1f} Hz to {RATE_HZ} Hz, behind a low-pass at 40 Hz")]
    return []


def _shifted(track: Track, config: ImportConfig) -> list[Track]:
    """A track of its own for each clock that the user moves."""
    lags = {"command": config.command_lag_ms / 1e3, "force": config.force_lag_ms / 1e3}
    groups: dict[float, Channels] = {}
    for channel, values in track.channels.items():
        groups.setdefault(lags.get(channel.split("_")[0], 0.0), {})[channel] = values
    return [Track(track.time - lag, channels) for lag, channels in groups.items()]


def _pieces(tracks: list[Track], name: str, config: ImportConfig) -> tuple[list[Piece], list[Finding]]:
    """Where all clocks have readings; gaps count in the readings, since a command holds until the next."""
    reading = [track for track in tracks if track.channels.keys() - set(COMMANDS)]
    begin = max(float(track.time[0]) for track in tracks)
    end = min(float(track.time[-1]) for track in reading)
    if end - begin < TICK_S:
        spans = "; ".join(
            f"{'/'.join(track.channels)} {track.time[0]:.2f} .. {track.time[-1]:.2f} s" for track in tracks
        )
        raise LogError(f"{name}: no time in common: {spans}; stamp all with one clock")
    holes = [
        (float(a), float(b), i)
        for track in reading
        for a, b, i in _holes(track.time, 1.5 * TICK_S)
        if b > begin and a < end
    ]
    wide = sorted(hole for hole in holes if hole[1] - hole[0] > config.gap_s + 1e-9)
    findings = []
    narrow = [b - a for a, b, _ in holes if b - a <= config.gap_s + 1e-9]
    if narrow:
        sentence = f"{counted(len(narrow), 'gap')} of up to {1e3 * max(narrow):.0f} ms, bridged by interpolation"
        findings.append(Finding("note", "short gaps", Place(name, "time"), sentence))
    if wide:
        a, b, row = wide[0]
        lost = sum(b - a for a, b, _ in wide)
        sentence = (
            f"{counted(len(wide), 'gap')} over {1e3 * config.gap_s:.0f} ms, the first of {b - a:.3f} s "
            f"after {a:.2f} s; {lost:.2f} s are missing: the log is split there"
        )
        remedy = f"record again if much is lost; --gap {1.01 * (b - a):.2g} would bridge the first"
        findings.append(Finding("warning", "gap", Place(name, "time", row), sentence, remedy))
    pieces, edge = [], begin
    for a, b, _ in wide:
        pieces.append(Piece(edge, a))
        edge = max(edge, b)
    pieces.append(Piece(edge, end))
    whole = [piece for piece in pieces if len(pieces) == 1 or piece.end - piece.start >= config.shortest_s]
    dropped = [piece.end - piece.start for piece in pieces if piece not in whole and piece.end > piece.start]
    if dropped:
        sentence = (
            f"{counted(len(dropped), 'piece')} between gaps, shorter than {config.shortest_s:g} s, left out: "
            f"{sum(dropped):.2f} s in all"
        )
        findings.append(Finding("warning", "short piece", Place(name), sentence, "--shortest 1 would keep more"))
    return whole, findings


def _holes(time: Float[np.ndarray, "rows"], longest_s: float) -> list[tuple[float, float, int]]:
    """Of a clock slower than 100 Hz, each step that is longer than the usual one; last, the row before it."""
    steps = np.diff(time)
    usual = float(np.median(steps)) if len(steps) else TICK_S
    rows = np.flatnonzero(steps > max(longest_s, 1.5 * usual))
    return [(float(time[row]), float(time[row + 1]), int(row)) for row in rows]


def _at_100_hz(tracks: list[Track], piece: Piece) -> Log:
    columns = _as_it_is(tracks, piece) or _resampled(tracks, piece)
    if "velocity" not in columns:
        columns["velocity"] = (
            np.gradient(columns["angle"], TICK_S) if len(columns["angle"]) > 1 else columns["angle"] * 0
        )

    def single(name: str) -> Float[np.ndarray, "ticks"]:
        return columns[name].astype(np.float32)

    force = np.stack([single("force_x"), single("force_y")], axis=1)
    reading = Reading(columns["time"], single("angle"), single("velocity"), force)
    return Log(Command(single("command_angle"), single("command_velocity")), reading)


def _as_it_is(tracks: list[Track], piece: Piece) -> dict[str, Float[np.ndarray, "rows"]] | None:
    """The rows themselves, where they share one steady clock of 100 Hz."""
    if len(tracks) > 1:
        return None
    track = tracks[0]
    rows = slice(int(np.searchsorted(track.time, piece.start)), int(np.searchsorted(track.time, piece.end, "right")))
    time = track.time[rows]
    steps = np.diff(time)
    even = len(steps) > 0 and bool((np.abs(steps - TICK_S) <= 0.5 * TICK_S).all())
    # As `read_log`: a handful of rows on a clock with jitter tells no rate.
    steady = len(steps) < RATE_HZ or abs(len(steps) / float(time[-1] - time[0]) / RATE_HZ - 1) <= RATE_TOLERANCE
    return (
        {"time": time, **{name: values[rows] for name, values in track.channels.items()}} if even and steady else None
    )


def _resampled(tracks: list[Track], piece: Piece) -> dict[str, Float[np.ndarray, "ticks"]]:
    count = int((piece.end - piece.start + EARLY_S) * RATE_HZ) + 1
    grid = piece.start + np.arange(count) / RATE_HZ
    columns = {"time": grid}
    for track in tracks:
        # The low-pass must see nothing from beyond a gap. A command holds, however long ago it was issued.
        within = _rows(track, _around(track, piece))
        for name, values in track.channels.items():
            columns[name] = (
                held(track.time, values, grid)
                if name in COMMANDS
                else interpolated(within.time, within.channels[name], grid)
            )
    return columns


def _around(track: Track, piece: Piece) -> slice:
    """From the last row by the piece's start to the first from its end on: no wide gap lies between these."""
    first = int(np.searchsorted(track.time, piece.start, "right")) - 1
    return slice(max(0, first), int(np.searchsorted(track.time, piece.end)) + 1)
