"""``softfin baselines``: a fin and a surrogate in; out, what force is held without a learnt controller."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softfin.cli.common import Configured, progress
from softfin.cli.kinds import Out, Plant


@dataclass(frozen=True, kw_only=True)
class Arguments(Configured):
    """Evaluate what needs no learnt controller: still fin, best sine, inverse model, random search, or RecurrentPPO."""

    out: Out
    """Folder to write baselines.json to."""
    plant: Plant = "tank"
    """The fin that all are evaluated on: tank, a tank's YAML, the folder of a surrogate, or package.module:plant."""
    surrogate: Plant | None = None
    """Where sines and gaits are searched, as a rule the folder of a surrogate of the fin (the fin itself)."""
    seconds: int | None = None
    """Length of each experiment (30)."""
    seeds: int | None = None
    """Repetitions (5)."""
    seed: int | None = None
    """Seed of the plant's noise and of the random gaits (0)."""
    recurrent: int | None = None
    """Actions that RecurrentPPO (extra sb3) learns from; the paper's 30,000 take minutes (0: left out)."""

    def run(self) -> None:
        """Find and evaluate."""
        from softfin.evaluation.baselines.baselines import BaselinesConfig
        from softfin.stages.baselines import baselines

        config = self.configured(
            BaselinesConfig(), seconds=self.seconds, seeds=self.seeds, seed=self.seed, recurrent_steps=self.recurrent
        )
        with progress() as report:
            result = baselines(
                self.plant, Path(self.out), config,
                surrogate=self.surrogate, overwrite=self.overwrite, progress=report,
            )  # fmt: skip
        self.tell(result, table(result["baselines"], result["left_out"]))


def table(summaries: Mapping[str, Any], left_out: Mapping[str, str]) -> str:
    """Table II of every baseline, then one line each."""
    from softfin.cli.tables import table_two

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
