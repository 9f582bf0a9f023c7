"""Baselines judged as controllers are: what the fin does with no learning, or with none but of a few numbers.

===================== =============================================================================================
``still``             the rest command: the fin does nothing
``sine``              the sine of the shaft that misses the reference least, searched for each reference
``inverse_F_hz``      the analytic inverse model of the U-CAT robots, beating at F Hz
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
from jaxtyping import Float
from pydantic import Field, PositiveFloat

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError, PlantError, RunError
from softfin.core.plant import Plant, rest_command
from softfin.core.quantities import RATE_HZ, AnyArray, Command, Limits
from softfin.evaluation.baselines.inverse import InverseConfig, inverse
from softfin.evaluation.baselines.open_loop import OpenLoop, judge, score_all
from softfin.evaluation.baselines.open_loop_search import SearchConfig, best_gaits, best_sines, fitted_constant
from softfin.evaluation.baselines.recurrent import run_recurrent, trained
from softfin.evaluation.baselines.sine import Sine, commanded
from softfin.evaluation.evaluate import EvaluateConfig, Evaluation, Reference
from softfin.evaluation.paper import REFERENCES
from softfin.gaits.reachable import Cell, bounding_box
from softfin.storage import artifact as artifacts
from softfin.task.task import TaskConfig

KIND = "baselines"

Report = Callable[[float, str], None]
"""Called with how much is done (0 .. 1) and what is going on."""


class BaselinesConfig(Configuration):
    """How baselines are found and judged."""

    references: tuple[Reference, ...] = Field(default=REFERENCES, min_length=1)
    """Reference forces (x, y) [N]; the paper's six."""
    seconds: int = Field(default=30, ge=3)
    """Length of each experiment [s], whole, from rest; that of controllers."""
    seeds: int = Field(default=5, ge=1)
    """Repetitions, each with its own randomness of the plant."""
    seed: int = Field(default=0, ge=0)
    """Of the repetitions, the random gaits and RecurrentPPO."""
    search: SearchConfig = SearchConfig()
    """Of the sines and gaits."""
    inverse: InverseConfig = InverseConfig()
    """Coefficients of the inverse model."""
    inverse_frequencies_hz: tuple[PositiveFloat, ...] = Field(default=(2.1, 1.1, 1.0), min_length=1)
    """At which the inverse model beats [Hz]: the fast and the slow mode of the U-CAT robots, and 1 Hz, whose periods
    fill the window of 2 s: those of the other two leave a ripple in its mean that is no error of the model."""
    recurrent_steps: int = Field(default=0, ge=0)
    """Actions that RecurrentPPO learns from; the paper's 30,000 take minutes, so 0 leaves it out."""

    @property
    def experiments(self) -> EvaluateConfig:
        """What controllers would be judged by."""
        return EvaluateConfig(references=self.references, seconds=self.seconds, seeds=self.seeds, seed=self.seed)


class Baselines(NamedTuple):
    """Of each baseline its scores, or why it has none."""

    summaries: dict[str, dict[str, Any]]
    """By name, as `Evaluation.summary` gives them; each reference has what was ``commanded`` for it."""
    left_out: dict[str, str]
    """By name, in words."""


def evaluate_baselines(
    plant: Plant, search_in: Plant, config: BaselinesConfig, report: Report | None = None
) -> Baselines:
    """Find the baselines on one plant and judge them on another, the same one or the fin that it stands for.

    Raises PlantError where there is no command that both plants take.
    """
    told = report or (lambda done, note: None)
    references = np.asarray(config.references, np.float64)
    limits = shared_limits(Limits(*search_in.limits), Limits(*plant.limits))
    judged, searching = _Judged(OpenLoop(plant, limits), config.experiments), OpenLoop(search_in, limits)

    told(0.0, "still fin")
    judged.still()
    told(0.1, "inverse model")
    left_out = {}
    for frequency in config.inverse_frequencies_hz:
        judged.inverse(f"inverse_{frequency:g}_hz", config.inverse.constant, frequency, references, config.inverse)
        name = f"recalibrated_{frequency:g}_hz"
        amplitudes = (config.inverse.amplitude_min_rad, config.inverse.amplitude_max_rad)
        try:
            constant = fitted_constant(searching, frequency, amplitudes, config.search, config.seed)
        except RunError as error:
            left_out[name] = str(error)
            continue
        judged.inverse(name, constant, frequency, references, config.inverse)
    told(0.4, "random gaits")
    gaits = best_gaits(searching, references, config.search, config.seed)
    described = [
        {"angles_rad": [_rounded(x) for x in angle], "velocities_rad_s": [_rounded(x) for x in velocity]}
        for angle, velocity in zip(*gaits, strict=True)
    ]
    judged.add("random_search", gaits.commands(config.seconds), described)
    told(0.5, "sines")
    judged.sines("sine", best_sines(searching, references, config.search, config.seed))
    if config.recurrent_steps:
        told(0.6, "RecurrentPPO")
        try:
            judged.recurrent("recurrent_ppo", search_in, config.recurrent_steps)
        except (ConfigurationError, PlantError) as error:
            left_out["recurrent_ppo"] = str(error)
    told(1.0, "")
    return Baselines(judged.summaries, left_out)


def shared_limits(one: Limits, other: Limits) -> Limits:
    """The commands that two plants both take; raises PlantError where there are none."""
    low = np.maximum(one, other)[[0, 2]]
    high = np.minimum(one, other)[[1, 3]]
    for quantity, least, greatest in zip(("angle", "velocity"), low, high, strict=True):
        if not least < greatest:
            raise PlantError(
                f"baselines: no {quantity} that both plants take: the one searched in takes {one.to_dict()}, the one "
                f"judged on {other.to_dict()}; search in a surrogate of the fin itself"
            )
    return Limits(*(float(value) for value in (low[0], high[0], low[1], high[1])))


class _Judged:
    """Summaries by name, of what was played on one plant."""

    def __init__(self, player: OpenLoop, config: EvaluateConfig) -> None:
        self.player, self.config = player, config
        self.summaries: dict[str, dict[str, Any]] = {}

    def add(self, name: str, commands: Command, described: list[dict[str, Any]]) -> None:
        self._keep(name, judge(self.player, commands, self.config), described)

    def recurrent(self, name: str, learns_in: Plant, steps: int) -> None:
        plant, task, limits = self.player.plant, TaskConfig(), Limits(*learns_in.limits)
        if not np.allclose(limits, self.player.limits, rtol=0, atol=1e-3):
            raise PlantError(
                f"it would learn commands that the plant does not take, {limits.to_dict()}; let it learn in a "
                "surrogate of the fin itself"
            )
        box = bounding_box([Cell.around(reference, 0.0) for reference in self.config.references])
        model = trained(learns_in, steps, self.config.seed, task, box)
        recording = run_recurrent(model, task, limits, plant, self.config)
        self._keep(name, score_all(recording, plant, self.config), [{}] * len(self.config.references))

    def _keep(self, name: str, evaluation: Evaluation, described: list[dict[str, Any]]) -> None:
        summary = evaluation.summary()
        for row, words in zip(summary["references"], described, strict=True):
            row["commanded"] = words
        self.summaries[name] = summary

    def still(self) -> None:
        count, ticks = len(self.config.references), self.config.seconds * RATE_HZ
        commands = Command(*(np.full((count, ticks), part) for part in rest_command(self.player.limits)))
        self.add("still", commands, [{}] * count)

    def sines(self, name: str, sine: Sine, also: list[dict[str, Any]] | None = None) -> None:
        command, clipped = commanded(self.player.limits, sine, self.config.seconds * RATE_HZ)
        described = [
            {
                "centre_rad": _rounded(sine.centre[i]),
                "amplitude_rad": _rounded(sine.amplitude[i]),
                "frequency_hz": _rounded(sine.frequency[i]),
                "angle_clipped": _rounded(clipped.angle[i]),
                "velocity_clipped": _rounded(clipped.velocity[i]),
                **(also[i] if also else {}),
            }
            for i in range(len(self.config.references))
        ]
        self.add(name, jax.tree.map(np.asarray, command), described)

    def inverse(
        self,
        name: str,
        constant: float,
        frequency: float,
        references: Float[np.ndarray, "references 2"],
        config: InverseConfig,
    ) -> None:
        found = inverse(references, frequency, self.player.limits, config, constant)
        also = [
            {"amplitude_limited": bool(amplitude), "direction_limited": bool(direction), "constant_n_s2": constant}
            for amplitude, direction in zip(found.amplitude_clipped, found.direction_clipped, strict=True)
        ]
        self.sines(name, found.sine, also)


def write_baselines(
    baselines: Baselines, out: Path, facts: Mapping[str, Any], overwrite: bool = False
) -> dict[str, Any]:
    """Write ``baselines.json`` as a folder; returns its content.

    ``baselines`` holds a summary by name, laid out as in ``evaluation.json``, and in each of its references, as
    ``commanded``, the sine with the share of ticks at which the plant's limits clipped its angle or velocity, or the
    gait; ``left_out`` says by name why a baseline has no scores; the caller's `facts` stand beside them.
    """
    result = {KIND: baselines.summaries, "left_out": baselines.left_out, **facts}

    def write(folder: Path) -> None:
        (folder / f"{KIND}.json").write_text(artifacts.dump_json(result))

    artifacts.write_folder(out, write, overwrite)
    return result


def _rounded(value: Float[AnyArray, ""] | np.floating[Any]) -> float:
    # A zero without a sign.
    return round(float(value), 4) + 0.0
