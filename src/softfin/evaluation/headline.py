"""Summarize a run in one sentence: does the controller reach the target forces?"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from softfin.core.quantities import AXES
from softfin.evaluation.results import (
    EvaluationSummary,
    MeanScores,
    ReferenceScores,
    RunResults,
)
from softfin.evaluation.scores import SETTLED_N
from softfin.gaits.reachable import force_decimals
from softfin.storage.figures import with_minus_signs


class Headline(NamedTuple):
    """Best controller of a run, by mean error in the plant, and its outcome."""

    controller: str
    """Kind of controller."""
    sentence: str
    """Outcome: whether the controller holds the references."""
    caption: str
    """Caption of the figure."""
    holds: bool
    """Whether the error at every reference is at most the band within which a force is settled, on
    both axes."""


def headline(results: RunResults) -> Headline | None:
    """Choose the best controller in a run's ``results.json``, with force feedback if evaluated;
    None without controllers.

    A controller that leaves the fin at rest ranks last, no matter how small its error is.
    """
    evaluated = results.get("trimmed") or results.get("controllers")
    if not evaluated:
        return None

    def still_or_error(item: tuple[str, EvaluationSummary]) -> tuple[bool, float]:
        return any(row["still"] for row in item[1]["references"]), greatest_error(item[1]["mean"])

    name, summary = min(evaluated.items(), key=still_or_error)
    (still, _) = still_or_error((name, summary))
    rows = summary["references"]
    settled_n = summary["conditions"].get("settled_n", SETTLED_N)
    decimals = error_decimals(summary) - 1
    plain = results["controllers"][name] if results.get("trimmed") else None
    too_far = _missed_references(rows, settled_n)
    if still:
        sentence = (
            "The fin does not move at some of the target forces, so this controller does not work"
        )
    elif too_far:
        worst = max(too_far, key=lambda reference: too_far[reference])
        force = with_minus_signs(f"({worst[0]:g}, {worst[1]:g})")
        held = len(rows) - len(too_far)
        sentence = (
            f"The fin holds {held} of {len(rows)} forces within {settled_n:g} N on average; it "
            f"misses {force} N by {too_far[worst]:.{decimals}f} N"
        )
    else:
        forces = f"each of {len(rows)} forces" if len(rows) > 1 else "the force"
        error = max(map(greatest_error, rows))
        sentence = f"The fin holds {forces} within {within(error, decimals)} N on average"
        if plain is not None:
            before = max(map(greatest_error, plain["references"]))
            sentence += f"; without force feedback, within {within(before, decimals)} N"
    seconds = summary["conditions"]["duration_s"]
    window = summary["conditions"]["window_samples"]
    rate = summary["conditions"]["rate_hz"]
    caption = (
        f"Mean force over the last {window / rate:g} s (lines) and target force (dashed, with a "
        f"band of ±{settled_n:g} N), starting from rest, for {seconds} s: controller "
        f"{name}{', with force feedback' if plain is not None else ''}, the first of "
        f"{summary['conditions']['seeds']} runs."
    )
    return Headline(name, f"{sentence}.", caption, not too_far and not still)


def _missed_references(
    rows: Sequence[ReferenceScores], settled_n: float
) -> dict[tuple[float | int, ...], float | int]:
    """Return the references with an error above `settled_n`, with the error [N]."""
    errors = {}
    for row in rows:
        error = greatest_error(row)
        if error > settled_n:
            errors[tuple(row["reference_n"])] = error
    return errors


def greatest_error(row: MeanScores) -> float:
    """Return the larger of the two axes' errors [N]."""
    return max(row[axis]["error_n"] for axis in AXES)


def error_decimals(summary: EvaluationSummary) -> int:
    """Return the number of decimals with which to show errors [N]: one more than for the
    references."""
    forces = [abs(force) for row in summary["references"] for force in row["reference_n"]]
    return force_decimals(max(forces)) + 1


def within(error_n: float, decimals: int = 2) -> str:
    """Return the error rounded up to these decimals, so that it is a valid upper bound."""
    # Round first: 100 * 0.07 is 7.000000000000001, which would become 0.08.
    units = 10**decimals
    return f"{math.ceil(round(units * error_n, 6)) / units:.{decimals}f}"


def over_seeds(interval: list[float] | None, values: Sequence[float], decimals: int = 3) -> str:
    """Return the text that follows a mean over seeds: half the interval, the range of the values if
    there are two seeds, or nothing for one seed."""
    if interval is not None:
        return f"±{(interval[1] - interval[0]) / 2:.{decimals - 1}f}"
    return (
        f"({min(values):.{decimals}f} to {max(values):.{decimals}f})"
        if len(set(values)) > 1
        else ""
    )
