"""One self-contained ``report.html`` of a whole run: tables, figures, learning curves, configuration, provenance.

Results and figures go in; the page needs no network, and a part whose data is absent is absent from the page.
"""

import importlib.resources
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jinja2
import numpy as np
import yaml
from jaxtyping import Float
from markupsafe import Markup
from matplotlib.figure import Figure

from softfin.core.quantities import AXES, RATE_HZ
from softfin.evaluation.paper import PAPER_PRINTED_MEANS, PAPER_TABLE_II, recomputed_means
from softfin.storage import artifact as artifacts
from softfin.storage.figures import BLACK, BLUE, GREY, ORANGE, inline_svg, new_figure, styled, with_minus_signs
from softfin.surrogate.compare.scores import NETS, PAPER_TABLE_I

Figures = Mapping[str, Figure]
"""Figures by caption."""

CONTROLLER_COLOURS = {"single": BLUE, "grid": ORANGE}


def write_report(path: Path, results: Mapping[str, Any], figures: Mapping[str, Figures] = MappingProxyType({})) -> None:
    """Write the page, with `figures` of the parts ``surrogate``, ``learning``, ``experiment``.

    `results` may hold any of these; what it lacks is left out:

    ================= ===============================================================================================
    ``title``         text of the heading
    ``plant``         what the controllers were evaluated on, in words
    ``surrogate``     ``{"scores": ...}`` of `softfin.surrogate.compare.scores.table_one`, or None (imported)
    ``controllers``   by name (``single``, ``grid``), what `write_evaluation` gives
    ``in_surrogate``  the same of these controllers in the surrogate that they were trained in
    ``configuration`` nested mappings
    ``provenance``    a mapping
    ================= ===============================================================================================
    """
    controllers, configuration = results.get("controllers") or {}, results.get("configuration")
    scores = (results.get("surrogate") or {}).get("scores") or {}
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    environment.filters["number"] = _number
    template = importlib.resources.files("softfin.evaluation").joinpath("report.html.jinja").read_text("utf-8")
    page = environment.from_string(template).render(
        title=results.get("title", "softfin: force control of a soft fin"),
        plant=results.get("plant"),
        table_one=[
            {**scores[key], "text": text, "unit": unit, "paper": PAPER_TABLE_I[published] if published else None}
            for key, (text, unit, published) in NETS.items()
            if key in scores
        ],
        tables_two={name: _table_two(name, summary) for name, summary in controllers.items()},
        in_surrogate={name: _table_two(name, summary) for name, summary in (results.get("in_surrogate") or {}).items()},
        conditions=next((summary["conditions"] for summary in controllers.values()), None),
        table_two_svg=_svgs({"errors": table_two_figure(controllers)})["errors"] if controllers else None,
        **{f"{part}_figures": _svgs(figures.get(part, {})) for part in ("surrogate", "learning", "experiment")},
        configuration=yaml.safe_dump(configuration, sort_keys=False, allow_unicode=True) if configuration else None,
        provenance=results.get("provenance"),
    )
    artifacts.write_file(path, page)


def _number(value: float) -> str:
    """Three significant digits, as the paper prints them; no exponent for the sizes met here."""
    return f"{value:#.3g}" if 1e-4 <= abs(value) < 1000 else f"{value:.3g}"


def _table_two(name: str, summary: Mapping[str, Any]) -> dict[str, Any]:
    """Rows of cells in the order of the columns: x and y, error and std of each, then what the paper does not have."""
    published, references = PAPER_TABLE_II.get(name, {}), [tuple(row["reference_n"]) for row in summary["references"]]
    complete = bool(published) and set(references) == set(published)
    papers: list[Any] = [*map(published.get, references), recomputed_means(name) if complete else None]
    rows = [
        {
            "label": label,
            "cells": [_cell(row[axis], score) | {"paper": next(paper)} for axis in AXES for score in ("error", "std")],
            "raw": [_cell(row[axis], "raw_std") for axis in AXES],
            "travel": row["shaft_travel_rad_s"],
            "still": row.get("still", False),
        }
        for label, row, paper in zip(
            [*map(_force, references), "mean"],
            [*summary["references"], summary["mean"]],
            (iter(paper or (None,) * 4) for paper in papers),
            strict=True,
        )
    ]
    return {"rows": rows, "paper": any(papers), "printed": PAPER_PRINTED_MEANS[name] if complete else None}


def _cell(scores: Mapping[str, Any], name: str) -> dict[str, Any]:
    interval = scores[f"{name}_interval_n"]
    return {"mean": scores[f"{name}_n"], "half": None if interval is None else (interval[1] - interval[0]) / 2}


def _force(reference: Iterable[float | int]) -> str:
    return with_minus_signs(f"({', '.join(f'{value:g}' for value in reference)})")


def _svgs(figures: Figures) -> dict[str, Markup]:
    # Safe: Matplotlib escapes all text that it draws.
    return {caption: Markup(inline_svg(figure, caption)) for caption, figure in figures.items()}


def table_two_figure(summaries: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Errors by reference: each controller's ``evaluation.json``, beside the paper's figures where it has them."""
    references = [tuple(row["reference_n"]) for row in next(iter(summaries.values()))["references"]]
    places = np.arange(len(references) + 1)
    with styled():
        figure = new_figure(10, 5.2)
        for index, (axes, axis) in enumerate(zip(figure.subplots(2, 1, sharex=True), AXES, strict=True)):
            bars: list[tuple[list[float], dict[str, Any]]] = []
            for name, summary in summaries.items():
                rows = [row[axis] for row in (*summary["references"], summary["mean"])]
                several = rows[0]["error_interval_n"] is not None
                half = [row["error_interval_n"][1] - row["error_n"] for row in rows] if several else None
                colour, published = CONTROLLER_COLOURS.get(name, GREY), PAPER_TABLE_II.get(name, {})
                looks = {"label": name, "yerr": half, "facecolor": colour, "edgecolor": colour}
                bars.append(([row["error_n"] for row in rows], looks))
                if published and set(references) <= published.keys():
                    values = [published[reference][2 * index] for reference in references]
                    looks = {"label": f"{name}, paper (real fin)", "facecolor": "white", "hatch": "////"}
                    bars.append(([*values, float(np.mean(values))], looks | {"edgecolor": colour}))
            width = min(0.25, 0.8 / len(bars))
            for k, (errors, looks) in enumerate(bars):
                at = places + (k - (len(bars) - 1) / 2) * width
                axes.bar(at, errors, 0.92 * width, ecolor=BLACK, capsize=2, **looks)
            axes.axvline(len(references) - 0.5, color=GREY, linewidth=0.8)
            axes.grid(visible=False, axis="x")
            axes.set_ylabel(f"error {axis} [N]")
        axes.set_xticks(places, [*map(_force, references), "mean"])
        axes.set_xlabel("reference force (x, y) [N]")
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
    return figure


def prediction_figure(
    measured: Float[np.ndarray, "ticks 2"], predicted: Mapping[str, Float[np.ndarray, "ticks 2"]], start_s: float = 0.0
) -> Figure:
    """Measured force and predictions of it by name, at 100 Hz from `start_s` [s]."""
    time = start_s + np.arange(len(measured)) / RATE_HZ
    with styled():
        figure = new_figure(9, 4.2)
        for index, (axes, axis) in enumerate(zip(figure.subplots(2, 1, sharex=True), AXES, strict=True)):
            axes.plot(time, measured[:, index], color="#BBBBBB", linewidth=2.6, label="measured")
            for (name, force), (line, colour) in zip(predicted.items(), (("-", BLUE), ("--", BLACK)), strict=False):
                axes.plot(time, force[:, index], line, color=colour, label=name, linewidth=1.1)
            axes.set_ylabel(f"force {axis} [N]")
        last: Any = axes
        last.set(xlabel="time [s]", xlim=(time[0], time[-1]))
        handles, labels = last.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
    return figure
