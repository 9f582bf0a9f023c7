"""Write the ``report.html`` of a run: tables, figures, learning curves, configuration, provenance.

The page is self-contained and needs no network. Sections without data are omitted.
"""

import base64
import importlib.resources
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import jinja2
import numpy as np
import yaml
from jaxtyping import Float
from matplotlib.figure import Figure

from softfin.core.quantities import AXES, RATE_HZ
from softfin.evaluation.figures import add_legend
from softfin.evaluation.headline import error_decimals, headline, over_seeds
from softfin.evaluation.results import (
    AxisScores,
    EvaluationSummary,
    MeanScores,
    MovingRow,
    RunResults,
)
from softfin.evaluation.scores import SETTLED_N
from softfin.storage import artifact as artifacts
from softfin.storage.figures import (
    BLACK,
    BLUE,
    new_figure,
    styled,
    with_minus_signs,
)

Figures = Mapping[str, Path]
"""Files (.png) by caption."""

PARTS = ("headline", "surrogate", "learning", "experiment", "moving")
"""Sections of the report that can have figures."""


def write_report(
    path: Path, results: RunResults, figures: Mapping[str, Figures] = MappingProxyType({})
) -> None:
    """Write the report with the `figures` of each section in `PARTS`; sections without results are
    omitted."""
    controllers = results.get("controllers") or {}
    configuration = results.get("configuration")
    scores = (results.get("surrogate") or {}).get("scores") or {}
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True
    )
    environment.filters["number"] = _number
    environment.filters["capitalize_first"] = lambda text: text[:1].upper() + text[1:]
    conditions = None
    has_intervals = False
    if controllers:
        # All controllers of a run are evaluated under the same conditions.
        summary = next(iter(controllers.values()))
        conditions = summary["conditions"]
        has_intervals = summary["references"][0]["x"]["error_interval_n"] is not None
    template = (
        importlib.resources.files("softfin.evaluation")
        .joinpath("report.html.jinja")
        .read_text("utf-8")
    )
    page = environment.from_string(template).render(
        title=results.get("title", "softfin: force control of a soft fin"),
        plant=results.get("plant"),
        headline=headline(results),
        stages=results.get("stages") or [],
        overview=_overview(results),
        settled=SETTLED_N if conditions is None else conditions.get("settled_n", SETTLED_N),
        intervals=has_intervals,
        table_one=list(scores.values()),
        tables_two=_tables_two(controllers),
        in_surrogate=_tables_two(results.get("in_surrogate") or {}),
        conditions=conditions,
        **{f"{part}_figures": _encode(figures.get(part, {})) for part in PARTS},
        configuration=yaml.safe_dump(configuration, sort_keys=False, allow_unicode=True)
        if configuration
        else None,
        provenance=results.get("provenance"),
    )
    artifacts.write_file(path, page)


def _number(value: float) -> str:
    """Format with three significant digits, as in the paper, and without an exponent for common
    magnitudes."""
    return f"{value:#.3g}" if 1e-4 <= abs(value) < 1000 else f"{value:.3g}"


class Cell(NamedTuple):
    """A mean over the seeds [N], and a text about their spread."""

    mean: float
    over_seeds: str
    decimals: int
    reading: float | None = None
    """Mean of the same score, computed from the sensor readings [N]."""


class TableRow(NamedTuple):
    """One row of Table II."""

    label: str
    cells: list[Cell]
    """x error, x std, y error, y std."""
    raw_std_n: list[float]
    """x, y."""
    travel: float
    still: bool


class OverviewRow(NamedTuple):
    """Scores of one controller in the plant, with force feedback, and in the surrogate."""

    name: str
    errors: list[list[Cell] | None]
    settling: list[str | None]


def _tables_two(summaries: Mapping[str, EvaluationSummary]) -> dict[str, list[TableRow]]:
    return {name: _table_two(summary) for name, summary in summaries.items()}


def _table_two(summary: EvaluationSummary) -> list[TableRow]:
    decimals = error_decimals(summary)
    rows = []
    for row in summary["references"]:
        label = _force(row["reference_n"])
        rows.append(_table_row(label, row, decimals, row.get("still", False)))
    rows.append(_table_row("mean", summary["mean"], decimals))
    return rows


def _table_row(label: str, row: MeanScores, decimals: int, still: bool = False) -> TableRow:
    # In the order of the columns: x error, x std, y error, y std.
    cells = []
    for axis in AXES:
        cells += [_error_cell(row[axis], decimals), _std_cell(row[axis], decimals)]
    raw_std_n = [row[axis]["raw_std_n"] for axis in AXES]
    return TableRow(label, cells, raw_std_n, row["shaft_travel_rad_s"], still)


def _error_cell(scores: AxisScores, decimals: int) -> Cell:
    text = over_seeds(scores["error_interval_n"], scores["error_seeds_n"], decimals)
    return Cell(scores["error_n"], text, decimals, scores.get("reading_error_n"))


def _std_cell(scores: AxisScores, decimals: int) -> Cell:
    text = over_seeds(scores["std_interval_n"], scores["std_seeds_n"], decimals)
    return Cell(scores["std_n"], text, decimals)


def _overview(results: RunResults) -> list[OverviewRow]:
    """Return one row per controller: mean errors and settling times in the plant, with force
    feedback, and in the surrogate (errors only)."""
    rows = []
    parts = (results.get("controllers"), results.get("trimmed"), results.get("in_surrogate"))
    for name in parts[0] or {}:
        errors: list[list[Cell] | None] = []
        settling = []
        for part in parts:
            summary = (part or {}).get(name)
            cells = None
            if summary:
                decimals = error_decimals(summary)
                cells = [_error_cell(summary["mean"][axis], decimals) for axis in AXES]
            errors.append(cells)
            settling.append(summary and _settling(summary.get("moving", [])))
        rows.append(OverviewRow(name, errors, settling[:2]))
    return rows


def _settling(rows: Iterable[MovingRow]) -> str | None:
    """Return the longest settling time over all steps and seeds, or "never" if a step does not
    settle; None without steps."""
    times = [row["longest_settling_s"] for row in rows if row["settles"] is not None]
    if not times:
        return None
    settled = [time for time in times if time is not None]
    return f"{max(settled):.1f} s" if settled == times else "never"


def _force(reference: Iterable[float | int]) -> str:
    return with_minus_signs(f"({', '.join(f'{value:g}' for value in reference)})")


def _encode(figures: Figures) -> dict[str, str]:
    return {
        caption: base64.b64encode(file.read_bytes()).decode() for caption, file in figures.items()
    }


def prediction_figure(
    measured: Float[np.ndarray, "ticks 2"],
    predicted: Mapping[str, Float[np.ndarray, "ticks 2"]],
    start_s: float = 0.0,
) -> Figure:
    """Draw the measured force and the named predictions at 100 Hz, starting at `start_s` [s]."""
    time = start_s + np.arange(len(measured)) / RATE_HZ
    with styled():
        figure = new_figure(9, 4.2)
        panels = figure.subplots(2, 1, sharex=True)
        for index, axes in enumerate(panels):
            axes.plot(time, measured[:, index], color="#BBBBBB", linewidth=2.6, label="measured")
            for (name, force), (line, colour) in zip(
                predicted.items(), (("-", BLUE), ("--", BLACK)), strict=False
            ):
                axes.plot(time, force[:, index], line, color=colour, label=name, linewidth=1.1)
            axes.set_ylabel(f"force {AXES[index]} [N]")
        axes.set(xlabel="time [s]", xlim=(time[0], time[-1]))
        add_legend(figure, [axes], "outside upper center")
    return figure
