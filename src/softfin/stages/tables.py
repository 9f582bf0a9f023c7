"""Tables as text for a terminal: aligned columns, and the two tables of the paper."""

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import Any

from softfin.core.json_object import JsonObject
from softfin.core.power import describe_powers, power_cells, power_kind
from softfin.core.quantities import AXES
from softfin.evaluation.headline import error_decimals, over_seeds, settling_time
from softfin.evaluation.paper import PAPER_PRINTED_MEANS, PAPER_TABLE_I, PAPER_TABLE_II
from softfin.evaluation.results import (
    EvaluationSummary,
    MeanScores,
    MovingRow,
    RangeErrors,
)

TABLE_TWO_TITLES = ("x error", "x std", "y error", "y std")


def aligned(rows: Sequence[Sequence[object]], left: Sequence[int] = (0,)) -> list[str]:
    """Return one line per row, with columns as wide as necessary; columns in `left` are
    left-aligned."""
    columns = zip_longest(*rows, fillvalue="")
    widths = [max(map(len, map(str, column))) for column in columns]
    lines = []
    for row in rows:
        line = ""
        for index, cell in enumerate(row):
            line += f"{cell!s:{'<' if index in left else '>'}{widths[index]}}  "
        lines.append(line.rstrip())
    return lines


def format_table_one(scores: JsonObject) -> str:
    """Return Table I in physical and scaled units."""
    rows: list[list[object]] = [["Table I", "window", "parameters", "", "RMSE", "MAE", "DTW"]]
    for row in scores.values():
        titles = [row["title"], row["window"] or "-", f"{row['parameters']:,}"]
        for unit, label in (("physical", titles), ("scaled", ["", "", ""])):
            measure = row["unit"] if unit == "physical" else "scaled"
            errors = row[unit]
            scored = (errors["rmse"], errors["mae"], errors["dtw_mae"])
            rows.append([*label, measure, *map("{:.4f}".format, scored)])
    return "\n".join(aligned(rows))


def table_two(controllers: Mapping[str, EvaluationSummary]) -> str:
    """Return Table II: error and standard deviation of the 200-sample moving average.

    Each error is followed by half of its 95% interval over the seeds, or by both values if there
    are two seeds.
    """
    lines = []
    for name, summary in controllers.items():
        decimals = error_decimals(summary)
        powers = summary["mean"].get("power", {})
        kind = power_kind(powers)
        titles = (*TABLE_TWO_TITLES, *(("power W", "N/W") if kind else ()))
        rows = [[f"Table II, {name}", *titles]]
        notes = [""]
        for row in summary["references"]:
            x, y = row["reference_n"]
            rows.append(
                [
                    f"  ({x:5.{decimals - 1}f}, {y:5.{decimals - 1}f}) N",
                    *_scores(row, decimals, kind),
                ]
            )
            notes.append(
                ("  does not move" if row["still"] else "")
                + format_reference_errors(row, decimals - 1)
            )
        rows.append(["  mean", *_scores(summary["mean"], decimals, kind)])
        lines += [line + note for line, note in zip(aligned(rows), [*notes, ""], strict=True)]
        lines += [
            f"  {line}" for line in (describe_errors(summary), describe_powers(powers)) if line
        ]
    return "\n".join(lines)


def format_paper_tables() -> str:
    """Return the tables of the paper."""
    titles = ["window", "parameters", "RMSE", "MAE", "DTW"]
    networks: list[list[object]] = [["Table I of the paper", *titles]]
    for name, row in PAPER_TABLE_I.items():
        networks.append([f"  {name}", *row.values()])
    errors = [["Table II of the paper", *TABLE_TWO_TITLES]]
    for name, references in PAPER_TABLE_II.items():
        for (x, y), scores in references.items():
            errors.append([f"  {name}, ({x}, {y}) N", *map("{:.3f}".format, scores)])
        means = PAPER_PRINTED_MEANS[name]
        errors.append([f"  {name}, mean", *map("{:.3f}".format, means)])
    note = "measured on the real fin; do not compare these errors with simulated ones"
    return "\n".join([*aligned(networks), *aligned(errors), f"  {note}"])


def describe_errors(summary: EvaluationSummary) -> str:
    """Return one line that states which force the errors refer to, the error of the readings if it
    differs, and the errors as a percentage of the fin reach."""
    mean = summary["mean"]
    reach_n = summary["conditions"].get("reach_n")
    share = ""
    if reach_n:
        x, y = (100 * mean[axis]["error_n"] / reach_n for axis in AXES)
        share = f"; {x:.2g}%, {y:.2g}% of the fin reach of {reach_n:.2g} N"
    if summary["conditions"].get("judged_by") != "true force":
        return (
            "errors are relative to the measured force; errors in the sensor itself do not show up"
            + share
        )
    decimals = error_decimals(summary)
    x, y = (mean[axis]["reading_error_n"] for axis in AXES)
    return (
        "errors are relative to the true force; the mean error of the readings is "
        f"{x:.{decimals}f}, {y:.{decimals}f} N{share}"
    )


def _scores(row: MeanScores, decimals: int, kind: str) -> list[str]:
    """Return the scores of a row; `kind` is that of the powers, or empty without powers."""
    cells = []
    for axis in AXES:
        interval = row[axis]["error_interval_n"]
        errors = row[axis]["error_seeds_n"]
        error = f"{row[axis]['error_n']:.{decimals}f} {over_seeds(interval, errors, decimals)}"
        cells += [error.rstrip(), f"{row[axis]['std_n']:.{decimals}f}"]
    return [*cells, *power_cells(row.get("power", {}), kind)] if kind else cells


def format_reference_errors(row: Mapping[str, Any], decimals: int = 2) -> str:
    """Return a note if the controller tracks a force other than the requested one."""
    held = row.get("tracked_reference_n") or row["reference_n"]
    change_n = max(abs(a - b) for a, b in zip(held, row["reference_n"], strict=True))
    # Files contain rounded forces.
    if change_n < 0.1 * 10.0**-decimals:
        return ""
    x, y = (f"{force:.{decimals}f}" for force in held)
    return f"  unreachable: tracks ({x}, {y}) N instead"


def evaluation_tables(summary: EvaluationSummary) -> str:
    """Return Table II, followed by the parts of the evaluation that were requested."""
    decimals = error_decimals(summary)
    lines = [table_two({summary["conditions"]["kind"]: summary})]
    if "feedback" in summary:
        found = summary["feedback"]
        x, y = found["half_width_n"]
        share = "" if found["coverage"] is None else f", which held in {found['coverage']:.0%}"
        lines.append(
            f"  feedback: 90% interval of the true mean force +-{x:.{decimals}f}, "
            f"+-{y:.{decimals}f} N{share}; level {found['level']:.1f}"
        )
    if "moving" in summary:
        lines.append(moving_table(summary["moving"], decimals))
    if "random" in summary:
        count = len(summary["random"]["errors_n"])
        errors = _range_errors(summary["random"], decimals)
        lines.append(f"{count} random references: {errors}")
    if summary["warning"] is not None:
        lines.append(f"warning: {summary['warning']}")
    return "\n".join(lines)


def benchmark_table(summary: JsonObject) -> str:
    """Return the scores of a benchmark."""
    cases = summary["cases"]
    constant = cases["references"]
    decimals = error_decimals(constant)
    name = summary["conditions"]["kind"] + " with feedback" * summary["conditions"]["feedback"]
    lines = [table_two({f"{name}, benchmark {summary['protocol_version']}": constant})]
    if "rows" in cases["moving"]:
        lines.append(moving_table(cases["moving"]["rows"], decimals))
    rows = [["other fins", "x error", "y error"]]
    for row in cases["perturbed"]:
        errors = [f"{row['mean'][axis]['error_n']:.{decimals}f}" for axis in AXES]
        rows.append([f"  tanks perturbed by {row['width']:.0%}", *errors])
    for row in cases["changed"]:
        errors = [f"{rms_n:.{decimals}f}" for rms_n in row["rms_n"]]
        rows.append([f"  changed fin, after {row['after_s']} s (rms)", *errors])
    rows.append(["frequency response", "turn", "pulse", "window"])
    responses = (cases["frequency"].get(motion, ()) for motion in ("turn", "pulse"))
    for turn, pulse in zip(*responses, strict=True):
        gains = [f"{row['gain']:.3f}, {row['phase_deg']:.0f} deg" for row in (turn, pulse)]
        rows.append([f"  {turn['rate_hz']:g} Hz", *gains, f"{turn['window_gain']:.3f}"])
    lines += aligned(rows)
    for case in (cases["moving"], cases["frequency"]):
        lines += [f"warning: {text}" for text in case.get("warnings", [case.get("not_covered")])]
    if constant["warning"] is not None:
        lines.append(f"warning: {constant['warning']}")
    if not summary["is_standard"]:
        lines.append("warning: the protocol was changed; do not compare these scores with others")
    return "\n".join(lines)


def moving_table(rows: Sequence[MovingRow], decimals: int) -> str:
    """Return one line per moving reference with the errors and the longest settling time over all
    seeds."""
    cells = [["moving references", "x error", "y error", "settles in"]]
    for row in rows:
        errors = [f"{row[axis]['error_n']:.{decimals}f}" for axis in AXES]
        cells.append([f"  {row['described']}", *errors, settling_time(row) or "-"])
    return "\n".join(aligned(cells))


def _range_errors(errors: RangeErrors, decimals: int) -> str:
    """Return the errors at many references as text."""
    mean, p95, worst = (
        ", ".join(f"{error:.{decimals}f}" for error in pair)
        for pair in (errors["mean_n"], errors["p95_n"], errors["worst_n"])
    )
    return f"error x, y mean {mean}, 95% within {p95}, worst {worst} N"
