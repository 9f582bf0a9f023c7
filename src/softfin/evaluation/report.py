"""Writes the ``report.html`` of a run: tables, figures, learning curves, configuration and
provenance.

The report is self-contained and needs no network connection. Sections without data are omitted.
"""

import base64
import importlib.resources
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import jinja2
import numpy as np
import yaml
from jaxtyping import Float
from matplotlib.figure import Figure

from softfin.core.power import describe_powers, power_cells, power_kind
from softfin.core.printable import with_minus_signs
from softfin.core.quantities import AXES, RATE_HZ
from softfin.evaluation.figures import add_legend
from softfin.evaluation.headline import error_decimals, headline, over_seeds, settling_time
from softfin.evaluation.results import RunResults
from softfin.storage import artifact as artifacts
from softfin.storage.figures import (
    BLACK,
    BLUE,
    new_figure,
    styled,
)

Figures = Mapping[str, Path]
"""Figure files (.png), keyed by caption."""

PARTS = ("fin", "surrogate", "learning", "experiment", "moving")
"""Sections of the report that can have figures."""


def write_report(
    path: Path, results: RunResults, figures: Mapping[str, Figures] = MappingProxyType({})
) -> None:
    """Write the report with the `figures` of each section in `PARTS`; sections without results are
    omitted."""
    controllers = results.get("controllers") or {}
    configuration = results.get("configuration")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True
    )
    environment.filters["number"] = _number
    environment.filters["minus"] = with_minus_signs
    environment.filters["capitalize_first"] = lambda text: text[:1].upper() + text[1:]
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
        table_one=list(((results.get("surrogate") or {}).get("scores") or {}).values()),
        controllers=controllers,
        with_feedback=results.get("with_feedback") or {},
        in_surrogate=results.get("in_surrogate") or {},
        # All controllers of a run are evaluated under the same conditions.
        conditions=next((each["conditions"] for each in controllers.values()), None),
        error_decimals=error_decimals,
        over_seeds=over_seeds,
        settling_time=settling_time,
        power_kind=power_kind,
        power_cells=power_cells,
        describe_powers=describe_powers,
        **{f"{part}_figures": _encode(figures.get(part, {})) for part in PARTS},
        configuration=configuration
        and yaml.safe_dump(configuration, sort_keys=False, allow_unicode=True),
        provenance=results.get("provenance"),
    )
    artifacts.write_file(path, page)


def _number(value: float) -> str:
    """Format a number with three significant digits, as in the paper, and without an exponent for
    common magnitudes."""
    return f"{value:#.3g}" if 1e-4 <= abs(value) < 1000 else f"{value:.3g}"


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
