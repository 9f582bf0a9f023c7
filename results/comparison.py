"""Compare figures of one seed with the stated ones: does each lie where one further seed is expected?

Over n >= 3 stated values the interval for one further value is mean +- t(n - 1, 0.975) s sqrt(1 + 1/n). The interval of
the mean, which documents print, is sqrt(n + 1) times as narrow and would reject most single seeds.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from results.record import Value
from softfin.core.window import interval

TOLERANCE = 0.05
"""Relative tolerance of a figure whose stated values do not differ, or are fewer than three."""

Verdict = Literal["inside", "outside", "missing", "not judged"]


class Comparison(NamedTuple):
    """A figure of one seed and its verdict."""

    verdict: Verdict
    unit: str
    values: list[Value]
    intervals: list[tuple[float, float]]
    """Interval of a further value, for each axis."""


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
        comparisons[name] = Comparison("not judged", measured[name]["unit"], measured[name]["values"], [])
    return comparisons


def compare(stated: Mapping[str, Any], measured: Mapping[str, Any], digit: float) -> Comparison:
    """Compare one figure; each measured value must lie inside on each axis."""
    values = measured["values"]
    stated_axes = split_axes(stated["values"])
    intervals = [further_interval(axis, stated["summary"], digit) for axis in stated_axes]
    if stated.get("machine_dependent") or measured.get("machine_dependent"):
        return Comparison("not judged", measured["unit"], values, intervals)
    if not values:
        return Comparison("missing", stated["unit"], [], intervals)
    # null is a result as well: a force that never settled.
    is_inside = None not in values or None in stated["values"]
    measured_axes = split_axes(values)
    if measured_axes and len(measured_axes) != len(stated_axes):
        is_inside = False
    for (low, high), axis in zip(intervals, measured_axes, strict=False):
        for value in axis:
            is_inside = is_inside and low <= value <= high
    return Comparison("inside" if is_inside else "outside", measured["unit"], values, intervals)


def split_axes(values: Sequence[Value]) -> list[list[float]]:
    """Return the numbers of each axis of values that are numbers, pairs or null; no axes if all are null."""
    numbers = [value for value in values if value is not None]
    if not numbers:
        return []
    axes = np.atleast_2d(np.asarray(numbers, float).T)
    return [axis.tolist() for axis in axes]


def further_interval(values: Sequence[float], summary: str, digit: float) -> tuple[float, float]:
    """Return the interval for one further value; a worst case has no lower end."""
    mean = sum(values) / len(values)
    margin = further_margin(values)
    low = mean - margin
    high = mean + margin
    if margin < digit:
        margin = max(TOLERANCE * abs(mean), digit)
        low = min(values) - margin
        high = max(values) + margin
    if summary == "worst":
        return -math.inf, max(values) + margin
    return low, high


def further_margin(values: Sequence[float]) -> float:
    """Return t s sqrt(1 + 1/n), which is sqrt(n + 1) times the margin of the mean; 0 for fewer than three values."""
    mean_interval = interval(np.asarray(values))
    if mean_interval is None:
        return 0.0
    return math.sqrt(len(values) + 1) * (mean_interval[1] - mean_interval[0]) / 2
