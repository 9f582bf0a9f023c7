"""An inspection of logs as a folder: ``inspection.json`` and a figure of what is wrong, beside the logs themselves."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from softfin.core.quantities import AXES, RATE_HZ
from softfin.data.checks.alignment import COMMAND_LAG_MS, FORCE_LAG_MS
from softfin.data.checks.inspection import Inspection
from softfin.data.importing.importing import FORCE_FRAMES
from softfin.data.importing.recording import NamedLog
from softfin.data.issues import Issue, counted
from softfin.storage import artifact as artifacts
from softfin.storage.figures import BLACK, BLUE, GREEN, GREY, ORANGE, new_figure, save_figure, styled

SHOWN_S = 10
"""Length of the part of one log that is drawn, about the first row that has an issue [s]."""

SHOWN_ISSUES = 6

BAND = "#E3E3E3"


def write_inspection(
    inspection: Inspection, logs: Sequence[NamedLog], out: Path, metadata: dict[str, Any], overwrite: bool = False
) -> dict[str, Any]:
    """Write the folder, whole or not at all; returns the content of its JSON."""
    summary = {**inspection.to_dict(), **metadata}
    figure = inspection_figure(inspection, logs)

    def write(folder: Path) -> None:
        (folder / "inspection.json").write_text(artifacts.dump_json(summary))
        save_figure(figure, folder, "inspection")

    artifacts.write_folder(out, write, overwrite)
    return summary


def inspection_figure(inspection: Inspection, logs: Sequence[NamedLog]) -> Figure:
    """Draw a part of one log with the first issue in it; the issues; commands, clocks, axes and rest of all logs."""
    with styled():
        figure = new_figure(13, 8.4)
        halves: Any = figure.subfigures(2, 1, height_ratios=(1.35, 1))
        above, below = halves
        left, right = above.subfigures(1, 2, width_ratios=(1.7, 1))
        angle, force = left.subplots(2, 1, sharex=True)
        _draw_log(angle, force, inspection.issues, logs)
        _list_issues(right.subplots(), inspection)
        commands, lags, frames, rest = below.subplots(1, 4)
        _draw_commands(commands, logs)
        _draw_lags(lags, inspection)
        _draw_frames(frames, inspection)
        _draw_rest(rest, inspection)
    return figure


def _draw_log(above: Axes, below: Axes, issues: Sequence[Issue], logs: Sequence[NamedLog]) -> None:
    by_name = {one.name: one for one in logs}
    placed = [issue for issue in issues if issue.log in by_name]
    marked = next((issue for issue in placed if issue.row is not None), None)
    shown = by_name[(marked or placed[0]).log] if placed else logs[0]
    row = (marked.row or 0) if marked else 0
    start = max(0, min(row - SHOWN_S * RATE_HZ // 3, len(shown.log.reading.time) - SHOWN_S * RATE_HZ))
    rows = slice(start, start + SHOWN_S * RATE_HZ)
    reading, command = shown.log.reading, shown.log.command
    time = reading.time[rows]
    above.step(time, command.angle[rows], where="post", color=ORANGE, label="commanded angle")
    above.plot(time, reading.angle[rows], color=BLACK, label="angle")
    for index, (axis, colour) in enumerate(zip(AXES, (BLUE, GREEN), strict=True)):
        below.plot(time, reading.force[rows, index], color=colour, label=f"force {axis}", linewidth=0.9)
    # The axis must not be in rad where the issue beside it tells that it is not.
    degrees = any(issue.name == "degrees" for issue in issues)
    above.set_ylabel("angle, taken as rad" if degrees else "angle [rad]")
    below.set(ylabel="force [N]", xlabel="time [s]")
    above.set_title(f"{shown.name}: {SHOWN_S} s" + ("" if marked is None else f" about row {row}: {marked.name}"))
    for axes in (above, below):
        if marked is not None and row < len(reading.time):
            axes.axvline(float(reading.time[row]), color=GREY, linestyle=":", label=marked.name)
        axes.margins(y=0.25)
        axes.legend(loc="upper right", ncols=3)


def _list_issues(axes: Axes, inspection: Inspection) -> None:
    axes.set_axis_off()
    counts = inspection.summary()["counts"]
    axes.set_title(", ".join(counted(count, kind) for kind, count in counts.items()), weight="bold")
    lines = []
    for issue in inspection.issues[:SHOWN_ISSUES]:
        log = f"{len(issue.logs)} logs" if len(issue.logs) > 1 else issue.log
        where = ", ".join(filter(None, [issue.column, log]))
        texts = [f"{issue.severity}, {issue.name} ({where}): {issue.message}"]
        texts += [f"\N{RIGHTWARDS ARROW} {issue.fix}"] * bool(issue.fix)
        short = [textwrap.shorten(text, 330, placeholder=" ...") for text in texts]
        lines += ["", *(textwrap.fill(text, 72, break_on_hyphens=False) for text in short)]
    if len(inspection.issues) > SHOWN_ISSUES:
        lines.append(f"\nand {len(inspection.issues) - SHOWN_ISSUES} more in inspection.json")
    axes.text(0, 1, "\n".join(lines[1:]) or "nothing is wrong with these logs", va="top", fontsize=8, parse_math=False)


def _draw_commands(axes: Axes, logs: Sequence[NamedLog]) -> None:
    for part, colour, marker in (("train", BLUE, "o"), ("test", ORANGE, "^")):
        commands = [one.log.command for one in logs if one.part == part]
        pairs = [np.unique(np.stack([c.angle, c.velocity], axis=1), axis=0) for c in commands]
        if pairs:
            angle, velocity = np.concatenate(pairs).T
            axes.plot(angle, velocity, marker, color=colour, markersize=1.2, linestyle="", alpha=0.5,
                      label=f"{part} logs", rasterized=True)  # fmt: skip
    axes.set(title="commands", xlabel="commanded angle [rad]", ylabel="commanded velocity [rad/s]")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=2, markerscale=4)


def _draw_lags(axes: Axes, inspection: Inspection) -> None:
    for place, (name, plausible) in enumerate((("command", COMMAND_LAG_MS), ("force", FORCE_LAG_MS))):
        axes.fill_between([place - 0.35, place + 0.35], *plausible, color=BAND, label=None if place else "plausible")
        lags = [one.command_lag if name == "command" else one.force_lag for one in inspection.logs]
        found = [lag.milliseconds for lag in lags if lag is not None]
        spread = np.linspace(-0.25, 0.25, len(found)) if len(found) > 1 else np.zeros(len(found))
        axes.plot(place + spread, found, ".", color=BLUE, label=None if place else "a log")
        if not found:
            axes.text(place, sum(plausible) / 2, "not\nknown", ha="center", va="center", color=GREY)
    axes.set_xticks([0, 1], ["command\nto angle", "angle\nto force"])
    axes.set(title="clocks", ylabel="lag [ms]", xlim=(-0.5, 1.5))
    axes.grid(visible=False, axis="x")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=2)


def _draw_frames(axes: Axes, inspection: Inspection) -> None:
    frames = inspection.summary()["frames"]
    if frames is None:
        axes.text(0.5, 0.5, "logs under 10 s: not known", ha="center", transform=axes.transAxes, color=GREY)
    else:
        best = max(frames, key=frames.__getitem__)
        colours = [ORANGE if frame == best else GREY for frame in FORCE_FRAMES]
        names = [f"{frame}  (as it is)" if frame == "x,y" else frame for frame in FORCE_FRAMES]
        axes.barh(names, [frames[frame] for frame in FORCE_FRAMES], color=colours)
        axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.set(title="force axes, the best in orange", xlabel="correlation with a model fin", xlim=(0, 1))


def _draw_rest(axes: Axes, inspection: Inspection) -> None:
    found = [one.offset_n for one in inspection.logs if one.offset_n is not None]
    for index, (axis, colour, marker) in enumerate(zip(AXES, (BLUE, GREEN), ("o", "^"), strict=True)):
        axes.plot(range(len(found)), [offset[index] for offset in found], marker, color=colour, markersize=3,
                  linestyle="", label=f"force {axis}")  # fmt: skip
    if found:
        most = max(0.5, 1.1 * float(np.abs(found).max()))
        axes.set(ylim=(-most, most))
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=2)
    else:
        axes.text(0.5, 0.5, "the fin never rests", ha="center", transform=axes.transAxes, color=GREY)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(title="force on the fin at rest", xlabel="log", ylabel="mean force [N]")
