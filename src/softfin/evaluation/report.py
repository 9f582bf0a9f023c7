"""One self-contained ``report.html`` of a whole run: tables, figures, learning curves,
configuration, provenance.

Results and figures go in; the page needs no network, and a part whose data is absent is absent from
the page.
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
from softfin.evaluation.headline import headline, over_seeds
from softfin.evaluation.paper import PAPER_PRINTED_MEANS, PAPER_TABLE_II, recomputed_means
from softfin.evaluation.scores import SETTLED_N
from softfin.storage import artifact as artifacts
from softfin.storage.figures import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    inline_svg,
    new_figure,
    styled,
    with_minus_signs,
)
from softfin.surrogate.compare.scores import NETS, PAPER_TABLE_I

Figures = Mapping[str, Figure]
"""Figures by caption."""

PARTS = ("headline", "surrogate", "learning", "experiment", "moving")
"""Parts of the page that have figures."""

CONTROLLER_COLOURS = {"gaits": GREEN, "single": BLUE, "grid": ORANGE}


def write_report(
    path: Path, results: Mapping[str, Any], figures: Mapping[str, Figures] = MappingProxyType({})
) -> None:
    """Write the page, with `figures` of the parts named in `PARTS`.

    `results` may hold any of these; what it lacks is left out:

    ================= ========================================================================
    ``title``         text of the heading
    ``plant``         what the controllers were evaluated on, in words
    ``surrogate``     ``{"scores": ...}`` of `compare.scores.table_one`, or None (imported)
    ``stages``        what was done, each with ``what`` and ``wall_s``
    ``controllers``   by name (``gaits``, ``single``, ``grid``), what `write_evaluation` gives
    ``trimmed``       the same of these controllers with force feedback
    ``in_surrogate``  the same of these controllers in the surrogate that they were trained in
    ``configuration`` nested mappings
    ``provenance``    a mapping
    ================= ========================================================================
    """
    controllers = results.get("controllers") or {}
    configuration = results.get("configuration")
    scores = (results.get("surrogate") or {}).get("scores") or {}
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True
    )
    environment.filters["number"] = _number
    environment.filters["capitalize_first"] = lambda text: text[:1].upper() + text[1:]
    first = next((summary["references"][0] for summary in controllers.values()), None)
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
        settled=SETTLED_N,
        intervals=first is not None and first["x"]["error_interval_n"] is not None,
        table_one=[
            {
                **scores[key],
                "text": text,
                "unit": unit,
                "paper": PAPER_TABLE_I[published] if published else None,
            }
            for key, (text, unit, published) in NETS.items()
            if key in scores
        ],
        tables_two={name: _table_two(name, summary) for name, summary in controllers.items()},
        in_surrogate={
            name: _table_two(name, summary)
            for name, summary in (results.get("in_surrogate") or {}).items()
        },
        conditions=next((summary["conditions"] for summary in controllers.values()), None),
        table_two_svg=_svgs({"errors": table_two_figure(controllers)})["errors"]
        if controllers
        else None,
        **{f"{part}_figures": _svgs(figures.get(part, {})) for part in PARTS},
        configuration=yaml.safe_dump(configuration, sort_keys=False, allow_unicode=True)
        if configuration
        else None,
        provenance=results.get("provenance"),
    )
    artifacts.write_file(path, page)


def _number(value: float) -> str:
    """Three significant digits, as the paper prints them; no exponent for the sizes met here."""
    return f"{value:#.3g}" if 1e-4 <= abs(value) < 1000 else f"{value:.3g}"


def _table_two(name: str, summary: Mapping[str, Any]) -> dict[str, Any]:
    """Rows of cells in the order of the columns: x and y, error and std of each, then what the
    paper does not have."""
    published = PAPER_TABLE_II.get(name, {})
    references = [tuple(row["reference_n"]) for row in summary["references"]]
    complete = bool(published) and set(references) == set(published)
    papers: list[Any] = [
        *map(published.get, references),
        recomputed_means(name) if complete else None,
    ]
    rows = [
        {
            "label": label,
            "cells": [
                _cell(row[axis], score) | {"paper": next(paper)}
                for axis in AXES
                for score in ("error", "std")
            ],
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
    return {
        "rows": rows,
        "paper": any(papers),
        "printed": PAPER_PRINTED_MEANS[name] if complete else None,
    }


def _cell(scores: Mapping[str, Any], name: str) -> dict[str, Any]:
    reading = scores.get("reading_error_n") if name == "error" else None
    return {"mean": scores[f"{name}_n"], "over_seeds": over_seeds(scores, name), "reading": reading}


def _overview(results: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A row for each controller: mean errors in the plant, with force feedback, in the surrogate;
    settling times."""
    parts = [results.get(part) or {} for part in ("controllers", "trimmed", "in_surrogate")]
    return [
        {
            "name": name,
            "errors": [
                [_cell(part[name]["mean"][axis], "error") for axis in AXES]
                if name in part
                else None
                for part in parts
            ],
            "settling": [
                _settling(part[name].get("moving", [])) if name in part else None
                for part in parts[:2]
            ],
        }
        for name in parts[0]
    ]


def _settling(rows: Iterable[Mapping[str, Any]]) -> str | None:
    """The longest time that a step takes at any seed, or that there is one that never settles; None
    without steps."""
    stepped = [row for row in rows if row["settles"] is not None]
    if not stepped:
        return None
    if not all(row["settles"] for row in stepped):
        return "never"
    return f"{max(row['longest_settling_s'] for row in stepped):.1f} s"


def _force(reference: Iterable[float | int]) -> str:
    return with_minus_signs(f"({', '.join(f'{value:g}' for value in reference)})")


def _svgs(figures: Figures) -> dict[str, Markup]:
    # Safe: Matplotlib escapes all text that it draws.
    return {caption: Markup(inline_svg(figure, caption)) for caption, figure in figures.items()}


def table_two_figure(summaries: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Errors by reference: each controller's ``evaluation.json``, beside the paper's figures where
    it has them."""
    references = [tuple(row["reference_n"]) for row in next(iter(summaries.values()))["references"]]
    places = np.arange(len(references) + 1)
    with styled():
        figure = new_figure(10, 5.2)
        for index, (axes, axis) in enumerate(
            zip(figure.subplots(2, 1, sharex=True), AXES, strict=True)
        ):
            bars: list[tuple[list[float], dict[str, Any]]] = []
            for name, summary in summaries.items():
                rows = [row[axis] for row in (*summary["references"], summary["mean"])]
                ends = [
                    row["error_interval_n"]
                    or (min(row["error_seeds_n"]), max(row["error_seeds_n"]))
                    for row in rows
                ]
                marks = np.abs(
                    np.transpose(
                        [
                            np.subtract(row["error_n"], end)
                            for row, end in zip(rows, ends, strict=True)
                        ]
                    )
                )
                half = marks if len(rows[0]["error_seeds_n"]) > 1 else None
                colour = CONTROLLER_COLOURS.get(name, GREY)
                published = PAPER_TABLE_II.get(name, {})
                looks = {"label": name, "yerr": half, "facecolor": colour, "edgecolor": colour}
                bars.append(([row["error_n"] for row in rows], looks))
                if published and set(references) <= published.keys():
                    values = [published[reference][2 * index] for reference in references]
                    looks = {
                        "label": f"{name}, paper (real fin)",
                        "facecolor": "white",
                        "hatch": "////",
                    }
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
    measured: Float[np.ndarray, "ticks 2"],
    predicted: Mapping[str, Float[np.ndarray, "ticks 2"]],
    start_s: float = 0.0,
) -> Figure:
    """Measured force and predictions of it by name, at 100 Hz from `start_s` [s]."""
    time = start_s + np.arange(len(measured)) / RATE_HZ
    with styled():
        figure = new_figure(9, 4.2)
        for index, (axes, axis) in enumerate(
            zip(figure.subplots(2, 1, sharex=True), AXES, strict=True)
        ):
            axes.plot(time, measured[:, index], color="#BBBBBB", linewidth=2.6, label="measured")
            for (name, force), (line, colour) in zip(
                predicted.items(), (("-", BLUE), ("--", BLACK)), strict=False
            ):
                axes.plot(time, force[:, index], line, color=colour, label=name, linewidth=1.1)
            axes.set_ylabel(f"force {axis} [N]")
        last: Any = axes
        last.set(xlabel="time [s]", xlim=(time[0], time[-1]))
        handles, labels = last.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
    return figure
