"""How open-loop baselines are found: sines and gaits tried on a plant, as a rule a surrogate, for each reference.

Commands are issued one a tick, so that a sine can be commanded; an action held for 33 ticks is 33 equal commands.
"""

from itertools import product
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Key, PRNGKeyArray
from pydantic import Field, PositiveFloat, PositiveInt

from softfin.core.action_clock import CYCLE_ACTIONS, ticks_of
from softfin.core.configuration import Configuration
from softfin.core.errors import RunError
from softfin.core.plant import Plant, roll
from softfin.core.plant_identity import jit_argument
from softfin.core.quantities import RATE_HZ, Command, Limits, Reading
from softfin.core.randomness import generator_of, key_of
from softfin.core.window import moving_error
from softfin.evaluation.baselines.sines import ShaftSine

Forces = Float[np.ndarray, "cases ticks 2"]
References = Float[np.ndarray, "references 2"]
Sines = Float[np.ndarray, "cases 3"]
"""Centre [rad], amplitude [rad] and frequency [Hz]."""

CHUNK = 256
"""Cases that run side by side at most: one compiled program serves any greater number of them."""

OFFSETS = np.array(list(product(range(-2, 3), repeat=2)))
"""Steps of centre and amplitude to the 5 x 5 sines round one that is refined."""


class SearchConfig(Configuration):
    """Length and fineness of the search."""

    seconds: int = Field(default=8, ge=3)
    """Length of a trial from rest [s], whole; its first 2 s fill the first window."""
    frequencies_hz: tuple[PositiveFloat, ...] = Field(default=(0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0), min_length=1)
    """Frequencies of the sines [Hz]; whole periods fill the window of 2 s, so that its mean has no ripple."""
    centres: int = Field(default=13, ge=2)
    """Zero directions of the first lattice, over the angles that the plant takes."""
    amplitudes: int = Field(default=8, ge=2)
    """Amplitudes of the first lattice, up to `amplitude_max_rad`."""
    amplitude_max_rad: float = Field(default=1.5, gt=0, le=np.pi)
    """Greatest amplitude of a sine [rad]."""
    kept: PositiveInt = 4
    """Sines that are refined for each reference."""
    refinements: int = Field(default=4, ge=0)
    """Rounds; each halves the steps of centre and amplitude and tries the 5 x 5 sines round each kept one."""
    gaits: PositiveInt = 256
    """Random gaits of six actions: some 20 s of what a surrogate learnt from, as many as a look-up table might hold."""
    trials: int = Field(default=6, ge=1)
    """Sines straight ahead that the inverse model's constant is fitted to, over the driver's amplitudes."""


@eqx.filter_jit
def run_commands(plant: Plant, commands: Command, keys: Key[Array, "seeds"]) -> Reading:
    """Readings of every series of commands with every key of the plant, each from rest: ``(cases, seeds, ticks)``.

    `plant` as `jit_argument` makes it.
    """

    def one(command: Command, key: PRNGKeyArray) -> Reading:
        return roll(plant, plant.init(key), command)[1]

    readings: Reading = jax.vmap(jax.vmap(one, in_axes=(None, 0)), in_axes=(0, None))(commands, keys)
    return readings


def repeated(gaits: Command, seconds: int) -> Command:
    """Hold gaits of six actions on the 33/33/34 clock, again and again: one command a tick."""
    actions = np.arange(CYCLE_ACTIONS * seconds) % CYCLE_ACTIONS
    rows = np.repeat(actions, ticks_of(len(actions)))[: seconds * RATE_HZ]
    return Command(*(np.asarray(part)[..., rows].astype(np.float32) for part in gaits))


def force_errors(forces: Forces, references: References) -> Float[np.ndarray, "cases references"]:
    """Error of each case at each reference: those of x and y together [N], as in Table II."""
    return np.stack([moving_error(forces, reference).sum(axis=1) for reference in references], axis=1)


class OpenLoopSearch(NamedTuple):
    """Sines and gaits tried on a plant."""

    plant: Plant
    limits: Limits
    """Limits that the commands keep."""
    config: SearchConfig
    seed: int

    def forces(self, commands: Command) -> Forces:
        """Forces of many series of commands, all with one key."""
        count = len(commands.angle)
        size = min(CHUNK, count)
        # Filled up with repetitions of the last case, whose forces are dropped again.
        padded = Command(*(np.pad(part, ((0, -count % size), (0, 0)), mode="edge") for part in commands))
        plant, keys = jit_argument(self.plant), key_of(self.seed, "baselines/search")[None]
        parts = (Command(*(part[i : i + size] for part in padded)) for i in range(0, count, size))
        return np.concatenate([np.asarray(run_commands(plant, part, keys).force[:, 0]) for part in parts])[:count]

    def forces_of_sines(self, sines: Sines) -> Forces:
        """Forces of many sines."""
        return self.forces(ShaftSine(*sines.T).commands(self.limits, self.config.seconds * RATE_HZ)[0])

    def best_sines(self, references: References) -> ShaftSine:
        """Find the sine of least error for each reference: in a lattice, then in finer ones round the best of each."""
        config = self.config
        low, high = np.array([(self.limits.angle_min, 0.0), (self.limits.angle_max, config.amplitude_max_rad)])
        step = (high - low) / [config.centres - 1, config.amplitudes]
        centres = np.linspace(low[0], high[0], config.centres)
        amplitudes = np.linspace(low[1], high[1], config.amplitudes + 1)[1:]
        lattice = np.array(list(product(centres, amplitudes, config.frequencies_hz)))
        tried = [(lattice, error) for error in force_errors(self.forces_of_sines(lattice), references).T]
        for _ in range(config.refinements):
            step = step / 2
            near = []
            for points, error in tried:
                best = points[np.argsort(error)[: config.kept]].repeat(len(OFFSETS), axis=0)
                best[:, :2] = np.clip(best[:, :2] + np.tile(OFFSETS * step, (len(best) // len(OFFSETS), 1)), low, high)
                near.append(best)
            forces = np.split(self.forces_of_sines(np.concatenate(near)), np.cumsum([len(new) for new in near])[:-1])
            tried = [
                (np.concatenate([points, new]), np.concatenate([error, force_errors(force, reference[None])[:, 0]]))
                for (points, error), new, force, reference in zip(tried, near, forces, references, strict=True)
            ]
        return ShaftSine(*np.stack([points[error.argmin()] for points, error in tried], axis=1))

    def best_gaits(self, references: References) -> Command:
        """Find the gait of least error for each reference, ``(references, 6)``, of the same few random ones."""
        limits, generator = self.limits, generator_of(self.seed, "baselines/gaits")
        shape = (self.config.gaits, CYCLE_ACTIONS)
        gaits = Command(
            generator.uniform(limits.angle_min, limits.angle_max, shape),
            generator.uniform(limits.velocity_min, limits.velocity_max, shape),
        )
        best = force_errors(self.forces(repeated(gaits, self.config.seconds)), references).argmin(axis=0)
        return Command(*(part[best] for part in gaits))

    def fitted_constant(self, frequency: float, amplitudes: tuple[float, float]) -> float:
        """Fit the inverse model's constant [N s2] to the fin by least squares; raises RunError where it pulls."""
        amplitude = np.linspace(*amplitudes, self.config.trials)
        forces = self.forces_of_sines(np.stack([0 * amplitude, amplitude, np.full_like(amplitude, frequency)], axis=1))
        # At angle 0 thrust is along x. The first window shows how the fin starts.
        force = forces[:, 2 * RATE_HZ :, 0].mean(axis=1, dtype=np.float64)
        unit = frequency**2 * (1 - np.cos(amplitude))
        constant = float(unit @ force / (unit @ unit))
        if not constant > 0:
            raise RunError(
                f"inverse model at {frequency:g} Hz: the trials' mean force is {force.mean():.3g} N, against the zero "
                "direction; the model holds for fins that push along it; give another frequency"
            )
        return constant
