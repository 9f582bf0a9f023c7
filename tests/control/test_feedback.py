"""The outer loop about a controller whose fin makes something else than it was trained for."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from softfin.control.controller import Controller, Measured
from softfin.control.disturbance_observer import DisturbanceObserver as Observer
from softfin.control.disturbance_observer import DisturbanceObserverConfig as Config
from softfin.control.disturbance_observer import ObserverForces
from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.errors import ConfigurationError, CoverageError
from softfin.core.quantities import Command
from softfin.gaits.reachable import Cell, Reachable

BIAS = (0.3, -0.2)
RIPPLE = jnp.array([0.4, -0.9, 0.6, 0.1, -0.5, 0.3])
"""Of the force, within the window of six actions."""
RIPPLE -= (
    RIPPLE * jnp.array([*PAPER_CLOCK.ticks, *PAPER_CLOCK.ticks]) / PAPER_CLOCK.window_ticks
).sum()


class Carrier(eqx.Module):
    """Commands the reference: its angle is x, its velocity y, in an action's time. A controller
    that is never wrong."""

    reachable: Reachable | None = None
    cells: tuple[Cell, ...] = eqx.field(static=True, default=(Cell(low=(-1, -1), high=(3, 3)),))

    def init(self) -> Float[Array, ""]:
        return jnp.zeros(())

    def act(self, state: Any, measured: Measured, reference: Any) -> tuple[Any, Command]:
        return state, Command(reference[0], reference[1])

    def check(self, reference: tuple[float, float]) -> None:
        if self.cells[0].distance(reference) > 0:
            raise CoverageError("outside")


def forces(
    controller: Controller,
    references: Any,
    bias: tuple[float, float] = BIAS,
    most_n: float = 99.0,
    ripple: float = 1.0,
    sensor: Any = (0.0, 0.0),
) -> tuple[np.ndarray, Any]:
    """Mean force read in each action and the states: a fin that makes what is commanded up to
    `most_n`, and a bias.

    `sensor` is added to every reading, ``(2,)`` or ``(actions, 2)``.
    """

    def act(carry: Any, now: Any) -> Any:
        state, force = carry
        reference, index, sensed = now
        state, command = controller.act(state, Measured(jnp.float32(0), force), reference)
        made = jnp.minimum(jnp.stack([command.angle, command.velocity]), most_n)
        force = made + jnp.asarray(bias) + ripple * RIPPLE[index % 6] + sensed
        return (state, force), (force, state)

    asked = jnp.asarray(references, jnp.float32)
    start = (controller.init(), jnp.zeros(2))
    sensed = jnp.broadcast_to(jnp.asarray(sensor, jnp.float32), asked.shape)
    _, (force, states) = jax.lax.scan(act, start, (asked, jnp.arange(len(asked)), sensed))
    return np.asarray(force), states


def window(force: np.ndarray, end: int) -> np.ndarray:
    """Mean over the six actions before `end`, by their ticks."""
    held = np.array([PAPER_CLOCK.ticks[k % 3] for k in range(end - 6, end)])
    return np.asarray((held[:, None] * force[end - 6 : end]).sum(axis=0) / PAPER_CLOCK.window_ticks)


def still(count: int, force: tuple[float, float] = (1.0, 1.0)) -> np.ndarray:
    return np.tile(force, (count, 1))


OBSERVED = Observer(Carrier(), Config(lag_actions=0))


def test_a_constant_bias_is_taken_off_and_stays_without_the_loop() -> None:
    plain, _ = forces(Carrier(), still(60))
    trimmed, _ = forces(OBSERVED, still(60))
    np.testing.assert_allclose(window(plain, 60) - 1, BIAS, atol=1e-4)
    # A small part is attributed to the sensor's drift.
    np.testing.assert_allclose(window(trimmed, 60) - 1, 0, atol=1e-2)


def test_without_drift_the_whole_of_a_constant_bias_is_taken_off() -> None:
    trusting = Observer(Carrier(), Config(lag_actions=0, drift_n=0.0))
    trimmed, _ = forces(trusting, still(200))
    np.testing.assert_allclose(window(trimmed, 200) - 1, 0, atol=1e-3)


def test_the_estimate_is_that_of_a_kalman_filter() -> None:
    """Against the textbook's matrices, with a measurement of variance 6 noise^2 a action."""
    config = Config(lag_actions=0)
    newtons = ObserverForces()
    _, states = forces(Observer(Carrier(), config), still(60), ripple=0.0)
    kept = np.exp(-1 / (3 * 2 * config.drift_s))
    transition = np.diag([1.0, kept])
    process = np.diag([0.0, (1 - kept**2) * 2 * newtons.drift_n**2])
    covariance = np.diag([newtons.bias_n**2, 0.0])
    estimate = np.zeros((2, 2))
    sensed = np.ones((1, 2))
    for action in range(60):
        estimate = transition @ estimate
        covariance = transition @ covariance @ transition.T + process
        if action >= Observer(Carrier(), config).settle_actions:
            total = sensed @ covariance @ sensed.T + 6 * newtons.noise_n**2
            gain = covariance @ sensed.T / total
            estimate = estimate + gain @ (np.array([BIAS]) - sensed @ estimate)
            covariance = covariance - gain @ sensed @ covariance
        np.testing.assert_allclose(states.bias[action], estimate[0], atol=1e-4)
        np.testing.assert_allclose(states.drift[action], estimate[1], atol=1e-4)


def test_the_variance_of_the_drift_is_that_of_a_zeroed_sensor() -> None:
    """Of w(t) - w(0), where w is a stationary Ornstein-Uhlenbeck process: 2 s^2 (1 - exp(-t /
    tau))."""
    config = Config(settle_actions=1000)
    _, states = forces(Observer(Carrier(), config), still(900))
    time_s = np.arange(1, 901) / 3
    expected = 2 * ObserverForces().drift_n ** 2 * (1 - np.exp(-time_s / config.drift_s))
    np.testing.assert_allclose(states.covariance[:, 2], expected, rtol=1e-3)


def test_the_variance_of_the_bias_grows_with_the_distance_that_the_reference_moves() -> None:
    """As much in ten small steps as in one large step."""
    config = Config(settle_actions=1000)
    observer = Observer(Carrier(), config)
    small = np.linspace(1, 2, 11)[:, None] * np.ones(2)
    large = np.where(np.arange(11) > 0, 2.0, 1.0)[:, None] * np.ones(2)
    newtons = ObserverForces()
    for references in (small, large):
        _, states = forces(observer, references)
        np.testing.assert_allclose(
            states.covariance[-1, 0], newtons.bias_n**2 + newtons.bias_per_n**2, rtol=1e-4
        )


def test_the_action_of_a_step_is_not_learnt_from() -> None:
    """Its window belongs to the reference before the step, but the variance of the bias already to
    the new one."""
    _, constant = forces(OBSERVED, still(41), bias=(0.6, -0.2), ripple=0.0)
    _, stepped = forces(
        OBSERVED, np.concatenate([still(40), still(1, (2.5, 0.0))]), bias=(0.6, -0.2), ripple=0.0
    )
    np.testing.assert_allclose(stepped.bias[40], stepped.bias[39], atol=1e-5)
    assert (abs(constant.bias[40] - constant.bias[39]) > 1e-4).any()


def drifting(seed: int, count: int) -> np.ndarray:
    """Reading of a sensor that was just zeroed and drifts with a standard deviation of 0.05 N and
    300 s."""
    random = np.random.default_rng(seed)
    kept = np.exp(-1 / 900)
    drift = np.zeros((count, 2))
    drift[0] = 0.05 * random.standard_normal(2)
    for action in range(1, count):
        drift[action] = kept * drift[action - 1] + 0.05 * np.sqrt(
            1 - kept**2
        ) * random.standard_normal(2)
    return drift - drift[0]


def test_drift_of_the_sensor_is_not_chased() -> None:
    """The true force is nearer to the reference than with an observer that trusts the sensor."""
    errors = {}
    for drift_n in (0.05, 0.0):
        config = Config(lag_actions=0, drift_n=drift_n)
        observer = Observer(Carrier(), config)
        true_errors = []
        for seed in range(12):
            drift = drifting(seed, 180)
            _, states = forces(observer, still(180), ripple=0.0, sensor=drift)
            true_errors.append(np.abs(np.asarray(states.bias[30:]) - np.array(BIAS)).mean())
        errors[drift_n] = np.mean(true_errors)
    assert errors[0.05] < 0.9 * errors[0.0]


def test_a_change_of_the_fin_is_told_from_drift() -> None:
    """After a minute at rest references an error grows at once by more than any drift: it is taken
    off."""
    biases = np.concatenate([np.tile(BIAS, (180, 1)), np.tile((0.6, -0.2), (60, 1))])
    _, states = forces(OBSERVED, still(240), bias=(0.0, 0.0), ripple=0.0, sensor=biases)
    np.testing.assert_allclose(states.bias[-1, 0], 0.6, atol=0.05)
    assert abs(float(states.drift[-1, 0])) < 0.05


def test_the_ripple_of_a_gait_is_not_taken_for_a_bias() -> None:
    """Weighted by the ticks that each action is held, it cancels in every window."""
    _, states = forces(OBSERVED, still(60), bias=(0, 0))
    np.testing.assert_allclose(states.bias, 0, atol=1e-5)


def test_nothing_is_trimmed_before_the_fin_has_settled() -> None:
    late = Observer(Carrier(), Config(settle_actions=20))
    _, states = forces(late, still(25))
    assert (states.bias[:20] == 0).all()
    assert (states.bias[20] != 0).all()


@pytest.mark.parametrize("lag", [0, 1, 3])
def test_a_step_of_the_reference_does_not_disturb_the_bias(lag: int) -> None:
    """The window of what was asked is as old as that of the forces; a fin that follows late is what
    `lag` is for."""
    controller = Observer(Late(Carrier(), lag), Config(lag_actions=lag, settle_actions=9))
    steps = np.concatenate([still(50), still(50, (2.5, 0.0))])
    _, states = forces(controller, steps, ripple=0.0)
    # The correction moves the inner reference, too; once it hardly changes any more, little is left
    # to disturb.
    before = np.asarray(states.bias[49])
    np.testing.assert_allclose(before, BIAS, rtol=0.03)
    np.testing.assert_allclose(states.bias[50:], np.broadcast_to(before, (50, 2)), atol=5e-3)


def test_a_lag_that_is_not_known_of_disturbs_the_bias() -> None:
    controller = Observer(Late(Carrier(), 3), Config(lag_actions=0))
    _, states = forces(controller, np.concatenate([still(50), still(50, (2.5, 0.0))]), ripple=0.0)
    assert np.abs(states.bias[50:] - np.array(BIAS)).max() > 0.1


def test_while_what_is_asked_moves_little_is_learnt() -> None:
    """A fin that follows late seems to have a bias whenever its reference moves."""
    swinging = 1 + np.sin(2 * np.pi * np.arange(90) / 30)[:, None] * np.ones(2)
    worst = {}
    for still_n in (0.05, 99.0):
        controller = Observer(Late(Carrier(), 2), Config(lag_actions=0, still_n=still_n))
        worst[still_n] = np.abs(forces(controller, swinging, (0, 0), ripple=0.0)[1].bias).max()
    assert worst[0.05] < 0.02 < 0.2 < worst[99.0]


class Late(eqx.Module):
    """Does what another controller says some actions later."""

    inner: Carrier
    actions: int = eqx.field(static=True)

    def init(self) -> Any:
        return jnp.zeros((self.actions + 1, 2))

    def act(self, state: Any, measured: Measured, reference: Any) -> tuple[Any, Command]:
        _, command = self.inner.act(jnp.zeros(()), measured, reference)
        state = jnp.concatenate([jnp.stack(command)[None], state[:-1]])
        return state, Command(state[-1, 0], state[-1, 1])

    def check(self, reference: tuple[float, float]) -> None:
        self.inner.check(reference)

    @property
    def cells(self) -> tuple[Cell, ...]:
        return self.inner.cells


REGION = Reachable(np.zeros(2, np.float32), np.full(64, 2, np.float32))


def test_what_is_asked_stays_within_reach_and_nothing_winds_up_there() -> None:
    """The fin makes no more than 2 N in x: after 60 s at the edge, an easy reference is held at
    once."""
    controller = Observer(Carrier(REGION), Config(lag_actions=0))
    steps = np.concatenate([still(180, (2.0, 0.0)), still(40, (1.0, 0.0))])
    force, states = forces(controller, steps, bias=(-0.3, 0.0))
    asked = np.asarray(states.tracked)[:, 0]
    assert np.hypot(*asked.T).max() <= 2.001
    np.testing.assert_allclose(states.bias[8 + 40 :, 0], -0.3, atol=5e-3)
    np.testing.assert_allclose(window(force, 180)[0], 1.7, atol=5e-3)
    np.testing.assert_allclose(window(force, 186)[0], 1.0, atol=5e-3)


def test_where_the_reach_is_not_known_the_trim_ends_at_its_limit() -> None:
    controller = Observer(Carrier(), Config(lag_actions=0, limit_n=0.5))
    steps = np.concatenate([still(180, (3.0, 0.0)), still(40, (1.0, 0.0))])
    force, states = forces(controller, steps, bias=(0, 0), most_n=2.0)
    assert np.abs(states.bias).max() == pytest.approx(0.5)
    np.testing.assert_allclose(window(force, 220)[0], 1.0, atol=0.02)


def test_it_covers_and_reaches_what_the_inner_controller_does() -> None:
    controller = Observer(Carrier(REGION), Config())
    assert isinstance(controller, Controller)
    assert controller.reachable is REGION
    assert controller.cells == (Cell(low=(-1, -1), high=(3, 3)),)
    controller.check((1.0, 1.0))
    with pytest.raises(CoverageError, match="outside"):
        controller.check((9.0, 0.0))


def test_a_loop_that_learns_before_its_window_is_full_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"settle_actions = 8 .* to 10"):
        Observer(Carrier(), Config(lag_actions=4, settle_actions=8))
    late = Config(lag_actions=4, settle_actions=10)
    assert Observer(Carrier(), late).settle_actions == 10
    assert Observer(Carrier()).settle_actions == 8


def test_at_the_edge_of_the_range_it_does_not_wind_up() -> None:
    controller = Observer(Carrier(), Config(lag_actions=0))
    _, states = forces(controller, still(180, (3.0, 1.0)), bias=(-0.3, 0.0))
    assert np.asarray(states.tracked)[:, 0, 0].max() == 3.0
    np.testing.assert_allclose(states.bias[-1], [-0.3, 0.0], atol=5e-3)


def test_a_great_bias_is_learnt_as_fast_as_a_small_one() -> None:
    def actions(bias: float) -> int:
        _, states = forces(OBSERVED, still(120, (1.0, 1.0)), bias=(bias, 0.0))
        return int(np.argmax(np.asarray(states.bias)[:, 0] > 0.9 * bias))

    assert actions(0.8) <= actions(0.05) + 1


L_SHAPE = (
    Cell(low=(0.0, 0.0), high=(1.0, 1.0)),
    Cell(low=(1.0, 0.0), high=(2.0, 1.0)),
    Cell(low=(0.0, 1.0), high=(1.0, 2.0)),
)
"""Cells whose bounding box has a corner that no policy was trained for."""


@pytest.mark.parametrize(
    "region", [None, Reachable(np.array([0.2, 0.2], np.float32), np.full(64, 1.4, np.float32))]
)
@pytest.mark.parametrize("bias", [(-0.6, -0.6), (-0.9, 0.3), (0.4, -0.7), (0.9, 0.9)])
@pytest.mark.parametrize("reference", [(0.9, 0.9), (1.5, 0.5), (0.5, 1.2)])
def test_the_inner_reference_stays_in_the_cells_where_their_box_has_gaps(
    region: Reachable | None, bias: tuple[float, float], reference: tuple[float, float]
) -> None:
    controller = Observer(Carrier(region, L_SHAPE), Config(lag_actions=0))
    _, states = forces(controller, still(60, reference), bias=bias, ripple=0.0)
    for inner in np.asarray(states.tracked)[:, 0]:
        assert min(cell.distance(tuple(map(float, inner))) for cell in L_SHAPE) < 1e-5


def test_a_correction_may_lead_into_another_cell() -> None:
    controller = Observer(Carrier(None, L_SHAPE), Config(lag_actions=0))
    force, states = forces(controller, still(60, (0.9, 0.5)), bias=(-0.3, 0.0), ripple=0.0)
    assert float(states.tracked[-1, 0, 0]) > 1.15
    np.testing.assert_allclose(force[-1], (0.9, 0.5), atol=0.02)


def test_with_numpy_it_does_what_it_does_with_jax() -> None:
    """On a robot, where a reference is a tuple and forces are NumPy's."""
    controller = Observer(Carrier(None, L_SHAPE), Config(lag_actions=0))
    force, states = forces(controller, still(40, (0.9, 0.9)), bias=(-0.4, 0.1))
    state = controller.init()
    measured = np.zeros(2)
    for action in range(40):
        state, _ = controller.act(state, Measured(0.0, measured), (0.9, 0.9))
        measured = force[action].astype(float)
        np.testing.assert_allclose(state.bias, states.bias[action], atol=1e-5)
        np.testing.assert_allclose(state.tracked[0], states.tracked[action, 0], atol=1e-5)
        np.testing.assert_allclose(state.covariance, states.covariance[action], atol=1e-6)
