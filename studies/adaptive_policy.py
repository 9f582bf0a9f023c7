"""Does a policy that is trained on random fins adapt to a changed fin?

    python -m studies.adaptive_policy train RUN --actions 100000 --seeds 5
    python -m studies.adaptive_policy score RUN --fins 100
    python -m studies.adaptive_policy information

The fin of each training episode is drawn at random. Besides the reference, the angle and the past
actions, the adaptive policy observes two signals of the last action that depend on the fin and need
no force sensor: the mean torque about the shaft, and the following error at the end. Three variants
are trained together: `adaptive` observes both signals, `blind` neither, and `informed` the
parameters of the fin instead, which no robot knows; it shows how much adaptation could gain.

The score is the error of the true mean force over windows of 2 s on fins that were not used in
training. `errors` scores any `Controller` in the same way.
"""

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PRNGKeyArray

import softfin
from softfin.control.controller import Controller, Measured, controller_clock
from softfin.control.family import load_family
from softfin.control.feedback import Feedback, FeedbackConfig
from softfin.control.policy import PolicyMemory
from softfin.control.pytrees import register_controllers
from softfin.control.store import load_controller
from softfin.core.action_clock import PAPER_CLOCK, ActionClock
from softfin.core.compilation import jit
from softfin.core.plant import Ticks, hold_action_with_hidden, masked_mean
from softfin.core.quantities import (
    RATE_HZ,
    AnyArray,
    Command,
    Limits,
    Reading,
    action_to_command,
)
from softfin.core.randomness import named_key
from softfin.evaluation.experiment import Held, closed_loop
from softfin.gaits.reachable import ForceVector, Reachable
from softfin.learning.configuration import SINGLE, TrainConfig
from softfin.learning.policy import Policy
from softfin.learning.ppo import PPO
from softfin.learning.rollout import AgentState, Metrics, evaluate_policy
from softfin.tank import Tank
from softfin.tank.randomization import DomainRandomization, RandomizedTank, RandomizedTankState
from softfin.task.references import References
from softfin.task.task import (
    ForceTracking,
    PastActions,
    TaskConfig,
    TaskState,
    observation,
    remember,
    rest_actions,
)

WIDTHS = DomainRandomization(
    temperature_c=5,
    stiffness=0.3,
    drag=0.3,
    added_mass=0.15,
    lag=0.3,
    dead_time=0.3,
    drift=0,
    misalignment_rad=0.03,
)
"""Half-widths of the fins, in training and in the test."""

TEST_REFERENCES: tuple[ForceVector, ...] = ((2, 0), (1, -1), (2, 1))
"""Reference forces of the test [N]."""

TEST_S = 30
"""Duration of a test from rest [s]."""

WINDOW_STARTS_S = (6, 20)
"""Starts of the windows of 2 s over which the force is averaged [s]."""

TORQUE_SCALE_NM = 0.5
"""Scale of the observed torque: its standard deviation under random actions [N m]."""

ERROR_SCALE_RAD = 0.002
"""Following error of a stroke that ends in time [rad]; a stroke that does not end in time leaves a
following error a hundred times larger."""

NUM_LOADS = 2
NUM_PARAMETERS = 4

VARIANTS: Mapping[str, tuple[int, ...]] = MappingProxyType(
    {
        "adaptive": (1, 1, 0, 0, 0, 0),
        "blind": (0, 0, 0, 0, 0, 0),
        "informed": (0, 0, 1, 1, 1, 1),
    }
)
"""Senses that each variant observes (1) or that are 0 instead: torque, following error, and the
parameters of the fin."""

EXAMPLE = Path(softfin.__file__).parent / "example"
"""Controllers to compare with, trained for the default fin."""

Parameters = Float[Array, "parameters"]
Senses = Float[Array, "senses"]


class Load(NamedTuple):
    """Signals of the last action that depend on the fin."""

    torque: Float[Array, ""]
    """Mean torque about the shaft [N m]."""
    following_error: Float[Array, ""]
    """Commanded angle minus angle at the end of the action [rad]."""


class SensedState(NamedTuple):
    """State of a random fin with the signals of the last action."""

    fin: RandomizedTankState
    load: Load


class SensedFins(eqx.Module):
    """Random fins that remember the load of the last action; implements `Plant`."""

    fins: RandomizedTank

    @property
    def limits(self) -> Limits:
        """Limits of the commands."""
        return self.fins.limits

    def init(self, key: PRNGKeyArray) -> SensedState:
        """Draw a fin at rest, without a load."""
        return SensedState(self.fins.init(key), Load(jnp.float32(0), jnp.float32(0)))

    def advance(
        self, state: SensedState, command: Command, ticks: int
    ) -> tuple[SensedState, Reading]:
        """Hold a command for one action of `ticks` ticks."""
        return self.hold_action(state, command, ticks, ticks)

    def hold_action(
        self, state: SensedState, command: Command, ticks: Ticks, rows: int
    ) -> tuple[SensedState, Reading]:
        """Hold a command for one action. The readings contain the true force, because the reward in
        a simulation need not suffer from the errors of a sensor."""
        held = hold_action_with_hidden(self.fins, state.fin, command, ticks, rows)
        fin, (reading, hidden) = held
        assert hidden.torque is not None
        load = Load(
            masked_mean(jnp.asarray(hidden.torque[:, 0]), ticks),
            command.angle - reading.angle[ticks - 1],
        )
        return SensedState(fin, load), reading._replace(force=hidden.true_force)


def fin_parameters(fins: RandomizedTank, state: RandomizedTankState) -> Parameters:
    """Return the parameters of a fin that change its force, relative to the default fin and scaled
    to about [-1, 1]: stiffness, drag, added mass and dead time."""
    tank = state[0]
    default = fins.tank
    ratios = (
        tank.fin.stiffness[0] / default.fin.stiffness[0],
        tank.water.drag[0, 0] / default.water.drag[0, 0],
        tank.water.tip[-1] / default.water.tip[-1],
        tank.drive.dead_time / default.drive.dead_time,
    )
    return jnp.log(jnp.stack(ratios)) / 0.3


def scale_senses(load: Load, parameters: Parameters) -> Senses:
    """Return all senses with magnitudes of about 1. Following errors range over three decades, so
    they are compressed."""
    loads = (
        load.torque / TORQUE_SCALE_NM,
        jnp.arcsinh(load.following_error / ERROR_SCALE_RAD) / 2,
    )
    return jnp.concatenate([jnp.stack(loads), parameters])


class AdaptiveTaskConfig(TaskConfig):
    """The force-tracking task with the senses."""

    @property
    def observations(self) -> int:
        """Size of an observation."""
        return super().observations + NUM_LOADS + NUM_PARAMETERS


class AdaptiveTracking(ForceTracking):
    """Force tracking on random fins: the observation ends with the visible senses, and the critic
    also observes the parameters of the fin."""

    plant: SensedFins
    visible: Senses

    def __init__(self, config: TaskConfig, visible: Senses) -> None:
        super().__init__(SensedFins(random_fins()), config)
        object.__setattr__(self, "visible", visible)

    def observe(self, state: TaskState) -> Float[Array, "observations"]:
        """Return the observation of `ForceTracking` and the visible senses."""
        senses = scale_senses(state.plant.load, fin_parameters(self.plant.fins, state.plant.fin))
        return jnp.concatenate([super().observe(state), self.visible * senses])

    def privileged_observation(self, state: TaskState) -> Float[Array, "privileged"]:
        """Return the input of the critic."""
        parameters = fin_parameters(self.plant.fins, state.plant.fin)
        return jnp.concatenate([super().privileged_observation(state), parameters])


class AdaptiveState(NamedTuple):
    """State of an adaptive policy as a controller."""

    memory: PolicyMemory
    actions: PastActions
    angle: Float[Array, ""]
    """Angle of the last command [rad]."""


class AdaptivePolicy(eqx.Module):
    """A trained policy of any variant; implements `Controller`."""

    policy: Policy
    visible: Senses
    config: AdaptiveTaskConfig = eqx.field(static=True)
    limits: Limits = eqx.field(static=True)
    parameters: Parameters = eqx.field(default_factory=lambda: jnp.zeros(NUM_PARAMETERS))

    @property
    def clock(self) -> ActionClock:
        """Clock of the actions."""
        return self.config.clock

    def knowing(self, parameters: Parameters) -> "AdaptivePolicy":
        """Return the policy with the parameters of a fin."""
        return AdaptivePolicy(self.policy, self.visible, self.config, self.limits, parameters)

    def init(self) -> AdaptiveState:
        """Return the state for a fin at rest."""
        actions = rest_actions(self.config, self.limits)
        return AdaptiveState(self.policy.init(), actions, jnp.float32(self.limits.rest_angle))

    def act(
        self, state: AdaptiveState, measured: Measured, reference: Array
    ) -> tuple[AdaptiveState, Command]:
        """Compute the deterministic action."""
        assert measured.shaft is not None
        load = Load(measured.shaft[0], state.angle - measured.angle)
        senses = self.visible * scale_senses(load, self.parameters)
        now = observation(self.config, measured.angle, reference, state.actions)
        memory, action = self.policy.act(state.memory, jnp.concatenate([now, senses]))
        command = action_to_command(self.limits, action)
        return AdaptiveState(memory, remember(state.actions, action), command.angle), command

    def check(self, reference: ForceVector) -> None:
        """Accept any reference."""


def random_fins() -> RandomizedTank:
    """Return fins around the default tank."""
    return RandomizedTank(Tank(), WIDTHS)


def held_out_keys(count: int) -> Key[Array, "fins"]:
    """Return the keys of fins that training does not use."""
    return jax.random.split(named_key(0, "adaptive/test"), count)


class Errors(NamedTuple):
    """Errors of a controller on many fins."""

    force: Float[np.ndarray, "windows references fins 2"]
    """True mean force over each window minus the reference [N]."""
    angle: Float[np.ndarray, "references fins ticks"]
    """Angle of the shaft [rad]."""

    def rms(self) -> Float[np.ndarray, "windows"]:
        """Return the rms error over references, fins and axes [N]."""
        return np.asarray(np.sqrt((self.force**2).mean(axis=(1, 2, 3))))

    def spread(self) -> Float[np.ndarray, "windows"]:
        """Return the rms over references and axes of the standard deviation between fins [N]: the
        part of the error that no correction removes that is the same for all fins."""
        return np.asarray(np.sqrt(self.force.var(axis=2).mean(axis=(1, 2))))

    def common(self) -> Float[np.ndarray, "windows"]:
        """Return the rms over references and axes of the mean error of all fins [N]."""
        return np.asarray(np.sqrt((self.force.mean(axis=2) ** 2).mean(axis=(1, 2))))

    def half_interval(self) -> Float[np.ndarray, "windows"]:
        """Return the half-width of the 95% interval of the rms error, from the scatter between fins
        [N]."""
        squares = (self.force**2).mean(axis=(1, 3))
        standard_error = squares.std(axis=1, ddof=1) / np.sqrt(squares.shape[1])
        return np.asarray(1.96 * standard_error / (2 * self.rms()))

    def amplitude(self) -> float:
        """Return the standard deviation of the angle after the first window starts [rad]; 0 for a
        fin that does not move."""
        return float(self.angle[..., WINDOW_STARTS_S[0] * RATE_HZ :].std(axis=-1).mean())


def errors(
    controller: Controller,
    keys: Key[Array, "fins"],
    shuffle_torque: bool = False,
    references: Sequence[ForceVector] = TEST_REFERENCES,
) -> Errors:
    """Run a controller from rest on the fin of each key, for each reference.

    With `shuffle_torque`, the controller on each fin receives the torque of a different fin.
    """
    register_controllers()
    force, angle, _ = _run(
        controller, random_fins(), jnp.asarray(references, jnp.float32), keys, shuffle_torque
    )
    return Errors(_force_errors(force, references), np.asarray(angle))


def _force_errors(
    force: AnyArray, references: Sequence[ForceVector]
) -> Float[np.ndarray, "windows references fins 2"]:
    length = PAPER_CLOCK.window_ticks
    means = []
    for start_s in WINDOW_STARTS_S:
        start = start_s * RATE_HZ
        means.append(np.asarray(force)[:, :, start : start + length].mean(axis=2))
    return np.stack(means) - np.asarray(references)[:, None]


@jit("low")
def _run(
    controller: Controller,
    plant: RandomizedTank,
    references: Float[Array, "references 2"],
    keys: Key[Array, "fins"],
    shuffle_torque: bool,
) -> tuple[Array, Array, Array]:
    """Return true force, angle and mean torque of the action at each tick, ``(references, fins,
    ticks, ...)``."""
    clock = controller_clock(controller)
    ticks = TEST_S * RATE_HZ
    actions = clock.actions_within(ticks)
    neighbours = [(i, (i + 1) % len(keys)) for i in range(len(keys))]

    def hold(state: RandomizedTankState, command: Command, ticks: Ticks) -> Held:
        held = hold_action_with_hidden(plant, state, command, ticks, clock.max_ticks)
        state, (reading, hidden) = held
        torque = jnp.asarray(hidden.torque)
        mean_torque = jnp.full(clock.max_ticks, masked_mean(torque[:, 0], ticks))
        if shuffle_torque:
            torque = jax.lax.ppermute(torque, "fins", neighbours)
        return state, (reading, torque, (hidden.true_force, mean_torque))

    def one(reference: Float[Array, "2"], key: PRNGKeyArray) -> tuple[Array, Array, Array]:
        own: Any = controller
        if isinstance(controller, AdaptivePolicy):
            own = controller.knowing(fin_parameters(plant, plant.init(key)))
        series = jnp.tile(reference, (actions, 1))
        recording = closed_loop(own, plant, hold, series, key, clock)
        force, torque = recording.output
        return force[:ticks], recording.reading.angle[:ticks], torque[:ticks]

    over_fins = jax.vmap(one, in_axes=(None, 0), axis_name="fins")
    result: tuple[Array, Array, Array] = jax.vmap(over_fins, in_axes=(0, None))(references, keys)
    return result


def print_information(num_training: int = 200, num_test: int = 100) -> None:
    """Print the standard deviation between fins of the error of the example's gaits, and what is
    left of it after a linear regression on the torques of the first six actions."""
    register_controllers()
    gaits = load_controller(EXAMPLE / "gaits")
    keys = jax.random.split(named_key(0, "adaptive/information"), num_training + num_test)
    references = jnp.asarray(TEST_REFERENCES, jnp.float32)
    force, _, torque = _run(gaits, random_fins(), references, keys, False)
    last = _force_errors(force, TEST_REFERENCES)[-1]
    starts = np.cumsum([0, *gaits.clock.action_ticks(gaits.clock.window_actions - 1)])
    print("| reference | SD over fins, x and y [N] | left after the regression [N] |")
    print("| --- | --- | --- |")
    for reference, error, series in zip(TEST_REFERENCES, last, np.asarray(torque), strict=True):
        inputs = np.column_stack([np.ones(len(keys)), series[:, starts]])
        weights = np.linalg.lstsq(inputs[:num_training], error[:num_training], rcond=None)[0]
        residual = (error - inputs @ weights)[num_training:]
        before = ", ".join(f"{value:.3f}" for value in error[num_training:].std(axis=0))
        after = ", ".join(f"{value:.3f}" for value in np.sqrt((residual**2).mean(axis=0)))
        print(f"| {reference} N | {before} | {after} |")


def training_config(
    actions: int,
    num_envs: int = SINGLE.ppo.num_envs,
    learning_rate: float = SINGLE.ppo.learning_rate,
) -> TrainConfig:
    """Return softfin's configuration for a single policy, with the senses."""
    task = AdaptiveTaskConfig.model_validate(SINGLE.task.model_dump())
    changed = {"num_envs": num_envs, "learning_rate": learning_rate}
    ppo = SINGLE.ppo.model_copy(update=changed)
    return SINGLE.model_copy(update={"steps": actions, "task": task, "ppo": ppo})


def reachable_forces() -> Reachable:
    """Return the reachable forces of the default fin."""
    reachable = load_controller(EXAMPLE / "gaits").reachable
    assert reachable is not None
    assert reachable.size == 1
    return reachable


def _learner(config: TrainConfig, visible: Senses) -> PPO:
    task = AdaptiveTracking(config.task, visible)
    return PPO(task, config.ppo, config.policy, config.num_updates)


@jit("none")
def _start(
    config: TrainConfig, visible: Array, keys: Key[Array, "agents"], references: References
) -> AgentState:
    def one(visible: Senses, key: PRNGKeyArray) -> AgentState:
        return _learner(config, visible).init(key, references)

    return jax.vmap(one)(visible, keys)


@jit("low")
def _update(config: TrainConfig, visible: Array, agents: AgentState) -> tuple[AgentState, Metrics]:
    def one(visible: Senses, agent: AgentState) -> tuple[AgentState, Metrics]:
        return _learner(config, visible).update(agent)

    return jax.vmap(one)(visible, agents)


@jit("low")
def _evaluate(
    config: TrainConfig, visible: Array, policies: Policy, references: Array
) -> Float[Array, "agents references 2"]:
    """Return the errors of the deterministic policies, on the same validation fins for all."""

    def one(visible: Senses, policy: Policy) -> Float[Array, "references 2"]:
        task = AdaptiveTracking(config.task, visible)
        key = named_key(0, "adaptive/validation")
        return jnp.asarray(evaluate_policy(task, policy, references, key).error)

    return jax.vmap(one)(visible, policies)


def train(config: TrainConfig, variants: Sequence[str], seeds: int, folder: Path) -> None:
    """Train every variant with every seed, all in one program.

    After each evaluation, write the policies with the lowest validation error so far and the
    learning curves to the folder.
    """
    reachable = reachable_forces()
    box = reachable.bounding_box()
    references = References.of(box, jax.tree.map(jnp.asarray, reachable))
    lattice = jnp.asarray(reachable.nearest(box.lattice(config.lattice)), jnp.float32)
    visible = jnp.repeat(jnp.array([VARIANTS[name] for name in variants], float), seeds, axis=0)
    # The variants of a seed start from the same weights and fins.
    keys = jnp.stack([named_key(seed, "adaptive/train") for seed in range(seeds)] * len(variants))
    agents = _start(config, visible, keys, references)
    best = agents.policy
    lowest = np.full(len(keys), np.inf)
    curves: list[dict[str, Any]] = []
    start = time.monotonic()
    for update in range(1, config.num_updates + 1):
        agents, metrics = _update(config, visible, agents)
        count = config.num_evaluations
        if update * count // config.num_updates == (update - 1) * count // config.num_updates:
            continue
        score = np.asarray(_evaluate(config, visible, agents.policy, lattice)).mean(axis=(1, 2))
        best = jax.tree.map(partial(_choose, score < lowest), agents.policy, best)
        lowest = np.minimum(lowest, score)
        scores = score.reshape(len(variants), seeds)
        step = update * config.ppo.steps_per_update
        curves.append(
            {
                "step": step,
                "score_n": dict(zip(variants, scores.tolist(), strict=True)),
                "exploration_std": float(np.mean(metrics["std"])),
                "kl": float(np.mean(metrics["kl"])),
            }
        )
        (folder / "curves.json").write_text(json.dumps(curves, indent=1))
        eqx.tree_serialise_leaves(folder / "policies.eqx", best)
        means = ", ".join(
            f"{name} {mean:.3f}" for name, mean in zip(variants, scores.mean(axis=1), strict=True)
        )
        print(f"{step:,} actions, {time.monotonic() - start:.0f} s: {means} N", flush=True)


def _choose(is_better: np.ndarray, new: AnyArray, old: AnyArray) -> np.ndarray:
    return np.where(is_better.reshape(-1, *[1] * (new.ndim - 1)), new, old)


def load_policies(folder: Path) -> tuple[int, dict[str, list[AdaptivePolicy]]]:
    """Load the policies of a training run; return the number of actions of each, and the policies
    by variant, one per seed."""
    last = json.loads((folder / "curves.json").read_text())[-1]
    config = training_config(last["step"])
    task = config.task
    assert isinstance(task, AdaptiveTaskConfig)

    def create(key: PRNGKeyArray) -> Policy:
        return Policy.create(key, config.policy, task.observations)

    owners = [name for name, scores in last["score_n"].items() for _ in scores]
    keys = jax.random.split(jax.random.key(0), len(owners))
    policies = eqx.tree_deserialise_leaves(
        folder / "policies.eqx", jax.eval_shape(jax.vmap(create), keys)
    )
    limits = random_fins().limits
    loaded: dict[str, list[AdaptivePolicy]] = {name: [] for name in owners}
    for index, name in enumerate(owners):
        policy = jax.tree.map(lambda leaf, index=index: leaf[index], policies)
        visible = jnp.array(VARIANTS[name], float)
        loaded[name].append(AdaptivePolicy(policy, visible, task, limits))
    return last["step"], loaded


def row(name: str, scored: Sequence[Errors]) -> str:
    """Format the scores of a controller, one `Errors` per seed, as a row of the table."""
    rms = np.array([one.rms() for one in scored])
    common = np.array([one.common() for one in scored]).mean(axis=0)
    spread = np.array([one.spread() for one in scored]).mean(axis=0)
    half = np.array([one.half_interval() for one in scored]).mean(axis=0)
    cells = [name, f"{len(scored)}"]
    cells += [
        f"{mean:.3f} \N{PLUS-MINUS SIGN} {width:.3f}"
        for mean, width in zip(rms.mean(axis=0), half, strict=True)
    ]
    cells.append(f"{rms[:, -1].std(ddof=1):.3f}" if len(scored) > 1 else "\N{EN DASH}")
    cells += [f"{common[-1]:.3f}", f"{spread[-1]:.3f}"]
    per_reference = np.sqrt(
        np.mean([(one.force[-1] ** 2).mean(axis=(1, 2)) for one in scored], axis=0)
    )
    cells += [f"{value:.3f}" for value in per_reference]
    cells.append(f"{np.mean([one.amplitude() for one in scored]):.2f}")
    return "| " + " | ".join(cells) + " |"


def known_controllers(gaits: Path) -> dict[str, Controller]:
    """Return the controllers to compare with, by name: without feedback, and, if the folder of the
    gaits contains a family, with feedback from different measurements."""
    loaded = load_controller(gaits)
    controllers: dict[str, Controller] = {
        "gaits": loaded,
        "single policy": load_controller(EXAMPLE / "single"),
    }
    family = load_family(gaits, loaded)
    if family is not None:
        for uses in ("force", "torque", "both"):
            config = FeedbackConfig(uses=uses)
            controllers[f"gaits, feedback from {uses}"] = Feedback(loaded, config, family)
    return controllers


def print_table(run: Path, keys: Key[Array, "fins"], gaits: Path) -> None:
    """Score the known controllers and all trained policies."""
    windows = [f"rms {start} to {start + 2} s [N]" for start in WINDOW_STARTS_S]
    titles = ["controller", "seeds", *windows]
    titles += ["SD over seeds [N]", "mean over fins [N]", "SD over fins [N]"]
    titles += [f"{reference} N" for reference in TEST_REFERENCES] + ["SD of angle [rad]"]
    print("| " + " | ".join(titles) + " |\n|" + " --- |" * len(titles))
    for name, controller in known_controllers(gaits).items():
        print(row(name, [errors(controller, keys)]), flush=True)
    runs = [load_policies(file.parent) for file in run.glob("*/policies.eqx")]
    for actions, variants in sorted(runs, key=lambda run: run[0]):
        for variant, policies in variants.items():
            scored = [errors(policy, keys) for policy in policies]
            print(row(f"{variant}, {actions:,} actions", scored), flush=True)
        if "adaptive" in variants:
            shuffled = [errors(each, keys, shuffle_torque=True) for each in variants["adaptive"]]
            print(
                row(f"adaptive, {actions:,} actions, torque of another fin", shuffled), flush=True
            )


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("step", choices=("train", "score", "information"))
    parser.add_argument("run", type=Path, nargs="?", help="folder of all policies")
    parser.add_argument("--actions", type=int, default=100_000, help="per policy")
    parser.add_argument("--envs", type=int, default=SINGLE.ppo.num_envs, help="per policy")
    parser.add_argument("--learning-rate", type=float, default=SINGLE.ppo.learning_rate)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--fins", type=int, default=100)
    parser.add_argument("--gaits", type=Path, default=EXAMPLE / "gaits", help="to compare with")
    options = parser.parse_args(words)
    if options.step == "information":
        print_information()
        return
    if options.run is None:
        parser.error(f"{options.step}: RUN is missing; name the folder of the policies")
    if options.step == "score":
        print_table(options.run, held_out_keys(options.fins), options.gaits)
        return
    folder = options.run / f"{options.actions}"
    folder.mkdir(parents=True, exist_ok=True)
    config = training_config(options.actions, options.envs, options.learning_rate)
    train(config, options.variants, options.seeds, folder)


if __name__ == "__main__":
    main()
