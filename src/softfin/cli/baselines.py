"""``softfin baselines``: a fin and a surrogate in; out, what force is held without a learnt controller."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from softfin.cli.common import Configured
from softfin.cli.kinds import Out, Plant


@dataclass(frozen=True, kw_only=True)
class Arguments(Configured):
    """Evaluate baselines without learning: still fin, best sine, inverse model, random search; or RecurrentPPO."""

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
        """Search and evaluate."""
        from softfin.evaluation.baselines.baselines import BaselinesConfig
        from softfin.stages.baselines import baselines

        config = self.configured(BaselinesConfig(), recurrent_steps=self.recurrent)
        result = self.stage(baselines, self.plant, self.out, config, surrogate=self.surrogate)
        self.tell(result, table(result["baselines"], result["left_out"]))


def table(summaries: Mapping[str, Any], left_out: Mapping[str, str]) -> str:
    """Return Table II of every baseline, then one line for each."""
    from softfin.cli.tables import aligned, table_two

    rows = [["mean over the references [N]", "x error", "y error", "x std", "y std", ""]]
    for name, summary in summaries.items():
        means = (summary["mean"][axis][score] for score in ("error_n", "std_n") for axis in "xy")
        clipped = sum(map(clips, summary["references"]))
        note = f"{clipped} of {len(summary['references'])} clipped by the limits" if clipped else ""
        rows.append([name, *map("{:.3f}".format, means), note])
    left = [f"{name}  left out: {why}" for name, why in left_out.items()]
    return "\n".join([table_two(summaries), "", *aligned(rows, (0, 5)), *left])


def clips(row: Mapping[str, Any]) -> bool:
    """Whether the limits of plant or model changed the gait of a reference."""
    limited = ("angle_clipped", "velocity_clipped", "amplitude_limited", "direction_limited")
    return any(row["commanded"].get(name) for name in limited)
