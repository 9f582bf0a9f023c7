"""Draws force against electrical power in the virtual tank: ``python -m studies.power PNG
LABEL=CONTROLLER ...``, with the cheapest sines of the shaft and the T200 thruster.
"""

import argparse
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure

from softfin.control.controller import LoadedController
from softfin.control.store import load_controller
from softfin.core.errors import CoverageError
from softfin.core.plant import State
from softfin.core.power import drive_power
from softfin.core.quantities import RATE_HZ, Command
from softfin.core.window import PAPER_WINDOW
from softfin.evaluation import experiment
from softfin.storage.figures import new_figure, save_figure, styled
from softfin.tank import Tank
from studies.open_loop import CHUNK, FREQUENCIES_HZ, ShaftSine

T200_N_W = np.array([(1.3, 1.6), (2.2, 3.2), (5.0, 9.6)])
"""Force [N] and electrical power [W] of a Blue Robotics T200 thruster at 16 V, forwards, from the
table of the manufacturer; its currents below 1 A are rounded to 0.1 A."""

DIRECTIONS_DEG = (0, 27, 45)
"""Directions of the force in the figure, from +x towards +y."""

MAGNITUDES_N = np.arange(0.5, 4.01, 0.25)

SECONDS = 12
"""Duration of a run from rest; the last window is evaluated."""

TOLERANCE_N = 0.15
"""Distance from its target within which the force of a sine counts. It must not be smaller than the
target, because a smaller force always costs less."""

TANK = Tank()
KEYS = jax.random.split(jax.random.key(0), 1)
STYLES = ("o-", "s--", "^", "v")
"""Policies miss their references by various forces, so no line joins these."""


class Runs(NamedTuple):
    """The last window of runs in the tank."""

    force: Float[np.ndarray, "runs 2"]
    """True mean force [N]."""
    power: Float[np.ndarray, "runs 2"]
    """Mean mechanical and electrical power [W]."""


@eqx.filter_jit
def _run(commands: Command) -> tuple[Array, Array]:
    def tick(state: State, command: Command) -> tuple[State, tuple[Array, Array, Array]]:
        state, reading = TANK.advance(state, command, 1)
        return state, (TANK.true_force(state), TANK.torque(state), reading.velocity[0])

    def one(commands: Command) -> tuple[Array, Array]:
        state = TANK.init(jax.random.key(0))
        force, torque, velocity = jax.lax.scan(tick, state, commands)[1]
        last = force[-PAPER_WINDOW:]
        power = drive_power(torque, velocity)[-PAPER_WINDOW:]
        return last.mean(axis=0), power.mean(axis=0)

    return jax.vmap(one)(commands)


def run(commands: Command) -> Runs:
    """Run commands ``(runs, ticks)`` in the tank."""
    return Runs(*map(np.asarray, _run(jax.tree.map(jnp.asarray, commands))))


def run_controller(controller: LoadedController, references: Float[np.ndarray, "points 2"]) -> Runs:
    """Run a controller, and take the means over its last windows."""
    recording = experiment.run(controller, TANK, references, SECONDS, KEYS)
    last = np.s_[:, 0, -PAPER_WINDOW:]
    assert recording.power is not None
    return Runs(recording.force[last].mean(axis=1), recording.power[last].mean(axis=1))


def held(controller: LoadedController, targets: Float[np.ndarray, "points 2"]) -> list[bool]:
    """Return which forces a controller can hold."""
    is_held = controller.reachable.contains(targets)
    for index, (x, y) in enumerate(targets.tolist()):
        try:
            controller.check((x, y))
        except CoverageError:
            is_held[index] = False
    return is_held


def run_sines() -> Runs:
    """Run all sines of a lattice."""
    centres = np.linspace(0, -1.5, 31)
    amplitudes = np.linspace(0.05, 1.5, 30)
    sines = np.array(list(product(centres, amplitudes, FREQUENCIES_HZ)))
    commands = ShaftSine(*sines.T).commands(TANK.limits, SECONDS * RATE_HZ)
    parts = []
    for start in range(0, len(sines), CHUNK):
        part = slice(start, start + CHUNK)
        parts.append(run(Command(commands.angle[part], commands.velocity[part])))
    return Runs(*map(np.concatenate, zip(*parts, strict=True)))


def draw(controllers: Mapping[str, LoadedController], sines: Runs) -> Figure:
    """Plot the electrical power over the force in each direction."""
    with styled():
        figure = new_figure(10.0, 3.6)
        panels = figure.subplots(1, len(DIRECTIONS_DEG), sharey=True)
        for axes, degrees in zip(panels, DIRECTIONS_DEG, strict=True):
            turn = np.deg2rad(degrees)
            along = np.array([np.cos(turn), np.sin(turn)])
            targets = MAGNITUDES_N[:, None] * along
            for (label, controller), style in zip(controllers.items(), STYLES, strict=False):
                found = run_controller(controller, targets[held(controller, targets)])
                axes.plot(found.force @ along, found.power[:, 1], style, markersize=3, label=label)
            apart = np.linalg.norm(sines.force[None] - targets[:, None], axis=-1)
            counts = (apart < TOLERANCE_N) & ((sines.force @ along)[None] >= MAGNITUDES_N[:, None])
            cheapest = np.where(counts, sines.power[:, 1], np.inf).min(axis=1)
            found_one = counts.any(axis=1)
            axes.plot(MAGNITUDES_N[found_one], cheapest[found_one], "x:", label="best sine")
            axes.plot(*T200_N_W.T, "k-.", linewidth=1, label="T200 thruster")
            axes.set(
                title=f"{degrees} degrees from +x", xlabel="force [N]", xlim=(0, 4.2), ylim=(0, 16)
            )
        panels[0].set_ylabel("electrical power [W]")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("png", type=Path)
    parser.add_argument("controllers", nargs="+", metavar="LABEL=CONTROLLER")
    words = parser.parse_args()
    controllers = {}
    for each in words.controllers:
        label, _, folder = each.partition("=")
        controllers[label] = load_controller(Path(folder))
    save_figure(draw(controllers, run_sines()), words.png)


if __name__ == "__main__":
    main()
