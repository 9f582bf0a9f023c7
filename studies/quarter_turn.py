"""Draws thrust against stiffness and against bending lag: ``python studies/quarter_turn.py
docs/quarter_turn.png``.

The shaft of the virtual tank beats as a sine, with fins of many stiffnesses. Bend: the direction
from shaft to tip less the shaft's angle. Lag: the phase by which the fundamental of the bend is
behind that of the shaft's angle. The table on standard output has the fin of the greatest thrust at
each frequency, in tanks that differ in one thing each.
"""

import sys
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from softfin.core.quantities import TICK_S, Command
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
from softfin.tank import IDEAL, Tank, TankConfig, with_parameters
from softfin.tank.fin import FinConfig
from softfin.tank.hydrodynamics import WaterConfig

AMPLITUDE_RAD = 0.4
"""Amplitude of the commanded angle [rad]; a greater one at 2 Hz needs more than the drive's
acceleration."""

FREQUENCIES_HZ = np.array([0.625, 1.0, 1.375, 2.0])
"""Frequencies of the beat [Hz], with whole cycles in the 8 s that count."""

STIFFNESSES = np.geomspace(0.05, 1.3, 14)
"""Stiffnesses over that of the tank's own fin [-] at 1 Hz; at other frequencies they grow as its
square."""

TICKS = 1000
SETTLED = 200
"""Length of a beat, and where the part that counts begins [ticks of 10 ms]."""


def tank(**parts: FinConfig | WaterConfig) -> Tank:
    """A tank with another fin or other water, and a force sensor without faults."""
    return Tank(TankConfig(sensor=IDEAL, **parts))


TANKS = {
    "default": tank(),
    "span 0.040 m": tank(fin=FinConfig(span_m=0.04)),
    "span 0.160 m": tank(fin=FinConfig(span_m=0.16)),
    "drag coefficient 2": tank(water=WaterConfig(drag_coefficient=2.0)),
    "no damping in the fin": tank(fin=FinConfig(damping_s=0.0)),
    "no stream": tank(water=WaterConfig(stream_decay_s=0.0)),
    "no tip term": tank(water=WaterConfig(tip_coefficient=0.0)),
}
"""Tanks in which the law is tried: the default, other aspect ratios, and others without one part of
the model."""


class Sweep(NamedTuple):
    """Fins of every stiffness at every frequency: ``(frequencies, stiffnesses)``."""

    stiffness: np.ndarray
    """Over that of the tank's own fin [-]; the structural damping goes with it."""
    thrust_n: np.ndarray
    """Mean force along x [N]."""
    lag_deg: np.ndarray
    """Lag of the bend behind the shaft's angle, both in their fundamental [degrees]."""


@jax.jit
def beat(plant: Tank, frequency_hz: jax.Array, stiffness: jax.Array) -> jax.Array:
    """Shaft's angle [rad], direction of the tip [rad] and force x [N] while the fin beats: ``(fins,
    ticks, 3)``."""

    def one(frequency_hz: jax.Array, stiffness: jax.Array) -> jax.Array:
        fin = with_parameters(plant, stiffness=stiffness)

        def tick(state, time_s):
            target = AMPLITUDE_RAD * jnp.sin(2 * jnp.pi * frequency_hz * time_s)
            state, reading = fin.advance(
                state, Command(target, jnp.float32(plant.limits.velocity_max)), 1
            )
            x, y = fin.shape(state)[-1]
            return state, jnp.stack([reading.angle[0], jnp.arctan2(y, -x), reading.force[0, 0]])

        return jax.lax.scan(tick, fin.init(jax.random.key(0)), jnp.arange(TICKS) * TICK_S)[1]

    return jax.vmap(one)(frequency_hz, stiffness)


def sweep(plant: Tank) -> Sweep:
    """Beat fins of every stiffness at every frequency."""
    stiffness = FREQUENCIES_HZ[:, None] ** 2 * STIFFNESSES
    frequency = np.broadcast_to(FREQUENCIES_HZ[:, None], stiffness.shape)
    rows = np.asarray(beat(plant, jnp.asarray(frequency.ravel()), jnp.asarray(stiffness.ravel())))
    shaft, tip, force = np.moveaxis(rows.reshape(*stiffness.shape, TICKS, 3)[:, :, SETTLED:], -1, 0)
    turns = np.exp(-2j * np.pi * FREQUENCIES_HZ[:, None] * np.arange(SETTLED, TICKS) * TICK_S)
    angle, bend = (np.einsum("fst,ft->fs", series, turns) for series in (shaft, tip - shaft))
    return Sweep(stiffness, force.mean(axis=-1), np.degrees(np.unwrap(-np.angle(bend / angle))))


class Optimum(NamedTuple):
    """The fin of the greatest thrust at each frequency; nan where that is not between the
    stiffnesses tried."""

    stiffness: np.ndarray
    thrust_n: np.ndarray
    lag_deg: np.ndarray


def optima(found: Sweep) -> Optimum:
    """Interpolate the greatest thrusts: a parabola through the best three points, over the
    stiffness's logarithm."""
    rows = []
    for stiffness, thrust, lag in zip(*found, strict=True):
        best = int(thrust.argmax())
        log = np.log(stiffness)
        if best in (0, len(log) - 1):
            rows.append((np.nan, np.nan, np.nan))
            continue
        curve = np.polyfit(log[best - 1 : best + 2] - log[best], thrust[best - 1 : best + 2], 2)
        ahead = -curve[1] / (2 * curve[0])
        at = log[best] + ahead
        rows.append((np.exp(at), np.polyval(curve, ahead), np.interp(at, log, lag)))
    return Optimum(*np.array(rows).T)


def draw(found: Sweep, best: Optimum) -> Figure:
    """Thrust over its greatest at each frequency: left against the fin's stiffness, right against
    its lag."""
    with styled():
        figure = new_figure(8, 2.9)
        left, right = figure.subplots(1, 2, sharey=True)
        right.axvline(90, color=GREY, linestyle=":", linewidth=1.5)
        for i, (frequency, colour, line) in enumerate(
            zip(
                FREQUENCIES_HZ,
                (BLUE, ORANGE, GREEN, BLACK),
                ("-", "--", "-.", (0, (1, 1))),
                strict=True,
            )
        ):
            for axes, x, peak in (
                (left, found.stiffness, best.stiffness),
                (right, found.lag_deg, best.lag_deg),
            ):
                axes.plot(
                    x[i],
                    found.thrust_n[i] / best.thrust_n[i],
                    color=colour,
                    linestyle=line,
                    label=f"{frequency:g} Hz, {best.thrust_n[i]:.2f} N",
                )
                axes.plot(peak[i], 1, "o", color=colour, markersize=5)
        left.set(
            xscale="log",
            xlabel="stiffness over the default fin's [-]",
            ylabel="thrust over its greatest [-]",
            title="A faster beat wants a stiffer fin ...",
            ylim=(0, 1.08),
        )
        left.set_xticks([0.02, 0.1, 0.5, 2], ["0.02", "0.1", "0.5", "2"])
        left.minorticks_off()
        left.legend(
            fontsize=8, loc="lower right", title="frequency, greatest thrust", title_fontsize=8
        )
        right.set(
            xlabel="lag of the bend behind the shaft [degrees]",
            title="... of the same lag",
            xlim=(180, 45),
            xticks=range(60, 181, 30),
        )
    return figure


def main(path: Path) -> None:
    """Print the table and draw the default tank's."""
    print("| tank | " + " | ".join(f"{frequency:g} Hz" for frequency in FREQUENCIES_HZ) + " |")
    print("| --- |" + " --- |" * len(FREQUENCIES_HZ))
    found = {name: sweep(each) for name, each in TANKS.items()}
    for name, each in found.items():
        best = optima(each)
        cells = (
            f"{lag:.0f} ({stiffness:.2f}, {thrust:.2f} N)"
            for stiffness, thrust, lag in zip(*best, strict=True)
        )
        print(f"| {name} | " + " | ".join(cells) + " |")
    save_figure(draw(found["default"], optima(found["default"])), path)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
