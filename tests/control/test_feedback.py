"""Feedback around a controller whose fin is not what it was, and whose sensor drifts."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from softfin.control.controller import Controller, Measured
from softfin.control.family import FEATURES, Family
from softfin.control.feedback import UNFAMILIAR, Feedback, FeedbackConfig, FeedbackForces
from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.errors import ConfigurationError, CoverageError
from softfin.core.operations import NUMPY
from softfin.core.quantities import Command
from softfin.gaits.reachable import Cell, Reachable

BIAS = (0.2, -0.15)
TICKS = np.array([*PAPER_CLOCK.ticks, *PAPER_CLOCK.ticks])
RIPPLE = np.array([0.4, -0.9, 0.6, 0.1, -0.5, 0.3])
"""Of the force, within the window of six actions."""
RIPPLE -= (RIPPLE * TICKS).sum() / PAPER_CLOCK.window_ticks
QUIET = FeedbackConfig(drift_n=1e-4)


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


def make_family(coefficients: int = 2) -> Family:
    """A family whose changes have a pattern in force and torque that no drift has."""
    random = np.random.default_rng(3)
    actions = PAPER_CLOCK.window_actions
    nodes = np.linspace(-4, 4, 5)
    references = np.stack(np.meshgrid(nodes, nodes, indexing="ij"), axis=-1)
    nominal = np.zeros((5, 5, actions, len(FEATURES)))
    nominal[..., :2] = references[:, :, None] + RIPPLE[:, None]
    nominal[..., 3:] = random.normal(size=(actions, 4))
    changes = np.zeros((5, 5, actions, coefficients, len(FEATURES)))
    changes += 0.2 * random.normal(size=changes.shape[2:])
    shares = TICKS / PAPER_CLOCK.window_ticks
    force = np.einsum("a,xyacf->xycf", shares, changes[..., :2])
    return Family(
        low=np.full(2, -4.0),
        high=np.full(2, 4.0),
        nominal=nominal,
        nominal_noise=np.zeros((5, 5, len(FEATURES))),
        friction=np.zeros((5, 5, actions, 2)),
        force=force,
        features=changes,
        force_noise=np.full(2, 0.002),
        feature_noise=np.full(len(FEATURES), 0.005),
        feature_spread=np.full(len(FEATURES), 1.0),
    )


FAMILY = make_family()


def run(
    controller: Controller,
    references: Any,
    bias: Any = (0.0, 0.0),
    sensor: Any = (0.0, 0.0),
    coefficients: Any = (0.0, 0.0),
    most_n: float = 99.0,
    has_torque: bool = True,
    strange: Any = 0.0,
) -> tuple[np.ndarray, Any]:
    """True mean force of each action without the ripple, and the estimates after it.

    The fin makes what is commanded up to `most_n`, plus `bias` and the changes of `FAMILY`. `bias`,
    `sensor` and `coefficients` are constant or have a row per action; `strange` is added to one
    torque.
    """
    count = len(references)

    def each(values: Any) -> Array:
        return jnp.broadcast_to(jnp.asarray(values, jnp.float32), (count, 2))

    start = controller.init()

    def act(carry: Any, now: Any) -> Any:
        state, measured = carry
        reference, index, wrong, sensed, changed, odd = now
        state, command = controller.act(state, measured, reference)
        made = jnp.minimum(jnp.stack([command.angle, command.velocity]), most_n)
        nominal, features = (
            jnp.asarray(table[2, 2], jnp.float32)[index % 6]
            for table in (FAMILY.nominal, FAMILY.features)
        )
        seen = nominal + changed @ features
        force = made + wrong + seen[:2]
        torque = seen[3:5] + jnp.stack([odd, 0.0]) if has_torque else jnp.full(2, jnp.nan)
        measured = Measured(seen[2], force + sensed, torque, seen[5:])
        true = force - jnp.asarray(RIPPLE, jnp.float32)[index % 6]
        return (state, measured), (true, controller.estimate(state))

    rest = Measured(jnp.float32(0), jnp.zeros(2), jnp.zeros(2), jnp.zeros(2))
    inputs = (
        jnp.asarray(references, jnp.float32),
        jnp.arange(count),
        each(bias),
        each(sensor),
        each(coefficients),
        jnp.broadcast_to(jnp.asarray(strange, jnp.float32), (count,)),
    )
    _, (force, estimates) = jax.lax.scan(act, (start, rest), inputs)
    return np.asarray(force), estimates


def window(force: np.ndarray, end: int) -> np.ndarray:
    """Mean over the six actions before `end`, by their ticks."""
    held = np.array([PAPER_CLOCK.ticks[k % 3] for k in range(end - 6, end)])
    return np.asarray((held[:, None] * force[end - 6 : end]).sum(axis=0) / PAPER_CLOCK.window_ticks)


def still(count: int, force: tuple[float, float] = (1.0, 1.0)) -> np.ndarray:
    return np.tile(force, (count, 1))


def drifting(seed: int, count: int) -> np.ndarray:
    """Reading of a sensor that was just zeroed and drifts with a standard deviation of 0.05 N and
    300 s."""
    random = np.random.default_rng(seed)
    kept = np.exp(-1 / 900)
    drift = 0.05 * random.standard_normal((count, 2))
    drift[1:] *= np.sqrt(1 - kept**2)
    for action in range(1, count):
        drift[action] += kept * drift[action - 1]
    return drift - drift[0]


def test_a_constant_error_is_taken_off() -> None:
    force, _ = run(Feedback(Carrier(), QUIET), still(120), BIAS)
    np.testing.assert_allclose(window(force, 120) - 1, 0, atol=0.01)


def test_an_update_is_that_of_the_textbook() -> None:
    """K = P H' (H P H' + R)^-1, with a singular P."""
    random = np.random.default_rng(0)
    root = random.normal(size=(5, 3))
    covariance = root @ root.T
    rows = random.normal(size=(8, 5))
    errors = random.normal(size=8)
    variance = random.uniform(0.1, 2.0, 8)
    total = rows @ covariance @ rows.T + np.diag(variance)
    gain = covariance @ rows.T @ np.linalg.inv(total)
    found = Feedback(Carrier())._correct(NUMPY, covariance, rows, errors, 1 / variance)
    np.testing.assert_allclose(found.change, gain @ errors, atol=1e-9)
    np.testing.assert_allclose(found.covariance, covariance - gain @ rows @ covariance, atol=1e-9)
    assert found.innovation == pytest.approx(errors @ np.linalg.solve(total, errors))


def test_a_reference_that_toggles_for_long_does_not_bring_the_drift_into_the_force() -> None:
    """For 20 min, between two forces that the fin makes with constant errors."""
    toggling = np.where((np.arange(3600) // 30 % 2 == 0)[:, None], (3.0, 1.0), (2.0, 1.0))
    drifts = [drifting(seed, 3600) for seed in range(6)]
    assert np.sqrt(np.mean(np.square(drifts)[:, -1])) > 0.05
    for family in (None, FAMILY):
        controller = Feedback(Carrier(), family=family)
        late = []
        for drift in drifts:
            force, _ = run(controller, toggling, (0.05, 0.05), drift)
            late.append(window(force, 3600 - 1) - toggling[-1])
        assert np.sqrt(np.mean(np.square(late))) < 0.03


def test_the_pattern_tells_a_changed_fin_from_a_drifting_sensor() -> None:
    """Both shift the mean force; most of the sensor's share is not corrected."""
    changed = np.where((np.arange(240) < 120)[:, None], (0.0, 0.0), (1.0, -0.7))
    sensor = np.linspace(0, 0.1, 240)[:, None] * np.ones(2)
    feedback = Feedback(Carrier(), family=FAMILY)
    without, _ = run(Feedback(Carrier(), FeedbackConfig(limit_n=1e-6)), still(240), 0, 0, changed)
    force, estimates = run(feedback, still(240), 0, sensor, changed)
    assert np.abs(window(without, 240) - 1).max() > 0.05
    np.testing.assert_allclose(window(force, 240), 1, atol=0.035)
    assert (np.asarray(estimates.half_width)[-1] < 0.1).all()


def test_without_a_force_sensor_the_torque_is_enough() -> None:
    changed = np.where((np.arange(240) < 120)[:, None], (0.0, 0.0), (1.0, -0.7))
    feedback = Feedback(Carrier(), FeedbackConfig(uses="torque"), FAMILY)
    force, _ = run(feedback, still(240), 0, (9.0, 9.0), changed)
    np.testing.assert_allclose(window(force, 240), 1, atol=0.03)


def test_channels_that_are_missing_have_no_weight() -> None:
    changed = (0.8, 0.4)
    feedback = Feedback(Carrier(), family=FAMILY)
    force, estimates = run(feedback, still(120), 0, 0, changed, has_torque=False)
    np.testing.assert_allclose(window(force, 120), 1, atol=0.03)
    assert np.isfinite(np.asarray(estimates.half_width)).all()


def test_a_fin_outside_the_family_is_told_and_its_mean_force_still_corrected() -> None:
    strange = np.where(np.arange(300) < 120, 0.0, 3.0 * (np.arange(300) % 6 == 2))
    bias = np.where((np.arange(300) < 120)[:, None], (0.0, 0.0), (-0.3, 0.2))
    force, estimates = run(Feedback(Carrier(), family=FAMILY), still(300), bias, 0, strange=strange)
    level = np.asarray(estimates.level)
    assert (level[:120] < UNFAMILIAR).all()
    assert (level[138:] > UNFAMILIAR).any()
    np.testing.assert_allclose(window(force, 300), 1, atol=0.06)


def test_a_sudden_change_without_a_family_is_corrected() -> None:
    bias = np.where((np.arange(360) < 180)[:, None], (0.05, 0.05), (0.6, -0.2))
    force, estimates = run(Feedback(Carrier()), still(360), bias)
    np.testing.assert_allclose(window(force, 360), 1, atol=0.06)
    assert abs(float(estimates.drift[-1, 0])) < 0.06


@pytest.mark.parametrize("jump_n", [0.15, 0.5, 2.0])
@pytest.mark.parametrize("action", [120, 122, 125])
def test_a_sensor_that_jumps_is_not_taken_for_a_changed_fin(jump_n: float, action: int) -> None:
    """Anywhere within a window. Without a family, half of the jump or more would be corrected."""
    sensor = np.where((np.arange(240) < action)[:, None], (0.0, 0.0), (jump_n, -jump_n))
    force, estimates = run(Feedback(Carrier(), family=FAMILY), still(240), 0, sensor)
    np.testing.assert_allclose(window(force, 240), 1, atol=0.03)
    drift = np.asarray(estimates.drift)[-1]
    np.testing.assert_allclose(drift, (jump_n, -jump_n), atol=0.04)
    assert np.asarray(estimates.level).max() < UNFAMILIAR


def test_a_jump_of_the_sensor_does_not_decay() -> None:
    """Over 20 min, whereas the drift tends to 0."""
    sensor = np.where((np.arange(3600) < 120)[:, None], (0.0, 0.0), (2.0, -2.0))
    force, estimates = run(Feedback(Carrier(), family=FAMILY), still(3600), 0, sensor)
    np.testing.assert_allclose(window(force, 3600), 1, atol=0.03)
    np.testing.assert_allclose(np.asarray(estimates.drift)[-1], (2.0, -2.0), atol=0.04)


def test_without_drift_every_error_is_that_of_the_fin() -> None:
    sensor = np.where((np.arange(240) < 120)[:, None], (0.0, 0.0), (0.5, -0.5))
    config = FeedbackConfig(drift_n=0.0)
    force, _ = run(Feedback(Carrier(), config, FAMILY), still(240), 0, sensor)
    np.testing.assert_allclose(window(force + sensor, 240), 1, atol=0.1)


def test_a_fin_that_changes_while_the_sensor_has_jumped_is_corrected() -> None:
    changed = np.where((np.arange(360) < 240)[:, None], (0.0, 0.0), (1.0, -0.7))
    sensor = np.where((np.arange(360) < 120)[:, None], (0.0, 0.0), (0.5, 0.3))
    force, _ = run(Feedback(Carrier(), family=FAMILY), still(360), 0, sensor, changed)
    np.testing.assert_allclose(window(force, 360), 1, atol=0.05)


def test_the_ripple_of_a_gait_is_not_taken_for_an_error() -> None:
    force, _ = run(Feedback(Carrier()), still(60))
    np.testing.assert_allclose(force[12:], 1, atol=1e-4)


REGION = Reachable(np.zeros(2, np.float32), np.full(64, 2, np.float32))


def test_what_is_asked_stays_within_reach_and_nothing_winds_up_there() -> None:
    """The fin makes 0.3 N less than it is told: after 60 s at the edge, an easy reference is held
    as soon as before."""
    steps = np.concatenate([still(180, (2.0, 0.0)), still(40, (1.0, 0.0))])
    force, estimates = run(Feedback(Carrier(REGION), QUIET), steps, (-0.2, 0.0))
    np.testing.assert_allclose(window(force, 180)[0], 1.8, atol=0.01)
    np.testing.assert_allclose(np.asarray(estimates.force)[179, 0], 1.8, atol=0.03)
    np.testing.assert_allclose(window(force, 220)[0], 1.0, atol=0.04)


def test_the_correction_ends_at_its_limit() -> None:
    controller = Feedback(Carrier(), FeedbackConfig(limit_n=0.1, drift_n=0.0))
    force, _ = run(controller, still(180), (0.4, 0.0))
    np.testing.assert_allclose(force[-1], (1.3, 1.0), atol=0.01)


def test_it_covers_and_reaches_what_the_inner_controller_does() -> None:
    controller = Feedback(Carrier(REGION))
    assert isinstance(controller, Controller)
    assert controller.reachable is REGION
    assert controller.cells == (Cell(low=(-1, -1), high=(3, 3)),)
    controller.check((1.0, 1.0))
    with pytest.raises(CoverageError, match="outside"):
        controller.check((9.0, 0.0))


def test_a_policy_does_not_repeat_so_its_windows_count_less() -> None:
    class Policy(Carrier):
        kind = "single"

    (gaits, policy) = (Feedback(each).newtons for each in (Carrier(), Policy()))
    assert gaits is not None
    assert policy is not None
    assert policy.noise_n == 20 * gaits.noise_n


def test_torque_needs_a_family() -> None:
    with pytest.raises(ConfigurationError, match=r"uses = torque: .*softfin family"):
        Feedback(Carrier(), FeedbackConfig(uses="torque"))


def test_forces_are_scaled_with_the_fin_and_the_drift_is_not() -> None:
    small = Reachable(np.zeros(2, np.float32), np.full(64, 0.24, np.float32))
    config = FeedbackConfig(noise_n=0.3)
    newtons = Feedback(Carrier(small), config).newtons
    assert newtons is not None
    assert newtons.bias_n == pytest.approx(FeedbackForces().bias_n / 10)
    assert newtons.noise_n == 0.3
    assert "drift_n" not in FeedbackForces._fields


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
    controller = Feedback(Carrier(region, L_SHAPE), QUIET)
    force, _ = run(controller, still(60, reference), bias)
    for inner in force - np.array(bias):
        assert min(cell.distance(tuple(map(float, inner))) for cell in L_SHAPE) < 1e-4


def test_a_correction_may_lead_into_another_cell() -> None:
    controller = Feedback(Carrier(None, L_SHAPE), QUIET)
    force, _ = run(controller, still(60, (0.9, 0.5)), (-0.2, 0.0))
    np.testing.assert_allclose(force[-1], (0.9, 0.5), atol=0.02)


@pytest.mark.parametrize("family", [None, FAMILY])
def test_with_numpy_it_does_what_it_does_with_jax(family: Family | None) -> None:
    """On a robot, where a reference is a tuple and measurements are numbers."""
    controller = Feedback(Carrier(None, L_SHAPE), family=family)
    changed = np.where((np.arange(90) < 40)[:, None], (0.2, 0.0), (1.0, -0.5))
    _, estimates = run(controller, still(90, (0.7, 0.6)), (0.05, 0.05), 0, changed)
    state = controller.init()
    measured = Measured(0.0, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0))
    for action in range(90):
        state, command = controller.act(state, measured, (0.7, 0.6))
        found = controller.estimate(state)
        np.testing.assert_allclose(found.force, estimates.force[action], atol=2e-4)
        np.testing.assert_allclose(found.half_width, estimates.half_width[action], atol=2e-4)
        features = changed[action] @ FAMILY.features[2, 2, action % 6]
        seen = FAMILY.nominal[2, 2, action % 6] + features
        force = np.array([command.angle, command.velocity]) + 0.05 + seen[:2]
        angle, *loads = seen[2:].tolist()
        measured = Measured(angle, tuple(force.tolist()), tuple(loads[:2]), tuple(loads[2:]))


def test_one_missing_action_costs_only_this_action() -> None:
    """Of the torque and of the force; the controller inside acts all the same."""
    controller = Feedback(Carrier(), family=FAMILY)
    state = controller.init()
    for action in range(60):
        # What is measured belongs to the action before.
        phase = (action - 1) % 6
        features = FAMILY.nominal[2, 2, phase] + [0.8, 0.4] @ FAMILY.features[2, 2, phase]
        features[:2] += state.tracked[-1]
        features[3] = np.nan if phase == 2 else features[3]
        features[0] = np.nan if action == 41 else features[0]
        angle, *loads = features[2:].tolist()
        measured = Measured(angle, tuple(features[:2]), tuple(loads[:2]), tuple(loads[2:]))
        state, command = controller.act(state, measured, (1.0, 1.0))
        assert np.isfinite([command.angle, command.velocity]).all()
    np.testing.assert_allclose(state.mean[:2], [0.8, 0.4], atol=0.1)


def test_coefficients_that_no_fin_has_are_told() -> None:
    force, estimates = run(Feedback(Carrier(), family=FAMILY), still(120), 0, 0, (6.0, -6.0))
    assert np.asarray(estimates.level)[-1] > UNFAMILIAR
    np.testing.assert_allclose(window(force, 120), 1, atol=0.1)
