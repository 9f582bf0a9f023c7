"""Faults of single channels of one log at 100 Hz: units, spikes, stuck or saturated sensors, coarse steps, offsets."""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from softfin.core.quantities import RATE_HZ, TICK_S, Log
from softfin.data.checks.findings import Finding, Place, Severity, counted
from softfin.data.importing.alignment import SHORTEST_S, motion
from softfin.data.importing.importing import ANGLES

MOST_RADIANS = {"command_angle": 2 * np.pi, "angle": 2 * np.pi, "command_velocity": 40.0}
"""Beyond these it is degrees: a fin does not turn round, and no drive of one makes 6 turns a second. By size a measured
velocity does not tell: the published nets' own jumps reach 145 rad/s."""

SPIKE = 1.2
"""Height over half the span of 98% of the samples; the published nets' own jumps reach 0.8."""

SPIKE_Z = 8.0
"""Least robust z of the second difference: a spike in a series that is rough anyway is none."""

MANY_SPIKES = 1e-3
"""Share of samples from which spikes stop training."""

STUCK_S = 1.0
"""Shortest constant run of interest [s]."""

MOVING_RAD_S = 0.2
"""A fin that is faster than this does not leave the force on it constant."""

RESTING_RAD_S = 0.05
"""A fin whose rate deviates by less tells nothing of its velocity's unit."""

JUMP_RAD = 2.0
"""From one sample to the next: 200 rad/s; the published nets' own jumps reach 1.5."""

ERROR_RAD = 0.1
"""A drive this far off its target is on its way there."""


class Columns(NamedTuple):
    """A log in double precision, by channel."""

    command_angle: Float[np.ndarray, "ticks"]
    command_velocity: Float[np.ndarray, "ticks"]
    angle: Float[np.ndarray, "ticks"]
    velocity: Float[np.ndarray, "ticks"]
    force_x: Float[np.ndarray, "ticks"]
    force_y: Float[np.ndarray, "ticks"]


def columns_of(log: Log) -> Columns:
    """All channels but time."""
    command, reading = log
    series = (command.angle, command.velocity, reading.angle, reading.velocity, *np.asarray(reading.force).T)
    return Columns(*(np.asarray(values, np.float64) for values in series))


def in_degrees(columns: Columns, name: str, velocity_told: bool = False) -> tuple[Columns, list[Finding]]:
    """What is in degrees, turned to radians so that all else can be judged, and the finding.

    Not the commanded velocity where an option told it, in rad/s.
    """
    channels = columns._asdict()
    # The size of one sample in a hundred may be a spike's.
    wrong = [name for name, most in MOST_RADIANS.items() if np.percentile(np.abs(channels[name]), 99) > most]
    if not wrong:
        return columns, []
    if "angle" in wrong and 0.5 < _slope(columns)[1] < 2:
        wrong.append("velocity")
    if "command_angle" in wrong and "command_velocity" not in wrong and "angle" in wrong and not velocity_told:
        wrong.append("command_velocity")
    spans = "; ".join(f"{c} spans {channels[c].min():.4g} .. {channels[c].max():.4g}" for c in wrong)
    option = "deg" if set(wrong) == set(ANGLES) else ",".join(f"{channel}=deg" for channel in wrong)
    finding = Finding("error", "degrees", Place(name, wrong[0]), f"{spans}: degrees, not rad", f"--angles {option}")
    return columns._replace(**{channel: np.radians(channels[channel]) for channel in wrong}), [finding]


def without_spikes(columns: Columns, name: str) -> tuple[Columns, list[Finding]]:
    """Spikes found by name and replaced for whatever is judged next; the log itself keeps them.

    Of the angle and the force: a velocity is mostly a difference of angles, and rough by nature.
    """
    findings: list[Finding] = []
    for channel in ("angle", "force_x", "force_y"):
        values = getattr(columns, channel)
        rows, calm = spikes(values)
        if not rows.size:
            continue
        severity: Severity = "error" if rows.size > MANY_SPIKES * len(values) else "warning"
        sentence = (
            f"{counted(rows.size, 'spike')}, up to {np.abs(values - calm)[rows].max():.3g} {_unit(channel)} "
            f"off the samples beside, where 98% of all lie within {np.ptp(np.percentile(values, [1, 99])):.3g}"
        )
        remedy = "check the cable and the sensor's range; repair these samples in the file, or record again"
        findings.append(Finding(severity, "spikes", Place(name, channel, int(rows[0])), sentence, remedy))
        columns = columns._replace(**{channel: calm})
    return columns, findings


def spikes(values: Float[np.ndarray, "ticks"]) -> tuple[Int[np.ndarray, "spikes"], Float[np.ndarray, "ticks"]]:
    """Rows of outliers of one or two samples, and the series with the median of five in their place."""
    if len(values) < SHORTEST_S * RATE_HZ:
        return np.zeros(0, int), values
    padded = np.pad(values, 2, mode="edge")
    middle = np.median(np.stack([padded[k : k + len(values)] for k in range(5)]), axis=0)
    bend = np.abs(np.diff(np.pad(values, 1, mode="edge"), 2))
    # Most of a fin at rest bends by nothing at all: the scale is that of the bends there are.
    scale = 1.4826 * float(np.median(bend[bend > 0])) if (bend > 0).any() else 0.0
    half = 0.5 * float(np.ptp(np.percentile(values, [1, 99])))
    outlying = (np.abs(values - middle) > SPIKE * max(half, 1e-9)) & (bend > SPIKE_Z * scale)
    return np.flatnonzero(outlying), np.where(outlying, middle, values)


def jumps(columns: Columns, name: str) -> list[Finding]:
    """Angles that no fin can have between two samples: the seam of two logs, or an encoder that lost its count."""
    rows = np.flatnonzero(np.abs(np.diff(columns.angle)) > JUMP_RAD)
    if not rows.size:
        return []
    height = float(np.abs(np.diff(columns.angle)).max())
    sentence = f"{counted(rows.size, 'jump')} of up to {height:.2f} rad from one sample to the next: logs end to end?"
    remedy = "--rows-per-log 20000, if every log has so many rows; else cut the file at these rows"
    return [Finding("warning", "jumps", Place(name, "angle", int(rows[0])), sentence, remedy)]


def stuck(columns: Columns, name: str) -> list[Finding]:
    """Runs of one value in a channel that something else should have moved."""
    moving = np.abs(motion(columns.angle).velocity) > MOVING_RAD_S
    # A fifth of a second for the dead time, and for the force a drive may press in vain.
    behind = np.abs(columns.command_angle - columns.angle) > ERROR_RAD
    findings = []
    for channel, driven, cause in (
        ("angle", behind, "the command is elsewhere"),
        ("force_x", moving, "the fin moves"),
        ("force_y", moving, "the fin moves"),
    ):
        runs = [
            (start, end)
            for start, end in constant_runs(getattr(columns, channel), round(STUCK_S * RATE_HZ))
            if driven[start + round(0.2 * RATE_HZ) : end].sum() > 0.5 * STUCK_S * RATE_HZ
        ]
        if runs:
            start, end = max(runs, key=lambda run: run[1] - run[0])
            value = getattr(columns, channel)[start]
            sentence = (
                f"stuck at {value:.4g} {_unit(channel)} for {(end - start) * TICK_S:.2f} s while {cause}; "
                f"{counted(len(runs), 'such run')}, {sum(b - a for a, b in runs) * TICK_S:.2f} s in all"
            )
            remedy = "check sensor and drive; cut these rows off, or record again"
            findings.append(Finding("error", "stuck", Place(name, channel, start), sentence, remedy))
    return findings


def constant_runs(values: Float[np.ndarray, "ticks"], least: int) -> list[tuple[int, int]]:
    """First row and the row after the last of each run of one value."""
    edges = np.concatenate([[0], np.flatnonzero(np.diff(values) != 0) + 1, [len(values)]])
    return [(int(a), int(b)) for a, b in itertools.pairwise(edges) if b - a >= least]


def saturated(columns: Columns, name: str) -> list[Finding]:
    """Force that stays at its extreme again and again: the sensor's range ends there."""
    findings = []
    for channel in ("force_x", "force_y"):
        values = getattr(columns, channel)
        for extreme in sorted({float(values.min()), float(values.max())}):
            runs = constant_runs(np.where(values == extreme, extreme, np.arange(len(values)) + extreme + 1.0), 3)
            rows = sum(end - start for start, end in runs)
            if len(runs) < 2 or rows < 10 or rows == len(values):
                continue
            sentence = f"clipped at {extreme:.4g} N: {rows:,} samples in {len(runs):,} runs of 3 or more stay there"
            remedy = "choose a wider range of the sensor, and record again"
            findings.append(Finding("warning", "saturated", Place(name, channel, runs[0][0]), sentence, remedy))
    return findings


def coarse(columns: Columns, name: str) -> list[Finding]:
    """Steps of the readings that are large beside what is read."""
    findings = []
    for channel in ("angle", "force_x", "force_y"):
        values = getattr(columns, channel)
        step = quantum(values)
        if step > 0.1 * values.std() > 0 and len(values) >= SHORTEST_S * RATE_HZ:
            sentence = (
                f"resolved in steps of {step:.3g} {_unit(channel)}, beside a standard deviation of {values.std():.3g}"
            )
            remedy = "record with more digits"
            findings.append(Finding("warning", "coarse", Place(name, channel), sentence, remedy))
    return findings


def quantum(values: Float[np.ndarray, "ticks"]) -> float:
    """Least step from one value to the next that occurs."""
    steps = np.diff(np.unique(values.astype(np.float32)))
    return float(steps.min()) if steps.size else 0.0


def velocity(columns: Columns, name: str) -> list[Finding]:
    """A velocity that is not the angle's rate: of another unit, of the wrong sign, of something else."""
    place = Place(name, "velocity")
    correlation, slope = _slope(columns)
    if slope == 0:
        return []
    told = f"velocity is {slope:.3g} times the angle's rate (correlation {correlation:.2f})"
    if correlation < -0.5:
        return [Finding("error", "velocity sign", place, f"{told}: of the wrong sign", "--negate velocity")]
    if correlation < 0.5:
        return [Finding("warning", "velocity", place, f"{told}: it is something else",
                        "map another column, or none, so that it is derived: --columns velocity=-")]  # fmt: skip
    if not 0.5 < slope < 2:
        unit = "degrees" if 30 < slope < 100 else "degrees in the angle" if 0.01 < slope < 0.03 else "another unit"
        return [Finding("error", "velocity unit", place, f"{told}: {unit}", "--angles velocity=deg, or map another")]
    return []


def _slope(columns: Columns) -> tuple[float, float]:
    """Correlation of the velocity with the angle's rate, and how many times that it is; 0, 0 where neither moves."""
    rate = np.gradient(columns.angle, TICK_S)
    if rate.std() < RESTING_RAD_S or columns.velocity.std() == 0:
        return 0.0, 0.0
    correlation = float(np.corrcoef(rate, columns.velocity)[0, 1])
    return correlation, correlation * float(columns.velocity.std() / rate.std())


def commanded_velocity(columns: Columns, name: str) -> list[Finding]:
    """A profile velocity is a magnitude, and 0 never arrives."""
    wrong = np.flatnonzero(columns.command_velocity <= 0)
    if not wrong.size:
        return []
    sentence = f"0 or negative in {wrong.size:,} of {len(columns.angle):,} rows; a profile velocity is positive"
    return [Finding("warning", "command velocity", Place(name, "command_velocity", int(wrong[0])), sentence,
                    "map the column of the drive's profile velocity")]  # fmt: skip


def _unit(channel: str) -> str:
    return "rad" if channel == "angle" else "N"
