"""LSTM-PPO with its updates in the published surrogate, against sb3-contrib's RecurrentPPO on the
same task.

Both learn the same Gymnasium task with their own defaults; RecurrentPPO's are the paper's (two
LSTMs of 256 units, 128 actions a rollout, 10 epochs). A second row of RecurrentPPO has softfin's 64
units, so that the size of the networks does not decide. Compilation is not counted: it is paid
once, and its time is stated.
"""

import time
from typing import Any

from benchmarks.controllers import PAPER_PRESETS, run
from benchmarks.measure import entry
from benchmarks.nets import published_layout
from softfin.core.gym_registration import register
from softfin.surrogate import Surrogate

PEER_STEPS = 512


def peer_speed(plant: Surrogate, units: int) -> float:
    """Steps a second of RecurrentPPO with its updates, from its second rollout on."""
    import gymnasium
    from sb3_contrib import RecurrentPPO

    register()
    environment = gymnasium.make("softfin/ForceTracking-v0", plant=plant)
    model = RecurrentPPO(
        "MlpLstmPolicy", environment, device="cpu", policy_kwargs={"lstm_hidden_size": units}
    )
    model.learn(model.n_steps)
    start = time.perf_counter()
    model.learn(PEER_STEPS, reset_num_timesteps=False)
    return PEER_STEPS / (time.perf_counter() - start)


def main() -> list[dict[str, Any]]:
    plant = published_layout()
    grid = run(plant, PAPER_PRESETS["grid"])
    single = run(plant, PAPER_PRESETS["single"])
    details: dict[str, Any] = {
        "grid_steps_per_s": grid["steps_per_s"],
        "single_steps_per_s": single["steps_per_s"],
        "grid_compile_s": grid["before_first_s"],
        "single_compile_s": single["before_first_s"],
    }
    try:
        import sb3_contrib  # noqa: F401
    except ImportError:
        note = "sb3-contrib is not installed: no ratio; uv sync --extra sb3"
        return [
            {
                "figure": "LSTM-PPO / RecurrentPPO",
                "value": None,
                "bar": ">= 15",
                "met": None,
                "note": note,
                **details,
            }
        ]
    paper = peer_speed(plant, 256)
    small = peer_speed(plant, 64)
    details |= {"recurrent_ppo_steps_per_s": paper, "recurrent_ppo_64_units_steps_per_s": small}
    return [
        entry("LSTM-PPO grid / RecurrentPPO", grid["steps_per_s"] / paper, "ratio", 15, **details),
        entry("LSTM-PPO single / RecurrentPPO", single["steps_per_s"] / paper, "ratio", 15),
    ]
