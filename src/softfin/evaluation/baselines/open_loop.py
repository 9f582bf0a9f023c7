"""Open-loop commands, tried on a plant, usually a surrogate: sines of the shaft, the U-CAT robots'
model, gaits.

Commands are issued once per tick, so that a sine can be commanded; an action held for 33 ticks is
33 equal commands.

The drive runs a velocity profile to its target angle, so the target follows the sine, and the
profile velocity, which is a limit, stays at the largest speed of the sine. A limit that followed
the speed of the sine would hold the profile back at each reversal: in the virtual tank a sine of
0.4 rad and 2 Hz would become one of 0.25 rad; this way it reaches 0.39 rad.

The inverse model, `softfin.gaits.inverse_model`, chooses a sine for a force.
"""

from itertools import product
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PRNGKeyArray
from pydantic import Field, PositiveFloat, PositiveInt

from softfin.core.action_clock import CYCLE_ACTIONS, action_ticks
from softfin.core.configuration import Configuration
from softfin.core.errors import RunError
from softfin.core.json_object import JsonObject
from softfin.core.plant import Plant, roll_with_true_force
from softfin.core.plant_identity import jit_argument
from softfin.core.quantities import RATE_HZ, TICK_S, AnyArray, Command, Limits, Reading
from softfin.core.randomness import named_generator, named_key
from softfin.core.window import moving_error
from softfin.gaits.inverse_model import InverseConfig, find_amplitude

MeanForces = Float[np.ndarray, "cases ticks 2"]
ReferenceRows = Float[np.ndarray, "references 2"]
Sines = Float[np.ndarray, "cases 3"]
"""Centre [rad], amplitude [rad] and frequency [Hz]."""

CHUNK = 256
"""Largest number of cases that run together: one compiled program works for any larger number."""

OFFSETS = np.array(list(product(range(-2, 3), repeat=2)))
"""Steps of centre and amplitude to the 5 x 5 sines around one that is refined."""

ROUNDING = 1e-6
"""Rounding error of single precision at the largest angles [rad] and velocities [rad/s]."""


class ShaftSine(NamedTuple):
    """angle(t) = centre + amplitude sin(2 pi frequency t)."""

    centre: Float[AnyArray, "*shape"]
    """Centre angle [rad]."""
    amplitude: Float[AnyArray, "*shape"]
    """Amplitude [rad]."""
    frequency: Float[AnyArray, "*shape"]
    """Periods a second [Hz]."""

    def commands(
        self, limits: Limits, ticks: int
    ) -> tuple[Command, Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Return commands ``(*shape, ticks)`` within the limits, and the fractions of ticks at
        which these clip angle and speed.

        A profile velocity that is raised to the plant's lowest one clips nothing, because the
        target angle still sets the pace.
        """
        centre, amplitude, frequency = (jnp.asarray(part, jnp.float32)[..., None] for part in self)
        # The command of a tick affects the reading at its end.
        turn = 2 * jnp.pi * frequency * (jnp.arange(ticks) + 1) * TICK_S
        angle = centre + amplitude * jnp.sin(turn)
        # |d angle / dt| = 2 pi f A |cos(2 pi f t)|, at most 2 pi f A.
        fastest = 2 * jnp.pi * frequency * amplitude
        outside = (angle < limits.angle_min - ROUNDING) | (angle > limits.angle_max + ROUNDING)
        too_fast = fastest * jnp.abs(jnp.cos(turn)) > limits.velocity_max + ROUNDING
        velocity = jnp.broadcast_to(
            jnp.clip(fastest, limits.velocity_min, limits.velocity_max), angle.shape
        )
        command = Command(jnp.clip(angle, limits.angle_min, limits.angle_max), velocity)
        return command, outside.mean(axis=-1), too_fast.mean(axis=-1)


def inverse(
    force: Float[np.ndarray, "forces 2"],
    frequency: float,
    limits: Limits,
    config: InverseConfig,
    constant: float,
) -> tuple[ShaftSine, list[JsonObject]]:
    """Return the sine that should give each force (x, y) [N] on average; `constant` is K [N s2],
    the config's or a fitted one.

    Also returns, for JSON, whether the amplitude was clipped to the driver's range (to pi if no
    amplitude is large enough) and the centre to the angles that the plant accepts. Thrust at angle
    theta points along (cos theta, -sin theta), so a force towards -y is made at a positive angle.
    """
    wanted = np.arctan2(-force[:, 1], force[:, 0])
    centre = np.clip(wanted, limits.angle_min, limits.angle_max)
    exact = find_amplitude(np.linalg.norm(force, axis=1), frequency, constant)
    amplitude = np.clip(exact, config.amplitude_min_rad, config.amplitude_max_rad)
    limited = [
        {
            "amplitude_limited": bool(size),
            "direction_limited": bool(direction),
            "constant_n_s2": constant,
        }
        for size, direction in zip(amplitude != exact, centre != wanted, strict=True)
    ]
    return ShaftSine(centre, amplitude, np.full_like(amplitude, frequency)), limited


class SearchConfig(Configuration):
    """Length and fineness of the search."""

    seconds: int = Field(default=8, ge=3)
    """Length of a trial from rest [s], whole; its first 2 s fill the first window."""
    frequencies_hz: tuple[PositiveFloat, ...] = Field(
        default=(0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0), min_length=1
    )
    """Frequencies of the sines [Hz]; whole periods fill the window of 2 s, so that its mean has no
    ripple."""
    centres: int = Field(default=13, ge=2)
    """Number of zero directions in the first lattice, over the angles that the plant accepts."""
    amplitudes: int = Field(default=8, ge=2)
    """Number of amplitudes in the first lattice, up to `amplitude_max_rad`."""
    amplitude_max_rad: float = Field(default=1.5, gt=0, le=np.pi)
    """Largest amplitude of a sine [rad]."""
    kept: PositiveInt = 4
    """Number of sines that are refined for each reference."""
    refinements: int = Field(default=4, ge=0)
    """Number of rounds; each halves the steps of centre and amplitude and tries the 5 x 5 sines
    around each kept one."""
    gaits: PositiveInt = 256
    """Number of random gaits of six actions: as many as a look-up table might contain."""
    trials: int = Field(default=6, ge=1)
    """Number of sines straight ahead to which the inverse model's constant is fitted, over the
    driver's amplitudes."""


@eqx.filter_jit
def run_commands(
    plant: Plant, commands: Command, keys: Key[Array, "seeds"]
) -> tuple[Reading, Array | None]:
    """Issue every series of commands with every key of the plant, each from rest.

    Returns the readings ``(cases, seeds, ticks)`` and the true force ``(cases, seeds, ticks, 2)``
    [N], or None if the plant does not know it. `plant` is the result of `jit_argument`.
    """

    def one(command: Command, key: PRNGKeyArray) -> tuple[Reading, Array | None]:
        return roll_with_true_force(plant, plant.init(key), command)[1]

    recorded: tuple[Reading, Array | None]
    recorded = jax.vmap(jax.vmap(one, in_axes=(None, 0)), in_axes=(0, None))(commands, keys)
    return recorded


def repeated(gaits: Command, seconds: int) -> Command:
    """Repeat gaits of six actions on the 33/33/34 clock: one command per tick."""
    actions = np.arange(CYCLE_ACTIONS * seconds) % CYCLE_ACTIONS
    rows = np.repeat(actions, action_ticks(len(actions)))[: seconds * RATE_HZ]
    return Command(*(np.asarray(part)[..., rows].astype(np.float32) for part in gaits))


def force_errors(
    forces: MeanForces, references: ReferenceRows
) -> Float[np.ndarray, "cases references"]:
    """Return the error of each case at each reference: those of x and y combined [N], as in Table
    II."""
    return np.stack(
        [moving_error(forces, reference).sum(axis=1) for reference in references], axis=1
    )


class OpenLoopSearch(NamedTuple):
    """Tries sines and gaits on a plant."""

    plant: Plant
    limits: Limits
    """Limits of the commands."""
    config: SearchConfig
    seed: int

    def forces(self, commands: Command) -> MeanForces:
        """Forces of many series of commands, all with one key."""
        count = len(commands.angle)
        size = min(CHUNK, count)
        # Padded with repetitions of the last case, whose forces are dropped again.
        padded = Command(
            *(np.pad(part, ((0, -count % size), (0, 0)), mode="edge") for part in commands)
        )
        plant = jit_argument(self.plant)
        keys = named_key(self.seed, "baselines/search")[None]
        parts = (Command(*(part[i : i + size] for part in padded)) for i in range(0, count, size))
        return np.concatenate(
            [np.asarray(run_commands(plant, part, keys)[0].force[:, 0]) for part in parts]
        )[:count]

    def forces_of_sines(self, sines: Sines) -> MeanForces:
        """Forces of many sines."""
        return self.forces(
            ShaftSine(*sines.T).commands(self.limits, self.config.seconds * RATE_HZ)[0]
        )

    def best_sines(self, references: ReferenceRows) -> ShaftSine:
        """Find the sine with the smallest error for each reference: in a lattice, then in finer
        ones around the best of each."""
        config = self.config
        low, high = np.array(
            [(self.limits.angle_min, 0.0), (self.limits.angle_max, config.amplitude_max_rad)]
        )
        # Distance of neighbours in the lattice of centres and amplitudes, whose amplitudes leave
        # out 0, at which all sines are one.
        step = (high - low) / [config.centres - 1, config.amplitudes]
        centres = np.linspace(low[0], high[0], config.centres)
        amplitudes = np.linspace(low[1], high[1], config.amplitudes + 1)[1:]
        lattice = np.array(list(product(centres, amplitudes, config.frequencies_hz)))
        tried = [
            (lattice, error) for error in force_errors(self.forces_of_sines(lattice), references).T
        ]
        for _ in range(config.refinements):
            step = step / 2
            near = []
            # The best sines of each reference, each with its 5 x 5 neighbours, whose frequency is
            # its own.
            for points, error in tried:
                best = points[np.argsort(error)[: config.kept]].repeat(len(OFFSETS), axis=0)
                best[:, :2] = np.clip(
                    best[:, :2] + np.tile(OFFSETS * step, (len(best) // len(OFFSETS), 1)), low, high
                )
                near.append(best)
            # All references in one call, so that one program serves them.
            forces = np.split(
                self.forces_of_sines(np.concatenate(near)),
                np.cumsum([len(new) for new in near])[:-1],
            )
            tried = [
                (
                    np.concatenate([points, new]),
                    np.concatenate([error, force_errors(force, reference[None])[:, 0]]),
                )
                for (points, error), new, force, reference in zip(
                    tried, near, forces, references, strict=True
                )
            ]
        return ShaftSine(*np.stack([points[error.argmin()] for points, error in tried], axis=1))

    def best_gaits(self, references: ReferenceRows) -> Command:
        """Find the gait with the smallest error for each reference, ``(references, 6)``, among the
        same random ones."""
        limits = self.limits
        generator = named_generator(self.seed, "baselines/gaits")
        shape = (self.config.gaits, CYCLE_ACTIONS)
        gaits = Command(
            generator.uniform(limits.angle_min, limits.angle_max, shape),
            generator.uniform(limits.velocity_min, limits.velocity_max, shape),
        )
        best = force_errors(self.forces(repeated(gaits, self.config.seconds)), references).argmin(
            axis=0
        )
        return Command(*(part[best] for part in gaits))

    def fitted_constant(self, frequency: float, amplitudes: tuple[float, float]) -> float:
        """Fit the inverse model's constant [N s2] to the fin by least squares; raises RunError if
        it pulls."""
        amplitude = np.linspace(*amplitudes, self.config.trials)
        forces = self.forces_of_sines(
            np.stack([0 * amplitude, amplitude, np.full_like(amplitude, frequency)], axis=1)
        )
        # At angle 0 thrust is along x. The first window shows how the fin starts.
        force = forces[:, 2 * RATE_HZ :, 0].mean(axis=1, dtype=np.float64)
        # F = K f^2 (1 - cos A) (`softfin.gaits.inverse_model`): K by least squares.
        unit = frequency**2 * (1 - np.cos(amplitude))
        constant = float(unit @ force / (unit @ unit))
        if not constant > 0:
            raise RunError(
                f"inverse model at {frequency:g} Hz: the trials' mean force is {force.mean():.3g} "
                "N, against the zero direction; the model holds for fins that push along it; give "
                "another frequency"
            )
        return constant
