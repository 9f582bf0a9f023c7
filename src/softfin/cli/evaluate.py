"""``softfin evaluate``: a controller and a plant in, Table II and figures out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from softfin.cli.common import Armed, Configured
from softfin.cli.kinds import AnyPlant, Controller, Force, Out, ReferenceFile
from softfin.core.choices import MovingReference
from softfin.core.errors import ConfigurationError
from softfin.storage.registry import is_live


@dataclass(frozen=True, kw_only=True)
class Arguments(Armed, Configured):
    """Evaluate a controller on a fin over reference forces (paper Sec. IV-B, Table II)."""

    controller: Controller
    """Folder of the controller."""
    out: Out
    """Folder to write evaluation.json and the figures to."""
    plant: AnyPlant = "tank"
    """The fin: tank, a tank's YAML, the folder of a surrogate, package.module:plant; or a real one: rig, ros2, or
    one of these with :FILE."""
    reference: tuple[Force, ...] = ()
    """Reference force as --reference=X,Y in newton, once for each (the paper's six)."""
    seconds: int | None = None
    """Length of each experiment (30)."""
    seeds: int | None = None
    """Repetitions (5)."""
    seed: int | None = None
    """Seed of the plant's noise (0)."""
    strict: bool = False
    """Refuse a reference that the fin cannot make; else the nearest one that it can make is tracked, with a warning."""
    trim: bool = False
    """Add a slow outer loop that cancels the steady-state force error, from the measured mean force."""
    randomize: float | None = None
    """With the tank: each repetition in another one, material, water and servo within this part of theirs, from 0 (the
    same tank) to less than 1, such as 0.15."""
    moving: tuple[MovingReference, ...] = ()
    """References that move too, within the controller's range: --moving step, --moving ramp, --moving sine."""
    reference_file: ReferenceFile | None = None
    """Another that moves: .csv or .parquet with time_s, force_x_n, force_y_n, each row held until the next one."""
    error_map: bool = False
    """Draw the error over the whole range of the controller, 7 x 7 references; --set error_map=N for N x N."""
    random: int | None = None
    """Evaluate it on so many random references, too, over all that it was trained for and the fin can make."""

    def check(self) -> None:
        """Refuse options that do not go with the plant."""
        super().check()
        if is_live(self.plant):
            if self.randomize is not None:
                raise ConfigurationError(
                    f"--randomize {self.randomize:g} needs the virtual tank as plant, got {self.plant!r}; leave it out"
                )
        elif self.arm:
            raise ConfigurationError(f"--arm: {self.plant} is not a real fin; leave it out, or give --plant rig")

    def run(self) -> None:
        """Evaluate."""
        from softfin.cli.tables import table_two
        from softfin.evaluation.evaluate import EvaluateConfig
        from softfin.evaluation.range_errors import LATTICE_POINTS
        from softfin.rig.robot_setup import find_robot
        from softfin.stages.evaluate import evaluate, kind_of
        from softfin.stages.live import evaluate_live
        from softfin.task.signals import read_reference_file

        recorded = None if self.reference_file is None else read_reference_file(self.reference_file).model_dump()
        config = self.configured(
            EvaluateConfig(), references=self.reference, recorded=recorded, strict=self.strict or None
        )
        if self.error_map and config.error_map is None:
            config = config.merged({"error_map": LATTICE_POINTS}, "options")
        if self.trim and config.trim is None:
            config = config.merged({"trim": {}}, "options")
        if is_live(self.plant):
            robot = find_robot(self.plant)
            summary = self.stage(evaluate_live, self.controller, robot, self.out, config, self.confirm)
        else:
            summary = evaluate(
                self.controller, self.plant, self.out, config, randomize=self.randomize, overwrite=self.overwrite
            )
        lines = [table_two({kind_of(self.controller): summary})]
        lines += [moving_table(summary["moving"])] if "moving" in summary else []
        lines += [map_line(summary["error_map"])] if "error_map" in summary else []
        lines += [random_line(summary["random"])] if "random" in summary else []
        lines += [] if summary["warning"] is None else [f"warning: {summary['warning']}"]
        self.tell(summary, "\n".join(lines))


def moving_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a line for every signal: errors, and the longest settling time of its steps over all seeds."""
    from softfin.cli.tables import aligned

    cells = [["references that move", "x error", "y error", "settles in"]]
    for row in rows:
        settling = {None: "-", True: f"{row['longest_settling_s']} s", False: "never"}[row["settles"]]
        cells.append([f"  {row['described']}", *(f"{row[axis]['error_n']:.3f}" for axis in "xy"), settling])
    return "\n".join(aligned(cells))


def map_line(errors: Mapping[str, Any]) -> str:
    """Return the error map in one line."""
    (x0, y0), (x1, y1) = errors["low_n"], errors["high_n"]
    counts = {"not covered": errors["not_covered"], "beyond the fin's reach": errors["not_reachable"]}
    gaps = "".join(f", {count} {what}" for what, count in counts.items() if count)
    return (
        f"error map, {errors['points']} x {errors['points']} references over x {x0:g} .. {x1:g}, y {y0:g} .. {y1:g} N"
        f"{gaps}: mean {errors['mean_x_n']:.3f}, {errors['mean_y_n']:.3f}, worst {errors['worst_x_n']:.3f}, "
        f"{errors['worst_y_n']:.3f} N"
    )


def random_line(errors: Mapping[str, Any]) -> str:
    """Return the errors over random references in one line."""
    words = (f"{name} " + ", ".join(f"{errors[axis][key]:.3f}" for axis in "xy")
             for name, key in (("mean", "mean_n"), ("95% within", "p95_n"), ("worst", "worst_n")))  # fmt: skip
    return f"{errors['count']} random references: error x, y {', '.join(words)} N"
