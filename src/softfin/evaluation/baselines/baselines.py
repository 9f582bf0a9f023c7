"""Find baselines and evaluate them like controllers: what the fin can do without learning, or with
only a few fitted numbers.

===================== ========================================================================
``still``             the rest command: the fin does not move
``sine``              the shaft sine with the smallest error, searched for each reference
``inverse_F_hz``      the analytic inverse model of the U-CAT robots, a sine at F Hz
``recalibrated_F_hz`` the same model with its only constant fitted to a few sines
``random_search``     the best of several random gaits of six actions, for each reference
===================== ========================================================================

All are open loop and tuned only on the search plant, usually a surrogate of the fin.
"""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import SupportsFloat

import jax
import numpy as np
from pydantic import Field, PositiveFloat

from softfin.core.errors import PlantError, RunError
from softfin.core.json_object import JsonObject
from softfin.core.plant import Plant, rest_command
from softfin.core.plant_identity import jit_argument
from softfin.core.quantities import RATE_HZ, Command, Limits
from softfin.evaluation.baselines import open_loop
from softfin.evaluation.baselines.open_loop import ShaftSine, inverse
from softfin.evaluation.evaluate import (
    EvaluateConfig,
    Evaluation,
    ExperimentsConfig,
    score_experiments,
)
from softfin.evaluation.experiment import ExperimentRecording
from softfin.evaluation.results import Baselines, EvaluationSummary
from softfin.gaits.inverse_model import InverseConfig
from softfin.gaits.reachable import PAPER_REFERENCES
from softfin.storage import artifact as artifacts
from softfin.task.signals import ReferenceForce

BASELINES_KIND = "baselines"


class BaselinesConfig(ExperimentsConfig):
    """Configuration of the search for baselines and of their evaluation."""

    references: tuple[ReferenceForce, ...] = Field(default=PAPER_REFERENCES, min_length=1)
    """Reference forces (x, y) [N]; the paper's six."""
    search: open_loop.SearchConfig = open_loop.SearchConfig()
    """Search for sines and gaits."""
    inverse: InverseConfig = InverseConfig()
    """Coefficients of the inverse model."""
    inverse_frequencies_hz: tuple[PositiveFloat, ...] = Field(default=(2.1, 1.1, 1.0), min_length=1)
    """Frequencies of the inverse model [Hz]: the fast and the slow mode of the U-CAT robots, and
    1 Hz. Only at 1 Hz does a whole number of periods fit into the window of 2 s; the other two
    leave a ripple in the mean that is not an error of the model."""

    @property
    def experiments(self) -> EvaluateConfig:
        """Configuration of the same experiments for a controller."""
        return EvaluateConfig(
            references=self.references, seconds=self.seconds, seeds=self.seeds, seed=self.seed
        )


def evaluate_baselines(
    plant: Plant,
    search_in: Plant,
    config: BaselinesConfig,
    report: Callable[[float, str], None] = lambda *_: None,
) -> Baselines:
    """Find the baselines on the plant `search_in` and evaluate them on `plant`, the fin that it
    models or the same plant.

    ``baselines`` in the result contains the `Evaluation.summary` of each baseline. Its key
    ``commanded`` is, for each reference, a gait or a sine with the fractions of ticks at which the
    limits clipped angle and velocity. ``left_out`` contains the reasons why baselines have no
    scores. `report` is called with the completed fraction (0 .. 1) and a note. Raises PlantError if
    no command is valid for both plants.
    """
    references = np.asarray(config.references, np.float64)
    seconds = config.seconds
    limits = shared_limits(Limits(*search_in.limits), Limits(*plant.limits))
    search = open_loop.OpenLoopSearch(search_in, limits, config.search, config.seed)
    summaries: dict[str, EvaluationSummary] = {}
    left_out: dict[str, str] = {}
    nothing: list[JsonObject] = [{} for _ in references]

    def add_commands(name: str, commands: Command, commanded: list[JsonObject]) -> None:
        summaries[name] = evaluate_commands(plant, commands, config.experiments).summary()
        for row, words in zip(summaries[name]["references"], commanded, strict=True):
            row["commanded"] = words

    def add_sines(name: str, sine: ShaftSine, more: list[JsonObject]) -> None:
        command, *clipped = sine.commands(limits, seconds * RATE_HZ)
        keys = ("centre_rad", "amplitude_rad", "frequency_hz", "angle_clipped", "velocity_clipped")
        rows = []
        for values, row in zip(zip(*sine, *clipped, strict=True), more, strict=True):
            rows.append(dict(zip(keys, _rounded(values), strict=True)) | row)
        add_commands(name, command, rows)

    report(0.0, "still fin")
    shape = (len(references), seconds * RATE_HZ)
    rest = Command(*(np.full(shape, field) for field in rest_command(limits)))
    add_commands("still", rest, nothing)
    report(0.1, "inverse model")
    for frequency in config.inverse_frequencies_hz:
        model = config.inverse
        add_sines(
            f"inverse_{frequency:g}_hz",
            *inverse(references, frequency, limits, model, model.constant),
        )
        name = f"recalibrated_{frequency:g}_hz"
        try:
            constant = search.fitted_constant(
                frequency, (model.amplitude_min_rad, model.amplitude_max_rad)
            )
        except RunError as error:
            left_out[name] = str(error)
        else:
            add_sines(name, *inverse(references, frequency, limits, model, constant))
    report(0.4, "random gaits")
    gaits = search.best_gaits(references)
    rows = [
        {"angles_rad": _rounded(angle), "velocities_rad_s": _rounded(v)}
        for angle, v in zip(*gaits, strict=True)
    ]
    add_commands("random_search", open_loop.repeated(gaits, seconds), rows)
    report(0.5, "sines")
    add_sines("sine", search.best_sines(references), nothing)
    report(1.0, "")
    return {"baselines": summaries, "left_out": left_out}


def evaluate_commands(plant: Plant, commands: Command, config: EvaluateConfig) -> Evaluation:
    """Score one series of commands per reference ``(references, ticks)`` in the same way as a
    controller."""
    recorded = open_loop.run_commands(jit_argument(plant), commands, config.keys())
    reading, true_force = jax.tree.map(np.asarray, recorded)
    # A recording has the commands of every seed, which are the same here.
    angle = np.repeat(np.asarray(commands.angle)[:, None], config.seeds, axis=1)
    velocity = np.repeat(np.asarray(commands.velocity)[:, None], config.seeds, axis=1)
    issued = Command(angle, velocity)
    recording = ExperimentRecording(
        np.asarray(config.references, np.float32), issued, reading, true_force
    )
    return score_experiments(recording, plant, config)


def shared_limits(one: Limits, other: Limits) -> Limits:
    """Return the commands that both plants accept; raises PlantError if there are none."""
    low = np.maximum(one, other).tolist()
    high = np.minimum(one, other).tolist()
    # Limits are (angle_min, angle_max, velocity_min, velocity_max): the higher minima and the lower
    # maxima.
    limits = Limits(low[0], high[1], low[2], high[3])
    if limits.problem() is not None:
        raise PlantError(
            "baselines: the search plant and the evaluated plant have no valid commands in common: "
            f"their limits are {one.to_dict()} and {other.to_dict()}; search in a surrogate of the "
            "evaluated fin"
        )
    return limits


def write_baselines(result: Mapping[str, object], out: Path, overwrite: bool = False) -> None:
    """Write a folder with ``baselines.json``."""

    def write(folder: Path) -> None:
        artifacts.write_description(folder, BASELINES_KIND, result)

    artifacts.write_folder(out, write, overwrite)


def _rounded(values: Iterable[SupportsFloat]) -> list[float]:
    # Adding 0.0 turns -0.0 into 0.0.
    return [round(float(value), 4) + 0.0 for value in values]
