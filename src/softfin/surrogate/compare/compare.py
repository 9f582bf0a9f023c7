"""Surrogates side by side on the same unseen logs, left alone for several horizons: Table I extended.

Folders and logs go in; groups of scores come out, a group being the seeds of one configuration on the same data. All
surrogates are scored on the same rows, whatever they need to be warm.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pydantic
from jaxtyping import Float

from softfin.core.configuration import Configuration
from softfin.core.plant import Plant
from softfin.core.quantities import RATE_HZ, Log, Reading
from softfin.core.randomness import key_of
from softfin.core.statistics import interval
from softfin.surrogate.compare.candidates import Candidate, beyond_limits, names_of
from softfin.surrogate.compare.horizons import BATCH, FreeRunner, free_running, from_rest, places, take
from softfin.surrogate.compare.prediction_scores import HalfWidth, Judgement, judge, ranges
from softfin.surrogate.streaming.uncertainty import COVERAGE

ENOUGH_SEEDS = 3
"""Below, a difference between two groups may be the luck of a seed."""

FAR = 0.01
"""Of the range of the training commands: further beyond it, a test command is worth a note."""


class CompareConfig(Configuration):
    """How surrogates are compared."""

    horizons_s: tuple[float, ...] = (1.0, 5.0, 30.0)
    """How long a surrogate is left alone [s], on the 10 ms grid; the last is long beside any memory of the fin."""
    seed: int = pydantic.Field(default=0, ge=0)
    """Of the noise of the plant that sets the floor."""
    batch: pydantic.PositiveInt = BATCH
    """Stretches side by side, at most."""

    @pydantic.field_validator("horizons_s")
    @classmethod
    def _each_once_on_the_grid(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if not value or any(h < 0.1 or abs(h * RATE_HZ - round(h * RATE_HZ)) > 1e-6 for h in value):
            raise ValueError("horizons are at least 0.1 s and whole numbers of 10 ms samples, such as 1, 5, 30")
        if len(set(value)) < len(value):
            raise ValueError("a horizon is given twice")
        return tuple(sorted(value))


class Run(NamedTuple):
    """One member of a group over all horizons."""

    judgements: list[Judgement]
    """One a horizon."""
    reading: Reading
    """What it says of the stretches of the longest horizon."""


class Group(NamedTuple):
    """Seeds of one configuration, or the plant of the floor."""

    name: str
    model: str
    members: list[Candidate]
    """None of the floor."""
    runs: list[Run]


class Comparison(NamedTuple):
    """All groups on the same rows."""

    horizons_s: tuple[float, ...]
    groups: list[Group]
    floor: Group | None
    measured: Log
    """The stretches of the longest horizon."""
    scored: list[dict[str, int]]
    """Of each horizon."""
    spans: dict[str, float]
    """Of the measured channels, as `ranges` gives them."""
    beyond: list[tuple[float, float]]
    """Of each group: share of the test commands beyond the training range, and how far the furthest is, over the
    range."""

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
            stated = getattr(group.members[0].surrogate, "interval", None)
            if stated is not None and (caveat := stated.caveat()) is not None:
                notes.append(f"{group.name}: {caveat}")
        if self.floor is not None:
            notes.append(
                f"{self.floor.name}: its own noise and drift count too, so that it is off by up to sqrt(2) times what "
                "these leave of a model that has none"
            )
        return notes

    def summary(self) -> dict[str, Any]:
        """For JSON."""
        papers = [group for group in self.groups if group.model == "paper"]
        yardstick = (papers or self.groups)[0]
        flops = yardstick.members[0].surrogate.flops_per_tick()
        rows = []
        for group, (share, furthest) in zip(self.groups, self.beyond, strict=True):
            first = group.members[0].surrogate
            rows.append({
                "name": group.name,
                "model": group.model,
                "surrogates": [str(member.folder) for member in group.members],
                "seeds": len(group.members),
                "parameters": first.parameters(),
                "flops_per_tick": first.flops_per_tick(),
                "flops_ratio": first.flops_per_tick() / flops,
                "commands_beyond_training": share,
                "furthest_beyond_training": furthest,
                "horizons": self._scores(group),
            })  # fmt: skip
        floor = None if self.floor is None else {"name": self.floor.name, "horizons": self._scores(self.floor)}
        return {
            "horizons_s": list(self.horizons_s),
            "scored": self.scored,
            "ranges": {f"{name}_{'rad' if name == 'angle' else 'n'}": span for name, span in self.spans.items()},
            "stated_confidence": COVERAGE,
            "flops_ratio_to": yardstick.name,
            "groups": rows,
            "floor": floor,
            "notes": self.notes(),
        }

    def _scores(self, group: Group) -> list[dict[str, Any]]:
        rows = []
        for index, horizon in enumerate(self.horizons_s):
            each = [run.judgements[index].scores for run in group.runs]
            row = {name: _mean(np.array([scores[name] for scores in each])) for name in each[0]}
            rows.append({"horizon_s": horizon, **row})
        return rows


def _mean(values: Float[np.ndarray, "seeds"]) -> dict[str, Any]:
    return {"mean": float(values.mean()), "interval": interval(values)}


def half_width_of(surrogate: FreeRunner) -> HalfWidth | None:
    """What states a surrogate's intervals of the mean force; None of a kind that states none."""
    stated = getattr(surrogate, "interval", None)
    return None if stated is None else stated.half_width


def compare(
    found: Sequence[Candidate],
    logs: Sequence[Log],
    config: CompareConfig,
    floor: tuple[str, Plant] | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> Comparison:
    """Leave every surrogate alone over the same stretches of the logs, and score it; `floor`: a plant by its name.

    Raises:
        LogError: a log is shorter than the longest horizon behind the rows that a surrogate needs to be warm.
        CommandError: the plant of the floor does not take the commands of the logs.
        PlantError: a prediction is no finite number.
    """
    ticks = [round(horizon * RATE_HZ) for horizon in config.horizons_s]
    first = max(candidate.surrogate.memory for candidate in found)
    counts = [len(log.reading.time) for log in logs]
    # The longest first: it is the one that a log may be too short for.
    stretches = [places(counts, each, first) for each in reversed(ticks)][::-1]
    spans = ranges(logs)
    measured = [take(logs, where, each) for where, each in zip(stretches, ticks, strict=True)]
    of, done = len(found) * len(ticks) + (floor is not None), 0

    def report(note: str) -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done / of, note)

    def run(candidate: Candidate) -> Run:
        judgements = []
        for where, each, actual, horizon in zip(stretches, ticks, measured, config.horizons_s, strict=True):
            reading, members = free_running(candidate.surrogate, logs, where, each, config.batch)
            judgements.append(judge(actual, reading, spans, members, half_width_of(candidate.surrogate)))
            report(f"{candidate.folder}, {horizon:g} s")
        return Run(judgements, reading)

    grouped: dict[str, list[Candidate]] = {}
    for candidate in found:
        grouped.setdefault(candidate.group, []).append(candidate)
    names = names_of(list(grouped.values()))
    groups = [
        Group(name, members[0].surrogate.model, members, [run(member) for member in members])
        for name, members in zip(names, grouped.values(), strict=True)
    ]
    bottom = None
    if floor is not None:
        name, plant = floor
        whole = from_rest(plant, logs, key_of(config.seed, "compare/floor"))
        readings = [take(whole, where, each) for where, each in zip(stretches, ticks, strict=True)]
        judged = [judge(actual, reading, spans) for actual, reading in zip(measured, readings, strict=True)]
        bottom = Group(f"second recording ({name})", name, [], [Run(judged, readings[-1])])
        report(f"second recording ({name})")
    scored = [
        {"stretches": len(where), "rows": len(where) * each, "rows_left": sum(counts) - len(where) * each}
        for where, each in zip(stretches, ticks, strict=True)
    ]
    beyond = [beyond_limits(group.members, logs) for group in groups]
    return Comparison(config.horizons_s, groups, bottom, measured[-1], scored, spans, beyond)
