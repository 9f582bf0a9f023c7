"""Training runs: a plant, a configuration and seeds in; one deterministic policy per seed and cell out.

Seeds x cells are lanes of one program. Every few updates the policies are scored without their noise, the best ones so
far kept, and a checkpoint written; a resumed run ends with the same weights as one that was never stopped.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from pydantic import NonNegativeFloat, PositiveInt, model_validator

from softfin.control.grid import SwitchingConfig
from softfin.core.action_clock import ACTION_TICKS
from softfin.core.choices import Algorithm, AlgorithmOption, PolicyLayout
from softfin.core.compilation import used_once
from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError, RunError
from softfin.core.plant import Plant
from softfin.core.plant_identity import jit_argument
from softfin.core.quantities import AXES, Limits
from softfin.core.randomness import key_of
from softfin.gaits.force_map import empty_map, map_forces
from softfin.gaits.gait import ForceMap, GaitTable
from softfin.gaits.reachable import Cell, Reachable, bounding_box
from softfin.gaits.simulate import missing_gradient
from softfin.learning.ensemble import trained_in
from softfin.learning.gradient import Gradient, GradientConfig
from softfin.learning.learner import Learner, Metrics
from softfin.learning.policy import Policy, PolicyConfig
from softfin.learning.ppo import PPO, PPOConfig
from softfin.learning.refine import begun_from
from softfin.learning.score import Score, score
from softfin.learning.sharding import over_devices
from softfin.storage.run_directory import Workspace
from softfin.surrogate.streaming.streaming import StreamingSurrogate
from softfin.task.cells import check_apart
from softfin.task.references import PAPER_CELLS, PAPER_RANGE, References, stack_references
from softfin.task.task import ForceTracking, TaskConfig

Tree = TypeVar("Tree")


class TrainConfig(Configuration):
    """A training run; the defaults are those of `GRID`."""

    controller: PolicyLayout = "grid"
    """One policy for a whole range of references, or one for each cell of a grid."""
    steps: PositiveInt = 10_000
    """Actions in the plant for each policy, over all its environments: the paper's 10,000 a cell, 30,000 single."""
    cells: tuple[Cell, ...] = PAPER_CELLS
    """References [N] that each policy is trained for; one cell for `single`."""
    margin_n: NonNegativeFloat = 0.0
    """Policies are trained for references this far beyond their cells, too [N]: a grid switches with a hysteresis."""
    switching: SwitchingConfig = SwitchingConfig(margin_n=0.0)
    """How a grid's policies take over from one another; beyond `margin_n`, its own margin leaves the policy in charge
    references that it was not trained for, so the paper's grid has none of either."""
    task: TaskConfig = TaskConfig()
    """The force-tracking task."""
    policy: PolicyConfig = PolicyConfig()
    """Size and start of the networks."""
    ensemble: Literal["mean", "each"] = "mean"
    """Of an ensemble, fins are the mean of all members or each is another member; scored is the mean. Only streaming
    surrogates of two members or more take `each`, which leaves nothing to disagree (`task.reward.disagreement`)."""
    algorithm: Algorithm = "ppo"
    """LSTM-PPO, as the paper has it, or gradients through the plant."""
    ppo: PPOConfig = PPOConfig()
    """Of LSTM-PPO."""
    gradient: GradientConfig = GradientConfig()
    """Of gradient training."""
    scorings: PositiveInt = 10
    """How often the deterministic policies are scored, evenly over the run; a checkpoint is written each time."""
    lattice: PositiveInt = 1
    """Scored are lattice x lattice references of each cell; their actions do not count among `steps`."""

    @model_validator(mode="after")
    def _fits(self) -> "TrainConfig":
        if self.controller == "single" and len(self.cells) != 1:
            raise ValueError(f"a single controller has one cell, not {len(self.cells)}; give one, or controller=grid")
        if not self.cells:
            raise ValueError("no cells; give at least one")
        check_apart(self.cells, "cells")
        return self

    @property
    def updates(self) -> int:
        """Of each policy: as many whole rollouts as `steps` hold."""
        return self.steps // self.learning.steps_per_update

    @property
    def learning(self) -> PPOConfig | GradientConfig:
        """Of the algorithm."""
        return self.ppo if self.algorithm == "ppo" else self.gradient


GRID = TrainConfig()
"""The paper's grid-switching controller on its budget."""

SINGLE = TrainConfig(
    controller="single",
    steps=30_000,
    cells=(PAPER_RANGE,),
    task=TaskConfig(reference_actions=45),
    ppo=PPOConfig(environments=32, rollout_actions=15, minibatches=8, epochs=8, final_learning_rate=0.03),
    lattice=3,
)
"""The paper's single controller on its budget."""

GRADIENT_SINGLE = SINGLE.changed(
    ("algorithm=gradient", "steps=115200", "task.phase=true", "task.reward.target=window", "task.reference_actions=24",
     "margin_n=0.1", "gradient.map.spacing_n=0.55")
)  # fmt: skip
"""One controller by gradients through the plant: 200 updates."""

GRADIENT_GRID = GRADIENT_SINGLE.merged(
    {
        "controller": "grid", "cells": GRID.model_dump()["cells"], "steps": 5_760, "scorings": 5, "margin_n": 0.1,
        "switching": {"margin_n": 0.1},
        "gradient": {"environments": 8, "learning_rate": 3e-4, "common": {}},
    },
    "grid",
)  # fmt: skip
"""A policy a cell by gradients through the plant: 120 updates together, then 40 of each cell's own."""

STARTS: Mapping[tuple[Algorithm, PolicyLayout], TrainConfig] = MappingProxyType({
    ("ppo", "single"): SINGLE, ("ppo", "grid"): GRID,
    ("gradient", "single"): GRADIENT_SINGLE, ("gradient", "grid"): GRADIENT_GRID,
})  # fmt: skip
"""By algorithm and kind of controller."""


class Start(NamedTuple):
    """What a run begins from."""

    config: TrainConfig
    reason: str
    """The algorithm, and why it was chosen."""


def starting(plant: Plant, controller: PolicyLayout = "grid", algorithm: AlgorithmOption = "auto") -> Start:
    """What a run begins from where nothing else is asked for; auto: gradients wherever the plant has them."""
    if algorithm != "auto":
        return Start(STARTS[algorithm, controller], f"{algorithm}, as asked")
    missing = missing_gradient(plant)
    if missing is None:
        return Start(STARTS["gradient", controller], "gradient, as the plant has gradients")
    return Start(STARTS["ppo", controller], f"ppo, as the plant has no gradient: {missing}")


class TrainState(NamedTuple):
    """All that a resumed run needs; every leaf has a leading axis of lanes."""

    lanes: Any
    """Of the algorithm."""
    best: Policy
    best_score: Score
    """Errors and deviations ``(lanes, references, 2)``, of `best`."""


class Trained(NamedTuple):
    """What a run ends with."""

    config: TrainConfig
    limits: Limits
    seeds: tuple[int, ...]
    policies: Policy
    """Leaves ``(seeds, cells, ...)``: of each lane the policy with the best deterministic score."""
    score: Score
    """Of these policies, ``(seeds, cells, references, 2)``."""
    known: ForceMap | None = None
    """What the fin can do, where it was mapped."""

    def held(self) -> Float[np.ndarray, "cells references 2"]:
        """The forces that the policies were scored at [N]."""
        return held(self.config, None if self.known is None else self.known.reachable)


def held(config: TrainConfig, reachable: Reachable | None) -> Float[np.ndarray, "cells references 2"]:
    """Of each cell the lattice of references that are scored, each as the nearest force that the fin can make [N]."""
    lattices = [cell.lattice(config.lattice) for cell in config.cells]
    if reachable is not None:
        return reachable.nearest(lattices).astype(np.float32)
    return np.asarray(lattices, np.float32)


Progress = Callable[[str, float, str], None]
"""Called with what is going on, how much of it is done (0 .. 1), and the newest figures."""


def train(
    plant: Plant,
    config: TrainConfig,
    seeds: Sequence[int],
    workspace: Workspace,
    progress: Progress | None = None,
    known: ForceMap | None = None,
    start: Policy | None = None,
) -> Trained:
    """Train a policy for every seed and cell; goes on from the workspace's checkpoint where there is one.

    What the fin can do is looked for where it is not `known`. Policies that are given to `start` from, leaves
    ``(seeds, cells, ...)``, go on being learnt, and a lane never ends with a worse one.

    Raises:
        ConfigurationError: the budget is smaller than one rollout, a seed comes twice, or the plant or what is `known`
            of it does not fit the configuration.
        RunError: a loss is no longer finite; the last good checkpoint is left in the workspace.
    """
    check(plant, config, seeds, known)
    known = mapped(plant, config, workspace, progress) if known is None else known
    asked = config
    if start is None:
        start = common_start(plant, config, seeds, workspace, progress, known)
    if start is not None:
        config = config.merged({"gradient": {"teacher": False}}, "start")
    run = _Run(plant, config, tuple(seeds), known)
    state, done = run.start(), 0
    if start is not None:
        state = _begun(run, state, start)
    if (resumed := workspace.load(_unkeyed(state))) is not None:
        state, done = _rekeyed(resumed[0], state), resumed[1]["updates"]
    state = state._replace(lanes=run.over_devices(state.lanes))
    record = workspace.log(rewind_to=done * config.learning.steps_per_update)
    due = _scorings(config)
    while done < config.updates:
        lanes, metrics = run.update(state.lanes)
        state, done = state._replace(lanes=lanes), done + 1
        steps = done * config.learning.steps_per_update
        scalars = run.by_seed(run.finite(metrics, done))
        if done in due:
            scores = run.score(state.lanes.policy, done)
            state = _keep_best(state, scores)
            scalars |= run.by_seed(_summary(scores))
        # Before the checkpoint: a resumed run drops entries that are too many, but cannot make up for one.
        record.write(steps, **scalars)
        if done in due:
            workspace.save(_unkeyed(state), {"updates": done})
        if progress is not None:
            progress(f"train {config.controller}", done / config.updates, run.note(metrics, state))
    record.close()
    return run.end(state)._replace(config=asked)


def common_start(
    plant: Plant,
    config: TrainConfig,
    seeds: Sequence[int],
    workspace: Workspace,
    progress: Progress | None,
    known: ForceMap | None,
) -> Policy | None:
    """What a grid's policies begin as: one policy for all its cells, trained first; leaves ``(seeds, cells, ...)``.

    They specialise from there, so neighbours beat in step, and nothing is learnt once a cell that holds for all. None
    where that is not asked for.
    """
    settings = config.gradient.common
    if config.algorithm != "gradient" or config.controller != "grid" or settings is None:
        return None
    box = bounding_box(config.cells)
    gradient = {"environments": settings.environments, "learning_rate": settings.learning_rate, "common": None}
    whole = config.merged(
        {"controller": "single", "cells": [box.model_dump()], "gradient": gradient, "lattice": settings.lattice},
        "common",
    )
    whole = whole.merged({"steps": settings.updates * whole.learning.steps_per_update}, "common")
    found = train(plant, whole, seeds, workspace.part("common"), progress, known=known)
    policies: Policy = jax.tree.map(lambda leaf: jnp.repeat(leaf, len(config.cells), axis=1), found.policies)
    return policies


def _begun(run: "_Run", state: TrainState, start: Policy) -> TrainState:
    """Lanes that go on from given policies, which count as the best ones so far."""
    lanes = begun_from(state.lanes, start)
    return TrainState(lanes, lanes.policy, run.score(lanes.policy, 0))


def mapped(plant: Plant, config: TrainConfig, workspace: Workspace, progress: Progress | None) -> ForceMap | None:
    """The gaits that the policies begin as and what the fin can do; of a stopped run, where it had found them."""
    if config.algorithm != "gradient" or not config.gradient.teacher:
        return None
    asked = config.gradient.map.merged({"box": taught_box(config).model_dump()}, "cells")
    part = workspace.part("map")
    lattice = asked.lattice(Reachable(np.zeros(2), np.ones(asked.survey.directions)))
    if (resumed := part.load(empty_map(lattice, asked.survey.directions))) is not None:
        known: ForceMap = jax.tree.map(np.asarray, resumed[0])
        return known
    found = map_forces(plant, asked, None if progress is None else partial(progress, "map"))
    part.save(found, {})
    return found


def taught_box(config: TrainConfig) -> Cell:
    """Round all references that policies are trained for."""
    return bounding_box(config.cells).expanded(config.margin_n)


class Given(NamedTuple):
    """Arguments of the programs: arrays, not constants in them."""

    plant: Plant
    """As `jit_argument` makes it."""
    teacher: GaitTable | None


class _Programs(NamedTuple):
    """Compiled for all lanes at once; the plant's arrays are arguments, not constants in the programs."""

    init: Callable[[Given, PRNGKeyArray, References], Any]
    update: Callable[[Given, Any], tuple[Any, Metrics]]
    score: Callable[[Given, Policy, Array], Score]


@lru_cache(maxsize=4)
def _programs(
    learning: PPOConfig | GradientConfig, policy: PolicyConfig, task: TaskConfig, ensemble: str, updates: int
) -> _Programs:
    """Kept for the next jobs of a run, which differ by their cells and seeds alone."""

    def learner(given: Given) -> Learner:
        tracking = ForceTracking(trained_in(given.plant, ensemble), task)
        if isinstance(learning, PPOConfig):
            return PPO(tracking, learning, policy, updates)
        return Gradient(tracking, learning, policy, updates, given.teacher)

    def judge(given: Given, policy: Policy, references: Array) -> Score:
        return score(ForceTracking(given.plant, task), policy, references, key_of(0, "score"))

    # To begin as a copy of gaits takes much longer than to compile that.
    jit_init = eqx.filter_jit if isinstance(learning, GradientConfig) and learning.teacher else used_once
    return _Programs(
        jit_init(lambda given, keys, boxes: jax.vmap(learner(given).init)(keys, boxes)),
        eqx.filter_jit(lambda given, lanes: jax.vmap(learner(given).update)(lanes)),
        eqx.filter_jit(lambda given, policies, references: jax.vmap(partial(judge, given))(policies, references)),
    )


class _Run:
    """One run over its lanes."""

    def __init__(self, plant: Plant, config: TrainConfig, seeds: tuple[int, ...], known: ForceMap | None) -> None:
        self.config, self.seeds, self.limits = config, seeds, Limits(*map(float, plant.limits))
        self.knows = isinstance(plant, StreamingSurrogate)
        self.lanes = [(seed, index) for seed in seeds for index in range(len(config.cells))]
        self.known = known
        self.reachable = None if known is None else known.reachable
        taught = config.algorithm == "gradient" and config.gradient.teacher
        self.given = Given(jit_argument(plant), known.gaits.table if known is not None and taught else None)
        self.programs = _programs(config.learning, config.policy, config.task, config.ensemble, config.updates)
        self.references = jnp.asarray(np.tile(held(config, self.reachable), (len(seeds), 1, 1)))

    def start(self) -> TrainState:
        """Fresh lanes; the key of a lane depends on its seed and cell alone, not on the lanes beside it."""
        keys = jnp.stack([key_of(seed, f"train/{self.config.cells[index]}") for seed, index in self.lanes])
        wider = [self.config.cells[index].expanded(self.config.margin_n) for _, index in self.lanes]
        boxes = stack_references(wider, self.reachable)
        lanes = self.programs.init(self.given, *self.over_devices((keys, boxes)))
        worst = np.full(self.references.shape, np.inf, np.float32)
        beyond = worst[..., 0] if self.knows else None
        return TrainState(lanes, lanes.policy, Score(worst, worst, beyond))

    def over_devices(self, lanes: Tree) -> Tree:
        """Dealt out over the machine's devices, where there are several."""
        return over_devices(lanes, len(self.lanes), self.config.learning.environments)

    def update(self, lanes: Any) -> tuple[Any, Metrics]:
        """One update of every lane."""
        return self.programs.update(self.given, lanes)

    def score(self, policies: Policy, update: int) -> Score:
        """Of every lane's policy without its noise; raises RunError where the plant's forces are not finite."""
        scores = self.programs.score(self.given, policies, self.references)
        self._check_finite("the force while the policies are scored", np.asarray(scores.error).sum(axis=(1, 2)), update)
        return scores

    def finite(self, metrics: Metrics, update: int) -> Metrics:
        """The metrics; raises RunError where a lane's loss or its gradient is not finite."""
        self._check_finite("the loss", np.asarray(metrics["loss"]) + np.asarray(metrics["gradient_norm"]), update)
        return metrics

    def _check_finite(self, what: str, of_lanes: np.ndarray, update: int) -> None:
        bad = np.flatnonzero(~np.isfinite(of_lanes))
        if bad.size:
            seed, index = self.lanes[bad[0]]
            raise RunError(
                f"train: {what} is not finite in update {update} of {self.config.updates}, seed {seed}, cell "
                f"{self.config.cells[index]}; lower {self.config.algorithm}.learning_rate "
                "(the last good checkpoint is kept)"
            )

    def by_seed(self, metrics: Metrics) -> dict[str, float]:
        """Means over the cells, named ``seedN/...``."""
        shape = (len(self.seeds), len(self.config.cells))
        means = {name: np.asarray(values).reshape(shape).mean(axis=1) for name, values in metrics.items()}
        return {f"seed{s}/{n}": float(values[i]) for n, values in means.items() for i, s in enumerate(self.seeds)}

    def note(self, metrics: Metrics, state: TrainState) -> str:
        """For a progress bar."""
        best = _summary(state.best_score)
        figures = [float(np.mean(best[f"score_{axis}_n"])) for axis in AXES]
        scored = "" if not np.isfinite(figures).all() else f", best deterministic {figures[0]:.2f}/{figures[1]:.2f} N"
        return f"error {np.mean(metrics['error_x_n']):.2f}/{np.mean(metrics['error_y_n']):.2f} N{scored}"

    def end(self, state: TrainState) -> Trained:
        """The best policies, by seed and cell."""
        policies, scores = _by_seed_and_cell((state.best, state.best_score), len(self.seeds))
        return Trained(self.config, self.limits, self.seeds, policies, scores, self.known)


def check(plant: Plant, config: TrainConfig, seeds: Sequence[int], known: ForceMap | None = None) -> None:
    """Raise ConfigurationError where the budget is smaller than one rollout, or anything else does not fit."""
    if not seeds or len(set(seeds)) != len(seeds):
        raise ConfigurationError(f"seeds {list(seeds)}: give at least one, and each once")
    learning = config.learning
    if config.updates == 0:
        raise ConfigurationError(
            f"steps = {config.steps}: fewer than one rollout of {learning.steps_per_update} "
            f"({learning.environments} environments x {learning.rollout_actions} actions); give more steps"
        )
    task = config.task
    if (samples := task.episode_actions // len(ACTION_TICKS) * sum(ACTION_TICKS)) < task.window_samples:
        raise ConfigurationError(
            f"task.episode_actions = {task.episode_actions}: an episode of {samples} samples holds no whole window of "
            f"{task.window_samples} to score; give a longer episode or a smaller task.window_samples"
        )
    _check_ensemble(plant, config)
    if config.algorithm == "gradient" and config.gradient.teacher:
        _check_taught(config, known)


def _check_ensemble(plant: Plant, config: TrainConfig) -> None:
    disagreement = config.task.reward.disagreement
    if config.ensemble == "each" and disagreement > 0:
        raise ConfigurationError(
            f"task.reward.disagreement = {disagreement:g}: a fin that is one member (ensemble = each) disagrees with "
            "none; give one of the two"
        )
    members = plant.size if isinstance(plant, StreamingSurrogate) else 1
    for given, asked in (("ensemble = each", config.ensemble == "each"),
                         (f"task.reward.disagreement = {disagreement:g}", disagreement > 0)):  # fmt: skip
        if asked and members < 2:
            raise ConfigurationError(
                f"{given}: the plant is no ensemble of two members or more; leave it out, or fit a streaming surrogate "
                "with --set members=5"
            )


def _check_taught(config: TrainConfig, known: ForceMap | None) -> None:
    if config.gradient.map.box is not None:
        raise ConfigurationError(
            f"gradient.map.box = {config.gradient.map.box}: gaits are found for all cells ({taught_box(config)}); "
            "leave it out, and give --range or --cells"
        )
    if known is None:
        return
    box, table = taught_box(config), known.gaits.table
    (x0, y0), (x1, y1) = known.reachable.bounds()
    low, high = np.maximum(box.low, (x0, y0)), np.minimum(box.high, (x1, y1))
    if (np.asarray(table.low) > low + EDGE_N).any() or (np.asarray(table.high) < high - EDGE_N).any():
        between = Cell(low=tuple(map(float, table.low)), high=tuple(map(float, table.high)))
        raise ConfigurationError(
            f"map of {between}: its gaits do not reach over the references to train for ({box}); map these too, or "
            "all that the fin can make (softfin map without a box)"
        )


EDGE_N = 1e-3
"""Edges of lattices and regions are rounded in their files."""


def _scorings(config: TrainConfig) -> set[int]:
    """After which updates policies are scored; always after the last."""
    count = min(config.scorings, config.updates)
    return {round(config.updates * (i + 1) / count) for i in range(count)}


def _summary(scores: Score) -> Metrics:
    """Of each lane, the mean error over its references, and how often it left the surrogate's data, where known."""
    beyond = {} if scores.beyond is None else {"score_beyond_data": np.asarray(scores.beyond).mean(axis=-1)}
    return {f"score_{axis}_n": np.asarray(scores.error)[..., i].mean(axis=-1) for i, axis in enumerate(AXES)} | beyond


def _keep_best(state: TrainState, scores: Score) -> TrainState:
    best, best_score = _better((state.lanes.policy, scores), (state.best, state.best_score))
    return state._replace(best=best, best_score=best_score)


def _better(new: tuple[Policy, Score], old: tuple[Policy, Score]) -> tuple[Policy, Score]:
    """Lane by lane, the policy whose mean error over references and axes is least; NumPy arrays."""
    better = np.asarray(new[1].error).mean(axis=(1, 2)) < np.asarray(old[1].error).mean(axis=(1, 2))
    chosen: tuple[Policy, Score] = jax.tree.map(
        lambda a, b: np.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b), new, old
    )
    return chosen


def _by_seed_and_cell(lanes: Tree, seeds: int) -> Tree:
    """Leaves ``(lanes, ...)`` as ``(seeds, cells, ...)``; NumPy arrays."""
    return cast(Tree, jax.tree.map(lambda x: np.asarray(x).reshape(seeds, -1, *x.shape[1:]), lanes))


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _unkeyed(tree: Tree) -> Tree:
    """Keys of the random generator as the numbers that they are, for storage."""
    return cast(Tree, jax.tree.map(lambda x: jax.random.key_data(x) if _is_key(x) else x, tree))


def _rekeyed(tree: Tree, like: Tree) -> Tree:
    """Numbers as keys again, where `like` has keys."""
    return cast(Tree, jax.tree.map(lambda x, y: jax.random.wrap_key_data(x) if _is_key(y) else x, tree, like))
