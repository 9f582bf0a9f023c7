"""Compares surrogates in free runs over several horizons of the same test logs; extends Table I.

A group contains the surrogates that differ only in their seed. All surrogates are scored on the
same rows, regardless of how long their warm-up is.
"""

import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pydantic

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError
from softfin.core.json_object import JsonObject
from softfin.core.plant import EnsemblePlant, Plant
from softfin.core.plant_identity import identity
from softfin.core.progress import Progress
from softfin.core.quantities import RATE_HZ, Log, Reading
from softfin.core.randomness import named_key
from softfin.core.window import interval, moving_average
from softfin.storage import artifact as artifacts
from softfin.surrogate.compare.scores import (
    HorizonScores,
    Segment,
    free_run,
    measured_ranges,
    plan_segments,
    run_from_rest,
    score_segments,
    take,
)
from softfin.surrogate.protocol import COVERAGE, SurrogatePlant
from softfin.surrogate.registry import PAPER
from softfin.surrogate.store import load_surrogate

ENOUGH_SEEDS = 3
"""Minimum number of seeds per group; with fewer, a difference may be due to chance."""

FAR = 0.01
"""Distance beyond the range of the training commands, relative to that range, above which a note
is added."""


class CompareConfig(Configuration):
    """Configuration of a comparison of surrogates."""

    horizons_s: tuple[float, ...] = (1.0, 5.0, 30.0)
    """Durations of the free runs [s], in multiples of 10 ms. 30 s is much longer than the memory of
    the fin."""
    seed: int = pydantic.Field(default=0, ge=0)
    """Seed for the noise of the plant used as the noise floor."""

    @pydantic.field_validator("horizons_s")
    @classmethod
    def _on_the_grid(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        problem = "horizons must be at least 0.1 s and multiples of 10 ms, e.g. 1, 5, 30"
        if not value:
            raise ValueError(problem)
        for horizon in value:
            ticks = horizon * RATE_HZ
            # 1e-6 allows for rounding: 0.29 * 100 is not exactly 29.
            if horizon < 0.1 or abs(ticks - round(ticks)) > 1e-6:
                raise ValueError(problem)
        return tuple(sorted(set(value)))


class Candidate(NamedTuple):
    """A surrogate and its folder."""

    folder: Path
    surrogate: SurrogatePlant
    group: str
    """Key of the group; the same for all seeds of one configuration on the same data."""


class Group(NamedTuple):
    """All seeds of one configuration, or the plant used as the noise floor."""

    row: JsonObject
    """Entry of the group in the summary."""
    longest: list[HorizonScores]
    """Scores of each seed at the longest horizon."""
    reading: Reading
    """Prediction of the first seed for the segments of the longest horizon."""


class Comparison(NamedTuple):
    """Scores of all groups on the same rows."""

    summary: JsonObject
    """Content of ``comparison.json``; docs/files.md describes it."""
    groups: list[Group]
    noise_floor: Group | None
    measured: Log
    """Measured segments of the longest horizon."""


class ScoredRows(NamedTuple):
    """Rows of the test logs that every surrogate predicts, by horizon."""

    logs: Sequence[Log]
    parts: list[tuple[list[Segment], int]]
    """Segments of each horizon and their length [ticks]."""
    measured: list[Log]
    """Measured values, with fields ``(segments, ticks, ...)``."""
    spans: dict[str, float]
    """Range of the measured values of each channel."""


def compare_surrogates(
    found: Sequence[Candidate],
    logs: Sequence[Log],
    config: CompareConfig,
    noise_floor: tuple[str, Plant] | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Score every surrogate in free runs over the same segments of the logs.

    `noise_floor` contains a plant's name and the plant. Its predictions are scored like a
    surrogate's, as if the measurement had been repeated.
    """
    scored = _plan_rows(found, logs, config)
    num_scorings = len(found) * len(scored.parts) + (noise_floor is not None)
    done = itertools.count(1)

    def report(note: str) -> None:
        if progress is not None:
            progress("compare", next(done) / num_scorings, note)

    seeds = _by_group(found)
    names = _name_groups(seeds)
    yardstick = _yardstick(seeds)
    yardstick_cost = seeds[yardstick][0].surrogate.flops_per_tick()
    groups = []
    notes = list[str]()
    for name, members in zip(names, seeds, strict=True):
        group = _score_group(name, members, scored, config, yardstick_cost, report)
        groups.append(group)
        for note in _notes(group.row, members[0].surrogate):
            notes.append(f"{name}: {note}")
    second = None
    if noise_floor is not None:
        second = _noise_floor_group(noise_floor, scored, config)
        name = second.row["name"]
        # The difference between two independent recordings with equal error variances has sqrt(2)
        # times the error of either one.
        notes.append(
            f"{name}: contains its own noise and drift: up to sqrt(2) times the error of a "
            "perfect model"
        )
        report(name)
    num_rows = sum(log.rows for log in logs)
    summary = {
        "horizons_s": list(config.horizons_s),
        "scored": [_count_rows(num_rows, *part) for part in scored.parts],
        "ranges": scored.spans,
        "stated_confidence": COVERAGE,
        "flops_ratio_to": names[yardstick],
        "groups": [group.row for group in groups],
        "noise_floor": None if second is None else second.row,
        "notes": notes,
    }
    return Comparison(summary, groups, second, scored.measured[-1])


def _plan_rows(
    found: Sequence[Candidate], logs: Sequence[Log], config: CompareConfig
) -> ScoredRows:
    # The longest warm-up applies to all, so that all are scored on the same rows.
    warm_up = max(candidate.surrogate.memory for candidate in found)
    rows = [log.rows for log in logs]
    parts = []
    # The longest horizon comes first, because its error message states how long logs must be.
    for horizon in reversed(config.horizons_s):
        ticks = round(horizon * RATE_HZ)
        parts.append((plan_segments(rows, ticks, warm_up), ticks))
    parts.reverse()
    spans = measured_ranges(logs)
    measured = [take(logs, *part) for part in parts]
    return ScoredRows(logs, parts, measured, spans)


def _yardstick(seeds: Sequence[Sequence[Candidate]]) -> int:
    """Return the group to which costs are relative: the paper's networks if they are compared,
    otherwise the first."""
    for index, members in enumerate(seeds):
        if members[0].surrogate.model == PAPER:
            return index
    return 0


def _name_groups(seeds: Sequence[Sequence[Candidate]]) -> list[str]:
    """Return the model of each group, with its first folder if several groups have that model."""
    models = [members[0].surrogate.model for members in seeds]
    names = []
    for members, model in zip(seeds, models, strict=True):
        is_unique = models.count(model) == 1
        names.append(model if is_unique else f"{model} ({members[0].folder})")
    return names


def _score_group(
    name: str,
    members: Sequence[Candidate],
    scored: ScoredRows,
    config: CompareConfig,
    yardstick_cost: int,
    report: Callable[[str], None],
) -> Group:
    surrogate = members[0].surrogate
    scores = []
    readings = []
    for member in members:
        member_scores, reading = _score_candidate(member, scored, config, report)
        scores.append(member_scores)
        readings.append(reading)
    cost = surrogate.flops_per_tick()
    share, furthest = beyond_limits(members, scored.logs)
    row = {
        "name": name,
        "model": surrogate.model,
        "surrogates": [str(member.folder) for member in members],
        "seeds": len(members),
        "parameters": surrogate.parameters(),
        "flops_per_tick": cost,
        "flops_ratio": cost / yardstick_cost,
        "commands_beyond_training": share,
        "furthest_beyond_training": furthest,
        "horizons": _horizons(config, scores),
    }
    return Group(row, [horizons[-1] for horizons in scores], readings[0])


def _score_candidate(
    candidate: Candidate,
    scored: ScoredRows,
    config: CompareConfig,
    report: Callable[[str], None],
) -> tuple[list[HorizonScores], Reading]:
    """Score a surrogate at each horizon; also return its prediction for the longest."""
    surrogate = candidate.surrogate
    scores = []
    for part, actual, horizon in zip(scored.parts, scored.measured, config.horizons_s, strict=True):
        reading, members = free_run(surrogate, scored.logs, *part)
        widths = None
        if members is not None and isinstance(surrogate, EnsemblePlant):
            widths = np.asarray(surrogate.interval.half_width(moving_average(members)))
        scores.append(score_segments(actual, reading, scored.spans, widths))
        report(f"{candidate.folder}, {horizon:g} s")
    return scores, reading


def _noise_floor_group(
    noise_floor: tuple[str, Plant], scored: ScoredRows, config: CompareConfig
) -> Group:
    name, plant = noise_floor
    # A plant cannot be warmed up from a log, so it replays each log from its first row.
    replayed = run_from_rest(plant, scored.logs, named_key(config.seed, "compare/floor"))
    scores = []
    for part, actual in zip(scored.parts, scored.measured, strict=True):
        reading = take(replayed, *part)
        scores.append(score_segments(actual, reading, scored.spans))
    row = {"name": f"second recording ({name})", "horizons": _horizons(config, [scores])}
    return Group(row, scores[-1:], reading)


def _by_group(found: Sequence[Candidate]) -> list[list[Candidate]]:
    groups: dict[str, list[Candidate]] = {}
    for candidate in found:
        groups.setdefault(candidate.group, []).append(candidate)
    return list(groups.values())


def _count_rows(rows: int, segments: Sequence[Segment], ticks: int) -> dict[str, int]:
    """Return the number of segments, and of rows inside and outside them."""
    used = len(segments) * ticks
    return {"segments": len(segments), "rows": used, "rows_left": rows - used}


def _horizons(config: CompareConfig, scores: Sequence[Sequence[HorizonScores]]) -> list[JsonObject]:
    """Return the scores at each horizon, as means and 95% intervals over the seeds."""
    rows = []
    for index, horizon in enumerate(config.horizons_s):
        seeds = [horizons[index] for horizons in scores]
        row: JsonObject = {"horizon_s": horizon}
        for name in seeds[0].scores:
            values = np.array([seed.scores[name] for seed in seeds])
            row[name] = {"mean": float(values.mean()), "interval": interval(values)}
        rows.append(row)
    return rows


def _notes(row: JsonObject, surrogate: SurrogatePlant) -> Iterator[str]:
    """Yield caveats about the scores of a group."""
    if (seeds := row["seeds"]) < ENOUGH_SEEDS:
        yield (
            f"{seeds} seed{'s' * (seeds > 1)}; fit at least {ENOUGH_SEEDS} before you trust a "
            "difference"
        )
    if row["furthest_beyond_training"] > FAR:
        yield (
            f"{row['commands_beyond_training']:.1%} of the test commands are outside the range of "
            f"its training commands, by up to {row['furthest_beyond_training']:.0%} of that range; "
            "the surrogate extrapolates there"
        )
    if isinstance(surrogate, EnsemblePlant) and (caveat := surrogate.interval.caveat()) is not None:
        yield caveat


def candidates(folders: Sequence[Path]) -> list[Candidate]:
    """Load surrogates and assign them to groups.

    Raises:
        ConfigurationError: there are no surrogates, or duplicates.
    """
    if not folders:
        raise ConfigurationError(
            "missing surrogates: add the folders of the surrogates to compare to the command"
        )
    found = []
    seen = set[str]()
    for folder in folders:
        surrogate = load_surrogate(folder)
        description = artifacts.load_description(folder, "surrogate")
        data = (description.get("provenance") or {}).get("data_hash")
        # Imported surrogates have no configuration, so each one is a group by itself.
        group = str(folder.resolve())
        if description.get("configuration") is not None and data is not None:
            # The networks are part of the key, because a search may have chosen different
            # architectures for different seeds.
            networks = description.get("networks")
            key = [surrogate.model, description["configuration"], networks, data]
            group = json.dumps(key, sort_keys=True)
        # A copy would count as a second seed and make the interval over seeds too narrow.
        if (which := identity(surrogate)) in seen:
            raise ConfigurationError(
                f"{folder}: duplicate surrogate, or a copy of another one; list each surrogate once"
            )
        seen.add(which)
        found.append(Candidate(folder, surrogate, group))
    return found


def beyond_limits(members: Sequence[Candidate], logs: Sequence[Log]) -> tuple[float, float]:
    """Return how far the commands of the logs go beyond the training commands of a group.

    Returns:
        The fraction of commands outside the training range, and the largest distance from it
        relative to the range; both are maxima over the members.
    """
    commands = np.concatenate([np.stack(log.command, axis=1) for log in logs]).astype(np.float64)
    # (members, 1, angle or velocity, minimum or maximum), against commands (rows, 2).
    limits = np.array([member.surrogate.limits for member in members]).reshape(-1, 1, 2, 2)
    low = limits[..., 0]
    high = limits[..., 1]
    # If the training commands never changed, distances are relative to 1 rad or 1 rad/s.
    span = np.where(high > low, high - low, 1)
    # (members, rows): negative inside the range.
    excess = np.maximum((low - commands) / span, (commands - high) / span).max(axis=-1)
    outside = (excess > 0).mean(axis=1)
    return float(outside.max()), max(float(excess.max()), 0.0)
