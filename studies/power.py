"""Draws force against electrical power in the virtual tank: ``python studies/power.py DEFAULT POWER
docs/power.png``.

DEFAULT and POWER are gait controllers: maps of the same surrogate without and with ``--power``. The
study also prints the true force, power and Sobolev term of both at the paper's references.
"""

import sys
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
from softfin.control.gait import GaitStep
from softfin.control.store import load_controller
from softfin.core.plant import State
from softfin.core.power import drive_power
from softfin.core.quantities import RATE_HZ, Command, action_to_command
from softfin.core.window import PAPER_WINDOW, sobolev
from softfin.gaits.reachable import PAPER_REFERENCES
from softfin.storage.figures import new_figure, save_figure, styled
from softfin.tank import Tank
from studies.open_loop import CHUNK, FREQUENCIES_HZ, ShaftSine, repeated

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


class Runs(NamedTuple):
    """The last window of runs in the tank."""

    force: Float[np.ndarray, "runs 2"]
    """True mean force [N]."""
    power: Float[np.ndarray, "runs 2"]
    """Mean mechanical and electrical power [W]."""
    smoothness: Float[np.ndarray, "runs"]
    """Sobolev term in the form `mean`, sum of x and y [N]."""


@eqx.filter_jit
def _run(commands: Command) -> tuple[Array, Array, Array]:
    def tick(state: State, command: Command) -> tuple[State, tuple[Array, Array, Array]]:
        state, reading = TANK.advance(state, command, 1)
        return state, (TANK.true_force(state), TANK.torque(state), reading.velocity[0])

    def one(commands: Command) -> tuple[Array, Array, Array]:
        state = TANK.init(jax.random.key(0))
        force, torque, velocity = jax.lax.scan(tick, state, commands)[1]
        last = force[-PAPER_WINDOW:]
        power = drive_power(torque, velocity)[-PAPER_WINDOW:]
        smoothness = sobolev(last, jnp.int32(PAPER_WINDOW)).sum()
        return last.mean(axis=0), power.mean(axis=0), smoothness

    return jax.vmap(one)(commands)


def run(commands: Command) -> Runs:
    """Run commands ``(runs, ticks)`` in the tank."""
    return Runs(*map(np.asarray, _run(jax.tree.map(jnp.asarray, commands))))


def run_gaits(controller: LoadedController, references: Float[np.ndarray, "references 2"]) -> Runs:
    """Run the gait for each reference."""
    assert isinstance(controller.step, GaitStep)
    table = controller.step.table
    gaits = np.stack([table.gait(reference) for reference in references.astype(np.float32)])
    commands = action_to_command(controller.limits, np.moveaxis(gaits, -1, 0))
    angle, velocity = repeated(commands, SECONDS)
    # The limits of a surrogate may exceed those of the tank by a rounding error.
    limits = TANK.limits
    return run(Command(np.clip(angle, limits.angle_min, limits.angle_max), velocity))


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


def draw(gaits: Mapping[str, LoadedController], sines: Runs) -> Figure:
    """Plot the electrical power over the force in each direction."""
    with styled():
        figure = new_figure(10.0, 3.6)
        panels = figure.subplots(1, len(DIRECTIONS_DEG), sharey=True)
        for axes, degrees in zip(panels, DIRECTIONS_DEG, strict=True):
            turn = np.deg2rad(degrees)
            targets = MAGNITUDES_N[:, None] * [np.cos(turn), np.sin(turn)]
            for (label, controller), style in zip(gaits.items(), ("o-", "s--"), strict=True):
                reached = controller.reachable.contains(targets)
                found = run_gaits(controller, targets[reached])
                axes.plot(
                    MAGNITUDES_N[reached], found.power[:, 1], style, markersize=3, label=label
                )
            apart = np.linalg.norm(sines.force[None] - targets[:, None], axis=-1)
            along = sines.force @ [np.cos(turn), np.sin(turn)]
            counts = (apart < TOLERANCE_N) & (along[None] >= MAGNITUDES_N[:, None])
            cheapest = np.where(counts, sines.power[:, 1], np.inf).min(axis=1)
            found_one = counts.any(axis=1)
            axes.plot(MAGNITUDES_N[found_one], cheapest[found_one], "x:", label="best sine")
            axes.plot(*T200_N_W.T, "k-.", linewidth=1, label="T200 thruster")
            axes.set(
                title=f"{degrees} degrees from +x", xlabel="force [N]", xlim=(0, 4.2), ylim=(0, 16)
            )
        panels[0].set_ylabel("electrical power [W]")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


def print_table(gaits: Mapping[str, LoadedController]) -> None:
    """Print the error per axis, power and Sobolev term of each controller at each reference."""
    references = np.array(PAPER_REFERENCES, float)
    for label, controller in gaits.items():
        runs = run_gaits(controller, references)
        print(label)
        for reference, force, power, smoothness in zip(references, *runs, strict=True):
            error = np.abs(force - reference).mean()
            print(
                f"({reference[0]:g}, {reference[1]:g}) N: error {error:.3f} N, mechanical "
                f"{power[0]:.2f} W, electrical {power[1]:.2f} W, Sobolev {smoothness:.2f} N"
            )


if __name__ == "__main__":
    default, cheap, target = map(Path, sys.argv[1:])
    gaits = {"default map": load_controller(default), "map with --power": load_controller(cheap)}
    print_table(gaits)
    save_figure(draw(gaits, run_sines()), target)
