"""``softfin compare``: surrogates and a dataset in; out, the error of each on test logs, free-running."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

from softfin.cli.common import Configured
from softfin.cli.kinds import Out, Plant, folder_of, numbers
from softfin.cli.options import Option
from softfin.data.issues import counted

HORIZONS = Option("SECONDS,...", parse=numbers("not numbers; write them with commas, in seconds, as 1,5,30"))


@dataclass(frozen=True, kw_only=True)
class Arguments(Configured):
    """Compare surrogates, free-running under the commands of a dataset's test logs for several horizons."""

    surrogates: Annotated[tuple[Path, ...], folder_of("surrogate", positional=True)]
    """Folders of the surrogates; seeds of one configuration, fitted to the same data, become one group."""
    dataset: Annotated[Path, folder_of("dataset")]
    """Folder of the dataset whose test logs they are scored on."""
    out: Out
    """Folder to write comparison.json and the figure to."""
    horizons: Annotated[tuple[float, ...], HORIZONS] | None = None
    """How long they run free, as 1,5,30 in seconds (1,5,30)."""
    noise_floor: Plant | None = None
    """A plant that records the same commands once more, such as the tank that was recorded: the error that noise,
    drift and other conditions leave."""
    seed: int | None = None
    """Seed of the second recording's noise (0)."""

    def run(self) -> None:
        """Compare."""
        from softfin.stages.compare import compare
        from softfin.surrogate.compare.compare import CompareConfig

        config = self.configured(CompareConfig(), horizons_s=self.horizons)
        result = self.stage(compare, self.surrogates, self.dataset, self.out, config, noise_floor=self.noise_floor)
        self.tell({"comparison": str(self.out), **result}, tables(result))


# Title, unit, score, and the factor from the score's unit to the one that is shown.
ERRORS = (
    ("angle RMSE", "[mrad]", "angle_rmse_rad", 1000),
    ("angle MAE", "[mrad]", "angle_mae_rad", 1000),
    ("force x RMSE", "[N]", "force_x_rmse_n", 1),
    ("force y RMSE", "[N]", "force_y_rmse_n", 1),
    ("force MAE", "[N]", "force_mae_n", 1),
    ("force x R2", "", "force_x_r2", 1),
    ("force y R2", "", "force_y_r2", 1),
)
MEANS = (
    ("MAE x", "[N]", "mean_force_x_mae_n", 1),
    ("MAE y", "[N]", "mean_force_y_mae_n", 1),
    ("MAE", "[N]", "mean_force_mae_n", 1),
    ("95% within", "[N]", "mean_force_p95_n", 1),
    ("worst", "[N]", "mean_force_worst_n", 1),
)
INTERVALS = (("inside", "[%]", "coverage", 100), ("half-width", "[N]", "half_width_n", 1))
WARPED = (
    ("angle", "[mrad]", "angle_dtw_mae_rad", 1000),
    ("angle", "scaled 1e-3", "angle_dtw_mae_scaled", 1000),
    ("force", "[mN]", "force_dtw_mae_n", 1000),
    ("force", "scaled 1e-3", "force_dtw_mae_scaled", 1000),
)


def tables(summary: Mapping[str, Any]) -> str:
    """Return the errors, mean force and DTW for a terminal of 120 columns, then what a reader should know."""
    groups = [(_heading(row, summary["flops_ratio_to"]), row["horizons"]) for row in summary["groups"]]
    if (floor := summary["noise_floor"]) is not None:
        groups.append((floor["name"], floor["horizons"]))
    several = any(row["seeds"] > 1 for row in summary["groups"])
    seeds = "; mean over the seeds \N{PLUS-MINUS SIGN} half of its 95% interval" if several else ""
    scored = f"{summary['test_logs']} test logs, {summary['scored'][-1]['rows']:,} rows at the longest horizon"
    lines = [f"Free-running over {scored}{seeds}", *_table(ERRORS, groups)]
    if any("mean_force_mae_n" in row for _, rows in groups for row in rows):
        stated = any("coverage" in row for _, rows in groups for row in rows)
        title = "Mean force over 200 samples" + (", and the intervals stated for it at 90%" if stated else "")
        lines += ["", title, *_table(MEANS + INTERVALS * stated, groups)]
    title = "DTW in a band of 1 s: mean absolute difference after warping, in units and scaled"
    lines += ["", title, *_table(WARPED, groups), *[f"note: {note}" for note in summary["notes"]]]
    return "\n".join(lines)


def _heading(row: Mapping[str, Any], yardstick: str) -> str:
    seeds = counted(row["seeds"], "seed")
    ratio = "" if row["name"] == yardstick else f" ({row['flops_ratio']:.3g} of {yardstick}'s)"
    return f"{row['name']}: {seeds}, {row['parameters']:,} parameters, {row['flops_per_tick']:,} FLOPs a tick{ratio}"


def _table(columns: Sequence[tuple[str, str, str, int]], groups: Sequence[tuple[str, Any]]) -> list[str]:
    from softfin.cli.tables import aligned

    head = [["", *(column[i] for column in columns)] for i in (0, 1)]
    body = [
        [f"  {row['horizon_s']:g} s", *(_cell(row.get(score), factor) for _, _, score, factor in columns)]
        for _, rows in groups
        for row in rows
    ]
    lines = aligned([*head, *body])
    rest = iter(lines[2:])
    return lines[:2] + [line for heading, rows in groups for line in (heading, *islice(rest, len(rows)))]


def _cell(cell: Mapping[str, Any] | None, factor: int) -> str:
    if cell is None:
        return "\N{EN DASH}"
    value = cell["mean"] * factor
    digits = 0 if abs(value) >= 1000 else 1 if abs(value) >= 100 else 2 if abs(value) >= 10 else 3
    text = f"{value:.{digits}f}" if abs(value) >= 0.0005 or value == 0 else f"{value:.0e}"
    if cell["interval"] is None:
        return text
    low, high = cell["interval"]
    return f"{text} \N{PLUS-MINUS SIGN}{(high - low) / 2 * factor:.{digits}f}"
