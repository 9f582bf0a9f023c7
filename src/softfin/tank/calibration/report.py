"""A calibration as a folder: ``calibration.json``, ``tank.yaml``, ``recording.yaml`` and the tank beside the logs."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from softfin.core.configuration import Configuration
from softfin.core.quantities import RATE_HZ
from softfin.storage import artifact as artifacts
from softfin.storage.figures import BLACK, BLUE, GREY, ORANGE, new_figure, save_figure, styled
from softfin.tank.calibration.calibrate import Calibration, scores
from softfin.tank.calibration.pieces import CHANNELS, Pieces

TRACE_S = 10
"""Duration of a test piece that the figure shows [s]."""

WINDOW = 2 * RATE_HZ
"""Ticks over which means are taken where there are no beats: those of the paper's moving average."""

Readings = Float[np.ndarray, "pieces ticks channels"]

Means = Float[np.ndarray, "rows channels"]


def write_calibration(
    found: Calibration,
    beats: Pieces | None,
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
    beating = None if beats is None else means(beats, found.read(beats.command))
    summary = {**found.summary(), "beating": None if beating is None else _means_to_list(*beating), **metadata}

    def write(folder: Path) -> None:
        (folder / "calibration.json").write_text(artifacts.dump_json(summary))
        (folder / "tank.yaml").write_text(_yaml(found.tank, "The tank that was found."))
        (folder / "recording.yaml").write_text(_yaml(found.recording, "How the logs differ from what that tank reads."))
        figure = calibration_figure(found.test, modelled, beating)
        save_figure(figure, folder, "calibration")
        extra_files(folder)

    artifacts.write_folder(out, write, overwrite)
    return summary


def means(pieces: Pieces, modelled: Readings) -> tuple[Means, Means]:
    """Return the means of each piece behind its warm-up, measured and modelled."""
    return np.asarray(pieces.compared).mean(axis=1), modelled[:, pieces.warm_up :].mean(axis=1)


def calibration_figure(test: Pieces, modelled: Readings, beating: tuple[Means, Means] | None) -> Figure:
    """Measured and modelled side by side over the same unseen commands: traces, mean forces, peaks, deviations.

    `beating`: means about several angles, measured and modelled; without it those of windows of the test pieces.
    """
    with styled():
        figure = new_figure(11, 9.5)
        parts: Any = figure.subfigures(2, 1, height_ratios=(1.75, 1))
        above, below = parts
        _draw_traces(above.subplots(3, 1, sharex=True), test, modelled)
        panels: Any = below.subplots(1, 3, width_ratios=(1.25, 1, 0.9))
        if beating is None:
            _draw_means(panels[0], *_windows(test, modelled), "means over 2 s of random commands")
        else:
            _draw_means(panels[0], *beating, "beating at 1.5 Hz about nine angles")
        _draw_peaks(panels[1], test, modelled)
        _draw_deviations(panels[2], scores(modelled, test))
    return figure


def _draw_traces(panels: Any, pieces: Pieces, modelled: Readings) -> None:
    shown = _typical(pieces, modelled)
    rows = scores(modelled, pieces)
    ticks = slice(pieces.warm_up, pieces.warm_up + TRACE_S * RATE_HZ)
    measured = np.asarray(pieces.measured)[shown, ticks]
    time = np.arange(len(measured)) / RATE_HZ
    titles = ("angle [rad]", "force x [N]", "force y [N]")
    for index, (axes, title, channel) in enumerate(zip(panels, titles, CHANNELS, strict=True)):
        if index == 0:
            command = np.asarray(pieces.command.angle)[shown, ticks]
            axes.step(time, command, where="post", color=GREY, linewidth=0.8, linestyle=":", label="commanded")
        axes.plot(time, measured[:, index], color=BLACK, linewidth=1.6, label="measured")
        axes.plot(time, modelled[shown, ticks, index], color=ORANGE, linewidth=1.3, linestyle="--", label="tank")
        axes.set(ylabel=title, xlim=(0, len(measured) / RATE_HZ))
        axes.set_title(f"R² {rows[channel]['r2']:.3f} over all unseen pieces", loc="right")
    panels[0].set_title("The unseen piece of median error", weight="bold")
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


def _draw_peaks(axes: Axes, pieces: Pieces, modelled: Readings) -> None:
    measured, ours = peaks(pieces, np.asarray(pieces.measured)), peaks(pieces, modelled)
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


def peaks(pieces: Pieces, readings: Readings) -> Float[np.ndarray, "strokes"]:
    """Greatest force of each held command, behind the warm-up [N]."""
    found = []
    for angle, force in zip(np.asarray(pieces.command.angle), np.linalg.norm(readings[..., 1:], axis=-1), strict=True):
        changes = np.flatnonzero(np.diff(angle)) + 1
        strokes = np.split(force, changes[changes >= pieces.warm_up])[1:]
        found += [stroke.max() for stroke in strokes]
    return np.asarray(found)


def _typical(pieces: Pieces, modelled: Readings) -> int:
    """The piece of median error."""
    error = (modelled - np.asarray(pieces.measured))[:, pieces.warm_up :] / np.asarray(pieces.deviation)
    each = np.mean(error**2, axis=(1, 2))
    return int(np.argsort(each)[len(each) // 2])


def _windows(pieces: Pieces, modelled: Readings) -> tuple[Means, Means]:
    def over(readings: Readings) -> Means:
        windows = readings.shape[1] // WINDOW
        return np.asarray(readings[:, : windows * WINDOW].reshape(-1, WINDOW, readings.shape[2]).mean(axis=1))

    return over(np.asarray(pieces.compared)), over(modelled[:, pieces.warm_up :])


def _means_to_list(measured: Means, modelled: Means) -> list[dict[str, Any]]:
    names = ("mean_angle_rad", "mean_force_x_n", "mean_force_y_n")
    return [
        {
            "measured": dict(zip(names, map(float, one), strict=True)),
            "modelled": dict(zip(names, map(float, other), strict=True)),
        }
        for one, other in zip(measured, modelled, strict=True)
    ]


def _yaml(config: Configuration, head: str) -> str:
    return f"# {head}\n{yaml.safe_dump(config.model_dump(mode='json'), sort_keys=False)}"
