"""Compares surrogates on the same unseen logs, free-running over several horizons: an extension of
Table I.

A group consists of the seeds of one configuration on the same data. All surrogates are scored on
the same rows, no matter how long their warm-up is.
"""

import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

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
from softfin.surrogate.store import AnySurrogate, load_surrogate
from softfin.surrogate.streaming.ensemble import COVERAGE

ENOUGH_SEEDS = 3
"""Smallest number of seeds in a group; with fewer, a difference between two groups may be luck."""

FAR = 0.01
"""Distance outside the range of the training commands, relative to that range, from which a test
command gets a note."""


class CompareConfig(Configuration):
    """How surrogates are compared."""

    horizons_s: tuple[float, ...] = (1.0, 5.0, 30.0)
    """Durations of the free runs [s], multiples of 10 ms; the last is much longer than any memory
    of the fin."""
    seed: int = pydantic.Field(default=0, ge=0)
    """Seed of the noise in the plant that gives the noise floor."""

    @pydantic.field_validator("horizons_s")
    @classmethod
    def _on_the_grid(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if not value or any(h < 0.1 or abs(h * RATE_HZ - round(h * RATE_HZ)) > 1e-6 for h in value):
            raise ValueError(
                "horizons are at least 0.1 s and whole numbers of 10 ms samples, such as 1, 5, 30"
            )
        return tuple(sorted(set(value)))


class Candidate(NamedTuple):
    """A surrogate and its folder."""

    folder: Path
    surrogate: AnySurrogate
    group: str
    """Key of the group: equal for seeds of one configuration on the same data."""


class Group(NamedTuple):
    """The seeds of one configuration, or the plant of the noise floor."""

    row: JsonObject
    """Entry of the group in the summary."""
    longest: list[HorizonScores]
    """Scores of each seed at the longest horizon."""
    reading: Reading
    """Prediction of the first seed for the segments of the longest horizon."""


class Comparison(NamedTuple):
    """All groups on the same rows."""

    summary: JsonObject
    """Return the content of ``comparison.json``, which docs/files.md describes."""
    groups: list[Group]
    noise_floor: Group | None
    measured: Log
    """The segments of the longest horizon."""


def compare_surrogates(
    found: Sequence[Candidate],
    logs: Sequence[Log],
    config: CompareConfig,
    noise_floor: tuple[str, Plant] | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Score every surrogate free-running over the same segments of the logs; `noise_floor`: a plant
    by its name."""
    warm_up = max(candidate.surrogate.memory for candidate in found)
    rows = [log.rows for log in logs]
    ticks = [round(horizon * RATE_HZ) for horizon in config.horizons_s]
    # The longest horizon comes first, because a log may be too short for it.
    parts = [(plan_segments(rows, each, warm_up), each) for each in reversed(ticks)][::-1]
    spans = measured_ranges(logs)
    measured = [take(logs, *part) for part in parts]
    num_scorings = len(found) * len(parts) + (noise_floor is not None)
    done = itertools.count(1)

    def report(note: str) -> None:
        if progress is not None:
            progress("compare", next(done) / num_scorings, note)

    def run(candidate: Candidate) -> tuple[list[HorizonScores], Reading]:
        surrogate = candidate.surrogate
        scores = []
        for part, actual, horizon in zip(parts, measured, config.horizons_s, strict=True):
            reading, members = free_run(surrogate, logs, *part)
            widths = None
            if members is not None and isinstance(surrogate, EnsemblePlant):
                widths = np.asarray(surrogate.interval.half_width(moving_average(members)))
            scores.append(score_segments(actual, reading, spans, widths))
            report(f"{candidate.folder}, {horizon:g} s")
        return scores, reading

    seeds = _by_group(found)
    firsts = [members[0] for members in seeds]
    models = [first.surrogate.model for first in firsts]
    # Costs are relative to the paper's networks if they are compared, otherwise to the first group.
    yardstick = firsts[models.index("paper") if "paper" in models else 0]

    def name_group(first: Candidate) -> str:
        model = first.surrogate.model
        return model if models.count(model) == 1 else f"{model} ({first.folder})"

    groups = []
    notes = list[str]()
    for members in seeds:
        name = name_group(members[0])
        surrogate = members[0].surrogate
        cost = surrogate.flops_per_tick()
        scores, readings = zip(*map(run, members), strict=True)
        share, furthest = beyond_limits(members, logs)
        row = {
            "name": name,
            "model": surrogate.model,
            "surrogates": [str(member.folder) for member in members],
            "seeds": len(members),
            "parameters": surrogate.parameters(),
            "flops_per_tick": cost,
            "flops_ratio": cost / yardstick.surrogate.flops_per_tick(),
            "commands_beyond_training": share,
            "furthest_beyond_training": furthest,
            "horizons": _horizons(config, scores),
        }
        groups.append(Group(row, [each[-1] for each in scores], readings[0]))
        notes += [f"{name}: {note}" for note in _notes(row, surrogate)]
    second = None
    if noise_floor is not None:
        name = f"second recording ({noise_floor[0]})"
        whole = run_from_rest(noise_floor[1], logs, named_key(config.seed, "compare/floor"))
        scores = []
        for part, actual in zip(parts, measured, strict=True):
            reading = take(whole, *part)
            scores.append(score_segments(actual, reading, spans))
        second = Group(
            {"name": name, "horizons": _horizons(config, [scores])}, scores[-1:], reading
        )
        notes.append(
            f"{name}: its own noise and drift count too: up to sqrt(2) times the error of a "
            "perfect model"
        )
        report(name)
    summary = {
        "horizons_s": list(config.horizons_s),
        "scored": [_count_rows(sum(rows), *part) for part in parts],
        "ranges": spans,
        "stated_confidence": COVERAGE,
        "flops_ratio_to": name_group(yardstick),
        "groups": [group.row for group in groups],
        "noise_floor": None if second is None else second.row,
        "notes": notes,
    }
    return Comparison(summary, groups, second, measured[-1])


def _by_group(found: Sequence[Candidate]) -> list[list[Candidate]]:
    groups: dict[str, list[Candidate]] = {}
    for candidate in found:
        groups.setdefault(candidate.group, []).append(candidate)
    return list(groups.values())


def _count_rows(rows: int, segments: Sequence[Segment], ticks: int) -> dict[str, int]:
    """Return how many rows of all logs are scored in segments of `ticks`, and how many are not."""
    used = len(segments) * ticks
    return {"segments": len(segments), "rows": used, "rows_left": rows - used}


def _horizons(config: CompareConfig, scores: Sequence[Sequence[HorizonScores]]) -> list[JsonObject]:
    """Return the scores at each horizon, as mean and 95% interval over the seeds."""
    rows = []
    for horizon, each in zip(config.horizons_s, zip(*scores, strict=True), strict=True):
        row: JsonObject = {"horizon_s": horizon}
        for name in each[0].scores:
            values = np.array([seed.scores[name] for seed in each])
            row[name] = {"mean": float(values.mean()), "interval": interval(values)}
        rows.append(row)
    return rows


def _notes(row: Mapping[str, Any], surrogate: AnySurrogate) -> Iterator[str]:
    """Caveats for a reader of a group's scores."""
    if (seeds := row["seeds"]) < ENOUGH_SEEDS:
        yield (
            f"{seeds} seed{'s' * (seeds > 1)}; fit at least {ENOUGH_SEEDS} before you trust a "
            "difference"
        )
    if row["furthest_beyond_training"] > FAR:
        yield (
            f"{row['commands_beyond_training']:.1%} of the test commands lie outside its training "
            f"commands, the furthest by {row['furthest_beyond_training']:.0%} of their range; "
            "there it extrapolates"
        )
    if isinstance(surrogate, EnsemblePlant) and (caveat := surrogate.interval.caveat()) is not None:
        yield caveat


def candidates(folders: Sequence[Path]) -> list[Candidate]:
    """Load surrogates; raises ConfigurationError if none or a duplicate is given."""
    if not folders:
        raise ConfigurationError("no surrogate: give the folders of the surrogates to compare")
    found = []
    seen = set[str]()
    for folder in folders:
        surrogate = load_surrogate(folder)
        description = artifacts.load_description(folder, "surrogate")
        data = (description.get("provenance") or {}).get("data_hash")
        # Nothing says whether two imported surrogates are seeds of the same configuration.
        group = str(folder.resolve())
        if description.get("configuration") is not None and data is not None:
            # The networks count too, because seeds may have chosen different candidates.
            networks = description.get("networks")
            parts = [surrogate.model, description["configuration"], networks, data]
            group = json.dumps(parts, sort_keys=True)
        # A copy would count as a second seed and make the interval too narrow.
        if (which := identity(surrogate)) in seen:
            raise ConfigurationError(
                f"{folder}: given twice, or a copy of another; give each surrogate once"
            )
        seen.add(which)
        found.append(Candidate(folder, surrogate, group))
    return found


def beyond_limits(members: Sequence[Candidate], logs: Sequence[Log]) -> tuple[float, float]:
    """Return the fraction of the logs' commands outside the training commands of a group, and the
    largest distance relative to their range."""
    commands = np.concatenate([np.stack(log.command, axis=1) for log in logs]).astype(np.float64)
    limits = np.array([member.surrogate.limits for member in members]).reshape(-1, 1, 2, 2)
    low = limits[..., 0]
    high = limits[..., 1]
    # If the training commands never changed, relative to 1 rad or rad/s.
    span = np.where(high > low, high - low, 1)
    excess = np.maximum((low - commands) / span, (commands - high) / span).max(axis=-1)
    return float((excess > 0).mean(axis=1).max()), max(float(excess.max()), 0.0)
