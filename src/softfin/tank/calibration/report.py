"""A calibration as a folder: ``calibration.json``, ``tank.yaml``, ``recording.yaml`` and the tank beside the logs."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from softfin.core.quantities import RATE_HZ
from softfin.storage import artifact as artifacts
from softfin.storage.figures import BLACK, BLUE, GREY, ORANGE, new_figure, save_figure, styled
from softfin.tank.calibration.calibrate import Calibration, scores
from softfin.tank.calibration.segments import CHANNELS, Segments

TRACE_S = 10
"""Duration of a test segment that the figure shows [s]."""

WINDOW = 2 * RATE_HZ
"""Ticks over which means are taken where there are no gaits: those of the paper's moving average."""

Readings = Float[np.ndarray, "segments ticks channels"]

Means = Float[np.ndarray, "rows channels"]


def write_calibration(
    found: Calibration,
    gaits: Segments | None,
    out: Path,
    metadata: dict[str, Any],
    extra_files: Callable[[Path], None],
    overwrite: bool = False,
) -> dict[str, Any]:
    """Write the folder, whole or not at all; returns the content of its JSON.

    =================== ============================================================================================
    ``scores``          of ``train`` and ``test`` by channel: pooled ``r2``, ``rmse``, means and standard deviations of
                        what is measured and modelled [rad, N, N]
    ``parameters``      by name: ``value``, ``unit``, ``range``; ``standard_error``, 95% ``interval``, ``left``: the
                        standard error over the deviation of the whole range; ``determined``: well, roughly, poorly;
                        or low end, high end of the range, no effect
    ``trades``          pairs of parameters whose errors are correlated by more than 0.9
    ``correlation``     of all parameters, in the order of ``parameters``; null for those on an end of their range
    ``singular_values`` of the scaled Jacobian; ``weakest``: the direction that the logs tell least about
    ``beating``         mean force about each mean angle, where a plant was there to beat
    ``recording``       what lies between tank and logs
    =================== ============================================================================================
    """
    modelled = found.read(found.test.command)
    beating = None if gaits is None else means(gaits, found.read(gaits.command))
    summary = {**found.summary(), "beating": None, **metadata}
    if beating is not None:
        names = ("mean_angle_rad", "mean_force_x_n", "mean_force_y_n")
        rows = [[dict(zip(names, row.tolist(), strict=True)) for row in side] for side in beating]
        summary["beating"] = [{"measured": one, "modelled": other} for one, other in zip(*rows, strict=True)]

    def write(folder: Path) -> None:
        (folder / "calibration.json").write_text(artifacts.dump_json(summary))
        for name, config, head in (
            ("tank", found.tank, "The tank that was found."),
            ("recording", found.recording, "How the logs differ from what that tank reads."),
        ):
            text = yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)
            (folder / f"{name}.yaml").write_text(f"# {head}\n{text}")
        figure = calibration_figure(found.test, modelled, beating)
        save_figure(figure, folder, "calibration")
        extra_files(folder)

    artifacts.write_folder(out, write, overwrite)
    return summary


def means(segments: Segments, modelled: Readings) -> tuple[Means, Means]:
    """Return the means of each segment behind its warm-up, measured and modelled."""
    return np.asarray(segments.compared).mean(axis=1), modelled[:, segments.warm_up :].mean(axis=1)


def peaks(segments: Segments, readings: Readings) -> Float[np.ndarray, "strokes"]:
    """Return the greatest force of each held command, behind the warm-up [N]."""
    found = []
    forces = np.linalg.norm(readings[..., 1:], axis=-1)
    for angle, force in zip(np.asarray(segments.command.angle), forces, strict=True):
        changes = np.flatnonzero(np.diff(angle)) + 1
        found += [stroke.max() for stroke in np.split(force, changes[changes >= segments.warm_up])[1:]]
    return np.asarray(found)


def calibration_figure(test: Segments, modelled: Readings, beating: tuple[Means, Means] | None) -> Figure:
    """Draw measured and modelled over the same unseen commands: traces, mean forces, peaks, deviations.

    `beating`: means about several angles, measured and modelled; without it those of windows of the test segments.
    """
    rows = scores(modelled, test)
    with styled():
        figure = new_figure(11, 9.5)
        parts: Any = figure.subfigures(2, 1, height_ratios=(1.75, 1))
        above, below = parts
        _draw_traces(above.subplots(3, 1, sharex=True), test, modelled, rows)
        panels: Any = below.subplots(1, 3, width_ratios=(1.25, 1, 0.9))
        if beating is None:
            windows = [
                side[:, : side.shape[1] // WINDOW * WINDOW].reshape(-1, WINDOW, side.shape[2]).mean(axis=1)
                for side in (np.asarray(test.compared), modelled[:, test.warm_up :])
            ]
            _draw_means(panels[0], windows[0], windows[1], "means over 2 s of random commands")
        else:
            _draw_means(panels[0], *beating, "beating at 1.5 Hz about nine angles")
        _draw_peaks(panels[1], test, modelled)
        _draw_deviations(panels[2], rows)
    return figure


def _draw_traces(panels: Any, segments: Segments, modelled: Readings, rows: dict[str, dict[str, float]]) -> None:
    error = (modelled - np.asarray(segments.measured))[:, segments.warm_up :] / np.asarray(segments.deviation)
    shown = int(np.argsort(np.mean(error**2, axis=(1, 2)))[len(error) // 2])
    ticks = slice(segments.warm_up, segments.warm_up + TRACE_S * RATE_HZ)
    measured = np.asarray(segments.measured)[shown, ticks]
    time = np.arange(len(measured)) / RATE_HZ
    command = np.asarray(segments.command.angle)[shown, ticks]
    panels[0].step(time, command, where="post", color=GREY, linewidth=0.8, linestyle=":", label="commanded")
    titles = ("angle [rad]", "force x [N]", "force y [N]")
    for index, (axes, title, channel) in enumerate(zip(panels, titles, CHANNELS, strict=True)):
        axes.plot(time, measured[:, index], color=BLACK, linewidth=1.6, label="measured")
        axes.plot(time, modelled[shown, ticks, index], color=ORANGE, linewidth=1.3, linestyle="--", label="tank")
        axes.set(ylabel=title, xlim=(0, len(measured) / RATE_HZ))
        axes.set_title(f"R² {rows[channel]['r2']:.3f} over all unseen segments", loc="right")
    panels[0].set_title("The unseen segment of median error", weight="bold")
    panels[0].legend(ncols=3, loc="lower left", bbox_to_anchor=(0.25, 0.98), borderaxespad=0)
    panels[-1].set_xlabel("time [s]")


def _draw_means(axes: Axes, measured: Means, modelled: Means, title: str) -> None:
    lines = len(measured) < 20
    for axis, colour, marker, name in ((1, BLUE, "o", "x"), (2, ORANGE, "s", "y")):
        for rows, face, source in ((measured, colour, "measured"), (modelled, "white", "tank")):
            axes.plot(
                rows[:, 0], rows[:, axis], marker, markersize=5 if lines else 3, color=colour,
                markerfacecolor=face, linestyle=("-" if face == colour else "--") if lines else "none",
                linewidth=0.9, label=f"force {name}, {source}",
            )  # fmt: skip
    axes.axhline(0, color=GREY, linewidth=0.8)
    axes.set(xlabel="mean angle [rad]", ylabel="mean force [N]")
    axes.set_title(f"Mean force: {title}", fontsize=8)
    axes.legend(fontsize=7, loc="best")


def _draw_peaks(axes: Axes, segments: Segments, modelled: Readings) -> None:
    measured, ours = peaks(segments, np.asarray(segments.measured)), peaks(segments, modelled)
    most = 1.05 * float(max(measured.max(), ours.max()))
    axes.plot([0, most], [0, most], color=GREY, linewidth=0.8)
    axes.plot(measured, ours, "o", markersize=3, color=BLUE, alpha=0.6, markeredgewidth=0)
    axes.set(xlabel="measured [N]", ylabel="tank [N]", xlim=(0, most), ylim=(0, most), aspect="equal")
    axes.set_title("Peak force of each unseen stroke", fontsize=8)


def _draw_deviations(axes: Axes, rows: dict[str, dict[str, float]]) -> None:
    places = np.arange(2)
    for shift, key, face, label in ((-0.2, "measured", BLUE, "measured"), (0.2, "modelled", "white", "tank")):
        values = [rows[channel][f"std_{key}"] for channel in CHANNELS[1:]]
        bars = axes.bar(places + shift, values, 0.36, facecolor=face, edgecolor=BLUE, label=label)
        axes.bar_label(bars, fmt="%.2f", fontsize=7)
    axes.set_xticks(places, ["force x", "force y"])
    axes.grid(visible=False, axis="x")
    axes.set(ylabel="standard deviation [N]")
    axes.margins(y=0.2)
    axes.set_title("Standard deviation, unseen", fontsize=8)
    axes.legend(ncols=2, fontsize=7, loc="upper center")
