"""Figures of a robot's trials: track, distance from the path, and angle to it."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from softfin.robot.trial import Record
from softfin.storage.figures import BLUE, GREY, ORANGE, new_figure, save_figure, styled


def draw_trials(folder: Path, records: Mapping[str, Record]) -> None:
    """Write ``TASK.png`` and ``TASK.svg`` for each trial."""
    for task, record in records.items():
        with styled():
            figure = new_figure(8.0, 3.4)
            place, off, tilt = figure.subplot_mosaic([["place", "off"], ["place", "tilt"]]).values()
            position = 100 * record.body.position
            target = 100 * record.target_position
            place.plot(target[:, 0], target[:, 1], color=ORANGE, lw=3, alpha=0.6, label="path")
            place.plot(position[:, 0], position[:, 1], color=BLUE, lw=0.9, label="robot")
            if task == "hold":
                place.plot(0, 0, "+", color=ORANGE, ms=12, mew=2)
            place.set(xlabel="x [cm]", ylabel="y [cm]", aspect="equal", title="seen from above")
            place.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
            off.plot(record.time, 100 * record.position_error(), color=BLUE)
            off.set(ylabel="distance from the path [cm]", ylim=(0, None))
            tilt.plot(record.time, np.degrees(record.attitude_error()), color=BLUE)
            tilt.set(ylabel="angle to it [degrees]", xlabel="time [s]", ylim=(0, None))
            for axis in (off, tilt):
                axis.axhline(0, color=GREY, lw=0.6)
        save_figure(figure, folder, task)
