"""Gradient training: its slope is the true one, it lowers its loss, and it goes on as if it had
never stopped."""

from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.choices import AlgorithmPreset, PolicyLayout
from softfin.core.errors import ConfigurationError, PlantError
from softfin.core.plant import EnsemblePlant, Plant
from softfin.core.plant_identity import jit_argument
from softfin.core.quantities import Command
from softfin.gaits.force_map import MapConfig
from softfin.gaits.gait import GaitTable
from softfin.gaits.reachable import PAPER_REFERENCES, Cell, Reachable
from softfin.gaits.simulate import missing_gradient
from softfin.learning.configuration import (
    GRADIENT_SINGLE,
    GRID,
    TRAIN_PRESETS,
    TrainConfig,
    check,
    choose_preset,
)
from softfin.learning.gradient import Gradient, GradientConfig
from softfin.learning.policy import Policy, PolicyConfig
from softfin.learning.rollout import AgentState, EnvState
from softfin.learning.run import TrainingResult, TrainingRun
from softfin.learning.train import train
from softfin.stages.reproduce_config import PRESETS
from softfin.storage.run_directory import RunDirectory
from softfin.task.references import References, stack_references
from softfin.task.task import ForceTracking, TaskConfig
from tests.learning.mapped import GAITS, SURVEY, WITHIN, mapped
from tests.learning.probes import Delayed, Direct
from tests.plants import AnalyticFin, PlainFin, StrokeFin
from tests.surrogate.streaming import small as streaming

QUICK = GRADIENT_SINGLE.model_copy(
    update={
        "cells": (WITHIN.box,),
        "margin_n": 0.0,
        "policy": PolicyConfig(units=8, width=8),
        "steps": 40 * 24,
        "num_evaluations": 4,
        "lattice": 1,
        "task": TaskConfig(phase=True, episode_actions=12, reference_actions=6),
        "gradient": GradientConfig(
            num_envs=4,
            num_steps=6,
            learning_rate=1e-2,
            map=MapConfig(spacing_n=0.5, survey=SURVEY, gaits=GAITS),
        ),
    }
)
SEEDS = (0, 1, 2, 3)
TASK = ForceTracking(StrokeFin(), QUICK.task)
LEARNER = Gradient(TASK, QUICK.gradient, QUICK.policy, QUICK.num_updates)


@cache
def loud() -> AgentState:
    """Four lanes with policies that beat: where a fin rests, its force has no slope."""
    keys = jax.random.split(jax.random.key(0), len(SEEDS))
    references = stack_references(
        [Cell(low=(1, -0.25), high=(1.5, 0.25))] * len(SEEDS), mapped().reachable
    )
    lanes = jax.jit(jax.vmap(LEARNER.init))(keys, references)
    return lanes._replace(
        policy=eqx.tree_at(lambda policy: policy.net.output.kernel, lanes.policy, replace_fn=louder)
    )


def louder(kernel: Any) -> Any:
    return 60 * kernel


def start() -> AgentState:
    return jax.tree.map(lambda x: x[0], loud())


class Judged(NamedTuple):
    loss: Any
    reward: Any
    slope: Policy


def judged(
    policy: Policy,
    env_state: EnvState,
    rounding: float,
    weight: Any = (1.0, 1.0),
    smoothness: Any = (0.01, 0.01),
) -> Judged:
    """The loss of the learner with other settings; defaults of a compiled function would be
    constants in it."""
    found: Judged = _judged(policy, env_state, rounding, weight, smoothness)
    return found


@jax.jit
def _judged(
    policy: Policy, env_state: EnvState, rounding: Any, weight: Any, smoothness: Any
) -> Judged:
    reward = QUICK.task.reward.model_copy(update={"weight": weight, "smoothness": smoothness})
    task = ForceTracking(TASK.plant, QUICK.task.model_copy(update={"reward": reward}))
    learner = Gradient(
        task,
        QUICK.gradient.model_copy(update={"rounding_n": rounding}),
        QUICK.policy,
        QUICK.num_updates,
    )
    (loss, (_, metrics)), slope = jax.value_and_grad(learner.loss, has_aux=True)(policy, env_state)
    return Judged(loss, metrics["reward"], slope)


def test_its_slope_is_that_of_finite_differences() -> None:
    """For the weight that the loss depends on most, and its neighbours."""
    lane = start()
    rounding = QUICK.gradient.rounding_n
    slope = np.asarray(judged(lane.policy, lane.env_state, rounding).slope.net.hidden.kernel)
    place = np.unravel_index(np.argmax(np.abs(slope)), slope.shape)
    step = 3e-2

    def moved(by: float) -> float:
        kernel = np.array(lane.policy.net.hidden.kernel)
        kernel[place] += by
        there = eqx.tree_at(
            lambda policy: policy.net.hidden.kernel, lane.policy, jnp.asarray(kernel)
        )
        return float(judged(there, lane.env_state, rounding).loss)

    assert float(slope[place]) != 0
    np.testing.assert_allclose(
        float(slope[place]), (moved(step) - moved(-step)) / (2 * step), rtol=0.05
    )


def test_no_slope_reaches_the_normalisation_and_the_noise() -> None:
    lane = start()
    slope = judged(lane.policy, lane.env_state, QUICK.gradient.rounding_n).slope
    assert not any(np.any(leaf) for leaf in jax.tree.leaves((slope.normalisation, slope.log_std)))


def test_updates_lower_the_loss() -> None:
    """On average over four policies: which references a short run draws weighs nearly as much as
    what it learns."""
    run = TrainingRun(StrokeFin(), QUICK, SEEDS, mapped().forces)
    lanes = loud()
    losses = []
    for number in range(QUICK.num_updates):
        lanes, metrics = run.update(lanes, number + 1)
        losses.append(np.asarray(metrics["loss"]))
    assert np.mean(losses[-5:]) < 0.85 * np.mean(losses[:5])
    assert {"loss", "error_x_n", "error_y_n", "reward", "gradient_norm"} <= set(metrics)


def test_a_loss_of_rounded_errors_is_the_plain_one_less_at_most_the_rounding() -> None:
    """sqrt(e^2 + r^2) - r lies between e - r and e."""
    lane = start()
    plain, rounded = (
        float(judged(lane.policy, lane.env_state, by).loss)
        for by in (1e-6, QUICK.gradient.rounding_n)
    )
    assert plain - 2 * QUICK.gradient.rounding_n <= rounded < plain


def test_the_loss_is_the_reward_of_the_task_but_for_the_rounding() -> None:
    """The reward of each action is what PPO's rollout collects; here its weights all differ."""
    lane = start()
    got = judged(lane.policy, lane.env_state, 1e-6, (2.0, 0.5), (0.3, 0.05))
    assert float(got.reward) < -0.1
    np.testing.assert_allclose(-float(got.loss), float(got.reward), rtol=1e-5)


def test_a_new_policy_acts_as_the_gait_for_each_reference_that_its_table_holds() -> None:
    """Gaits that differ from node to node, so that a gait for another reference is another
    action."""
    table = GaitTable.over(Cell(low=(-2, -2), high=(2, 2)), 1.0)
    actions = np.random.default_rng(0).uniform(-0.8, 0.8, table.actions.shape).astype(np.float32)
    table = table._replace(actions=actions)
    learner = Gradient(TASK, QUICK.gradient, QUICK.policy, QUICK.num_updates, table)
    references = stack_references([Cell(low=(1, -0.25), high=(1.5, 0.25))], mapped().reachable)
    policy = learner.init(jax.random.key(0), jax.tree.map(lambda x: x[0], references)).policy
    for reference in table.references().reshape(-1, 2):
        at = tuple(reference.tolist())
        start = TASK.reset(jax.random.key(0), References.of(Cell(low=at, high=at)))
        _, action = policy.act(policy.init(), TASK.observe(start))
        np.testing.assert_allclose(action, table.gait(reference)[0], atol=0.05)


def test_the_errors_shown_are_means_over_the_actions_of_all_fins() -> None:
    lane = start()
    _, (_, metrics) = jax.jit(LEARNER.loss)(lane.policy, lane.env_state)
    act = jax.jit(jax.vmap(lane.policy.act))
    step = jax.jit(jax.vmap(TASK.step, in_axes=(0, 0, None)))
    states = lane.env_state.states
    memories = lane.env_state.memories
    errors = []
    for ticks in PAPER_CLOCK.action_ticks(QUICK.gradient.num_steps):
        memories, action = act(memories, jax.vmap(TASK.observe)(states))
        states, outcome = step(states, action, ticks)
        errors.append(np.abs(outcome.force_error))
    expected = np.mean(errors, axis=(0, 1))
    np.testing.assert_allclose([metrics["error_x_n"], metrics["error_y_n"]], expected, rtol=1e-4)


def test_a_policy_that_begins_as_gaits_must_observe_the_phase() -> None:
    with pytest.raises(
        ConfigurationError,
        match=r"task\.phase is false, but a policy that starts from gaits must observe",
    ):
        GRADIENT_SINGLE.changed(["task.phase=false"])
    assert not GRADIENT_SINGLE.changed(
        ["task.phase=false", "gradient.warm_start=false"]
    ).begins_as_gaits


class Numb(StrokeFin):
    """A fin whose force knows nothing of its commands, as far as slopes go."""

    def advance(self, state: Any, command: Command, ticks: int) -> Any:
        return super().advance(state, jax.lax.stop_gradient(command), ticks)


class Foreign(StrokeFin):
    """A fin that computes beyond JAX."""

    def advance(self, state: Any, command: Command, ticks: int) -> Any:
        angle = jax.pure_callback(np.asarray, jax.ShapeDtypeStruct((), jnp.float32), command.angle)
        return super().advance(state, Command(angle, command.velocity), ticks)


class Branching(StrokeFin):
    """A fin whose own code fails: it asks for the value of what is only traced."""

    def advance(self, state: Any, command: Command, ticks: int) -> Any:
        return super().advance(
            state, command if command.angle > 0 else Command(*map(jnp.negative, command)), ticks
        )


class Broken(StrokeFin):
    """A fin with a bug of its own in it."""

    def advance(self, state: Any, command: Command, ticks: int) -> Any:
        raise KeyError("gear")


@pytest.mark.parametrize(
    ("plant", "reason"),
    [
        (StrokeFin(), None),
        (AnalyticFin(), None),
        (PlainFin(), None),
        (Direct(), None),
        (Delayed(), None),
        (Numb(), "its gradient is 0"),
        (Foreign(), "JAX cannot differentiate it (ValueError: Pure callbacks do not support JVP."),
    ],
    ids=["strokes", "analytic", "plain", "direct", "delayed", "numb", "foreign"],
)
def test_a_plant_has_a_gradient_where_its_force_has_a_slope(
    plant: Plant, reason: str | None
) -> None:
    found = missing_gradient(plant)
    assert found is None if reason is None else found is not None and found.startswith(reason)


@pytest.mark.parametrize(
    ("plant", "error", "message"),
    [
        (
            Branching(),
            PlantError,
            "^plant Branching: cannot be traced .TracerBoolConversionError: .*check_plant to find out",
        ),
        (
            Broken(),
            PlantError,
            "^plant Broken: cannot be traced .KeyError: 'gear'.; .*check_plant to find out",
        ),
    ],
    ids=["branching", "broken"],
)
def test_a_plant_that_fails_is_an_error_and_not_trained_by_another_algorithm(
    plant: Plant, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        choose_preset(plant)


def test_ctrl_c_is_no_missing_gradient(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(StrokeFin, "advance", interrupted)
    with pytest.raises(KeyboardInterrupt):
        missing_gradient(StrokeFin())


def test_the_gradient_is_compiled_once_for_all_who_ask() -> None:
    """The second time the plant is traced forward alone."""
    calls = [0]

    class Counted(StrokeFin):
        def advance(self, state: Any, command: Command, ticks: int) -> Any:
            calls[-1] += 1
            return super().advance(state, command, ticks)

    for _ in range(2):
        assert missing_gradient(Counted()) is None
        calls.append(0)
    assert 0 < calls[1] < calls[0]


def trained(folder: Path, resume: bool = False, progress: Any = None) -> TrainingResult:
    run_directory = RunDirectory(folder / "out", {"of": "this"}, resume=resume)
    return train(StrokeFin(), QUICK, SEEDS, run_directory, progress)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> TrainingResult:
    return trained(tmp_path_factory.mktemp("whole"))


class Cut(Exception):
    """The power goes."""


def test_a_run_that_was_stopped_twice_ends_with_the_weights_of_one_that_never_was(
    whole: TrainingResult, tmp_path: Path
) -> None:
    """Once between the map and the first checkpoint, once between two checkpoints."""

    def cut(at: float) -> Any:
        def progress(stage: str, done: float, note: str) -> None:
            if stage.startswith("train") and done >= at:
                raise Cut

        return progress

    stages = []
    for resume, at in ((False, 0.2), (True, 0.7)):
        with pytest.raises(Cut):
            trained(tmp_path, resume, cut(at))
    resumed = trained(tmp_path, True, lambda stage, done, note: stages.append(stage))

    jax.tree.map(np.testing.assert_array_equal, resumed.policies, whole.policies)
    jax.tree.map(np.testing.assert_array_equal, resumed.evaluation, whole.evaluation)
    assert "map" not in stages
    assert resumed.reachable is not None
    assert whole.reachable is not None
    jax.tree.map(np.testing.assert_array_equal, resumed.reachable, whole.reachable)


def test_a_run_knows_what_the_fin_can_do_over_its_cells(whole: TrainingResult) -> None:
    assert whole.reachable is not None
    assert WITHIN.box is not None
    low, high = whole.reachable.bounds()
    assert (np.asarray(low) <= np.array(WITHIN.box.low) + 1e-6).all()
    assert (np.asarray(high) >= np.array(WITHIN.box.high) - 1e-6).all()
    assert isinstance(whole.policies, Policy)


def test_the_table_reaches_over_all_that_is_taught() -> None:
    """Also over what lies beyond the cells by the margin."""
    wide = QUICK.changed(("margin_n=0.25",))
    assert WITHIN.box is not None
    assert wide.training_range == WITHIN.box.expanded(0.25)
    check(StrokeFin(), QUICK, (0,), mapped().forces)
    with pytest.raises(
        ConfigurationError,
        match=r"map of x 0.5 .. 1.5, y -0.5 .. 0.5 N: its gaits do not cover",
    ):
        check(StrokeFin(), wide, (0,), mapped().forces)


def test_a_run_begins_from_gradients_where_the_plant_has_them() -> None:
    assert choose_preset(StrokeFin(), "single") == (
        GRADIENT_SINGLE,
        "gradient, because the plant has gradients",
    )
    relabelled, reason = choose_preset(Numb())
    assert relabelled.algorithm == "ppo"
    assert relabelled.ppo.relabelling == 1
    assert reason == "ppo-hindsight, because the plant has no gradient: its gradient is 0"
    assert choose_preset(StrokeFin(), "grid", "ppo") == (GRID, "ppo, as requested")


def test_policies_of_a_grid_are_trained_for_all_that_they_hold() -> None:
    for config in TRAIN_PRESETS.values():
        assert config.controller == "single" or config.switching.margin_n <= config.margin_n


def test_members_are_trained_in_only_where_there_are_several() -> None:
    config = TrainConfig(ensemble="each")
    with pytest.raises(
        ConfigurationError, match="ensemble = each: the plant must be an ensemble of at least two"
    ):
        check(StrokeFin(), config, (0,))
    check(streaming.surrogate(), config, (0,))


def test_references_are_scored_at_the_nearest_force_that_the_fin_can_make() -> None:
    round_the_origin = Reachable(np.zeros(2, np.float32), np.ones(64, np.float32))
    at = GRID.evaluation_references(round_the_origin)
    assert at.shape == (6, 4, 2)
    lattices = [cell.lattice(2) for cell in GRID.cells]
    for place, force in zip(at.reshape(-1, 2), np.reshape(lattices, (-1, 2)).tolist(), strict=True):
        np.testing.assert_allclose(place, round_the_origin.nearest(force), atol=1e-5)
        assert np.hypot(*place) <= 1.003


@pytest.mark.parametrize("preset", TRAIN_PRESETS, ids="-".join)
def test_no_policy_is_selected_on_the_references_of_the_paper(
    preset: tuple[AlgorithmPreset, PolicyLayout],
) -> None:
    selected_on = TRAIN_PRESETS[preset].evaluation_references(None).reshape(-1, 2)
    for reference in PAPER_REFERENCES:
        assert np.linalg.norm(selected_on - np.array(reference), axis=1).min() > 0.1


def test_plain_ppo_is_the_papers() -> None:
    """Hindsight relabelling, which the paper does not have, has a name of its own."""
    for layout in ("single", "grid"):
        assert TRAIN_PRESETS["ppo", layout].ppo.relabelling == 0
        assert TRAIN_PRESETS["ppo-hindsight", layout].ppo.relabelling == 1
    assert PRESETS["paper"].single == TRAIN_PRESETS["ppo", "single"]
    assert PRESETS["paper"].grid == TRAIN_PRESETS["ppo", "grid"]


class Twins(StrokeFin):
    """An ensemble of one's own: two fins, the second with half the force of the first."""

    size = 2

    class Interval:
        def half_width(self, means: Any) -> Any:
            return 2 * means.std(axis=0)

        def caveat(self) -> str | None:
            return None

    interval = Interval()

    def member(self, index: Any) -> Plant:
        return StrokeFin(gain=self.gain / (1 + index))

    def advance_members(self, state: Any, command: Command, ticks: int) -> Any:
        after, reading = super().advance(state, command, ticks)
        each = jax.tree.map(lambda x: jnp.stack([x, x]), reading)
        return after, each._replace(force=jnp.stack([reading.force, reading.force / 2]))

    def advance(self, state: Any, command: Command, ticks: int) -> Any:
        after, each = self.advance_members(state, command, ticks)
        return after, jax.tree.map(lambda x: x.mean(axis=0), each)

    def distance(self, state: Any) -> Any:
        return jnp.float32(2)


def test_an_ensemble_of_ones_own_takes_what_only_an_ensemble_can_do(tmp_path: Path) -> None:
    assert isinstance(Twins(), EnsemblePlant)
    assert isinstance(jit_argument(Twins()), EnsemblePlant)
    config = QUICK.changed(
        ("ensemble=each", "steps=24", "num_evaluations=1", "gradient.warm_start=false")
    )
    result = train(Twins(), config, (0,), RunDirectory(tmp_path / "out", {}))
    assert np.isfinite(result.evaluation.error).all()
    np.testing.assert_array_equal(result.evaluation.out_of_distribution_fraction, 1)
