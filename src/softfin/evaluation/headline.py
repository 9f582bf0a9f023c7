"""Texts about the scores of a run: the outcome in one sentence, and the spread over seeds."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from softfin.core.printable import with_minus_signs
from softfin.core.quantities import AXES
from softfin.evaluation.results import EvaluationSummary, MeanScores, MovingRow, RunResults
from softfin.gaits.reachable import force_decimals


class Headline(NamedTuple):
    """Best controller of a run (by mean error in the plant) and its outcome."""

    controller: str
    """Kind of controller."""
    sentence: str
    """Outcome in one sentence: whether the controller holds the references."""
    holds: bool
    """Whether the error at every reference is within the settled band on both axes."""


def headline(results: RunResults) -> Headline | None:
    """Choose the best controller in the ``results.json`` of a run, with force feedback if
    evaluated; None if there are no controllers.

    A controller that leaves the fin at rest ranks last, however small its error is.
    """
    evaluated = results.get("with_feedback") or results.get("controllers")
    if not evaluated:
        return None
    name = min(
        evaluated, key=lambda kind: (_is_still(evaluated[kind]), _error(evaluated[kind]["mean"]))
    )
    summary = evaluated[name]
    rows = summary["references"]
    settled_n = summary["conditions"]["settled_n"]
    decimals = error_decimals(summary) - 1
    worst = max(rows, key=_error)
    num_held = sum(_error(row) <= settled_n for row in rows)
    if _is_still(summary):
        sentence = (
            "The fin does not move at some of the target forces, so this controller does not work."
        )
    elif num_held < len(rows):
        x, y = worst["reference_n"]
        sentence = with_minus_signs(
            f"The fin holds {num_held} of {len(rows)} forces within {settled_n:g} N on average; it "
            f"misses ({x:g}, {y:g}) N by {_error(worst):.{decimals}f} N."
        )
    else:
        sentence = (
            f"The fin holds each of {len(rows)} forces within {within(_error(worst), decimals)} N "
            "on average."
        )
    return Headline(name, sentence, num_held == len(rows) and not _is_still(summary))


def _is_still(summary: EvaluationSummary) -> bool:
    return any(row["still"] for row in summary["references"])


def _error(row: MeanScores) -> float:
    """Return the larger error of the two axes [N]."""
    return max(row[axis]["error_n"] for axis in AXES)


def error_decimals(summary: EvaluationSummary) -> int:
    """Return the number of decimals for displaying errors [N]: one more than for references."""
    forces = [abs(force) for row in summary["references"] for force in row["reference_n"]]
    return force_decimals(max(forces)) + 1


def within(error_n: float, decimals: int = 2) -> str:
    """Return the error, rounded up to a number of decimals so that it is a valid upper bound."""
    # Round first: 100 * 0.07 is 7.000000000000001, which would become 0.08.
    units = 10**decimals
    return f"{math.ceil(round(units * error_n, 6)) / units:.{decimals}f}"


def over_seeds(interval: list[float] | None, values: Sequence[float], decimals: int = 3) -> str:
    """Return the text after a mean over seeds: half the interval, the range of the values for two
    seeds, or nothing for one seed."""
    if interval is not None:
        return f"±{(interval[1] - interval[0]) / 2:.{decimals - 1}f}"
    if len(set(values)) > 1:
        return f"({min(values):.{decimals}f} to {max(values):.{decimals}f})"
    return ""


def settling_time(row: MovingRow) -> str:
    """Return the longest settling time of the steps of a moving reference over all seeds; empty if
    there are no steps."""
    if row["settles"] is None:
        return ""
    return f"{row['longest_settling_s']:.1f} s" if row["settles"] else "never"
