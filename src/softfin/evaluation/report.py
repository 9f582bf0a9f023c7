"""One self-contained ``report.html`` of a whole run: tables, figures, learning curves, configuration, provenance.

Results and figures go in; the page needs no network, and a part whose data is absent is absent from the page.
"""

import importlib.resources
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import yaml
from markupsafe import Markup
from matplotlib.figure import Figure

from softfin.core.quantities import AXES
from softfin.evaluation.figures import table_two_figure
from softfin.evaluation.paper import PAPER_PRINTED_MEANS, PAPER_TABLE_II, REFERENCES, PaperScores, recomputed_means
from softfin.storage import artifact as artifacts
from softfin.storage.figures import inline_svg
from softfin.surrogate.compare.metrics import PAPER_TABLE_I

Figures = Mapping[str, Figure]
"""By caption."""

NETS = {
    "posnet": ("PosNet, commands to angle", "rad", "posnet"),
    "forcenet_measured": ("ForceNet, given the measured angle", "N", "forcenet"),
    "forcenet_free_running": ("ForceNet, free-running behind PosNet", "N", None),
    "drive": ("Drive nets, commands to angle", "rad", "posnet"),
    "force_measured": ("Force nets, given the measured motion", "N", "forcenet"),
    "force_free_running": ("Force nets, free-running behind the drive nets", "N", None),
}
"""Rows of Table I: by key of `table_one`, what the row is, its unit, the paper's row to stand beside."""


def write_report(
    path: Path,
    results: Mapping[str, Any],
    surrogate_figures: Figures | None = None,
    learning_figures: Figures | None = None,
    experiment_figures: Figures | None = None,
) -> None:
    """Write the page. `results` may hold any of these; what it lacks is left out:

    ================= ===============================================================================================
    ``title``         text of the heading
    ``plant``         what the controllers were evaluated on, in words
    ``surrogate``     ``{"scores": ...}`` of `softfin.surrogate.compare.metrics.table_one`, or None (imported)
    ``controllers``   by name (``single``, ``grid``), what `write_evaluation` gives
    ``in_surrogate``  the same of these controllers in the surrogate that they were trained in
    ``configuration`` nested mappings
    ``provenance``    a mapping
    ================= ===============================================================================================
    """
    controllers = results.get("controllers") or {}
    scores = (results.get("surrogate") or {}).get("scores")
    page = _template().render(
        title=results.get("title", "softfin: force control of a soft fin"),
        plant=results.get("plant"),
        table_one=[_net_row(key, scores[key]) for key in NETS if key in scores] if scores else [],
        tables_two={name: _table_two(name, summary) for name, summary in controllers.items()},
        in_surrogate={name: _table_two(name, summary) for name, summary in (results.get("in_surrogate") or {}).items()},
        conditions=next((summary["conditions"] for summary in controllers.values()), None),
        table_two_svg=_svg("errors", table_two_figure(controllers)) if controllers else None,
        surrogate_figures=_svgs(surrogate_figures),
        learning_figures=_svgs(learning_figures),
        experiment_figures=_svgs(experiment_figures),
        configuration=_yaml(results.get("configuration")),
        provenance=results.get("provenance"),
    )
    artifacts.write_file(path, page)


def _template() -> jinja2.Template:
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    environment.filters["number"] = _number
    environment.filters["half"] = _half
    return environment.from_string(
        importlib.resources.files("softfin.evaluation").joinpath("report.html.jinja").read_text("utf-8")
    )


def _number(value: float) -> str:
    """Three digits that matter, as the paper prints them; no exponent for the sizes met here."""
    return f"{value:#.3g}" if 1e-4 <= abs(value) < 1000 else f"{value:.3g}"


def _half(cell: Mapping[str, Any]) -> str:
    """To the digits of its mean; a single digit where those would show zero."""
    digits = _number(cell["mean"]).partition(".")[2]
    text = f"{cell['half']:.{len(digits)}f}"
    return text if float(text) else f"{cell['half']:.1g}"


def _net_row(key: str, row: Mapping[str, Any]) -> dict[str, Any]:
    text, unit, published = NETS[key]
    return {**row, "text": text, "unit": unit, "paper": PAPER_TABLE_I[published] if published else None}


def _table_two(name: str, summary: Mapping[str, Any]) -> dict[str, Any]:
    """Rows of cells in the order of the columns: each of x and y, each of error and std, then what is softfin's own."""
    published = PAPER_TABLE_II.get(name, {})
    rows = [
        _row(f"({_signed(row['reference_n'])})", row, published.get(tuple(row["reference_n"])))
        for row in summary["references"]
    ]
    complete = {tuple(row["reference_n"]) for row in summary["references"]} == set(REFERENCES)
    mean = _row("mean", summary["mean"], recomputed_means(name) if published and complete else None)
    return {
        "rows": [*rows, mean],
        "paper": any(row["cells"][0]["paper"] is not None for row in rows),
        "printed": PAPER_PRINTED_MEANS[name] if published and complete else None,
    }


def _row(label: str, row: Mapping[str, Any], paper: PaperScores | None) -> dict[str, Any]:
    published = iter(paper or (None,) * 4)
    cells = [{**_cell(row[axis], score), "paper": next(published)} for axis in AXES for score in ("error", "std")]
    return {
        "label": label,
        "cells": cells,
        "raw": [_cell(row[axis], "raw_std") for axis in AXES],
        "travel": row["shaft_travel_rad_s"],
        "still": row.get("still", False),
    }


def _cell(scores: Mapping[str, Any], name: str) -> dict[str, Any]:
    interval = scores[f"{name}_interval_n"]
    return {"mean": scores[f"{name}_n"], "half": None if interval is None else (interval[1] - interval[0]) / 2}


def _signed(reference: Sequence[float | int]) -> str:
    return ", ".join(f"{value:g}" for value in reference).replace("-", "\N{MINUS SIGN}")


def _svgs(figures: Figures | None) -> dict[str, Markup]:
    return {caption: _svg(caption, figure) for caption, figure in (figures or {}).items()}


def _svg(name: str, figure: Figure) -> Markup:
    # Safe: Matplotlib escapes all text that it draws.
    return Markup(inline_svg(figure, name))


def _yaml(configuration: Any) -> str | None:
    return yaml.safe_dump(configuration, sort_keys=False, allow_unicode=True) if configuration else None
