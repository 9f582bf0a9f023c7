"""Write what sb3-contrib's RecurrentPPO makes of given data into recurrent_ppo.json, for
test_parity.py to compare.

    python -m tests.learning.recurrent_ppo

It needs sb3-contrib and nothing of softfin. The file lies in the repository because sb3-contrib
brings 5 GB, which is too much for every run of the tests; make it again only to add a case.

Time limits: RecurrentPPO adds discount x (value of the state that was left) to the last reward of
an episode and treats the episode as ended there; softfin keeps the reward and bootstraps the
truncated episode. The buffer here is filled in the way that RecurrentPPO fills it.
"""

import json
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np

FILE = Path(__file__).with_suffix(".json")

TIME = 12
NUM_ENVS = 4
EPISODE = 6
"""Actions of an episode; the environments are truncated at different times."""

SETTINGS = {
    "entropy_coef": 0.02,
    "value_coef": 0.7,
    "clip_ratio": 0.15,
    "discount": 0.83,
    "gae_lambda": 0.9,
}


class Numbered(gymnasium.Env[Any, Any]):
    """Never played; an observation is the number of its sample, so that shuffled samples can be
    told apart."""

    observation_space = gymnasium.spaces.Box(0, TIME * NUM_ENVS, (1,), np.float64)
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)


def draw_inputs() -> dict[str, Any]:
    """Return a rollout and the outputs of the networks before and after a change of their weights,
    rounded for JSON."""
    random = np.random.default_rng(0)

    def draw(*shape: int, scale: float = 1.0) -> np.ndarray:
        return np.round(scale * random.normal(size=(TIME, NUM_ENVS, *shape)), 4)

    # An environment is truncated every EPISODE actions, each at a time of its own; the last step is
    # one of them.
    steps = np.arange(1, TIME + 1)[:, None] + 3 * np.arange(NUM_ENVS)
    truncated = steps % EPISODE == 0
    is_first = np.concatenate([np.ones((1, NUM_ENVS), bool), truncated[:-1]])
    log_std = np.array([-0.3, 0.1])
    mean = draw(2)
    value = draw()
    # The state after an action is the next one, unless the environment was reset in between.
    next_value = draw()
    next_value[:-1] = np.where(truncated[:-1], next_value[:-1], value[1:])
    return {
        "reward": draw(),
        "is_first": is_first,
        "truncated": truncated,
        "action": np.round(mean + np.exp(log_std) * draw(2), 4),
        "mean": mean,
        "log_std": log_std,
        "value": value,
        "next_value": next_value,
        "changed_mean": mean + draw(2, scale=0.1),
        "changed_log_std": np.array([-0.25, 0.05]),
        "changed_value": value + draw(scale=0.2),
    }


def peer_outputs(inputs: dict[str, Any]) -> dict[str, Any]:
    """Return advantages and returns of RecurrentPPO's buffer, and what its `train` logs about the
    changed networks."""
    import sb3_contrib
    import torch
    from stable_baselines3.common.distributions import DiagGaussianDistribution
    from stable_baselines3.common.logger import configure
    from stable_baselines3.common.vec_env import DummyVecEnv

    model = sb3_contrib.RecurrentPPO(
        "MlpLstmPolicy",
        DummyVecEnv([Numbered] * NUM_ENVS),
        n_steps=TIME,
        batch_size=TIME * NUM_ENVS,
        n_epochs=1,
        learning_rate=0.0,
        gamma=SETTINGS["discount"],
        gae_lambda=SETTINGS["gae_lambda"],
        clip_range=SETTINGS["clip_ratio"],
        ent_coef=SETTINGS["entropy_coef"],
        vf_coef=SETTINGS["value_coef"],
        policy_kwargs={"lstm_hidden_size": 2},
        device="cpu",
    )
    model.set_logger(configure(None, []))

    def tensor(name: str) -> Any:
        return torch.tensor(np.asarray(inputs[name], np.float32))

    def gaussian(mean: Any, log_std: Any) -> Any:
        mean = mean.reshape(-1, 2)
        return DiagGaussianDistribution(2).proba_distribution(mean, log_std.expand_as(mean))

    actions = tensor("action").reshape(-1, 2)

    # Values are in units of 1 - discount times the reward.
    bootstrap = np.where(inputs["truncated"], SETTINGS["discount"] * inputs["next_value"], 0.0)
    reward = (1 - SETTINGS["discount"]) * inputs["reward"] + bootstrap
    log_prob = gaussian(tensor("mean"), tensor("log_std")).log_prob(actions).reshape(TIME, NUM_ENVS)
    zeros = torch.zeros(1, NUM_ENVS, 2)
    memory = SimpleNamespace(pi=(zeros, zeros), vf=(zeros, zeros))
    for t in range(TIME):
        number = np.arange(NUM_ENVS)[:, None] + NUM_ENVS * t
        model.rollout_buffer.add(
            number,
            inputs["action"][t],
            reward[t],
            inputs["is_first"][t],
            tensor("value")[t],
            log_prob[t],
            lstm_states=memory,
        )
    model.rollout_buffer.compute_returns_and_advantage(
        tensor("next_value")[-1], inputs["truncated"][-1]
    )
    advantages = model.rollout_buffer.advantages.copy()
    returns = model.rollout_buffer.returns.copy()

    changed = gaussian(tensor("changed_mean"), tensor("changed_log_std"))
    changed_log_prob = changed.log_prob(actions)
    changed_entropy = changed.entropy()
    changed_value = tensor("changed_value").reshape(-1)
    # So that the backward pass of `train` finds parameters.
    nothing = 0 * sum(parameter.sum() for parameter in model.policy.parameters())

    def evaluate_actions(observations: Any, *_: Any) -> Any:
        sample = observations.flatten().long()
        return (
            changed_value[sample] + nothing,
            changed_log_prob[sample] + nothing,
            changed_entropy[sample],
        )

    model.policy.evaluate_actions = evaluate_actions
    model.train()
    logged = model.logger.name_to_value
    names = {
        "clipped": "clip_fraction",
        "kl": "approx_kl",
        "value_loss": "value_loss",
        "loss": "loss",
    }
    return {
        "advantages": advantages,
        "returns": returns,
        **{name: float(logged[f"train/{peer}"]) for name, peer in names.items()},
    }


def to_json(value: Any) -> Any:
    """Return a number or an array of them as JSON has it, with seven digits after the point."""
    array = np.asarray(value)
    if array.dtype == bool:
        return array.tolist()
    return np.round(array.astype(float), 7).tolist()


def main() -> None:
    inputs = draw_inputs()
    outputs = peer_outputs(inputs)
    reference = {
        "made_with": {
            name: version(name) for name in ("sb3-contrib", "stable-baselines3", "torch")
        },
        "settings": SETTINGS,
        "inputs": {name: to_json(value) for name, value in inputs.items()},
        "outputs": {name: to_json(value) for name, value in outputs.items()},
    }
    parts = []
    for part, values in reference.items():
        # One line per array.
        rows = [f'"{name}": {json.dumps(value)}' for name, value in values.items()]
        parts.append(f'"{part}": {{\n' + ",\n".join(rows) + "\n}")
    FILE.write_text("{\n" + ",\n".join(parts) + "\n}\n")


if __name__ == "__main__":
    main()
