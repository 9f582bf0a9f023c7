"""Force feedback around any controller: estimate its steady-state force error and subtract it from
the reference.

A biased surrogate, a softer fin or colder water causes a difference e between the mean force over
the window and the mean of the inner controller's references over the same window. Subtracting the
estimated difference is a disturbance observer (Ohnishi 1987; Sariyildiz, Oboe and Ohnishi 2020). It
acts like an integrator that accounts for its own output, so the delay of the window does not
destabilise it.

The measured difference is the sum of the controller's bias b and the sensor drift d: e = b + d.
Only b may be corrected; a correction of d would move the true force away from the reference. The
two change differently over time. The sensor is zeroed at rest, so d starts at 0 and then wanders,
while b exists from the start and changes with the reference. A Kalman filter with the states b and
d on each axis therefore attributes an early error to the controller and a late, slow error to the
sensor:

    b: random walk over the distance that the reference moves
    d: Ornstein-Uhlenbeck process from 0, with the standard deviation sqrt(2) drift_n and the
       time constant 2 drift_s

After zeroing, a sensor whose drift w(t) has the standard deviation drift_n and the time constant
drift_s reads w(t) - w(0). The variance of this reading is 2 drift_n^2 (1 - exp(-t / drift_s)),
which is the variance of d.

If drift cannot explain an error, because it is sudden for example, the fin has changed, and the
observer estimates b again.

The separation has two limits. Every movement of the reference adds to the variance of b, even if
the reference returns to an earlier value. If the reference keeps moving for minutes, the observer
therefore assigns the drift to b and wrongly corrects it. At a constant reference, the observer
assigns a slow change in the fin to d and corrects very little of it.

The inner reference stays within the controller's cells and the reachable forces, so the observer
does not wind up at the edge.
"""

import math
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from softfin.control.controller import (
    STATIC,
    Controller,
    Measured,
    controller_clock,
)
from softfin.control.references import controller_cells, reachable_set
from softfin.core.action_clock import ActionClock
from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError
from softfin.core.operations import NUMPY, Array, Number, Operations, select_operations
from softfin.core.quantities import Command, Limits
from softfin.gaits.reachable import Cells, ForceVector, Reachable, cell_corners


@cache
def window_weights(clock: ActionClock) -> Float[np.ndarray, "ages actions"]:
    """Return the weights of the last actions in the window, newest first, by age modulo the length
    of the clock cycle."""
    # Actions differ in duration, so their weights depend on the phase of the clock.
    cycle = len(clock.ticks)
    return np.array(
        [
            [
                clock.ticks[(age - 1 - ago) % cycle] / clock.window_ticks
                for ago in range(clock.window_actions)
            ]
            for age in range(cycle)
        ]
    )


UNSTEADY = 3.0
"""Change in the window error within the last `UNSTEADY_ACTIONS`, divided by its noise, above which
the fin is treated as not settled."""

UNSTEADY_ACTIONS = 3


class DisturbanceObserverConfig(Configuration):
    """Configuration of the force feedback.

    If a force is null, softfin uses the value tuned on the paper's fin (`ObserverForces`), scaled
    by the size of the fin.
    """

    bias_n: PositiveFloat | None = None
    """Prior standard deviation of the force error of the controller [N]; null: 0.2 N, scaled."""
    bias_per_n: NonNegativeFloat | None = None
    """Standard deviation of the change in the force error when the reference moves by 1 N [N];
    null: 0.03 N, scaled. The variance is proportional to the distance, so a slow movement adds as
    much as a step."""
    drift_n: NonNegativeFloat | None = None
    """Standard deviation of the sensor drift without zeroing [N]; null: 0.05 N, scaled. If it is 0,
    every error is attributed to the controller."""
    drift_s: PositiveFloat = 300.0
    """Time constant of the drift [s]."""
    noise_n: PositiveFloat | None = None
    """Standard deviation of the mean force over a window at a constant reference [N]; null: 0.04 N,
    scaled."""
    lag_actions: NonNegativeInt = 1
    """Number of actions until the force follows the reference; the window of references is shifted
    by this number."""
    settle_actions: PositiveInt | None = None
    """Number of actions without estimation after rest, while the fin is starting; null: one more
    than the window and the lag."""
    still_n: PositiveFloat | None = None
    """Largest movement of the reference within the window that is treated as none [N]; null: 0.05
    N, scaled. Above it, the noise variance grows with the fourth power of the movement."""
    limit_n: PositiveFloat | None = None
    """Maximum correction per axis [N]; null: 1 N, scaled."""


class ObserverForces(NamedTuple):
    """Configured forces for one fin; the defaults were tuned on the paper's fin."""

    bias_n: float = 0.2
    bias_per_n: float = 0.03
    drift_n: float = 0.05
    noise_n: float = 0.04
    still_n: float = 0.05
    limit_n: float = 1.0

    @classmethod
    def for_fin(
        cls, config: DisturbanceObserverConfig, reachable: Reachable | None
    ) -> "ObserverForces":
        """Return the configured forces. Defaults are scaled to the fin, or unscaled if its reach is
        unknown."""
        size = 1.0 if reachable is None else reachable.size
        forces = cls(*(size * force for force in cls()))
        # The variance bias_per_n^2 * distance is a squared force, and the distance is already
        # scaled.
        forces = forces._replace(bias_per_n=size**0.5 * cls().bias_per_n)
        configured = config.model_dump(include=set(cls._fields), exclude_none=True)
        return forces._replace(**configured)


class DisturbanceObserverState(NamedTuple):
    """State of the observer and the inner controller; series are newest first."""

    bias: Array
    """Estimated steady-state force error of the controller (x, y) [N]."""
    drift: Array
    """Estimated drift of the sensor since it was zeroed (x, y) [N]."""
    covariance: Array
    """Variance of the bias, covariance, and variance of the drift [N2]; the same on both axes."""
    inner: Any
    """State of the inner controller."""
    forces: Array
    """Mean force during each action of the last window ``(actions, 2)`` [N]."""
    tracked: Array
    """Corrected references of the last actions [N]."""
    references: Array
    """Uncorrected references of the last actions [N]."""
    errors: Array
    """Window errors (x, y) at the last actions [N]."""
    age: Number
    """Number of actions since the start."""


@dataclass(frozen=True)
class DisturbanceObserver:
    """A controller with force feedback around an inner controller; both implement `Controller`."""

    controller: Any
    """The inner controller, a `Controller`."""
    config: DisturbanceObserverConfig = field(default=DisturbanceObserverConfig(), metadata=STATIC)
    newtons: ObserverForces | None = field(default=None, metadata=STATIC)
    """Configured forces; None: the forces for the reach of the inner controller."""

    def __post_init__(self) -> None:
        least = self.clock.window_actions + self.config.lag_actions
        if self.settle_actions < least:
            raise ConfigurationError(
                f"trim.settle_actions = {self.settle_actions} with lag_actions = "
                f"{self.config.lag_actions}: the window of references is full only after {least} "
                f"actions; set settle_actions to {least} or more"
            )
        # JAX recreates the observer inside a compiled program, where the reach has no value; the
        # forces are already set by then.
        if self.newtons is None:
            newtons = ObserverForces.for_fin(self.config, self.reachable)
            object.__setattr__(self, "newtons", newtons)

    @property
    def clock(self) -> ActionClock:
        """Clock of the inner controller."""
        return controller_clock(self.controller)

    @property
    def settle_actions(self) -> int:
        """Number of actions without estimation after rest."""
        config = self.config
        return config.settle_actions or self.clock.window_actions + config.lag_actions + 1

    @property
    def limits(self) -> Limits:
        """Limits of the inner controller."""
        limits: Limits = self.controller.limits
        return limits

    @property
    def cells(self) -> Cells:
        """Cells of the inner controller."""
        return controller_cells(self.controller)

    @property
    def reachable(self) -> Reachable | None:
        """Reachable forces of the inner controller, if known."""
        return reachable_set(self.controller)

    @cached_property
    def _corners(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Lower and upper corners of the cells ``(cells, 2)`` [N]; None if the controller covers
        every reference."""
        return cell_corners(self.cells) if self.cells else None

    def init(self) -> DisturbanceObserverState:
        """Return the state for a fin at rest whose sensor has just been zeroed."""
        controller: Controller = self.controller
        assert self.newtons is not None
        window_actions = self.clock.window_actions
        series = np.zeros((window_actions + self.config.lag_actions, 2))
        return DisturbanceObserverState(
            bias=np.zeros(2),
            drift=np.zeros(2),
            covariance=np.array([self.newtons.bias_n**2, 0.0, 0.0]),
            inner=controller.init(),
            forces=series[:window_actions],
            tracked=series,
            references=series,
            errors=np.zeros((UNSTEADY_ACTIONS, 2)),
            age=0,
        )

    def act(
        self, state: DisturbanceObserverState, measured: Measured, reference: Array
    ) -> tuple[DisturbanceObserverState, Command]:
        """Run the inner controller on the reference minus the estimated bias."""
        ops = select_operations(measured.angle, measured.force, reference, state.bias)
        xp = ops.xp
        force = xp.asarray(measured.force)
        reference = xp.asarray(reference)
        forces = xp.concatenate([force[None], state.forces[:-1]])
        clock = self.clock
        weights = ops.row(ops.constant(window_weights(clock)), state.age % len(clock.ticks))
        # The oldest tracked references are the window shifted by `lag_actions`.
        error = ops.dot(weights, forces - state.tracked[-clock.window_actions :])
        bias, drift, covariance = self._estimate(ops, state, error, reference)
        tracked = self._trackable(ops, reference, reference - bias)
        inner, command = self.controller.act(
            state.inner, measured, tuple(tracked.tolist()) if ops is NUMPY else tracked
        )
        return DisturbanceObserverState(
            bias=bias,
            drift=drift,
            covariance=covariance,
            inner=inner,
            forces=forces,
            tracked=xp.concatenate([tracked[None], state.tracked[:-1]]),
            references=xp.concatenate([reference[None], state.references[:-1]]),
            errors=xp.concatenate([error[None], state.errors[:-1]]),
            age=state.age + 1,
        ), command

    def _estimate(
        self, ops: Operations, state: DisturbanceObserverState, error: Array, reference: Array
    ) -> tuple[Array, Array, Array]:
        """Return the bias, the drift and their covariance after one step of the Kalman filter."""
        config = self.config
        newtons = self.newtons
        assert newtons is not None
        xp = ops.xp
        # Predict. The bias may change when the reference changes. The first reference is not a
        # change.
        distance = abs(reference - state.references[0]).max()
        bias_change = ops.choose(
            state.age > 0, lambda: newtons.bias_per_n**2 * distance, lambda: 0.0 * distance
        )
        kept = math.exp(-1 / (self.clock.rate_hz * 2 * config.drift_s))
        drift = kept * state.drift
        bias_variance = state.covariance[0] + bias_change
        cross = kept * state.covariance[1]
        drift_variance = kept**2 * state.covariance[2] + (1 - kept**2) * 2 * newtons.drift_n**2
        # While the reference moves, the fin's lag looks like an error for the entire movement, so
        # averaging neighbouring windows does not remove it, and the noise is raised instead. Only
        # changes in the uncorrected references count as movement; otherwise, each correction would
        # block the next update.
        highest = xp.maximum(state.references.max(axis=0), reference)
        lowest = xp.minimum(state.references.min(axis=0), reference)
        movement = xp.maximum((highest - lowest).max(), newtons.still_n)
        # The window error also changes while the fin starts or reacts to a correction. It is not
        # the steady-state error then, and following it could make a slow fin oscillate.
        change = abs(error - state.errors).max()
        unsteady = xp.maximum(change / (UNSTEADY * newtons.noise_n), 1.0)
        moving = (movement / newtons.still_n) ** 2 * unsteady**2
        noise_variance = (newtons.noise_n * moving) ** 2
        innovation = error - state.bias - drift
        # If the error exceeds three standard deviations, the fin or the water must have changed, so
        # raise the variance of the bias until the error is within them.
        expected = bias_variance + 2 * cross + drift_variance + noise_variance
        learns = ops.choose(state.age >= self.settle_actions, lambda: 1.0, lambda: 0.0)
        bias_variance = bias_variance + learns * xp.maximum(
            (innovation**2).max() - 9 * expected, 0.0
        )
        # Update. Neighbouring windows share all actions but one, so each of n counts as 1/n of an
        # independent measurement: its noise variance is multiplied by n.
        total = (
            bias_variance + 2 * cross + drift_variance + self.clock.window_actions * noise_variance
        )
        bias_gain = learns * (bias_variance + cross) / total
        drift_gain = learns * (cross + drift_variance) / total
        bias = state.bias + bias_gain * innovation
        bias = xp.maximum(xp.minimum(bias, newtons.limit_n), -newtons.limit_n)
        drift = drift + drift_gain * innovation
        covariance = xp.stack(
            [
                bias_variance - bias_gain * (bias_variance + cross),
                cross - bias_gain * (cross + drift_variance),
                drift_variance - drift_gain * (cross + drift_variance),
            ]
        )
        return bias, drift, covariance

    def _trackable(self, ops: Operations, reference: Array, corrected: Array) -> Array:
        """Move the corrected reference into the reachable forces and the controller cells.

        A correction may move the reference into a different cell. If it would move the reference
        between cells, it stops at the edge of the original cell. Cells are applied last: outside
        the cells, the controller's commands are meaningless, while outside the reachable forces,
        the fin only falls short.
        """
        if self.reachable is not None:
            corrected = self.reachable.project(corrected)
        if self._corners is None:
            return corrected
        xp = ops.xp
        low, high = map(ops.constant, self._corners)
        within = ((low <= corrected) & (corrected <= high)).all(axis=1).any()
        beyond = xp.maximum(xp.maximum(low - reference, reference - high), 0.0)
        # The original cell is the one nearest to the uncorrected reference.
        own = (beyond**2).sum(axis=1).argmin()
        clipped = xp.maximum(xp.minimum(corrected, ops.row(high, own)), ops.row(low, own))
        return xp.where(within, corrected, clipped)

    def check(self, reference: ForceVector) -> None:
        """Raise CoverageError if the inner controller does."""
        controller: Controller = self.controller
        controller.check(reference)
