"""Search for open-loop commands on a plant, usually a surrogate: shaft sines, the inverse model of
the U-CAT robots, and gaits.

Commands are issued once per tick, so that they can follow a sine; an action held for 33 ticks is 33
equal commands.

The drive runs a velocity profile to its target angle. The target follows the sine, while the
profile velocity, which is a limit, stays at the sine's maximum speed. If the limit followed the
speed of the sine, it would slow the profile down at each reversal: in the virtual tank, a sine of
0.4 rad at 2 Hz would reach 0.25 rad instead of 0.39 rad.

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

from softfin.core.action_clock import PAPER_CLOCK
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
"""Maximum number of cases per call; larger sets are split, so that one program serves them all."""

OFFSETS = np.array(list(product(range(-2, 3), repeat=2)))
"""Offsets of the 5 x 5 sines around a sine to refine, in steps of centre and amplitude."""

ROUNDING = 1e-6
"""Single-precision rounding error at the largest angles [rad] and velocities [rad/s]."""


class ShaftSine(NamedTuple):
    """angle(t) = centre + amplitude sin(2 pi frequency t)."""

    centre: Float[AnyArray, "*shape"]
    """Centre angle [rad]."""
    amplitude: Float[AnyArray, "*shape"]
    """Amplitude [rad]."""
    frequency: Float[AnyArray, "*shape"]
    """Frequency [Hz]."""

    def commands(
        self, limits: Limits, ticks: int
    ) -> tuple[Command, Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Return commands ``(*shape, ticks)`` within the limits, and the fractions of ticks at
        which the limits clip the angle and the speed.

        Raising the profile velocity to the plant's minimum is not clipping, because the target
        angle still sets the pace.
        """
        centre, amplitude, frequency = (jnp.asarray(part, jnp.float32)[..., None] for part in self)
        # The command of a tick affects the reading at the end of that tick, so time starts at 1.
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
    """Return the sine that should produce each mean force (x, y) [N]; `constant` is K [N s2], from
    the configuration or fitted.

    Also returns, for JSON, whether the amplitude was clipped to the driver's range (an amplitude of
    pi if none is large enough) and whether the centre was clipped to the plant's angle limits.
    Thrust at angle theta points along (cos theta, -sin theta), so a force towards -y requires a
    positive angle.
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
    """Duration and resolution of the search."""

    seconds: int = Field(default=8, ge=3)
    """Duration of a trial from rest [s], an integer; the first 2 s fill the first window."""
    frequencies_hz: tuple[PositiveFloat, ...] = Field(
        default=(0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0), min_length=1
    )
    """Frequencies of the sines [Hz]; a whole number of periods fits into the window of 2 s, so that
    the mean has no ripple."""
    centres: int = Field(default=13, ge=2)
    """Number of centre angles in the first lattice, over the plant's angle limits."""
    amplitudes: int = Field(default=8, ge=2)
    """Number of amplitudes in the first lattice, up to `amplitude_max_rad`."""
    amplitude_max_rad: float = Field(default=1.5, gt=0, le=np.pi)
    """Largest amplitude of a sine [rad]."""
    kept: PositiveInt = 4
    """Number of sines that are refined per reference."""
    refinements: int = Field(default=4, ge=0)
    """Number of refinement rounds; each halves the steps of centre and amplitude and tries the
    5 x 5 sines around each kept sine."""
    gaits: PositiveInt = 256
    """Number of random gaits of six actions; a look-up table might contain as many."""
    trials: int = Field(default=6, ge=1)
    """Number of sines about angle 0 to which the inverse model's constant is fitted; they cover the
    driver's range of amplitudes."""


@eqx.filter_jit
def run_commands(
    plant: Plant, commands: Command, keys: Key[Array, "seeds"]
) -> tuple[Reading, Array | None]:
    """Issue every series of commands with every key of the plant, each from rest.

    Returns the readings ``(cases, seeds, ticks)`` and the true force ``(cases, seeds, ticks, 2)``
    [N], or None if the plant does not compute it. `plant` is the result of `jit_argument`.
    """

    def one(command: Command, key: PRNGKeyArray) -> tuple[Reading, Array | None]:
        return roll_with_true_force(plant, plant.init(key), command)[1]

    recorded: tuple[Reading, Array | None]
    recorded = jax.vmap(jax.vmap(one, in_axes=(None, 0)), in_axes=(0, None))(commands, keys)
    return recorded


def repeated(gaits: Command, seconds: int) -> Command:
    """Repeat gaits of six actions on the 33/33/34 clock: one command per tick."""
    actions = np.arange(PAPER_CLOCK.window_actions * seconds) % PAPER_CLOCK.window_actions
    rows = np.repeat(actions, PAPER_CLOCK.action_ticks(len(actions)))[: seconds * RATE_HZ]
    return Command(*(np.asarray(part)[..., rows].astype(np.float32) for part in gaits))


def force_errors(
    forces: MeanForces, references: ReferenceRows
) -> Float[np.ndarray, "cases references"]:
    """Return the error of each case at each reference [N]: the sum of the errors in x and y, as
    defined for Table II."""
    return np.stack(
        [moving_error(forces, reference).sum(axis=1) for reference in references], axis=1
    )


class OpenLoopSearch(NamedTuple):
    """Search for sines and gaits by trying them on a plant."""

    plant: Plant
    limits: Limits
    """Limits of the commands."""
    config: SearchConfig
    seed: int

    def forces(self, commands: Command) -> MeanForces:
        """Return the forces of many series of commands, all with the same key."""
        count = len(commands.angle)
        size = min(CHUNK, count)
        # Pad with copies of the last case to full chunks; their forces are dropped at the end.
        padding = ((0, -count % size), (0, 0))
        angle, velocity = (np.pad(field, padding, mode="edge") for field in commands)
        plant = jit_argument(self.plant)
        keys = named_key(self.seed, "baselines/search")[None]
        forces = []
        for start in range(0, count, size):
            chunk = Command(angle[start : start + size], velocity[start : start + size])
            reading, _ = run_commands(plant, chunk, keys)
            forces.append(np.asarray(reading.force[:, 0]))
        return np.concatenate(forces)[:count]

    def forces_of_sines(self, sines: Sines) -> MeanForces:
        """Return the forces of many sines."""
        return self.forces(
            ShaftSine(*sines.T).commands(self.limits, self.config.seconds * RATE_HZ)[0]
        )

    def best_sines(self, references: ReferenceRows) -> ShaftSine:
        """Find the sine with the smallest error for each reference: first on a lattice, then on
        finer lattices around the best sines."""
        config = self.config
        low, high = np.array(
            [(self.limits.angle_min, 0.0), (self.limits.angle_max, config.amplitude_max_rad)]
        )
        # Spacing of the lattice. Its amplitudes start above 0, because at 0 all frequencies give
        # the same motion.
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
            # For each reference, the best sines and their 5 x 5 neighbours of the same frequency.
            for points, error in tried:
                best = points[np.argsort(error)[: config.kept]].repeat(len(OFFSETS), axis=0)
                best[:, :2] = np.clip(
                    best[:, :2] + np.tile(OFFSETS * step, (len(best) // len(OFFSETS), 1)), low, high
                )
                near.append(best)
            # All references in one call, so that they share one compiled program.
            forces = np.split(
                self.forces_of_sines(np.concatenate(near)),
                np.cumsum([len(new) for new in near])[:-1],
            )
            extended = []
            for (points, error), new, force, reference in zip(
                tried, near, forces, references, strict=True
            ):
                new_error = force_errors(force, reference[None])[:, 0]
                extended.append((np.concatenate([points, new]), np.concatenate([error, new_error])))
            tried = extended
        return ShaftSine(*np.stack([points[error.argmin()] for points, error in tried], axis=1))

    def best_gaits(self, references: ReferenceRows) -> Command:
        """Find the gait with the smallest error for each reference ``(references, 6)``; all
        references share the same random gaits."""
        limits = self.limits
        generator = named_generator(self.seed, "baselines/gaits")
        shape = (self.config.gaits, PAPER_CLOCK.window_actions)
        gaits = Command(
            generator.uniform(limits.angle_min, limits.angle_max, shape),
            generator.uniform(limits.velocity_min, limits.velocity_max, shape),
        )
        best = force_errors(self.forces(repeated(gaits, self.config.seconds)), references).argmin(
            axis=0
        )
        return Command(gaits.angle[best], gaits.velocity[best])

    def fitted_constant(self, frequency: float, amplitudes: tuple[float, float]) -> float:
        """Fit the inverse model's constant [N s2] to the fin by least squares; raises RunError if
        the force opposes the model's direction, or if the fin cannot make strokes about angle 0."""
        if self.limits.rest_angle != 0:
            raise RunError(
                f"inverse model at {frequency:g} Hz: its constant is fitted to strokes about angle "
                f"0, but the limits are {self.limits.angle_min:g} to {self.limits.angle_max:g} "
                "rad; use the other baselines"
            )
        amplitude = np.linspace(*amplitudes, self.config.trials)
        forces = self.forces_of_sines(
            np.stack([0 * amplitude, amplitude, np.full_like(amplitude, frequency)], axis=1)
        )
        # At angle 0, thrust is along x. The first 2 s, in which the fin starts, are left out.
        force = forces[:, 2 * RATE_HZ :, 0].mean(axis=1, dtype=np.float64)
        # F = K u with u = f^2 (1 - cos A) (`softfin.gaits.inverse_model`), so the least-squares
        # fit is K = (u . F) / (u . u).
        unit = frequency**2 * (1 - np.cos(amplitude))
        constant = float(unit @ force / (unit @ unit))
        if not constant > 0:
            raise RunError(
                f"inverse model at {frequency:g} Hz: the mean force of the trials is "
                f"{force.mean():.3g} N, against the zero direction, but the model requires thrust "
                "along it; use another frequency"
            )
        return constant
