"""Compare figures of one seed with the stated ones: does each lie where one further seed is
expected?

Over n >= 3 stated values the interval for one further value is mean +- t(n - 1, 0.975) s sqrt(1 +
1/n). The interval of the mean, which documents print, is sqrt(n + 1) times as narrow and would
reject most single seeds.

One figure in twenty lies outside such an interval by chance: of a pair both axes have to lie
inside, so the interval of each is wider. Two limits therefore hold for a whole run: the number of
figures outside, and a figure outside that has changed by more than a factor of three.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.stats import binom

from results.record import Value
from softfin.core.window import CONFIDENCE, FEWEST, interval

TOLERANCE = 0.05
"""Relative tolerance of a figure whose stated values do not differ, or are fewer than `FEWEST`."""

FALSE_ALARM = 0.01
"""Chance that a correct program exceeds the number of figures outside."""

FAR = 3.0
"""Factor to the stated values beyond which a figure outside its interval is far outside."""

Verdict = Literal["inside", "outside", "missing", "not judged"]


class Comparison(NamedTuple):
    """A figure of one seed and its verdict."""

    verdict: Verdict
    unit: str
    values: list[Value]
    intervals: list[tuple[float, float]]
    """Interval of a further value, for each axis."""
    is_far: bool = False
    """Whether a figure outside is beyond a factor of `FAR` of the stated values."""


def compare_figures(
    stated: Mapping[str, Mapping[str, Any]],
    measured: Mapping[str, Mapping[str, Any]],
    digits: Mapping[str, float],
    default_digit: float,
) -> dict[str, Comparison]:
    """Compare all figures of a part by name; `digits` are the last printed ones."""
    comparisons = {}
    for name, figure in stated.items():
        if name in measured:
            comparisons[name] = compare(figure, measured[name], digits.get(name, default_digit))
        else:
            comparisons[name] = Comparison("missing", figure["unit"], [], [])
    for name in measured.keys() - stated.keys():
        comparisons[name] = Comparison(
            "not judged", measured[name]["unit"], measured[name]["values"], []
        )
    return comparisons


def allowed_outside(judged: int) -> int:
    """Return how many of the judged figures of a correct program lie outside at most.

    Figures are taken as independent. Those of one training are not, so the chance of a false alarm
    is somewhat larger.
    """
    return int(binom.ppf(1 - FALSE_ALARM, judged, 1 - CONFIDENCE))


def compare(stated: Mapping[str, Any], measured: Mapping[str, Any], digit: float) -> Comparison:
    """Compare one figure; each measured value must lie inside on each axis."""
    values = measured["values"]
    stated_axes = split_axes(stated["values"])
    confidence = CONFIDENCE ** (1 / max(len(stated_axes), 1))
    intervals = [
        further_interval(axis, stated["summary"], digit, confidence) for axis in stated_axes
    ]
    if stated.get("machine_dependent") or measured.get("machine_dependent"):
        return Comparison("not judged", measured["unit"], values, intervals)
    if not values:
        return Comparison("missing", stated["unit"], [], intervals)
    if all(lies_within(value, stated["values"], intervals) for value in values):
        verdict: Verdict = "inside"
    else:
        verdict = "outside" if can_be_outside(stated, measured["seeds"]) else "not judged"
    is_far = verdict == "outside" and is_far_from(stated["values"], values)
    return Comparison(verdict, measured["unit"], values, intervals, is_far)


def can_be_outside(stated: Mapping[str, Any], seeds: Sequence[int]) -> bool:
    """Return whether the stated values tell what to expect of some seeds: they have an interval, or
    are repeated."""
    nulls = sum(value is None for value in stated["values"])
    numbers = len(stated["values"]) - nulls
    if numbers >= FEWEST or numbers == 0:
        return True
    return nulls == 0 and set(seeds) <= set(stated["seeds"])


def is_far_from(stated: Sequence[Value], values: Sequence[Value]) -> bool:
    """Return whether a number on some axis is not within a factor of `FAR` of those stated."""
    for axis, numbers in zip(split_axes(values), split_axes(stated), strict=False):
        magnitudes = np.abs(axis)
        stated_magnitudes = np.abs(numbers)
        if (
            magnitudes.max() > FAR * stated_magnitudes.max()
            or magnitudes.min() < stated_magnitudes.min() / FAR
        ):
            return True
    return False


def lies_within(
    value: Value, stated: Sequence[Value], intervals: Sequence[tuple[float, float]]
) -> bool:
    """Return whether a value lies in the interval of each axis; null is a force that never
    settled."""
    if value is None:
        return None in stated
    axes = np.atleast_1d(value)
    return len(axes) == len(intervals) and all(
        low <= axis <= high for axis, (low, high) in zip(axes, intervals, strict=True)
    )


def split_axes(values: Sequence[Value]) -> list[list[float]]:
    """Return the numbers of each axis of values that are numbers, pairs or null; no axes if all are
    null."""
    numbers = [value for value in values if value is not None]
    if not numbers:
        return []
    axes = np.atleast_2d(np.asarray(numbers, float).T)
    return [axis.tolist() for axis in axes]


def further_interval(
    values: Sequence[float], summary: str, digit: float, confidence: float = CONFIDENCE
) -> tuple[float, float]:
    """Return the interval for one further value; a worst case has no lower end."""
    mean = sum(values) / len(values)
    margin = further_margin(values, confidence)
    low = mean - margin
    high = mean + margin
    if margin < digit:
        margin = max(TOLERANCE * abs(mean), digit)
        low = min(values) - margin
        high = max(values) + margin
    if summary == "worst":
        return -math.inf, max(values) + margin
    return low, high


def further_margin(values: Sequence[float], confidence: float = CONFIDENCE) -> float:
    """Return t s sqrt(1 + 1/n), which is sqrt(n + 1) times the margin of the mean; 0 for fewer than
    three values."""
    mean_interval = interval(np.asarray(values), confidence)
    if mean_interval is None:
        return 0.0
    return math.sqrt(len(values) + 1) * (mean_interval[1] - mean_interval[0]) / 2
