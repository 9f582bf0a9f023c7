"""Writes an inspection of logs as a folder with ``inspection.json`` and a figure of the issues."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from softfin.core.json_object import JsonObject
from softfin.core.quantities import AXES, RATE_HZ
from softfin.data.checks.checks import PLAUSIBLE_LAG_MS
from softfin.data.checks.inspection import Inspection
from softfin.data.checks.statistics import known_lags
from softfin.data.importing.clocks import NamedLog
from softfin.data.issues import Issue, counted
from softfin.storage import artifact as artifacts
from softfin.storage.figures import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    new_figure,
    save_figure,
    styled,
)

SHOWN_LOG_S = 10
"""Length of the log section in the figure, around the first row with an issue [s]."""


def write_inspection(
    inspection: Inspection,
    logs: Sequence[NamedLog],
    out: Path,
    metadata: JsonObject,
    overwrite: bool = False,
) -> JsonObject:
    """Write the folder, completely or not at all, and return the content of its JSON file."""
    summary = {**artifacts.head("inspection"), **inspection.to_dict(), **metadata}
    figure = inspection_figure(inspection, logs)

    def write(folder: Path) -> None:
        artifacts.write_description(folder, "inspection", summary)
        save_figure(figure, folder / "inspection.png")

    artifacts.write_folder(out, write, overwrite)
    return summary


def inspection_figure(inspection: Inspection, logs: Sequence[NamedLog]) -> Figure:
    """Draw the log section around the most severe issue that has a row, and the clocks and force
    axes of all logs."""
    with styled():
        figure = new_figure(13, 8.4)
        above, below = np.asarray(figure.subfigures(2, 1, height_ratios=(1.35, 1)))
        counts = inspection.summary()["counts"]
        totals = [counted(count, kind) for kind, count in counts.items()]
        above.suptitle(", ".join(totals), weight="bold")
        plots = above.subplots(2, 1, sharex=True).tolist()
        _draw_log(plots, inspection.issues, logs)
        lags, frames = below.subplots(1, 2)
        _draw_lags(lags, inspection)
        _draw_frames(frames, inspection)
    return figure


def _draw_log(plots: Sequence[Axes], issues: Sequence[Issue], logs: Sequence[NamedLog]) -> None:
    """Draw angle and force below each other, around the row of the most severe issue that has a
    row in a log."""
    by_name = {one.name: one for one in logs}
    shown = logs[0]
    row = 0
    title_end = ""
    marked = next(
        (issue for issue in issues if issue.log in by_name and issue.row is not None), None
    )
    if marked is not None:
        shown = by_name[marked.log]
        row = marked.row or 0
        title_end = f" around row {row}: {marked.name}"
    above, below = plots
    # A third of the section lies before the marked row, unless the log ends earlier.
    num_rows = SHOWN_LOG_S * RATE_HZ
    start = max(0, min(row - num_rows // 3, shown.log.rows - num_rows))
    rows = slice(start, start + num_rows)
    reading = shown.log.reading
    command = shown.log.command
    time = reading.time[rows]
    above.step(time, command.angle[rows], where="post", color=ORANGE, label="commanded angle")
    above.plot(time, reading.angle[rows], color=BLACK, label="angle")
    for index, (axis, colour) in enumerate(zip(AXES, (BLUE, GREEN), strict=True)):
        below.plot(
            time, reading.force[rows, index], color=colour, label=f"force {axis}", linewidth=0.9
        )
    above.set(ylabel="angle, read as rad")
    below.set(ylabel="force [N]", xlabel="time [s]")
    above.set_title(f"{shown.name}: {SHOWN_LOG_S} s{title_end}")
    for axes in plots:
        if marked is not None and row < shown.log.rows:
            axes.axvline(float(reading.time[row]), color=GREY, linestyle=":", label=marked.name)
        axes.margins(y=0.25)
        axes.legend(loc="upper right", ncols=3)


def _draw_lags(axes: Axes, inspection: Inspection) -> None:
    for place, (name, plausible) in enumerate(PLAUSIBLE_LAG_MS.items()):
        axes.fill_between([place - 0.35, place + 0.35], *plausible, color="#E3E3E3")
        found = [lag for lag, _ in known_lags(inspection.logs, name)]
        axes.plot(np.linspace(place - 0.25, place + 0.25, len(found)), found, ".", color=BLUE)
        if not found:
            axes.text(place, sum(plausible) / 2, "unknown", ha="center", va="center")
    axes.set_xticks([0, 1], ["command\nto angle", "angle\nto force"])
    axes.set(title="lags (grey: plausible)", ylabel="lag [ms]", xlim=(-0.5, 1.5))
    axes.grid(visible=False, axis="x")


def _draw_frames(axes: Axes, inspection: Inspection) -> None:
    if frames := inspection.summary()["frames"]:
        best = max(frames, key=frames.__getitem__)
        for frame, correlation in frames.items():
            label = "x,y  (as recorded)" if frame == "x,y" else frame
            axes.barh(label, correlation, color=ORANGE if frame == best else GREY)
        axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    title = "force axes (orange: best fit)" if frames else "force axes: unknown, logs under 10 s"
    axes.set(title=title, xlabel="correlation with a model fin", xlim=(0, 1))
