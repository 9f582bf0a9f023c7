"""Feedback around any controller: estimate the change of the fin and the drift of the sensor, and
correct the reference for the fin only.

A softer fin, colder water or a slower servo changes the mean force at every reference. A drifting
sensor changes only the reading. A Kalman filter, which is updated once per window of the clock,
estimates both and several nuisance parameters. Its state, in units of the prior standard deviation:

    c   coefficients of the family of the fin (`softfin.control.family`): a random walk from 0
    r   rest of the controller's force error, an affine function of the reference: constant, so it
        does not become uncertain again when the reference returns to an earlier value
    g   local force error at the current reference: an Ornstein-Uhlenbeck process over the distance
        that the reference moves
    d   drift of the force sensor since it was zeroed: an Ornstein-Uhlenbeck process from 0
    f   Coulomb friction of the drive, and error of the torque constant

The measurements of a window are its mean force and, for each action, the deviation of the force
from this mean, the shaft angle, the torque and power on the fin, and the torque and power of the
motor. Missing measurements have no weight. Windows do not overlap, so their noise is independent.

The pattern within the window distinguishes the fin from the sensor: a changed fin changes the
forces, angles and torques of the actions relative to each other, whereas drift does not. Without a
family, the filter has no such pattern, and only time separates r from d: r exists from the start,
whereas d grows over time. The filter then mistakes slow changes of the fin for drift.

After each window, the filter compares the likelihoods of three explanations: nothing sudden, a
sudden change of the fin, and a jump of the sensor. A change makes c and g as uncertain as before
any measurement, and a jump makes d more uncertain than the drift. Unless a constant change explains
the window in which it happened, the window is skipped, because it is partly that from before, and
the next one decides. If no coefficients explain the pattern, the fin is outside the family (a torn
fin, a blocked shaft or weed). The noise of the pattern is then raised to the observed level, so
that the mean force of the window dominates, and r becomes uncertain, too. `Estimate.level` reports
the observed level.

The corrected reference x solves x + bias(x) = reference by fixed-point iteration, within the
controller's cells and the reachable forces.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from pydantic import NonNegativeFloat, PositiveFloat

from softfin.control.controller import (
    STATIC,
    Controller,
    Measured,
    controller_clock,
)
from softfin.control.family import FEATURES, FORCE_FEATURES, LOAD_FEATURES, MOTOR_FEATURES, Family
from softfin.control.gait import GaitStep
from softfin.control.references import controller_cells, reachable_set
from softfin.core.action_clock import ActionClock
from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError
from softfin.core.operations import NUMPY, Array, Number, Operations, select_operations
from softfin.core.quantities import RATE_HZ, Command, Limits
from softfin.gaits.reachable import PAPER_REACH_N, Cells, ForceVector, Reachable, cell_corners

HALF_90 = 1.645
"""Half-width of the 90% interval of a normal distribution, in standard deviations."""

FIXED_POINT_STEPS = 2
"""Number of steps of the fixed-point iteration per action."""

START_DEVIATION = 0.3
"""Prior standard deviation of the coefficients at the start, when the fin is close to the nominal
fin [-]."""

NEAR_SHARE = 0.15
"""Correlation length of the local force error between references, as a fraction of the reach
[-]."""

REPEATED = 20.0
"""Factor on the unexplained variance in repeated windows at the same reference [-]. The unexplained
part is the same in all of these windows, so it does not average out."""

NEW_REFERENCE = 0.1
"""Distance from the reference of the last window at which a window counts as new, as a fraction of
the reach [-]."""

SUDDEN = 6.0
"""Excess of the squared normalized innovation over its expected value, in standard deviations,
above which something has changed suddenly."""

LIKELIER = 20.0
"""Reduction in -2 times the logarithm of the likelihood, by a sudden change of the fin or of the
sensor, above which it has happened."""

FAR_SQUARED = 4.0
"""Square of a coefficient that is as strange as a level of 1: 4 standard deviations have the level
`UNFAMILIAR`."""

CLEAR = 1.5
"""`Estimate.level` up to which a window with a sudden change is explained [-]."""

JUMP_SHARE = 0.1
"""Prior standard deviation of a sudden change of the sensor, as a fraction of the reach [-]."""

POLICY_NOISE_N = 0.2
"""Default of `FeedbackConfig.noise_n` for policies on the paper's fin [N]."""

UNFAMILIAR = 4.0
"""`Estimate.level` above which the fin is outside the family."""

WHITE_NOISE = np.array([0.02, 0.02, 0.002, 0.01, 0.01, 0.01, 0.01])
"""Standard deviation of the noise of each feature, for any fin: force [N], angle [rad], and torques
and powers as a fraction of their spread [-]."""

FRICTION_SHARE = 0.1
"""Prior standard deviation of the friction, as a fraction of the spread of the motor torque [-]."""


class FeedbackConfig(Configuration):
    """Configuration of the feedback.

    If a force is null, softfin uses the value tuned on the paper's fin, scaled by the size of the
    fin.
    """

    uses: Literal["force", "torque", "both"] = "both"
    """Measurements that the feedback uses in addition to the angle; both: all that are available.
    torque requires a family."""
    bias_n: PositiveFloat | None = None
    """Prior standard deviation of the part of the force error that is not due to changes of the fin
    [N]; null: 0.1 N, scaled."""
    drift_n: NonNegativeFloat = 0.05
    """Standard deviation of the sensor drift without zeroing [N]; not scaled, because it is a
    property of the sensor. If it is 0, all errors are attributed to the fin."""
    drift_s: PositiveFloat = 300.0
    """Time constant of the drift [s]."""
    rest_n: PositiveFloat | None = None
    """Standard deviation of the local force error, which is neither due to changes of the fin nor
    affine in the reference [N]; null: 0.02 N, scaled."""
    noise_n: PositiveFloat | None = None
    """Standard deviation of the mean force over a window at a constant reference [N]; null: 0.01
    N for gaits, 0.2 N for policies, whose motion does not repeat, scaled."""
    change_s: PositiveFloat = 1500.0
    """Time in which the coefficients of the fin change by their standard deviation over the family
    [s]; smaller values correct faster changes."""
    torque_scale: NonNegativeFloat = 0.1
    """Prior standard deviation of the relative error of the torque constant [-]."""
    limit_n: PositiveFloat | None = None
    """Maximum correction per axis [N]; null: 1 N, scaled."""


class FeedbackForces(NamedTuple):
    """Configured forces for one fin; the defaults were tuned on the paper's fin."""

    bias_n: float = 0.1
    rest_n: float = 0.02
    noise_n: float = 0.01
    limit_n: float = 1.0

    @classmethod
    def for_fin(
        cls, config: FeedbackConfig, size: float, is_policy: bool = False
    ) -> "FeedbackForces":
        """Return the configured forces; the defaults are scaled by the size of the fin."""
        tuned = cls(noise_n=POLICY_NOISE_N) if is_policy else cls()
        forces = cls(*(size * force for force in tuned))
        return forces._replace(**config.model_dump(include=set(cls._fields), exclude_none=True))


class Estimate(NamedTuple):
    """Result of the feedback."""

    force: Array
    """Estimated true mean force at the corrected reference (x, y) [N]."""
    half_width: Array
    """Half-width of the 90% interval of `force` (x, y) [N]."""
    drift: Array
    """Estimated drift of the sensor since it was zeroed (x, y) [N]."""
    level: Number
    """Mean square of the unexplained pattern, relative to its expected value [-]; smoothed, and at
    least 1. Above `UNFAMILIAR`, the fin is outside the family."""


class FeedbackState(NamedTuple):
    """State of the feedback and the inner controller; series are oldest first."""

    mean: Array
    """Estimated state of the filter."""
    covariance: Array
    inner: Any
    """State of the inner controller."""
    seen: Array
    """Features of the last actions ``(actions, features)``; NaN if not measured."""
    tracked: Array
    """Corrected references of the last actions and of the next one [N]."""
    references: Array
    """Uncorrected references of the last actions and of the next one [N]."""
    zero: Array
    """Sum of the jumps of the sensor (x, y) [N]."""
    used: Array
    """Mean corrected reference over the last window [N]."""
    was_mixed: Array
    """Whether something changed suddenly within the last window."""
    level: Number
    """As in `Estimate`."""
    age: Number
    """Number of actions since the start."""


@dataclass(frozen=True)
class Feedback:
    """A controller with feedback around an inner controller; both implement `Controller`."""

    controller: Any
    """The inner controller, a `Controller`."""
    config: FeedbackConfig = field(default=FeedbackConfig(), metadata=STATIC)
    family: Family | None = None
    """Family of the fin; None to use only the mean force."""
    newtons: FeedbackForces | None = field(default=None, metadata=STATIC)
    """Configured forces; None: the forces for the reach of the inner controller."""
    reach_n: float = field(default=0.0, metadata=STATIC)
    """Scale of the references [N]; 0: the reach of the inner controller."""

    def __post_init__(self) -> None:
        if self.family is None and self.config.uses == "torque":
            raise ConfigurationError(
                "feedback.uses = torque: requires a family; run softfin family CONTROLLER"
            )
        # JAX recreates the object inside a compiled program, where the reach has no value; the
        # forces are already set by then.
        if self.newtons is None:
            reachable = self.reachable
            size = 1.0 if reachable is None else reachable.size
            reach_n = PAPER_REACH_N if reachable is None else reachable.reach_n
            is_policy = getattr(self.controller, "kind", GaitStep.kind) != GaitStep.kind
            newtons = FeedbackForces.for_fin(self.config, size, is_policy)
            object.__setattr__(self, "newtons", newtons)
            object.__setattr__(self, "reach_n", reach_n)

    @property
    def clock(self) -> ActionClock:
        """Clock of the inner controller."""
        return controller_clock(self.controller)

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

    @property
    def coefficients(self) -> int:
        """Number of coefficients of the family."""
        return 0 if self.family is None else self.family.coefficients

    @property
    def size(self) -> int:
        """Number of states of the filter: the coefficients, 6 parameters of the affine error, 2 of
        the local error, 2 of the drift, friction, and torque constant."""
        return self.coefficients + 12

    @property
    def _drifts(self) -> slice:
        return slice(self.coefficients + 8, self.coefficients + 10)

    def init(self) -> FeedbackState:
        """Return the state for a fin at rest whose sensor has just been zeroed."""
        controller: Controller = self.controller
        actions = self.clock.window_actions
        variances = np.ones(self.size)
        variances[: self.coefficients] = START_DEVIATION**2
        # The sensor has just been zeroed.
        variances[self._drifts] = 0.0
        return FeedbackState(
            mean=np.zeros(self.size),
            covariance=np.diag(variances),
            inner=controller.init(),
            seen=np.full((actions, len(FEATURES)), np.nan),
            tracked=np.zeros((actions + 1, 2)),
            references=np.zeros((actions + 1, 2)),
            zero=np.zeros(2),
            used=np.full(2, np.inf),
            was_mixed=np.False_,
            level=1.0,
            age=0,
        )

    def act(
        self, state: FeedbackState, measured: Measured, reference: Array
    ) -> tuple[FeedbackState, Command]:
        """Run the inner controller on the corrected reference."""
        ops = select_operations(*measured[:2], reference, state.mean)
        xp = ops.xp
        reference = xp.asarray(reference)
        missing = np.full(2, np.nan)
        shaft = missing if measured.shaft is None else measured.shaft
        motor = missing if measured.motor is None else measured.motor
        now = xp.asarray([*measured.force, measured.angle, *shaft, *motor])
        seen = xp.concatenate([state.seen[1:], now[None]])
        actions = self.clock.window_actions
        ends_window = (state.age % actions == 0) & (state.age > 0)
        before = state
        state = ops.branch(ends_window, lambda: self._update(ops, before, seen), lambda: before)
        tracked = reference + state.tracked[-1] - state.references[-1]
        for _ in range(FIXED_POINT_STEPS):
            tracked = self._trackable(
                ops, reference, reference - self._bias(ops, state.mean, tracked, state.used)
            )
        # The inner controller does not use the force, which may be missing.
        finite = measured._replace(force=xp.nan_to_num(xp.asarray(measured.force)))
        inner, command = self.controller.act(
            state.inner, finite, tuple(tracked.tolist()) if ops is NUMPY else tracked
        )
        return state._replace(
            inner=inner,
            seen=seen,
            tracked=xp.concatenate([state.tracked[1:], tracked[None]]),
            references=xp.concatenate([state.references[1:], reference[None]]),
            age=state.age + 1,
        ), command

    def estimate(self, state: FeedbackState) -> Estimate:
        """Return the estimate for the reference of the last action."""
        ops = select_operations(state.mean)
        xp = ops.xp
        tracked = state.tracked[-1]
        assert self.newtons is not None
        near = self._near(ops, tracked, state.used)
        rows = self._bias_rows(ops, tracked, near)
        variance = ((rows @ state.covariance) * rows).sum(axis=1)
        variance = variance + (1 - near**2) * self.newtons.rest_n**2
        if self.family is not None:
            variance = variance + ops.constant(self.family.force_noise) ** 2
        drift = math.sqrt(2) * self.config.drift_n
        return Estimate(
            tracked + rows @ state.mean,
            HALF_90 * xp.sqrt(variance),
            state.zero + drift * state.mean[self._drifts],
            state.level,
        )

    def _near(self, ops: Operations, one: Array, other: Array) -> Number:
        """Return the correlation of the local force errors at two references."""
        distance = ops.xp.sqrt(((one - other) ** 2).sum())
        return ops.xp.exp(-distance / (NEAR_SHARE * self.reach_n))

    def _bias_rows(self, ops: Operations, reference: Array, near: Number) -> Array:
        """Return the derivatives of the force error (x, y) [N] with respect to the filter state;
        `near` is the correlation of the local error with that of the last window."""
        xp = ops.xp
        assert self.newtons is not None
        force = xp.zeros((0, 2))
        if self.family is not None:
            (force,) = self.family.interpolate(ops, reference[None], self.family.force)
            force = force[0]
        place = self.newtons.rest_n * near * np.eye(2)
        affine = self._affine(ops, reference)
        return xp.concatenate([force.T, affine, place, np.zeros((2, 4))], axis=1)

    def _affine(self, ops: Operations, reference: Array) -> Array:
        """Return the derivatives of the affine part of the force error, ``(2, 6)`` [N]."""
        assert self.newtons is not None
        xp = ops.xp
        # Each axis has a constant and a slope along x and y.
        own = self.newtons.bias_n * xp.concatenate([np.ones(1), reference / self.reach_n])
        other = np.zeros(3)
        return xp.stack([xp.concatenate([own, other]), xp.concatenate([other, own])])

    def _bias(self, ops: Operations, mean: Array, reference: Array, used: Array) -> Array:
        assert self.newtons is not None
        limit_n = self.newtons.limit_n
        rows = self._bias_rows(ops, reference, self._near(ops, reference, used))
        return ops.xp.clip(rows @ mean, -limit_n, limit_n)

    def _update(self, ops: Operations, state: FeedbackState, seen: Array) -> FeedbackState:
        """Return the state after the window that has just ended."""
        xp = ops.xp
        coefficients = self.coefficients
        tracked = state.tracked[1:]
        centre = self._durations @ tracked
        mean, covariance = self._predict(ops, state, centre)
        steps = xp.abs(state.references[1:] - state.references[:-1]).max()
        moved = xp.maximum(steps, xp.abs(tracked[1:] - tracked[:-1]).max())
        measured = self._measurements(ops, state, seen, mean, moved)
        rows = measured.rows
        errors = measured.errors
        # Skip the first window, in which the fin starts from rest.
        has = measured.has & (state.age >= 2 * self.clock.window_actions)
        has_pattern = has[2:].any()
        distance = xp.sqrt(((centre - state.used) ** 2).sum()) / self.reach_n
        repeated = REPEATED - (REPEATED - 1) * xp.minimum(distance / NEW_REFERENCE, 1.0)
        repeated = xp.where(state.was_mixed, 1.0, repeated)

        def correct(covariance: Array, repeated: Number, level: Number) -> _Correction:
            variance = measured.variance + repeated * measured.unexplained
            raised = xp.concatenate([np.ones(2), level * np.ones(rows.shape[0] - 2)])
            return self._correct(ops, covariance, rows, errors, has / (variance * raised))

        # Compare three explanations: nothing sudden, a change of the fin, a jump of the sensor. If
        # the fin is outside the family, earlier windows have raised the level.
        index = np.arange(self.size)
        forgotten = (index < coefficients) + self._is_place
        by_fin = covariance * (1 - forgotten)[:, None] * (1 - forgotten) + np.diag(forgotten)
        jump_n = JUMP_SHARE * self.reach_n
        jump = (jump_n / self.config.drift_n) ** 2 if self.config.drift_n > 0 else 0.0
        by_sensor = covariance + jump * np.diag(self._is_drift)
        nothing = correct(covariance, repeated, state.level)
        fin = correct(by_fin, repeated, state.level)
        sensor = correct(by_sensor, repeated, state.level)
        count = xp.maximum(has.sum(), 1)
        is_far = nothing.innovation > count + SUDDEN * xp.sqrt(2 * count)
        gain = nothing.unlikely - xp.minimum(fin.unlikely, sensor.unlikely)
        is_sudden = is_far | (gain > LIKELIER)
        # Without a pattern, both explain a sudden change equally well.
        can_tell = has_pattern & has[:2].any() & (self.config.drift_n > 0)
        is_sensor = (sensor.unlikely < fin.unlikely) & can_tell
        prior = xp.where(is_sudden, xp.where(is_sensor, by_sensor, by_fin), covariance)
        # The unexplained part of a changed fin is new, so it is not a repetition.
        repeated = xp.where(is_sudden, 1.0, repeated)
        found = correct(prior, repeated, 1.0)
        left = (errors - rows @ found.change)[2:]
        variance = (measured.variance + measured.unexplained)[2:]
        level = (has[2:] * left**2 / variance).sum() / xp.maximum(has[2:].sum(), 1)
        # Coefficients that no fin of the family has are as strange as what they do not explain.
        implied = mean[:coefficients] + found.change[:coefficients]
        level = xp.maximum(level, (xp.concatenate([implied, np.ones(1)]) ** 2).max() / FAR_SQUARED)
        level = xp.maximum(level, 1.0)
        # A window in which something changed is partly that from before. Unless a constant change
        # explains it, the next one decides.
        is_first = is_sudden & xp.logical_not(state.was_mixed)
        is_mixed = is_first & (level > CLEAR) & (state.age > 2 * self.clock.window_actions)
        # If no coefficients explain the pattern, rely on the mean force.
        is_strange = is_sudden & ((level > UNFAMILIAR) | (coefficients == 0))
        opened = by_fin + np.diag((index < coefficients + 8).astype(float))
        found = correct(xp.where(is_strange, opened, prior), repeated, level)
        is_judged = has_pattern & xp.logical_not(is_mixed)
        mean = xp.where(is_mixed, mean, mean + found.change)
        # A jump remains, whereas the drift tends to 0.
        is_jump = is_sudden & is_sensor & xp.logical_not(is_mixed)
        jump = xp.where(is_jump, mean * self._is_drift, 0.0)
        return state._replace(
            mean=mean - jump,
            covariance=xp.where(is_mixed, covariance, (found.covariance + found.covariance.T) / 2),
            zero=state.zero + math.sqrt(2) * self.config.drift_n * jump[self._drifts],
            used=centre,
            was_mixed=is_mixed,
            level=xp.where(is_judged, (state.level + level) / 2, state.level),
        )

    def _predict(self, ops: Operations, state: FeedbackState, centre: Array) -> tuple[Array, Array]:
        """Return the mean and the covariance one window later."""
        config = self.config
        window_s = self.clock.window_ticks / RATE_HZ
        kept_drift = math.exp(-window_s / (2 * config.drift_s))
        is_place = self._is_place
        is_drift = self._is_drift
        kept = 1 - (1 - kept_drift) * is_drift
        added = (1 - kept_drift**2) * is_drift
        added[: self.coefficients] = window_s / config.change_s
        near = self._near(ops, centre, state.used)
        faded = kept * (1 + is_place * (near - 1))
        added = added + is_place * (1 - near**2)
        covariance = state.covariance * faded[:, None] * faded + ops.xp.diag(added)
        return faded * state.mean, covariance

    @cached_property
    def _is_place(self) -> Float[np.ndarray, "states"]:
        """1 for the states of the local error, 0 for the others."""
        return np.isin(np.arange(self.size), self.coefficients + np.array([6, 7])).astype(float)

    @cached_property
    def _is_drift(self) -> Float[np.ndarray, "states"]:
        """1 for the states of the drift, 0 for the others."""
        return np.isin(np.arange(self.size), self.coefficients + np.array([8, 9])).astype(float)

    @cached_property
    def _durations(self) -> Float[np.ndarray, "actions"]:
        """Duration of each action as a fraction of the window."""
        clock = self.clock
        return np.array(clock.action_ticks(clock.window_actions)) / clock.window_ticks

    def _measurements(
        self, ops: Operations, state: FeedbackState, seen: Array, mean: Array, moved: Number
    ) -> "_Measurements":
        """Return the measurements of the last window."""
        xp = ops.xp
        config = self.config
        newtons = self.newtons
        assert newtons is not None
        tracked = state.tracked[1:]
        actions = self.clock.window_actions
        durations = self._durations
        centre = durations @ tracked
        affine = self._affine(ops, centre)
        drift = math.sqrt(2) * config.drift_n * np.eye(2)
        force_error = durations @ seen[:, FORCE_FEATURES] - centre - state.zero
        force_variance = (newtons.noise_n**2 + moved**2) * np.ones(2)
        place = newtons.rest_n * np.eye(2)
        family = self.family
        if family is None:
            rows = xp.concatenate([affine, place, drift, np.zeros((2, 2))], axis=1)
            has = xp.isfinite(force_error)
            errors = xp.where(has, force_error, 0.0) - rows @ mean
            return _Measurements(rows, errors, has, force_variance, np.zeros(2))
        own = (np.arange(actions),)
        nominal, turning = family.interpolate(
            ops, tracked, family.nominal, family.friction, own=own
        )
        (rough,) = family.interpolate(ops, tracked, family.nominal_noise)
        (changes,) = family.interpolate(ops, tracked, family.features, own=own)
        changes = xp.moveaxis(changes, 1, 2)
        ahead = seen - nominal
        mean_change = xp.tensordot(durations, changes, 1)
        # Drift and the force error are the same for all actions of a window, so subtract the mean
        # to obtain the pattern.
        ahead = xp.where(IS_FORCE > 0, ahead - durations @ ahead, ahead)
        changes = changes - IS_FORCE[:, None] * mean_change
        count = actions * nominal.shape[1]
        spread = ops.constant(family.feature_spread)
        other = np.zeros((actions, MOTOR_FEATURES.start))
        friction = (
            FRICTION_SHARE * spread[MOTOR_FEATURES.start] * xp.concatenate([other, turning], axis=1)
        )
        scale = config.torque_scale * nominal * IS_MOTOR
        pattern_rows = xp.concatenate(
            [
                changes.reshape(count, -1),
                np.zeros((count, 10)),
                friction.reshape(count, 1),
                scale.reshape(count, 1),
            ],
            axis=1,
        )
        force_rows = xp.concatenate(
            [mean_change[FORCE_FEATURES], affine, place, drift, np.zeros((2, 2))], axis=1
        )
        rows = xp.concatenate([force_rows, pattern_rows])
        white = WHITE_NOISE * xp.concatenate([np.ones(LOAD_FEATURES.start), spread[LOAD_FEATURES]])
        variance = white**2 + rough**2 + (spread * moved / self.reach_n) ** 2
        unexplained = np.ones((actions, 1)) * ops.constant(family.feature_noise) ** 2
        is_allowed = np.ones(nominal.shape[1], bool)
        if config.uses != "both":
            is_allowed[LOAD_FEATURES if config.uses == "force" else FORCE_FEATURES] = False
        is_row_allowed = np.concatenate([is_allowed[FORCE_FEATURES], np.tile(is_allowed, actions)])
        errors = xp.concatenate([force_error, ahead.reshape(count)])
        has = xp.isfinite(errors) & is_row_allowed
        return _Measurements(
            rows,
            xp.where(has, errors - rows @ mean, 0.0),
            has,
            xp.concatenate([force_variance, variance.reshape(count)]),
            xp.concatenate([np.zeros(2), unexplained.reshape(count)]),
        )

    def _correct(
        self, ops: Operations, covariance: Array, rows: Array, errors: Array, weights: Array
    ) -> "_Correction":
        """Return the update of the Kalman filter for independent measurements."""
        weighted = weights[:, None] * rows
        information = rows.T @ weighted
        # The size of this system is the number of states, not of measurements, and the covariance
        # may be singular.
        system = np.eye(covariance.shape[0]) + covariance @ information
        after, volume = ops.solve(system, covariance)
        pull = errors @ weighted
        change = after @ pull
        innovation = (weights * errors**2).sum() - pull @ change
        return _Correction(change, after, innovation, volume)

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


class _Measurements(NamedTuple):
    """Measurements in a window: the mean force, followed by the features of each action."""

    rows: Array
    """Derivatives with respect to the state of the filter."""
    errors: Array
    """Differences from the prediction; 0 if missing."""
    has: Array
    """Whether each measurement is available and may be used."""
    variance: Array
    """Variance of the noise, which is independent between windows."""
    unexplained: Array
    """Variance of the part that the filter state does not explain, which is the same in all windows
    at the same reference."""


class _Correction(NamedTuple):
    change: Array
    """Change of the mean."""
    covariance: Array
    innovation: Number
    """Squared normalized innovation; its distribution is chi-squared with one degree of freedom per
    measurement."""
    volume: Number
    """Logarithm of the determinant of the innovation covariance, relative to that of the noise."""

    @property
    def unlikely(self) -> Number:
        """-2 times the logarithm of the likelihood of the measurements, except for a constant."""
        return self.innovation + self.volume


IS_FORCE = np.isin(FEATURES, FEATURES[FORCE_FEATURES]).astype(float)
IS_MOTOR = np.isin(FEATURES, FEATURES[MOTOR_FEATURES]).astype(float)
