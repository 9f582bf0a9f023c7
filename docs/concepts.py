"""Draws the fin, its frame and the window of the evaluation: ``python docs/concepts.py docs/concepts.png``."""

import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.patches import FancyBboxPatch

from softfin.core.action_clock import ACTION_TICKS, CYCLE_ACTIONS, WINDOW
from softfin.core.plant import hold
from softfin.core.quantities import RATE_HZ, Command
from softfin.storage.figures import BLACK, BLUE, GREEN, GREY, ORANGE, new_figure, save_figure, styled
from softfin.tank import Tank

CENTRE_RAD, SWING_RAD, VELOCITY_RAD_S = 0.3, 0.5, 2.8
ACTIONS = 15
REFERENCE_N = 4.0


def draw_frame(axes: Any, shape_m: np.ndarray, angle_rad: float) -> None:
    """The robot's body, the shaft, the fin at an angle, and the directions of force."""
    axes.add_patch(FancyBboxPatch(
        (0.02, -0.06), 0.13, 0.12, boxstyle="round,pad=0.01", facecolor="#E8ECEF", edgecolor=GREY))  # fmt: skip
    axes.text(0.085, 0.045, "robot", ha="center", va="center", color=GREY)
    axes.plot([0, -0.22], [0, 0], ":", color=GREY, linewidth=1)
    rigid = 0.2 * np.array([-np.cos(angle_rad), np.sin(angle_rad)])
    axes.plot([0, rigid[0]], [0, rigid[1]], "--", color=GREY, linewidth=1)
    axes.plot(*shape_m.T, color="#3E4C59", linewidth=9, solid_capstyle="round")
    turn = np.linspace(0, angle_rad, 30)
    axes.plot(-0.12 * np.cos(turn), 0.12 * np.sin(turn), color=ORANGE, linewidth=1.5)
    axes.text(-0.135, 0.03, "angle θ\n(of the shaft)", color=ORANGE, ha="right", va="center")
    axes.text(-0.215, -0.015, "θ = 0", color=GREY, ha="left", va="top")
    thrust = "+x: thrust, pushes\nthe robot forward"
    for tip, name, place in (((0.1, 0), thrust, (0.03, -0.105)), ((0, 0.1), "+y", (0.01, 0.1))):
        axes.annotate("", tip, (0, 0), arrowprops={"arrowstyle": "-|>", "color": BLUE, "linewidth": 2})
        axes.text(*place, name, color=BLUE, va="center")
    axes.plot(0, 0, "o", markersize=9, markerfacecolor="white", markeredgecolor=BLACK)
    axes.text(0.0, -0.03, "shaft and\nforce sensor", ha="center", va="top", fontsize=8)
    axes.set(xlim=(-0.25, 0.2), ylim=(-0.15, 0.17), aspect="equal", xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    axes.grid(visible=False)
    axes.set_title("The fin and its frame", weight="bold")


def draw_window(panels: Any, command_rad: np.ndarray, angle_rad: np.ndarray, force_n: np.ndarray) -> None:
    """Commands held for 33, 33 and 34 ticks, and the mean force over six of them."""
    time = (np.arange(len(angle_rad)) + 1) / RATE_HZ
    end = len(time) - 20
    start = end - WINDOW
    mean = np.convolve(force_n, np.ones(WINDOW) / WINDOW, "valid")
    for axes in panels:
        axes.axvspan(start / RATE_HZ, end / RATE_HZ, color=GREEN, alpha=0.12, linewidth=0)
    panels[0].step(time - 1 / RATE_HZ, command_rad, where="post", color=ORANGE, label="command, held for one action")
    panels[0].plot(time, angle_rad, color=BLUE, label="angle")
    panels[0].set(xlim=(0, 5.4), ylabel="angle [rad]", ylim=(-0.5, 1.5))
    panels[0].legend(ncols=2, loc="upper left", fontsize=8)
    panels[0].set_title("Action clock and window", weight="bold")
    panels[1].plot(time, force_n, color=BLUE, linewidth=0.9, label="force x at 100 Hz")
    panels[1].plot(time[WINDOW - 1 :], mean, color=BLACK, linewidth=2, label="mean of the last 200 samples")
    panels[1].axhline(REFERENCE_N, color=ORANGE, linestyle="--", label="reference force")
    last = float(mean[end - WINDOW])
    arrow = {"arrowstyle": "<->", "color": BLACK, "shrinkA": 0, "shrinkB": 0}
    panels[1].annotate("", (end / RATE_HZ, REFERENCE_N), (end / RATE_HZ, last), arrowprops=arrow)
    panels[1].text(end / RATE_HZ + 0.05, (REFERENCE_N + last) / 2, "error", va="center")
    panels[1].text(
        (start + end) / 2 / RATE_HZ, -5, "window: six actions,\n200 samples, 2 s", ha="center", color=GREEN, fontsize=8
    )
    panels[1].set(xlabel="time [s]", ylabel="force x [N]", ylim=(-6, 13))
    panels[1].legend(ncols=2, loc="upper left", fontsize=8)


def main(path: Path) -> None:
    """Beat the fin of the virtual tank and draw."""
    tank = Tank()
    targets = CENTRE_RAD + SWING_RAD * (-1.0) ** np.arange(ACTIONS)
    actions = Command(jnp.asarray(targets, jnp.float32), jnp.full(ACTIONS, VELOCITY_RAD_S))
    state = tank.init(jax.random.key(0))
    _, reading = jax.jit(lambda: hold(tank, state, actions))()
    bent, _ = jax.jit(lambda: hold(tank, state, Command(*(field[:9] for field in actions))))()
    ticks = [ACTION_TICKS[index % len(ACTION_TICKS)] for index in range(ACTIONS)]
    assert sum(ticks[:CYCLE_ACTIONS]) == WINDOW
    with styled():
        figure = new_figure(10, 4)
        left, right = figure.subfigures(1, 2, width_ratios=(1, 1.35))
        draw_frame(left.subplots(), np.asarray(tank.shape(bent)), 0.8)
        panels = right.subplots(2, 1, sharex=True)
        draw_window(panels, np.repeat(targets, ticks), reading.angle, np.asarray(reading.force[:, 0]))
    save_figure(figure, path.parent, path.stem, ("png",))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
