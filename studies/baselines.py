"""Baselines that need no training, evaluated like controllers: what a fin does without learning.

    python -m studies.baselines --plant tank --surrogate surrogate --out baselines

===================== ========================================================================
``still``             the rest command: the fin does not move
``sine``              the shaft sine with the smallest error, searched for each reference
``inverse_F_hz``      the analytic inverse model of the U-CAT robots, a sine at F Hz
``recalibrated_F_hz`` the same model with its only constant fitted to a few sines
``random_search``     the best of several random gaits of six actions, for each reference
===================== ========================================================================

All are open loop and tuned only on the search plant, usually a surrogate of the fin.
"""

import argparse
import json
from pathlib import Path

import jax
import numpy as np

from softfin.core.errors import RunError
from softfin.core.plant import Plant, rest_command
from softfin.core.quantities import RATE_HZ, Command, Limits
from softfin.evaluation.evaluate import EvaluateConfig, Evaluation, score_experiments
from softfin.evaluation.experiment import ExperimentRecording
from softfin.gaits.reachable import PAPER_REFERENCES
from softfin.storage.registry import find_plant
from studies.open_loop import OpenLoopSearch, inverse, repeated, run_commands

FREQUENCIES_HZ = (2.1, 1.1, 1.0)
"""Frequencies of the inverse model: the fast and the slow mode of the U-CAT robots, and 1 Hz. Only
at 1 Hz does a whole number of periods fit into the window of 2 s; the other two leave a ripple in
the mean that is not an error of the model."""


def find_baselines(search: OpenLoopSearch, config: EvaluateConfig) -> dict[str, Command]:
    """Return the commands of each baseline, ``(references, ticks)``. A recalibrated model is left
    out if its constant cannot be fitted."""
    references = np.asarray(config.references, np.float64)
    limits = search.limits
    ticks = config.seconds * RATE_HZ
    rest = Command(*(np.full((len(references), ticks), field) for field in rest_command(limits)))
    found = {"still": rest}
    for frequency in FREQUENCIES_HZ:
        sine = inverse(references, frequency, limits)
        found[f"inverse_{frequency:g}_hz"] = sine.commands(limits, ticks)
        try:
            constant = search.fitted_constant(frequency)
        except RunError as error:
            print(error)
            continue
        sine = inverse(references, frequency, limits, constant)
        found[f"recalibrated_{frequency:g}_hz"] = sine.commands(limits, ticks)
    found["random_search"] = repeated(search.best_gaits(references), config.seconds)
    found["sine"] = search.best_sines(references).commands(limits, ticks)
    return found


def evaluate_commands(plant: Plant, commands: Command, config: EvaluateConfig) -> Evaluation:
    """Score one series of commands per reference ``(references, ticks)`` in the same way as a
    controller."""
    recorded = run_commands(plant, commands, config.keys())
    reading, true_force = jax.tree.map(np.asarray, recorded)
    # A recording has the commands of every seed, which are the same here.
    angle = np.repeat(np.asarray(commands.angle)[:, None], config.seeds, axis=1)
    velocity = np.repeat(np.asarray(commands.velocity)[:, None], config.seeds, axis=1)
    recording = ExperimentRecording(
        np.asarray(config.references, np.float32), Command(angle, velocity), reading, true_force
    )
    return score_experiments(recording, plant, config)


def shared_limits(one: Limits, other: Limits) -> Limits:
    """Return the commands that both plants accept."""
    low = np.maximum(one, other).tolist()
    high = np.minimum(one, other).tolist()
    # Limits are (angle_min, angle_max, velocity_min, velocity_max): the higher minima and the lower
    # maxima.
    return Limits(low[0], high[1], low[2], high[3])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--plant", default="tank")
    parser.add_argument("--surrogate", help="plant in which to search (default: the plant itself)")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seconds", type=int, default=30)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--gaits", type=int, default=256)
    parser.add_argument("--refinements", type=int, default=4)
    words = parser.parse_args()
    plant = find_plant(words.plant)
    search_plant = plant if words.surrogate is None else find_plant(words.surrogate)
    limits = shared_limits(Limits(*search_plant.limits), Limits(*plant.limits))
    search = OpenLoopSearch(
        search_plant, limits, words.seed, gaits=words.gaits, refinements=words.refinements
    )
    config = EvaluateConfig(
        references=PAPER_REFERENCES, seconds=words.seconds, seeds=words.repeats, seed=words.seed
    )
    scores = {}
    for name, commands in find_baselines(search, config).items():
        scores[name] = evaluate_commands(plant, commands, config).summary()
        mean = scores[name]["mean"]
        print(f"{name}: mean error {mean['x']['error_n']:.3f}, {mean['y']['error_n']:.3f} N")
    words.out.mkdir(parents=True, exist_ok=True)
    (words.out / "baselines.json").write_text(json.dumps(scores, indent=1))


if __name__ == "__main__":
    main()
