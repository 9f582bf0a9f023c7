"""``softfin baselines``: a fin and a surrogate in; out, what force is held without a learnt controller."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from softfin import artifacts
from softfin.cli.common import Configured, Out, progress
from softfin.cli.tables import table_two
from softfin.evaluation.baselines import BaselinesConfig, evaluate_baselines, write_baselines
from softfin.plants import find_plant


@dataclass(frozen=True, kw_only=True)
class Arguments(Configured):
    """Judge what needs no learnt controller: still fin, best sine, inverse model, random search, or RecurrentPPO."""

    out: Out
    """Folder to write baselines.json to."""
    plant: str = "tank"
    """The fin that all are judged on: tank, a tank's YAML, the folder of a surrogate, or package.module:plant."""
    surrogate: str | None = None
    """Where sines and gaits are searched, as a rule the folder of a surrogate of the fin (the fin itself)."""
    seconds: int | None = None
    """Length of each experiment (30)."""
    seeds: int | None = None
    """Repetitions (5)."""
    seed: int | None = None
    """Of the plant's noise and of the random gaits (0)."""
    recurrent: int | None = None
    """Actions that RecurrentPPO (extra sb3) learns from; the paper's 30,000 take minutes (0: left out)."""

    def run(self) -> None:
        """Find and judge."""
        artifacts.check_vacant(Path(self.out), self.overwrite)
        config = self.configured(
            BaselinesConfig(), seconds=self.seconds, seeds=self.seeds, seed=self.seed, recurrent_steps=self.recurrent
        )
        plant = find_plant(self.plant)
        search_in = plant if self.surrogate is None else find_plant(self.surrogate)
        with progress() as report:
            found = evaluate_baselines(plant, search_in, config, partial(report, "baselines"))
        facts = {
            "plant": self.plant,
            "searched_in": self.surrogate or self.plant,
            "configuration": config.model_dump(mode="json"),
            "provenance": artifacts.provenance(seed=config.seed),
        }
        self.tell(write_baselines(found, Path(self.out), facts), table(found.summaries, found.left_out))


def table(summaries: Mapping[str, Any], left_out: Mapping[str, str]) -> str:
    """Table II of every baseline, then one line each."""
    head = f"{'mean over the references [N]':30}{'x error':>10}{'y error':>10}{'x std':>10}{'y std':>10}"
    lines = [table_two(summaries), "", head]
    for name, summary in summaries.items():
        x, y = summary["mean"]["x"], summary["mean"]["y"]
        clipped = sum(map(clips, summary["references"]))
        note = f"  {clipped} of {len(summary['references'])} clipped by the limits" if clipped else ""
        scores = "".join(f"{axis[score]:>10.3f}" for score in ("error_n", "std_n") for axis in (x, y))
        lines.append(f"{name:30}{scores}{note}")
    return "\n".join([*lines, *(f"{name:30}left out: {why}" for name, why in left_out.items())])


def clips(row: Mapping[str, Any]) -> bool:
    """Whether the limits of plant or model kept a reference's beat from what was wanted."""
    limited = ("angle_clipped", "velocity_clipped", "amplitude_limited", "direction_limited")
    return any(row["commanded"].get(name) for name in limited)
