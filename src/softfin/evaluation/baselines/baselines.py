"""Baselines evaluated as controllers are: what the fin does with no learning, or with a few fitted numbers alone.

===================== =============================================================================================
``still``             the rest command: the fin does nothing
``sine``              the sine of the shaft of least error, searched for each reference
``inverse_F_hz``      the analytic inverse model of the U-CAT robots, a sine of F Hz
``recalibrated_F_hz`` the same with its one constant fitted to a few sines
``random_search``     the best of some random gaits of six actions, for each reference
``recurrent_ppo``     sb3-contrib's RecurrentPPO, one for all references, where it is asked for
===================== =============================================================================================

All but the last are open loop. The search plant, as a rule a surrogate of the fin, is all that they learn from.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from pydantic import Field, PositiveFloat

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError, PlantError, RunError
from softfin.core.plant import Plant, rest_command
from softfin.core.quantities import RATE_HZ, Command, Limits
from softfin.evaluation.baselines.recurrent import run_recurrent, train_recurrent
from softfin.evaluation.baselines.search import OpenLoop, SearchConfig, best_gaits, best_sines, fitted_constant
from softfin.evaluation.baselines.sines import InverseConfig, ShaftSine, inverse
from softfin.evaluation.evaluate import EvaluateConfig, Evaluation, Reference, repetition_keys, score_experiments
from softfin.evaluation.experiment import ExperimentRecording
from softfin.gaits.reachable import PAPER_REFERENCES, Cell, bounding_box
from softfin.storage import artifact as artifacts
from softfin.task.task import TaskConfig

KIND = "baselines"


class BaselinesConfig(Configuration):
    """How baselines are found and evaluated."""

    references: tuple[Reference, ...] = Field(default=PAPER_REFERENCES, min_length=1)
    """Reference forces (x, y) [N]; the paper's six."""
    seconds: int = Field(default=30, ge=3)
    """Length of each experiment [s], whole, from rest; that of controllers."""
    seeds: int = Field(default=5, ge=1)
    """Repetitions, each with its own randomness of the plant."""
    seed: int = Field(default=0, ge=0)
    """Seed of the repetitions, the random gaits and RecurrentPPO."""
    search: SearchConfig = SearchConfig()
    """Search of the sines and gaits."""
    inverse: InverseConfig = InverseConfig()
    """Coefficients of the inverse model."""
    inverse_frequencies_hz: tuple[PositiveFloat, ...] = Field(default=(2.1, 1.1, 1.0), min_length=1)
    """Frequencies of the inverse model [Hz]: the fast and the slow mode of the U-CAT robots, and 1 Hz, whose periods
    fill the window of 2 s: those of the other two leave a ripple in its mean that is not the model's error."""
    recurrent_steps: int = Field(default=0, ge=0)
    """Actions that RecurrentPPO learns from; the paper's 30,000 take minutes, so 0 leaves it out."""

    @property
    def experiments(self) -> EvaluateConfig:
        """The experiments that controllers would be scored by."""
        return EvaluateConfig(references=self.references, seconds=self.seconds, seeds=self.seeds, seed=self.seed)


class Baselines(NamedTuple):
    """Scores of each baseline, or why it has none."""

    summaries: dict[str, dict[str, Any]]
    """Results of `Evaluation.summary` by name; each reference has what was ``commanded`` for it."""
    left_out: dict[str, str]
    """Reasons by name."""


def evaluate_baselines(
    plant: Plant, search_in: Plant, config: BaselinesConfig, report: Callable[[float, str], None] = lambda *_: None
) -> Baselines:
    """Find the baselines on one plant and evaluate them on another, the same one or the fin that it stands for.

    `report` is called with the done part (0 .. 1) and a note. Raises PlantError where no command suits both plants.
    """
    references = np.asarray(config.references, np.float64)
    ticks = config.seconds * RATE_HZ
    limits = shared_limits(Limits(*search_in.limits), Limits(*plant.limits))
    player, searching = OpenLoop(plant, limits), OpenLoop(search_in, limits)
    summaries: dict[str, dict[str, Any]] = {}
    left_out: dict[str, str] = {}

    def add(name: str, evaluation: Evaluation, commanded: list[dict[str, Any]]) -> None:
        summaries[name] = evaluation.summary()
        for row, words in zip(summaries[name]["references"], commanded, strict=True):
            row["commanded"] = words

    def add_commands(name: str, commands: Command, commanded: list[dict[str, Any]]) -> None:
        add(name, evaluate_commands(player, commands, config.experiments), commanded)

    def add_sines(name: str, sine: ShaftSine, more: list[dict[str, Any]]) -> None:
        command, *clipped = sine.commands(limits, ticks)
        keys = ("centre_rad", "amplitude_rad", "frequency_hz", "angle_clipped", "velocity_clipped")
        rows = zip(zip(*sine, *clipped, strict=True), more, strict=True)
        commanded = [dict(zip(keys, map(_rounded, values), strict=True)) | row for values, row in rows]
        add_commands(name, jax.tree.map(np.asarray, command), commanded)

    def add_inverse(name: str, frequency: float, constant: float) -> None:
        chosen = inverse(references, frequency, limits, config.inverse, constant)
        limited = zip(chosen.amplitude_limited, chosen.direction_limited, strict=True)
        add_sines(name, chosen.sine, [
            {"amplitude_limited": bool(amplitude), "direction_limited": bool(direction), "constant_n_s2": constant}
            for amplitude, direction in limited
        ])  # fmt: skip

    report(0.0, "still fin")
    nothing: list[dict[str, Any]] = [{} for _ in references]
    add_commands("still", Command(*(np.full((len(references), ticks), x) for x in rest_command(limits))), nothing)
    report(0.1, "inverse model")
    for frequency in config.inverse_frequencies_hz:
        add_inverse(f"inverse_{frequency:g}_hz", frequency, config.inverse.constant)
        name = f"recalibrated_{frequency:g}_hz"
        amplitudes = (config.inverse.amplitude_min_rad, config.inverse.amplitude_max_rad)
        try:
            constant = fitted_constant(searching, frequency, amplitudes, config.search, config.seed)
        except RunError as error:
            left_out[name] = str(error)
        else:
            add_inverse(name, frequency, constant)
    report(0.4, "random gaits")
    gaits = best_gaits(searching, references, config.search, config.seed)
    add_commands("random_search", gaits.commands(config.seconds), [
        {"angles_rad": list(map(_rounded, angle)), "velocities_rad_s": list(map(_rounded, velocity))}
        for angle, velocity in zip(*gaits, strict=True)
    ])  # fmt: skip
    report(0.5, "sines")
    add_sines("sine", best_sines(searching, references, config.search, config.seed), nothing)
    if config.recurrent_steps:
        report(0.6, "RecurrentPPO")
        try:
            add("recurrent_ppo", _evaluate_recurrent(plant, limits, search_in, config), nothing)
        except (ConfigurationError, PlantError) as error:
            left_out["recurrent_ppo"] = str(error)
    report(1.0, "")
    return Baselines(summaries, left_out)


def evaluate_commands(player: OpenLoop, commands: Command, config: EvaluateConfig) -> Evaluation:
    """Score a series of commands for each reference, ``(references, ticks)``, as `evaluate` does a controller."""
    reading = player.readings(commands, repetition_keys(config))
    issued = Command(*(np.repeat(np.asarray(part)[:, None], config.seeds, axis=1) for part in commands))
    recording = ExperimentRecording(np.asarray(config.references, np.float32), issued, reading)
    return score_experiments(recording, player.plant, config)


def _evaluate_recurrent(plant: Plant, limits: Limits, search_in: Plant, config: BaselinesConfig) -> Evaluation:
    learnt, task = Limits(*search_in.limits), TaskConfig()
    if not np.allclose(learnt, limits, rtol=0, atol=1e-3):
        raise PlantError(
            f"it would learn commands that the plant does not take, {learnt.to_dict()}; let it learn in a surrogate "
            "of the fin itself"
        )
    box = bounding_box([Cell.around(reference, 0.0) for reference in config.references])
    model = train_recurrent(search_in, config.recurrent_steps, config.seed, task, box)
    experiments = config.experiments
    return score_experiments(run_recurrent(model, task, learnt, plant, experiments), plant, experiments)


def shared_limits(one: Limits, other: Limits) -> Limits:
    """The commands that two plants both take; raises PlantError where there are none."""
    low = np.maximum(one, other)[[0, 2]]
    high = np.minimum(one, other)[[1, 3]]
    for quantity, least, greatest in zip(("angle", "velocity"), low, high, strict=True):
        if not least < greatest:
            raise PlantError(
                f"baselines: no {quantity} that both plants take: the search plant takes {one.to_dict()}, the "
                f"evaluated one {other.to_dict()}; search in a surrogate of the fin itself"
            )
    return Limits(*(float(value) for value in (low[0], high[0], low[1], high[1])))


def write_baselines(
    baselines: Baselines, out: Path, metadata: Mapping[str, Any], overwrite: bool = False
) -> dict[str, Any]:
    """Write ``baselines.json`` as a folder; returns its content.

    ``baselines`` holds a summary by name, laid out as in ``evaluation.json``, and in each of its references, as
    ``commanded``, the sine with the fraction of ticks at which the plant's limits clipped its angle or velocity, or the
    gait; ``left_out`` says by name why a baseline has no scores; the caller's `metadata` stand beside them.
    """
    result = {KIND: baselines.summaries, "left_out": baselines.left_out, **metadata}

    def write(folder: Path) -> None:
        (folder / f"{KIND}.json").write_text(artifacts.dump_json(result))

    artifacts.write_folder(out, write, overwrite)
    return result


def _rounded(value: Any) -> float:
    # A zero without a sign.
    return round(float(value), 4) + 0.0
