"""Actions of 33 and 34 ticks have one shape, so that a program holds the plant once, and is
compiled once."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.errors import PlantError
from softfin.core.plant import Plant, drop_padding, hold, hold_action, masked_mean, roll
from softfin.core.quantities import PAPER_LIMITS, Command, Reading
from softfin.evaluation import experiment
from softfin.learning.policy import Policy, PolicyConfig
from softfin.learning.ppo import PPO, PPOConfig
from softfin.learning.rollout import collect_rollout, evaluate_policy, start_episodes
from softfin.tank import Tank
from softfin.task.references import PAPER_RANGE, References
from softfin.task.task import ForceTracking, TaskConfig
from softfin.testing import check_plant
from tests.plants import AnalyticFin, Flapper

KEY = jax.random.key(0)
SIZE = PolicyConfig(units=4)
MARK = "lgamma"


class MarkedFin(AnalyticFin):
    """Each place in a program where it moves can be counted."""

    def advance(self, state: Any, command: Command, ticks: int) -> Any:
        state, reading = super().advance(state, command, ticks)
        return state, reading._replace(angle=jax.lax.lgamma(2 + reading.angle))


TASK = ForceTracking(MarkedFin(), TaskConfig())
POLICY = Policy.create(KEY, SIZE, TASK.config.observations)
ENVIRONMENTS = start_episodes(TASK, POLICY, References.of(PAPER_RANGE), KEY, 2)
LEARNER = PPO(TASK, PPOConfig(num_envs=2, num_steps=6, num_minibatches=1, num_epochs=1), SIZE, 2)
ACTIONS = Command(jnp.linspace(-1, 1, 7), jnp.full(7, 2.0))


def evaluated(references: Any) -> Any:
    return experiment._program.__wrapped__(
        (Flapper(), MarkedFin()), references, jax.random.split(KEY, 2)
    )


@pytest.mark.parametrize(
    "program",
    [
        lambda: hold(MarkedFin(), MarkedFin().init(KEY), ACTIONS),
        lambda: collect_rollout(TASK, POLICY, ENVIRONMENTS, KEY, 2),
        lambda: evaluate_policy(TASK, POLICY, jnp.ones((2, 2)), KEY),
        lambda: evaluated(jnp.ones((2, 9, 2))),
    ],
    ids=["hold", "rollout", "evaluation of a policy", "evaluation"],
)
def test_a_program_holds_the_plant_once(program: Any) -> None:
    assert str(jax.make_jaxpr(program)()).count(MARK) == 1


def test_an_update_takes_what_it_gives() -> None:
    """Shapes, types and how firm these are: else it would be compiled again for its own results."""
    first = jax.eval_shape(LEARNER.init, KEY, References.of(PAPER_RANGE))
    assert jax.eval_shape(LEARNER.update, first)[0] == first


def test_the_tank_takes_the_state_that_it_gives() -> None:
    tank = Tank()
    first = jax.eval_shape(tank.init, KEY)
    assert (
        jax.eval_shape(
            partial(tank.advance, ticks=1), first, jax.tree.map(jnp.float32, Command(0.1, 2.0))
        )[0]
        == first
    )


def test_actions_held_are_their_commands_one_a_tick() -> None:
    fin = AnalyticFin()
    state, reading = hold(fin, fin.init(KEY), ACTIONS)
    ticks = PAPER_CLOCK.action_ticks(7)
    assert ticks == [33, 33, 34, 33, 33, 34, 33]
    alone, each = roll(
        fin, fin.init(KEY), Command(*(jnp.repeat(part, np.array(ticks)) for part in ACTIONS))
    )
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5), (state, reading), (alone, each))


@pytest.mark.parametrize("ticks", [33, 34])
def test_the_rows_of_an_action_that_count_are_those_it_is_held(ticks: int) -> None:
    fin = AnalyticFin()
    command = Command(jnp.float32(0.4), jnp.float32(2.0))
    state, reading = jax.jit(partial(hold_action, fin, rows=34))(fin.init(KEY), command, ticks)
    expected_state, expected = fin.advance(fin.init(KEY), command, ticks)
    assert reading.force.shape == (PAPER_CLOCK.max_ticks, 2)
    np.testing.assert_allclose(reading.force[:ticks], expected.force, rtol=1e-5)
    np.testing.assert_allclose(state.angle, expected_state.angle, rtol=1e-5)
    np.testing.assert_allclose(
        masked_mean(reading.force, ticks), expected.force.mean(axis=0), rtol=1e-5
    )


def test_rows_that_count_follow_one_another() -> None:
    rows = jnp.arange(3 * PAPER_CLOCK.max_ticks)
    kept = drop_padding(rows.reshape(3, PAPER_CLOCK.max_ticks), 3, PAPER_CLOCK)
    assert (
        kept.tolist()
        == PAPER_CLOCK.valid_rows(3)
        == [row for row in rows.tolist() if row not in (33, 67)]
    )


class Careless(AnalyticFin):
    """Forgets that the last row of a short action does not count."""

    def hold_action(
        self, state: Any, command: Command, ticks: Any, rows: int
    ) -> tuple[Any, Reading]:
        return self.advance(state, command, rows)


class Careful(AnalyticFin):
    def hold_action(
        self, state: Any, command: Command, ticks: Any, rows: int
    ) -> tuple[Any, Reading]:
        plain: Plant = AnalyticFin()
        return hold_action(plain, state, command, ticks, rows)


def test_the_conformance_kit_checks_a_plants_own_way_to_hold_an_action() -> None:
    assert Careful().limits == PAPER_LIMITS
    check_plant(Careful())
    with pytest.raises(
        PlantError, match="Careless: hold_action for 33 ticks differs from advance by 33 ticks"
    ):
        check_plant(Careless())
