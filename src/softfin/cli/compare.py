"""``softfin compare``: surrogates and a dataset in; out, the error of each on test logs, free-running."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeAlias

from softfin.cli.common import Configured, progress
from softfin.cli.kinds import Out, Plant, folder_of, numbers
from softfin.cli.options import Option

Horizons: TypeAlias = Annotated[
    tuple[float, ...],
    Option("SECONDS,...", parse=numbers("not numbers; write them with commas, in seconds, as 1,5,30")),
]


@dataclass(frozen=True, kw_only=True)
class Arguments(Configured):
    """Compare surrogates, free-running under the commands of a dataset's test logs for several horizons."""

    surrogates: Annotated[tuple[Path, ...], folder_of("surrogate", positional=True)]
    """Folders of the surrogates; seeds of one configuration, fitted to the same data, become one group."""
    dataset: Annotated[Path, folder_of("dataset")]
    """Folder of the dataset whose test logs they are scored on."""
    out: Out
    """Folder to write comparison.json and the figure to."""
    horizons: Horizons | None = None
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

        config = self.configured(CompareConfig(), horizons_s=self.horizons, seed=self.seed)
        with progress() as report:
            result = compare(
                self.surrogates, self.dataset, Path(self.out), config,
                noise_floor=self.noise_floor, overwrite=self.overwrite, progress=report,
            )  # fmt: skip
        self.tell({"comparison": str(self.out), **result}, tables(result))


class Column(NamedTuple):
    """One column of a table."""

    title: str
    unit: str
    score: str
    factor: int = 1
    """Factor from the score's unit to the unit shown."""


ERRORS = (
    Column("angle RMSE", "[mrad]", "angle_rmse_rad", 1000),
    Column("angle MAE", "[mrad]", "angle_mae_rad", 1000),
    Column("force x RMSE", "[N]", "force_x_rmse_n"),
    Column("force y RMSE", "[N]", "force_y_rmse_n"),
    Column("force MAE", "[N]", "force_mae_n"),
    Column("force x R2", "", "force_x_r2"),
    Column("force y R2", "", "force_y_r2"),
)
MEANS = (
    Column("MAE x", "[N]", "mean_force_x_mae_n"),
    Column("MAE y", "[N]", "mean_force_y_mae_n"),
    Column("MAE", "[N]", "mean_force_mae_n"),
    Column("95% within", "[N]", "mean_force_p95_n"),
    Column("worst", "[N]", "mean_force_worst_n"),
)
INTERVALS = (
    Column("inside", "[%]", "coverage", 100),
    Column("half-width", "[N]", "half_width_n"),
)
WARPED = (
    Column("angle", "[mrad]", "angle_dtw_mae_rad", 1000),
    Column("angle", "scaled 1e-3", "angle_dtw_mae_scaled", 1000),
    Column("force", "[mN]", "force_dtw_mae_n", 1000),
    Column("force", "scaled 1e-3", "force_dtw_mae_scaled", 1000),
)

LABEL = 8
LINE = 120


def tables(summary: Mapping[str, Any]) -> str:
    """For a terminal of 120 columns: errors, mean force, DTW, then what a reader should know."""
    groups = [(_heading(row, summary["flops_ratio_to"]), row["horizons"]) for row in summary["groups"]]
    if (floor := summary["noise_floor"]) is not None:
        groups.append((floor["name"], floor["horizons"]))
    several = any(row["seeds"] > 1 for row in summary["groups"])
    spread = "; mean over the seeds \N{PLUS-MINUS SIGN} half of its 95% interval" if several else ""
    lines = [f"Free-running over {_scored(summary)}{spread}", *_table(ERRORS, groups)]
    if any("mean_force_mae_n" in row for _, rows in groups for row in rows):
        stated = any("coverage" in row for _, rows in groups for row in rows)
        title = "Mean force over 200 samples" + (", and the intervals stated for it at 90%" if stated else "")
        lines += ["", title, *_table(MEANS + INTERVALS * stated, groups)]
    title = "DTW in a band of 1 s: mean absolute difference after warping, in units and scaled"
    lines += ["", title, *_table(WARPED, groups), *[f"note: {note}" for note in summary["notes"]]]
    return "\n".join(lines)


def _scored(summary: Mapping[str, Any]) -> str:
    longest = summary["scored"][-1]
    return f"{summary['test_logs']} test logs, {longest['rows']:,} rows at the longest horizon"


def _heading(row: Mapping[str, Any], yardstick: str) -> str:
    seeds = "1 seed" if row["seeds"] == 1 else f"{row['seeds']} seeds"
    ratio = "" if row["name"] == yardstick else f" ({row['flops_ratio']:.3g} of {yardstick}'s)"
    return f"{row['name']}: {seeds}, {row['parameters']:,} parameters, {row['flops_per_tick']:,} FLOPs a tick{ratio}"


def _table(columns: Sequence[Column], groups: Sequence[tuple[str, Sequence[Mapping[str, Any]]]]) -> list[str]:
    width = (LINE - LABEL) // len(columns)

    def line(label: str, cells: Iterable[str]) -> str:
        return (f"{label:{LABEL}}" + "".join(f" {cell:>{width - 1}}" for cell in cells)).rstrip()

    lines = [line("", (column.title for column in columns)), line("", (column.unit for column in columns))]
    for heading, rows in groups:
        lines.append(heading)
        lines += [line(f"  {row['horizon_s']:g} s", (_cell(row, column) for column in columns)) for row in rows]
    return lines


def _cell(row: Mapping[str, Any], column: Column) -> str:
    cell = row.get(column.score)
    if cell is None:
        return "\N{EN DASH}"
    value = cell["mean"] * column.factor
    digits = 0 if abs(value) >= 1000 else 1 if abs(value) >= 100 else 2 if abs(value) >= 10 else 3
    text = f"{value:.{digits}f}" if abs(value) >= 0.0005 or value == 0 else f"{value:.0e}"
    if cell["interval"] is None:
        return text
    low, high = cell["interval"]
    return f"{text} \N{PLUS-MINUS SIGN}{(high - low) / 2 * column.factor:.{digits}f}"
