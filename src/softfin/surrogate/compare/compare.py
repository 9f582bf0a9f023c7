"""Surrogates side by side on the same unseen logs, free-running over several horizons: Table I extended.

A group of scores are the seeds of one configuration on the same data. All surrogates are scored on the same rows,
whatever they need to be warm.
"""

import itertools
import json
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pydantic

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError
from softfin.core.plant import EnsemblePlant, Plant
from softfin.core.plant_identity import identity
from softfin.core.progress import Progress
from softfin.core.quantities import PAPER_LIMITS, RATE_HZ, Log, Reading
from softfin.core.randomness import key_of
from softfin.core.window import interval
from softfin.storage import artifact as artifacts
from softfin.surrogate.compare.free_running import free_run, run_from_rest, segments_of, take
from softfin.surrogate.compare.metrics import HorizonScores, measured_ranges, score_segments
from softfin.surrogate.store import AnySurrogate, load_surrogate
from softfin.surrogate.streaming.uncertainty import COVERAGE

ENOUGH_SEEDS = 3
"""Fewest seeds of a group: below, a difference between two groups may be the luck of a seed."""

FAR = 0.01
"""Distance beyond the range of the training commands, over that range, from which a test command is worth a note."""


SEED_IN_NAME = re.compile(r"[-_./]?(seed)?[-_.]?\d+$")


class CompareConfig(Configuration):
    """How surrogates are compared."""

    horizons_s: tuple[float, ...] = (1.0, 5.0, 30.0)
    """How long a surrogate runs free [s], on the 10 ms grid; the last is long beside any memory of the fin."""
    seed: int = pydantic.Field(default=0, ge=0)
    """Seed of the noise of the plant that sets the noise floor."""

    @pydantic.field_validator("horizons_s")
    @classmethod
    def _each_once_on_the_grid(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if not value or any(h < 0.1 or abs(h * RATE_HZ - round(h * RATE_HZ)) > 1e-6 for h in value):
            raise ValueError("horizons are at least 0.1 s and whole numbers of 10 ms samples, such as 1, 5, 30")
        if len(set(value)) < len(value):
            raise ValueError("a horizon is given twice")
        return tuple(sorted(value))


class Candidate(NamedTuple):
    """A surrogate and where it lies."""

    folder: Path
    surrogate: AnySurrogate
    group: str
    """Key of the group: equal for seeds of one configuration on the same data."""


class Run(NamedTuple):
    """One member of a group over all horizons."""

    scores: list[HorizonScores]
    """Scores of each horizon."""
    reading: Reading
    """Prediction of the segments of the longest horizon."""


class Group(NamedTuple):
    """Seeds of one configuration, or the plant of the noise floor."""

    name: str
    model: str
    members: list[Candidate]
    """Surrogates of the group; empty for the noise floor."""
    runs: list[Run]


class Comparison(NamedTuple):
    """All groups on the same rows."""

    horizons_s: tuple[float, ...]
    groups: list[Group]
    noise_floor: Group | None
    measured: Log
    """The segments of the longest horizon."""
    scored: list[dict[str, int]]
    """Counts of segments and rows of each horizon."""
    ranges: dict[str, float]
    """Range of the measured channels, see `measured_ranges`."""
    beyond: list[tuple[float, float]]
    """Share of the test commands beyond each group's training range, and how far the furthest is, over the range."""

    def notes(self) -> list[str]:
        """What a reader of the scores should know, in words."""
        notes = []
        for group, (share, furthest) in zip(self.groups, self.beyond, strict=True):
            count = len(group.members)
            if count < ENOUGH_SEEDS:
                seeds = "1 seed" if count == 1 else f"{count} seeds"
                notes.append(f"{group.name}: {seeds}; fit at least {ENOUGH_SEEDS} before a difference is believed")
            if furthest > FAR:
                notes.append(
                    f"{group.name}: {share:.1%} of the test commands lie beyond those it was trained on, the furthest "
                    f"by {furthest:.0%} of their range: there it extrapolates"
                )
            surrogate = group.members[0].surrogate
            if isinstance(surrogate, EnsemblePlant) and (caveat := surrogate.interval.caveat()) is not None:
                notes.append(f"{group.name}: {caveat}")
        if self.noise_floor is not None:
            notes.append(
                f"{self.noise_floor.name}: its own noise and drift count too, so that it is off by up to sqrt(2) times "
                "what these leave of a model that has none"
            )
        return notes

    def summary(self) -> dict[str, Any]:
        """The comparison for JSON; `write_comparison` describes the entries."""
        yardstick = next((group for group in self.groups if group.model == "paper"), self.groups[0])
        flops = [group.members[0].surrogate.flops_per_tick() for group in (yardstick, *self.groups)]
        rows = [
            {
                "name": group.name,
                "model": group.model,
                "surrogates": [str(member.folder) for member in group.members],
                "seeds": len(group.members),
                "parameters": group.members[0].surrogate.parameters(),
                "flops_per_tick": own,
                "flops_ratio": own / flops[0],
                "commands_beyond_training": share,
                "furthest_beyond_training": furthest,
                "horizons": self.horizons_of(group),
            }
            for group, own, (share, furthest) in zip(self.groups, flops[1:], self.beyond, strict=True)
        ]
        second = self.noise_floor
        return {
            "horizons_s": list(self.horizons_s),
            "scored": self.scored,
            "ranges": self.ranges,
            "stated_confidence": COVERAGE,
            "flops_ratio_to": yardstick.name,
            "groups": rows,
            "noise_floor": None if second is None else {"name": second.name, "horizons": self.horizons_of(second)},
            "notes": self.notes(),
        }

    def horizons_of(self, group: Group) -> list[dict[str, Any]]:
        """Scores of a group at each horizon, as mean and 95% interval over its runs."""
        rows = []
        for index, horizon in enumerate(self.horizons_s):
            each = [run.scores[index].scores for run in group.runs]
            row: dict[str, Any] = {"horizon_s": horizon}
            for name in each[0]:
                values = np.array([scores[name] for scores in each])
                row[name] = {"mean": float(values.mean()), "interval": interval(values)}
            rows.append(row)
        return rows


def compare(
    found: Sequence[Candidate],
    logs: Sequence[Log],
    config: CompareConfig,
    noise_floor: tuple[str, Plant] | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Score every surrogate free-running over the same segments of the logs; `noise_floor`: a plant by its name.

    Raises:
        LogError: a log is shorter than the longest horizon behind the rows that a surrogate needs to be warm.
        CommandError: the plant of the noise floor does not take the commands of the logs.
        PlantError: a prediction is not finite.
    """
    ticks = [round(horizon * RATE_HZ) for horizon in config.horizons_s]
    first = max(candidate.surrogate.memory for candidate in found)
    counts = [len(log.reading.time) for log in logs]
    # The longest first: it is the one that a log may be too short for.
    segments = [segments_of(counts, each, first) for each in reversed(ticks)][::-1]
    ranges = measured_ranges(logs)
    measured = [take(logs, where, each) for where, each in zip(segments, ticks, strict=True)]
    of, done = len(found) * len(ticks) + (noise_floor is not None), itertools.count(1)

    def report(note: str) -> None:
        if progress is not None:
            progress("compare", next(done) / of, note)

    def run(candidate: Candidate) -> Run:
        surrogate, scores = candidate.surrogate, []
        half_width = surrogate.interval.half_width if isinstance(surrogate, EnsemblePlant) else None
        for where, each, actual, horizon in zip(segments, ticks, measured, config.horizons_s, strict=True):
            reading, members = free_run(surrogate, logs, where, each)
            scores.append(score_segments(actual, reading, ranges, members, half_width))
            report(f"{candidate.folder}, {horizon:g} s")
        return Run(scores, reading)

    grouped: dict[str, list[Candidate]] = {}
    for candidate in found:
        grouped.setdefault(candidate.group, []).append(candidate)
    names = names_of(list(grouped.values()))
    groups = [
        Group(name, members[0].surrogate.model, members, [run(member) for member in members])
        for name, members in zip(names, grouped.values(), strict=True)
    ]
    second = None
    if noise_floor is not None:
        name, plant = noise_floor
        whole = run_from_rest(plant, logs, key_of(config.seed, "compare/floor"))
        readings = [take(whole, where, each) for where, each in zip(segments, ticks, strict=True)]
        scores = [score_segments(actual, reading, ranges) for actual, reading in zip(measured, readings, strict=True)]
        second = Group(f"second recording ({name})", name, [], [Run(scores, readings[-1])])
        report(second.name)
    scored = [
        {"segments": len(where), "rows": len(where) * each, "rows_left": sum(counts) - len(where) * each}
        for where, each in zip(segments, ticks, strict=True)
    ]
    beyond = [beyond_limits(group.members, logs) for group in groups]
    return Comparison(config.horizons_s, groups, second, measured[-1], scored, ranges, beyond)


def candidates(folders: Sequence[Path]) -> list[Candidate]:
    """Load surrogates; raises ConfigurationError where there is none, or one is given twice."""
    if not folders:
        raise ConfigurationError("no surrogate: give the folders of those that are to be compared")
    seen: dict[str, Path] = {}
    found = []
    for folder in folders:
        surrogate = load_surrogate(folder)
        # A copy would pass for a second seed and make the interval too narrow.
        which = identity(surrogate)
        if which in seen:
            before = seen[which]
            same = "given twice" if before.resolve() == folder.resolve() else f"the same surrogate as {before}"
            raise ConfigurationError(f"{folder}: {same}; give each surrogate once")
        seen[which] = folder
        found.append(Candidate(folder, surrogate, _group(folder, surrogate)))
    return found


def names_of(groups: Sequence[Sequence[Candidate]]) -> list[str]:
    """Name each group by its model; where several are of one model, also by its first folder, less its seed."""
    models = Counter(members[0].surrogate.model for members in groups)

    def name(members: Sequence[Candidate], folder: str) -> str:
        model = members[0].surrogate.model
        common = SEED_IN_NAME.sub("", folder) if len(members) > 1 else folder
        return model if models[model] == 1 else f"{model} ({common or folder})"

    short = [name(members, members[0].folder.name) for members in groups]
    return short if len(set(short)) == len(short) else [name(each, str(each[0].folder)) for each in groups]


def beyond_limits(members: Sequence[Candidate], logs: Sequence[Log]) -> tuple[float, float]:
    """Share of the logs' commands beyond those a group was trained on, and how far the furthest is, over their range.

    For the member for which they are greatest.
    """
    commands = np.concatenate([np.stack(log.command, axis=1) for log in logs]).astype(np.float64)
    limits = np.array([member.surrogate.limits for member in members]).reshape(-1, 1, 2, 2)
    low, high = limits[..., 0], limits[..., 1]
    # Where the training commands never changed, over the range of the paper's.
    span = np.where(high > low, high - low, np.diff(np.reshape(PAPER_LIMITS, (2, 2)))[:, 0])
    excess = np.maximum((low - commands) / span, (commands - high) / span).max(axis=-1)
    return float((excess > 0).mean(axis=1).max()), max(float(excess.max()), 0.0)


def _group(folder: Path, surrogate: AnySurrogate) -> str:
    description = artifacts.load_description(folder, "surrogate")
    data = (description.get("provenance") or {}).get("data_hash")
    if description.get("configuration") is None or data is None:
        # Imported: nothing says that two such are seeds of one another.
        return str(folder.resolve())
    # The networks too: of several candidates one seed may have chosen another than the next.
    parts = [surrogate.model, description["configuration"], description.get("networks"), data]
    return json.dumps(parts, sort_keys=True)
