"""Commands that evaluate or show the motion of a fin: ``evaluate`` and ``explore``."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from softfin.cli.common import (
    AnyPlant,
    Armed,
    Common,
    Configured,
    ControllerFolder,
    File,
    ForcePair,
    Out,
    PlantName,
    ReferenceFile,
    Repeats,
    progress,
)
from softfin.core.errors import ConfigurationError
from softfin.core.quantities import AXES
from softfin.storage import artifact as artifacts
from softfin.storage.registry import is_live

if TYPE_CHECKING:
    from softfin.evaluation.results import ErrorMapRows, EvaluationSummary, MovingRow, RangeErrors


class EvaluateArguments(Armed, Configured):
    """Evaluate a controller on a fin over reference forces (paper Sec. IV-B, Table II)."""

    controller: ControllerFolder
    """Controller folder."""
    out: Out
    """Output folder for evaluation.json and the figures."""
    plant: AnyPlant = "tank"
    """The fin. Simulated: tank, a tank's YAML file, a surrogate's folder, or package.module:plant.
    Real: rig or ros2, optionally followed by :FILE."""
    reference: tuple[ForcePair, ...] = ()
    """Reference force [N], such as --reference=1,-0.5 (default: the paper's six)."""
    seconds: int | None = None
    """Length of each experiment [s] (default: 30)."""
    repeats: Repeats | None = None
    """Repetitions of each experiment (default: 5)."""
    seed: int | None = None
    """Seed for the plant's noise (default: 0)."""
    strict: bool = False
    """Reject unreachable references instead of tracking the nearest reachable one."""
    trim: bool = False
    """Add force feedback, which removes the steady-state error of the measured mean force."""
    randomize: float | None = None
    """Perturb the tank's parameters in each repetition, by up to this fraction (tank only)."""
    moving: bool = False
    """Also evaluate four steps of the reference within the controller's range."""
    reference_file: ReferenceFile | None = None
    """Also evaluate a recorded reference: .csv or .parquet with the columns time_s, force_x_n,
    force_y_n. Each row holds until the next one."""
    error_map: bool = False
    """Plot the error over the controller's range, at 7 x 7 references; use --set error_map=N for N
    x N."""
    random: int | None = None
    """Also evaluate this many random references within the reachable part of the training range."""

    def check(self) -> None:
        """Reject options that do not apply to the plant."""
        super().check()
        if is_live(self.plant) and self.randomize is not None:
            raise ConfigurationError(
                f"--randomize {self.randomize:g}: requires the virtual tank as plant, got "
                f"{self.plant!r}; omit --randomize"
            )
        if self.arm and not is_live(self.plant):
            raise ConfigurationError(
                f"--arm: {self.plant} is simulated; omit --arm, or use --plant rig"
            )

    def __call__(self) -> None:
        from softfin.cli.driving import KeyboardStop, say
        from softfin.evaluation.evaluate import EvaluateConfig
        from softfin.evaluation.range_errors import LATTICE_POINTS
        from softfin.stages.evaluation import evaluate
        from softfin.stages.live import evaluate_live
        from softfin.stages.machines import find_robot
        from softfin.task.signals import read_reference_file

        recorded = (
            None
            if self.reference_file is None
            else read_reference_file(self.reference_file).model_dump()
        )
        config = self.configured(
            EvaluateConfig(),
            references=self.reference,
            recorded=recorded,
            strict=self.strict or None,
            moving=self.moving or None,
            seeds=self.repeats,
        )
        if self.error_map and config.error_map is None:
            config = config.merged({"error_map": LATTICE_POINTS}, "options")
        if self.trim and config.trim is None:
            config = config.merged({"trim": {}}, "options")
        if is_live(self.plant):
            robot = find_robot(self.plant)
            keys = KeyboardStop(self.confirm)
            with progress() as report:
                summary = evaluate_live(
                    self.controller,
                    robot,
                    self.out,
                    config,
                    keys.confirm,
                    stop=keys.stop,
                    warn=say,
                    overwrite=self.overwrite,
                    progress=report,
                )
        else:
            summary = evaluate(
                self.controller,
                self.plant,
                self.out,
                config,
                randomize=self.randomize,
                overwrite=self.overwrite,
            )
        self.tell(summary, evaluation_tables(summary))


def evaluation_tables(summary: "EvaluationSummary") -> str:
    """Return Table II, followed by the parts of the evaluation that were requested."""
    from softfin.cli.tables import table_two
    from softfin.evaluation.headline import error_decimals

    decimals = error_decimals(summary)
    lines = [table_two({summary["conditions"]["kind"]: summary})]
    if "moving" in summary:
        lines.append(moving_table(summary["moving"], decimals))
    if "error_map" in summary:
        lines.append(map_line(summary["error_map"], decimals))
    if "random" in summary:
        count = len(summary["random"]["errors_n"])
        errors = _range_errors(summary["random"], decimals)
        lines.append(f"{count} random references: {errors}")
    if summary["warning"] is not None:
        lines.append(f"warning: {summary['warning']}")
    return "\n".join(lines)


def moving_table(rows: "Sequence[MovingRow]", decimals: int) -> str:
    """Return one line per moving reference: its errors, and the longest settling time of its steps
    over all seeds."""
    from softfin.cli.tables import aligned
    from softfin.evaluation.headline import settling_time

    cells = [["moving references", "x error", "y error", "settles in"]]
    for row in rows:
        errors = [f"{row[axis]['error_n']:.{decimals}f}" for axis in AXES]
        cells.append([f"  {row['described']}", *errors, settling_time(row) or "-"])
    return "\n".join(aligned(cells))


def map_line(errors: "ErrorMapRows", decimals: int) -> str:
    """Return the error map as one line."""
    (x0, y0) = errors["low_n"]
    (x1, y1) = errors["high_n"]
    gaps = ""
    if errors["not_covered"]:
        gaps += f", {errors['not_covered']} not covered"
    if errors["not_reachable"]:
        gaps += f", {errors['not_reachable']} unreachable"
    return (
        f"error map, {errors['points']} x {errors['points']} references over x {x0:g} .. {x1:g}, y "
        f"{y0:g} .. {y1:g} N{gaps}: {_range_errors(errors, decimals)}"
    )


def _range_errors(errors: "RangeErrors", decimals: int) -> str:
    """Return the errors at many references as text."""
    mean, p95, worst = (
        ", ".join(f"{error:.{decimals}f}" for error in pair)
        for pair in (errors["mean_n"], errors["p95_n"], errors["worst_n"])
    )
    return f"error x, y mean {mean}, 95% within {p95}, worst {worst} N"


class ExploreArguments(Common):
    """Write an HTML page that shows a fin and its force in a browser: drag the target force and
    watch a controller follow it, or move the fin by hand. The page works offline."""

    controllers: tuple[ControllerFolder, ...] = ()
    """Controller folders (default: none, to move the fin by hand only). For a surrogate, use
    --plant."""
    out: File
    """File to write (.html)."""
    plant: tuple[PlantName, ...] = ("tank",)
    """The fin: tank, a tank's YAML file, or the folder of a streaming surrogate. With several, the
    page can switch between them."""

    def check(self) -> None:
        """Reject an output file that is not HTML."""
        super().check()
        if self.out.suffix != ".html":
            raise ConfigurationError(f"--out {self.out}: must end in .html")
        artifacts.check_file(self.out, self.overwrite)

    def __call__(self) -> None:
        from softfin.stages.explore import explore

        summary = explore(self.controllers, self.out, self.plant, overwrite=self.overwrite)
        held = ", ".join(summary["controllers"]) or "no controller"
        moved = ", ".join(summary["plants"])
        self.tell(
            summary,
            f"{self.out}: {held} in {moved}, {summary['bytes'] / 1e6:.1f} MB; open it in a browser",
        )
