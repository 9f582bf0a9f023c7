"""Draws the first figure of the README and the figures of the concepts, by their names:

    python docs/concepts.py docs/fin.png docs/concept-frame.png docs/concept-plant.png \
        docs/concept-window.png docs/concept-gait.png docs/concept-map.png docs/concept-feedback.png
"""

import sys
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Polygon, Rectangle
from PIL import Image
from safetensors.numpy import load_file

import softfin
from softfin.control.controller import Measured
from softfin.control.family import load_family
from softfin.control.feedback import Feedback, FeedbackConfig
from softfin.control.store import load_controller
from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.plant import hold, masked_mean, mean_loads, repeat
from softfin.core.quantities import RATE_HZ, Command, action_to_command
from softfin.evaluation.fin_figure import draw_fin
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
from softfin.tank import Tank
from softfin.tank.randomization import with_parameters
from softfin.tank.tank import TankState

EXAMPLE = Path(softfin.__file__).parent / "example"
CENTRE_RAD = 0.3
SWING_RAD = 0.5
VELOCITY_RAD_S = 2.8
ACTIONS = 15
SHOWN_TICK = 451
FAINT_TICKS = (24, 18, 12, 6)
WIDTH_IN = 7.2
COLOURS = 64
RED = "#D55E00"


def actions(count: int = ACTIONS) -> Command:
    """Commands to and fro about an angle."""
    targets = CENTRE_RAD + SWING_RAD * (-1.0) ** np.arange(count)
    return Command(jnp.asarray(targets, jnp.float32), jnp.full(count, VELOCITY_RAD_S))


@cache
def beat() -> Any:
    """The readings of the virtual tank under these commands."""
    tank = Tank()
    return jax.tree.map(
        np.asarray, jax.jit(lambda: hold(tank, tank.init(jax.random.key(0)), actions()))()[1]
    )


def mean_force(force_n: np.ndarray) -> np.ndarray:
    """Moving average over the window, from the first full one on."""
    return np.convolve(
        force_n, np.ones(PAPER_CLOCK.window_ticks) / PAPER_CLOCK.window_ticks, "valid"
    )


def without_axes(axes: Any) -> None:
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    axes.grid(visible=False)


def fin(figure: Figure) -> None:
    """The fin in the tank under the gait of the example for a target force, and its traces."""
    target_n = np.array([2.0, -1.0])
    gaits = load_controller(EXAMPLE / "gaits")
    memory = gaits.init()
    commands = []
    for ticks in np.resize(PAPER_CLOCK.ticks, ACTIONS):
        # Gaits use no measurements.
        memory, command = gaits.act(memory, Measured(0.0, np.zeros(2)), target_n)
        commands += [command] * ticks
    tank = Tank()

    def tick(state: Any, command: Command) -> Any:
        state, reading = tank.advance(state, command, 1)
        return state, (reading.angle[0], tank.true_force(state), tank.shape(state))

    def beat_fin() -> Any:
        columns = np.transpose(commands).astype(np.float32)
        return jax.lax.scan(tick, tank.init(jax.random.key(0)), Command(*jnp.asarray(columns)))[1]

    angle, force_n, shape = jax.tree.map(np.asarray, jax.jit(beat_fin)())
    window = PAPER_CLOCK.window_ticks
    mean_n = np.stack([mean_force(force_n[:, axis]) for axis in (0, 1)], axis=1)
    figure.set_size_inches(9.6, 4.8)
    grid = figure.add_gridspec(3, 2)
    water = figure.add_subplot(grid[:, 0])
    for age in FAINT_TICKS:
        faint = shape[SHOWN_TICK - age]
        water.plot(*faint.T, color=GREY, alpha=0.2, linewidth=9, solid_capstyle="round")
    forces_n = np.stack([force_n[SHOWN_TICK], mean_n[SHOWN_TICK - window + 1], target_n])
    draw_fin(water, shape[SHOWN_TICK], forces_n, scale_n=10.0)
    water.set_title("A soft fin in the virtual tank", weight="bold")
    water.legend(loc="lower left")
    time = (np.arange(len(angle)) + 1) / RATE_HZ
    panels = [figure.add_subplot(grid[row, 1]) for row in range(3)]
    panels[0].plot(time, angle, color=BLUE)
    panels[0].set_ylabel("angle [rad]")
    for axis, axes in enumerate(panels[1:]):
        axes.plot(time, force_n[:, axis], color=BLUE, linewidth=0.9)
        axes.plot(time[window - 1 :], mean_n[:, axis], color=BLACK, linewidth=2)
        axes.axhline(target_n[axis], color=ORANGE, linewidth=1.6, zorder=1.9)
        axes.set_ylabel(f"force {'xy'[axis]} [N]")
    for axes in panels:
        axes.axvline(time[SHOWN_TICK], color=BLACK, linewidth=0.9)
        axes.set_xlim(0, time[-1])
        axes.tick_params(labelbottom=axes is panels[-1])
    panels[-1].set_xlabel("time [s]; black: mean over the last 2 s")
    figure.align_ylabels(panels)


def frame(figure: Figure) -> None:
    """The robot's body, the shaft, the bent fin at an angle, and the directions of force."""
    tank = Tank()
    angle_rad = 0.8
    bent, _ = jax.jit(lambda: hold(tank, tank.init(jax.random.key(0)), actions(9)))()
    figure.set_size_inches(WIDTH_IN, 4.4)
    axes = figure.subplots()
    axes.add_patch(
        FancyBboxPatch(
            (0.02, -0.06),
            0.13,
            0.12,
            boxstyle="round,pad=0.01",
            facecolor="#E8ECEF",
            edgecolor=GREY,
        )
    )
    axes.text(0.085, 0.045, "robot", ha="center", va="center", color=GREY)
    axes.plot([0, -0.22], [0, 0], ":", color=GREY, linewidth=1)
    rigid = 0.2 * np.array([-np.cos(angle_rad), np.sin(angle_rad)])
    axes.plot([0, rigid[0]], [0, rigid[1]], "--", color=GREY, linewidth=1)
    axes.text(rigid[0] + 0.012, rigid[1] - 0.005, "a rigid fin", color=GREY, ha="left")
    draw_fin(axes, np.asarray(tank.shape(bent)), np.zeros((0, 2)), 1.0)
    turn = np.linspace(0, angle_rad, 30)
    axes.plot(-0.12 * np.cos(turn), 0.12 * np.sin(turn), color=ORANGE, linewidth=1.5)
    axes.text(-0.135, 0.03, "angle θ\n(of the shaft)", color=RED, ha="right", va="center")
    axes.text(-0.215, -0.015, "θ = 0", color=GREY, ha="left", va="top")
    thrust = "+x: thrust, pushes\nthe robot forward"
    for tip, name, place in (((0.1, 0), thrust, (0.03, -0.105)), ((0, 0.1), "+y", (0.01, 0.1))):
        axes.annotate(
            "", tip, (0, 0), arrowprops={"arrowstyle": "-|>", "color": BLUE, "linewidth": 2}
        )
        axes.text(*place, name, color=BLUE, va="center")
    axes.text(0.0, -0.03, "shaft and\nforce sensor", ha="center", va="top", fontsize=8)
    axes.set(xlim=(-0.25, 0.2), ylim=(-0.15, 0.17), xlabel="", ylabel="")
    without_axes(axes)


def plant(figure: Figure) -> None:
    """A controller and a plant in a loop, and what can be the plant."""
    figure.set_size_inches(WIDTH_IN, 2.6)
    axes = figure.subplots()
    arrow = {"arrowstyle": "-|>", "color": BLACK, "linewidth": 1.4, "shrinkA": 0, "shrinkB": 0}
    boxes = (
        (2.0, "controller", "3 times a second", "#E5F1F8"),
        (6.4, "plant", "100 times a second", "#E3F3EE"),
    )
    for x, name, rate, colour in boxes:
        axes.add_patch(
            FancyBboxPatch(
                (x, 1.5), 1.8, 1.1, boxstyle="round,pad=0.08", facecolor=colour, edgecolor=BLACK
            )
        )
        axes.text(x + 0.9, 2.2, name, ha="center", va="center", weight="bold")
        axes.text(x + 0.9, 1.8, rate, ha="center", va="center", fontsize=8, color=GREY)
    axes.annotate("", (1.92, 2.05), (0.1, 2.05), arrowprops=arrow)
    axes.text(0.95, 2.15, "reference\nforce [N]", ha="center", va="bottom", color=RED)
    axes.annotate("", (6.32, 2.05), (3.88, 2.05), arrowprops=arrow)
    axes.text(
        5.1, 2.15, "command: angle [rad],\nvelocity [rad/s]", ha="center", va="bottom", color=RED
    )
    axes.annotate("", (9.9, 2.05), (8.28, 2.05), arrowprops=arrow)
    axes.text(9.1, 2.15, "readings", ha="center", va="bottom", color=BLUE)
    axes.plot([9.1, 9.1, 2.9], [2.05, 0.75, 0.75], color=BLACK, linewidth=1.4)
    axes.annotate("", (2.9, 1.42), (2.9, 0.74), arrowprops=arrow)
    axes.text(
        6.0,
        0.82,
        "angle [rad]; with --feedback also force (x, y) [N]",
        ha="center",
        va="bottom",
        color=BLUE,
    )
    axes.text(
        5.0,
        0.2,
        "A plant is the virtual tank, a surrogate, your own simulator, or the rig with the real "
        "fin.",
        ha="center",
        va="center",
        color=GREY,
    )
    axes.set(xlim=(0, 10), ylim=(0, 3))
    without_axes(axes)


def window(figure: Figure) -> None:
    """Commands held for 33, 33 and 34 ticks, and the mean force over six of them against the
    reference."""
    reference_n = 4.0
    reading = beat()
    ticks = [PAPER_CLOCK.ticks[index % len(PAPER_CLOCK.ticks)] for index in range(ACTIONS)]
    assert sum(ticks[: PAPER_CLOCK.window_actions]) == PAPER_CLOCK.window_ticks
    figure.set_size_inches(WIDTH_IN, 4.6)
    panels = figure.subplots(2, 1, sharex=True)
    time = (np.arange(len(reading.angle)) + 1) / RATE_HZ
    force_n = reading.force[:, 0]
    end = len(time) - 20
    start = end - PAPER_CLOCK.window_ticks
    mean = mean_force(force_n)
    for axes in panels:
        axes.axvspan(start / RATE_HZ, end / RATE_HZ, color=GREEN, alpha=0.12, linewidth=0)
    commanded = np.repeat(np.asarray(actions().angle), ticks)
    panels[0].step(
        time - 1 / RATE_HZ,
        commanded,
        where="post",
        color=ORANGE,
        label="command, held for one action",
    )
    panels[0].plot(time, reading.angle, color=BLUE, label="angle")
    panels[0].set(xlim=(0, 5.4), ylabel="angle [rad]", ylim=(-0.5, 1.5))
    panels[0].legend(ncols=2, loc="upper left", fontsize=8)
    panels[1].plot(time, force_n, color=BLUE, linewidth=0.9, label="force x at 100 Hz")
    panels[1].plot(
        time[PAPER_CLOCK.window_ticks - 1 :],
        mean,
        color=BLACK,
        linewidth=2,
        label="mean of the last 200 samples",
    )
    panels[1].axhline(reference_n, color=ORANGE, linestyle="--", label="reference force")
    last = float(mean[end - PAPER_CLOCK.window_ticks])
    arrow = {"arrowstyle": "<->", "color": BLACK, "shrinkA": 0, "shrinkB": 0}
    panels[1].annotate("", (end / RATE_HZ, reference_n), (end / RATE_HZ, last), arrowprops=arrow)
    panels[1].text(end / RATE_HZ + 0.05, (reference_n + last) / 2, "error", va="center")
    panels[1].text(
        (start + end) / 2 / RATE_HZ,
        -5,
        "window: six actions,\n200 samples, 2 s",
        ha="center",
        color=GREEN,
        fontsize=8,
    )
    panels[1].set(xlabel="time [s]", ylabel="force x [N]", ylim=(-6, 13))
    panels[1].legend(ncols=2, loc="upper left", fontsize=8)


def gait(figure: Figure) -> None:
    """A gait of the example, repeated three times in the tank without noise, and its mean force."""
    controller = load_controller(EXAMPLE / "gaits")
    table = controller.step.table
    reference_n = (2.0, 0.0)
    times = 4
    scaled = np.tile(np.asarray(table.gait(np.asarray(reference_n, np.float32))), (times, 1))
    tank = Tank()
    command = action_to_command(controller.limits, jnp.asarray(scaled.T))
    reading = jax.tree.map(
        np.asarray, jax.jit(lambda: hold(tank, tank.init(jax.random.key(0)), command))()[1]
    )
    time = (np.arange(len(reading.angle)) + 1) / RATE_HZ
    figure.set_size_inches(WIDTH_IN, 4.0)
    panels = figure.subplots(2, 1, sharex=True)
    cycle = PAPER_CLOCK.window_ticks / RATE_HZ
    for axes in panels:
        for first in range(0, times, 2):
            axes.axvspan(first * cycle, (first + 1) * cycle, color=GREY, alpha=0.1, linewidth=0)
    ticks = [PAPER_CLOCK.ticks[index % len(PAPER_CLOCK.ticks)] for index in range(len(scaled))]
    panels[0].step(
        time - 1 / RATE_HZ,
        np.repeat(np.asarray(command.angle), ticks),
        where="post",
        color=ORANGE,
        label="six actions, repeated",
    )
    panels[0].plot(time, reading.angle, color=BLUE, label="angle")
    panels[0].set(ylabel="angle [rad]", ylim=(-0.9, 1.3), xlim=(0, times * cycle))
    panels[0].legend(ncols=2, loc="upper left", fontsize=8)
    panels[1].plot(time, reading.force[:, 0], color=BLUE, linewidth=0.9, label="force x at 100 Hz")
    panels[1].plot(
        time[PAPER_CLOCK.window_ticks - 1 :],
        mean_force(reading.force[:, 0]),
        color=BLACK,
        linewidth=2,
        label="its mean over 2 s",
    )
    panels[1].axhline(
        reference_n[0], color=ORANGE, linestyle="--", label="force that the gait is for"
    )
    top = 1.45 * float(reading.force[:, 0].max())
    panels[1].set(xlabel="time [s]", ylabel="force x [N]", ylim=(None, top))
    panels[1].legend(ncols=3, loc="upper left", fontsize=8)


def force_map(figure: Figure) -> None:
    """The reachable forces of the example fin, the nodes of its map, and the cells of its grid."""
    gaits = load_controller(EXAMPLE / "gaits")
    grid = load_controller(EXAMPLE / "grid")
    corners = gaits.reachable.corners()
    figure.set_size_inches(WIDTH_IN, 5.0)
    axes = figure.subplots()
    axes.add_patch(Polygon(corners, facecolor=BLUE, alpha=0.12))
    outline = np.concatenate([corners, corners[:1]])
    axes.plot(
        *outline.T,
        color=BLUE,
        linewidth=1.6,
        label="edge of the reachable forces",
    )
    nodes = gaits.step.table.references().reshape(-1, 2)
    force = load_file(EXAMPLE / "gaits" / "weights.safetensors")["force_n"].reshape(-1, 2)
    held = np.linalg.norm(force - nodes, axis=-1) <= 0.1
    axes.plot(
        *nodes[held].T,
        "o",
        color=BLACK,
        markersize=2.2,
        label="node of the map, with the gait that makes this force",
    )
    for index, cell in enumerate(grid.cells):
        (left, bottom) = cell.low
        (right, top) = cell.high
        axes.add_patch(
            Rectangle(
                (left, bottom),
                right - left,
                top - bottom,
                fill=False,
                edgecolor=RED,
                linewidth=1.8,
                label="cell of a grid, with a policy of its own" if index == 0 else None,
            )
        )
        axes.text(
            left + 0.06,
            top - 0.06,
            str(index + 1),
            ha="left",
            va="top",
            color=RED,
            fontsize=8,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6},
        )
    axes.set(aspect="equal", xlabel="mean force x (thrust) [N]", ylabel="mean force y [N]")
    figure.legend(loc="outside lower center", fontsize=8)


def feedback(figure: Figure) -> None:
    """The mean force of the example's gaits in the tank before and after the fin changes, without
    and with feedback."""
    reference_n = np.array([2.0, 1.0])
    count = 180
    changed = with_parameters(
        Tank(), stiffness=0.75, drag=1.2, added_mass=1.1, lag=1.3, dead_time=1.3
    )
    gaits = load_controller(EXAMPLE / "gaits")
    family = load_family(EXAMPLE / "gaits", gaits)

    @jax.jit
    def act(tank: Tank, state: TankState, command: Command, ticks: jax.Array) -> Any:
        def tick(state: TankState) -> tuple[TankState, tuple[Any, Any]]:
            state, reading = tank.advance(state, command, 1)
            return state, (jax.tree.map(lambda x: x[0], reading), state.force, state.torque)

        state, (reading, force, torque) = repeat(tick, state, ticks, PAPER_CLOCK.max_ticks)
        shaft, motor = mean_loads(torque, reading.velocity, ticks)
        measured = Measured(
            reading.angle[ticks - 1], masked_mean(reading.force, ticks), shaft, motor
        )
        return state, measured, force

    def run(controller: Any) -> np.ndarray:
        state = Tank().init(jax.random.key(0))
        memory = controller.init()
        forces = []
        measured = Measured(0.0, np.zeros(2))
        for index in range(count):
            memory, command = controller.act(memory, measured, reference_n)
            ticks = PAPER_CLOCK.ticks[index % 3]
            tank = Tank() if index < count // 2 else changed
            state, seen, force = act(tank, state, Command(*map(jnp.float32, command)), ticks)
            forces.append(np.asarray(force)[:ticks])
            measured = Measured(float(seen.angle), *map(np.asarray, seen[1:]))
        return np.concatenate(forces)

    figure.set_size_inches(WIDTH_IN, 4.0)
    panels = figure.subplots(2, 1, sharex=True)
    runs = [("without", gaits, GREY)]
    for uses, colour in (("force", BLUE), ("torque", GREEN), ("both", BLACK)):
        settings = FeedbackConfig.build({"uses": uses})
        runs.append((f"feedback from {uses}", Feedback(gaits, settings, family), colour))
    for name, controller, colour in runs:
        force_n = run(controller)
        for axis, axes in enumerate(panels):
            mean = mean_force(force_n[:, axis])
            axes.plot(
                (np.arange(len(mean)) + PAPER_CLOCK.window_ticks) / RATE_HZ,
                mean,
                color=colour,
                linewidth=1.6,
                label=name,
            )
    for axis, axes in enumerate(panels):
        axes.axhline(reference_n[axis], color=ORANGE, linestyle="--", label="reference force")
        axes.axvline(count / 6, color=GREY, linestyle=":")
        axes.set(
            ylabel=f"mean force {'xy'[axis]} [N]",
            ylim=(reference_n[axis] - 0.35, reference_n[axis] + 0.35),
        )
    panels[0].legend(ncols=3, loc="upper left", fontsize=8)
    panels[1].set(xlabel="time [s]; the fin changes at 30 s", xlim=(0, count / 3))


FIGURES = {
    "fin": fin,
    "concept-frame": frame,
    "concept-plant": plant,
    "concept-window": window,
    "concept-gait": gait,
    "concept-map": force_map,
    "concept-feedback": feedback,
}


def main(paths: list[Path]) -> None:
    """Draw each figure that is named, with few colours, so that its file is small."""
    for path in paths:
        if path.stem not in FIGURES or path.suffix != ".png":
            names = ", ".join(f"{name}.png" for name in FIGURES)
            sys.exit(f"{path}: no such figure; there are {names}")
        with styled():
            figure = new_figure(WIDTH_IN, 4)
            FIGURES[path.stem](figure)
        save_figure(figure, path)
        image = Image.open(path).convert("RGB")
        image.quantize(COLOURS).save(path, optimize=True)


if __name__ == "__main__":
    main([Path(word) for word in sys.argv[1:]])
